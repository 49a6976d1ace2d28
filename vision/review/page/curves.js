/* Curves on the diagram's time axis, the displacement of the chosen sheets and the force, and the deformation in one stick. */

import { getBytes, Store } from "./server.js";
import { colours, curveThrough, line, steps, Surface, timeAxis, timeCursor, wrapped } from "./surface.js";

const CASES = { one: 0, near: 2 }; // sheets on either side of the chosen one

export class Displacement {
  constructor(canvas, view, tiles, page) {
    this.view = view; this.tiles = tiles; this.page = page; this.which = "near";
    this.surface = new Surface(canvas, { left: 58, right: 8, top: 4, bottom: 6 }, (s, c, colour) => this.draw(s, c, colour));
    alongTime(this.surface, view);
  }

  redraw() { this.surface.redraw(); }

  sheets() {
    const { sheets } = this.page.state, { sheet } = this.view;
    if (this.which in CASES) return sheets.filter((s) => Math.abs(s.index - sheet) <= CASES[this.which]);
    if (this.which === "all") return sheets;
    return sheets.filter((s) => (this.which === "left") === s.side < 0);
  }

  draw(s, c, colour) {
    const { view, tiles } = this, sheets = this.sheets();
    const blocks = tiles.tracks(tiles.level((view.last - view.first) / s.plotWidth), view.first, view.last);
    const [low, high] = this.range(blocks, sheets);
    const y = s.yAxis(low, high, "δx (px)"), x = timeAxis(s, view, false);
    s.clipped(() => {
      const order = [...sheets].sort((a, b) => (a.index === view.sheet) - (b.index === view.sheet));
      const rows = joined(blocks, view);
      for (const { index, side, x_px: mean } of order) {
        const chosen = index === view.sheet;
        c.strokeStyle = chosen ? colour.text : side < 0 ? colour.left : colour.right;
        curveThrough(c, 0, rows.length, (k) => [x(rows[k].frame), y(rows[k].block.column(rows[k].row, index) - mean)], chosen ? 2.4 : 1.1);
      }
      this.effect(c, x, y, colour);
    });
    s.frame();
    timeCursor(s, x, view, colour.cursor);
  }

  effect(c, x, y, colour) {
    for (const { sheet, frames, x_px: columns } of this.view.effect?.curves ?? []) {
      const mean = this.page.state.sheets[sheet]?.x_px;
      if (mean == null) continue;
      c.strokeStyle = colour.new; c.lineWidth = 2.2; c.setLineDash([5, 3]); c.beginPath();
      let pen = false;
      frames.forEach((frame, i) => {
        if (columns[i] == null) { pen = false; return; }
        c[pen ? "lineTo" : "moveTo"](x(frame + 0.5), y(columns[i] - mean)); pen = true;
      });
      c.stroke(); c.setLineDash([]);
    }
  }

  range(blocks, sheets) {
    let low = Infinity, high = -Infinity;
    for (const block of blocks) for (let row = 0; row < block.rows; row++) {
      if (block.frame(row) < this.view.first - 1 || block.frame(row) > this.view.last + 1) continue;
      for (const sheet of sheets) {
        const away = block.column(row, sheet.index) - sheet.x_px;
        if (away < low) low = away;
        if (away > high) high = away;
      }
    }
    if (!(low <= high)) return [-1, 1];
    const margin = Math.max(0.05, 0.06 * (high - low));
    return [low - margin, high + margin];
  }
}

/** Rows of several blocks about the range shown, one after the other. */
function joined(blocks, view) {
  const rows = [];
  for (const block of blocks) {
    const [from, to] = block.between(view.first, view.last);
    for (let row = from; row < to; row++) rows.push({ block, row, frame: block.frame(row) + 0.5 });
  }
  return rows;
}

/** Wheel, drag and click of a picture that has time along x. */
function alongTime(surface, view, grab = () => null) {
  const frame = (p) => view.first + ((p.x - surface.left) * (view.last - view.first)) / surface.plotWidth;
  surface.handle({
    begin: () => ({ first: view.first, last: view.last, tool: grab() }),
    drag: (held, dx) => {
      const frames = (dx * (held.last - held.first)) / surface.plotWidth;
      if (held.tool) held.tool(view.seconds(view.first + frames) - view.seconds(view.first));
      else view.setFrames(held.first - frames, held.last - frames);
    },
    click: (p) => view.goTo(Math.floor(frame(p))),
    whole: () => view.whole(),
    zoom: (factor, p) => view.zoomFrames(factor, frame(p)),
  });
}

/** The force recording on its own clock: coarse as a whole at once, finer where it is looked at. */
export class ForceRecording {
  constructor(arrived) {
    this.coarse = true; // while the program has not read the run
    this.parts = new Store(async (key) => {
      const rows = new Float64Array(await getBytes(`api/force?points=4096${key}`));
      return { count: rows.length / 3, time: (k) => rows[3 * k], load: (k) => rows[3 * k + 1] };
    }, arrived, 40);
  }

  /** The load between two times of the force clock, in as many points as can be seen; null until it is there. */
  between(from, to) {
    const whole = this.parts.get("");
    if (!whole?.count || this.coarse) return whole;
    // stretches on a grid of powers of two, so that panning asks rarely
    const span = 2 ** Math.ceil(Math.log2(Math.max(1e-3, to - from))), first = Math.floor(from / span) * span;
    if (2 * span >= whole.time(whole.count - 1) - whole.time(0)) return whole;
    return this.parts.get(`&first_s=${first}&stop_s=${first + 2 * span}`) ?? whole;
  }
}

export class Force {
  constructor(canvas, view, page) {
    this.view = view; this.page = page;
    this.surface = new Surface(canvas, { left: 58, right: 8, top: 4, bottom: 20 }, (s, c, colour) => this.draw(s, c, colour));
    alongTime(this.surface, view, () => view.tool?.slide?.() ?? null);
  }

  redraw() { this.surface.redraw(); }

  draw(s, c, colour) {
    const { view, page } = this, clock = page.clock(), rate = 1 + 1e-6 * (clock.drift_ppm ?? 0);
    const toForce = (seconds) => clock.offset_s + rate * seconds;
    const from = toForce(view.seconds(view.first)), to = toForce(view.seconds(view.last));
    const x = timeAxis(s, view, true);
    const force = page.force.between(from, to);
    let low = Infinity, high = -Infinity;
    for (let k = 0; k < (force?.count ?? 0); k++) {
      if (force.time(k) < from || force.time(k) > to) continue;
      if (force.load(k) < low) low = force.load(k);
      if (force.load(k) > high) high = force.load(k);
    }
    if (!(low <= high)) [low, high] = [0, 1];
    const margin = 0.06 * (high - low) || 1;
    low -= margin; high += margin;
    const y = s.yAxis(low, high, "F (N)");
    s.clipped(() => {
      if (view.tool?.slide) this.slips(s, c, x, colour);
      if (force) {
        c.strokeStyle = colour.accent;
        const place = (time) => x(view.frameAt((time - clock.offset_s) / rate));
        let begin = 0, end = force.count;
        while (begin < end && force.time(begin + 1) < from) begin++;
        while (end > begin + 1 && force.time(end - 2) > to) end--;
        curveThrough(c, begin, end, (k) => [place(force.time(k)), y(force.load(k))], 1.3);
      }
      if (!force) {
        const why = page.force.parts.why("");
        c.fillStyle = colour.soft; c.textAlign = "center"; c.textBaseline = "middle";
        wrapped(c, why ? `The force is not shown: ${why}` : "reading …", s.left, s.plotWidth, s.top + s.plotHeight / 2, s.size * 1.3);
      }
    });
    s.frame();
    timeCursor(s, x, view, colour.cursor);
  }

  /** Where the film shows slips: the force must drop there. */
  slips(s, c, x, colour) {
    c.strokeStyle = colour.right; c.lineWidth = 1; c.setLineDash([3, 3]);
    for (const frame of this.page.filmSlips) {
      const at = Math.round(x(frame)) + 0.5;
      line(c, at, s.top, at, s.top + s.plotHeight);
    }
    c.setLineDash([]);
  }
}

/** σ_x/Λ_st against n in one stick phase. */
export class Stick {
  constructor(canvas, view, page) {
    this.view = view; this.page = page;
    this.surface = new Surface(canvas, { left: 46, right: 8, top: 4, bottom: 34 }, (s, c, colour) => this.draw(s, c, colour));
    canvas.addEventListener("click", (event) => {
      const sheet = this.nearest(this.surface.pointer(event).x);
      if (sheet) view.choose(sheet.index);
    });
  }

  redraw() { this.surface.redraw(); }

  /** Left sheets at −n, right ones at +n. */
  place(s) {
    const most = Math.max(1, ...this.page.state.sheets.map((sheet) => sheet.n)) + 0.8;
    return (sheet) => s.left + s.plotWidth * (0.5 + (sheet.side * sheet.n) / (2 * most));
  }

  nearest(x) {
    const place = this.place(this.surface);
    return this.page.state.sheets.reduce((best, sheet) => (!best || Math.abs(place(sheet) - x) < Math.abs(place(best) - x) ? sheet : best), null);
  }

  draw(s, c, colour) {
    const { page, view } = this, before = page.stick(view.frame), threshold = page.state.threshold;
    const other = view.effect?.stick, after = other && (!before || other.event === before.event) ? other : null;
    const x = this.place(s);
    if (!before?.sheets.length && !after) {
      c.fillStyle = colour.soft; c.textAlign = "center"; c.textBaseline = "middle";
      wrapped(c, before?.reason ?? page.noStick(), 0, s.width, s.height / 2, s.size * 1.3); return;
    }
    // what is far off before or after must not flatten what is right: it is marked at the edge
    const [values, others] = [after ?? before, before ?? after].map((stick) => stick.sheets.map((one) => one.ratio).filter(Number.isFinite));
    const high = Math.max(2.2 * threshold, 1.12 * Math.min(Math.max(0, ...values), Math.max(0, ...others)));
    const y = s.yAxis(Math.min(-0.04 * high, 1.1 * Math.min(0, ...values)), high, "σₓ/Λₛₜ");
    this.nAxis(s, c, colour, x);
    const chosen = page.state.sheets[view.sheet];
    if (chosen) { c.fillStyle = colour.grid; c.globalAlpha = 0.8; c.fillRect(x(chosen) - 4, s.top, 8, s.plotHeight); c.globalAlpha = 1; }
    c.strokeStyle = colour.text; c.setLineDash([6, 4]); c.lineWidth = 1.4; line(c, s.left, y(threshold), s.left + s.plotWidth, y(threshold)); c.setLineDash([]);
    c.fillStyle = colour.text; c.textAlign = "center"; c.textBaseline = "bottom"; c.fillText(`threshold ${threshold}`, s.left + s.plotWidth / 2, y(threshold) - 2);
    s.clipped(() => {
      this.points(c, before?.sheets ?? [], x, y, (one) => (one.side < 0 ? colour.left : colour.right), after ? 0.45 : 1);
      if (after) this.points(c, after.sheets, x, y, () => colour.new, 1, 1.4);
    });
    s.frame();
  }

  nAxis(s, c, colour, x) {
    const sheets = this.page.state.sheets, most = Math.max(1, ...sheets.map((sheet) => sheet.n));
    const [ticks] = steps(0, most, Math.max(2, s.plotWidth / 75)), bottom = s.top + s.plotHeight;
    c.textAlign = "center"; c.textBaseline = "top"; c.fillStyle = colour.soft; c.strokeStyle = colour.line; c.lineWidth = 1;
    for (const side of [-1, 1]) for (const n of ticks) {
      if (n < 1) continue;
      const at = x({ side, n });
      line(c, at, bottom, at, bottom + 3); c.fillText(n, at, bottom + 4);
    }
    c.fillStyle = colour.text; c.fillText("←  left      sheet n      right  →", s.left + s.plotWidth / 2, bottom + 4 + s.size * 1.2);
  }

  /** Circles on the left, squares on the right, open where the sheet is stiff. */
  points(c, sheets, x, y, ink, alpha, grow = 1) {
    c.globalAlpha = alpha;
    for (const one of sheets) {
      if (!Number.isFinite(one.ratio)) continue;
      const px = x(one), py = y(one.ratio), r = 2.8 * grow, { top } = this.surface;
      if (py < top) { c.fillStyle = ink(one); c.beginPath(); c.moveTo(px, top + 1); c.lineTo(px - 4, top + 9); c.lineTo(px + 4, top + 9); c.fill(); continue; }
      c.strokeStyle = c.fillStyle = ink(one); c.lineWidth = 1;
      if (Number.isFinite(one.ratio_err)) line(c, px, y(one.ratio - one.ratio_err), px, y(one.ratio + one.ratio_err));
      c.beginPath();
      if (one.side < 0) c.arc(px, py, r, 0, 7); else c.rect(px - r, py - r, 2 * r, 2 * r);
      if (one.shell === "stiff") { c.fillStyle = colours().card; c.fill(); c.lineWidth = 1.6; c.stroke(); } else c.fill();
    }
    c.globalAlpha = 1;
  }
}
