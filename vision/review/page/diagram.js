/* The space-time diagram: tiles from the server, tracks upon them, zoom and pan. */

import { getBytes, getImage, Store } from "./server.js";
import { edged, line, NEAR_PX, ON_GREY, Surface, timeAxis, timeCursor } from "./surface.js";

const BESIDE = 0.25; // of the range shown is drawn beside it, too, while it moves
const STRETCH = 1.5; // so far a drawing of the tracks is stretched before they are drawn anew
const WAIT_MS = 150; // so long tracks that have arrived wait to be drawn while the range moves

/** Tracks of a stretch of time: rows of a frame's number and every sheet's column; in coarse blocks each interval has two rows, its extremes. */
class Block {
  constructor(bytes, width, from, to) {
    Object.assign(this, { width, from, to, rows: bytes.byteLength / 4 / width });
    this.values = new Float32Array(bytes);
    this.paths = [];
  }

  frame(row) { return this.values[row * this.width]; }
  column(row, sheet) { return this.values[row * this.width + 1 + sheet]; }

  /** The sheet's curve with frames since `from` along x and columns along y. */
  path(sheet) {
    if (this.paths[sheet]) return this.paths[sheet];
    const path = new Path2D();
    let pen = false;
    for (let row = 0; row < this.rows; row++) {
      const column = this.column(row, sheet), x = this.frame(row) - this.from + 0.5;
      if (Number.isNaN(column)) { pen = false; continue; }
      if (!pen) path.moveTo(x - 0.45, column);
      path.lineTo(x, column);
      pen = true;
    }
    return (this.paths[sheet] = path);
  }

  /** Rows between two frames, [from, to). */
  between(first, last) {
    let from = 0, to = this.rows;
    while (from < to && this.frame(from + 1) < first) from++;
    while (to > from + 1 && this.frame(to - 2) > last) to--;
    return [from, to];
  }

  /** Joins the sheet's curve to that of the block before. */
  join(path, sheet, before) {
    if (before?.to !== this.from || !before.rows || !this.rows) return;
    const from = before.column(before.rows - 1, sheet), to = this.column(0, sheet);
    if (Number.isNaN(from + to)) return;
    path.moveTo(before.frame(before.rows - 1) - this.from + 0.5, from); path.lineTo(this.frame(0) - this.from + 0.5, to);
  }
}

/** The sheet's curve through several blocks; `matrix` of a block gives frames and columns their place. */
function curve(blocks, sheet, matrix) {
  const path = new Path2D();
  blocks.forEach((block, i) => {
    const m = matrix(block), joint = new Path2D();
    path.addPath(block.path(sheet), m);
    block.join(joint, sheet, blocks[i - 1]);
    path.addPath(joint, m);
  });
  return path;
}

/** Pictures and tracks of the whole test in tiles, on levels that are coarser by `factor` in time each. */
export class Tiles {
  constructor(run, arrived) {
    const { rows, columns, factor, levels } = run.tiles;
    Object.assign(this, { run, rows, columns, factor, levels, width: run.columns, revision: 0 });
    this.arrivals = 0;
    const drawn = () => { this.arrivals += 1; arrived(); };
    this.pictures = new Store((key) => getImage(`api/kymograph/${key}.png`), arrived, 160);
    this.counts = new Map(); // revision to number of sheets
    this.blocks = new Store(async (key) => {
      const [revision, level, i] = key.split("/").map(Number);
      const from = this.begin(level, i), to = Math.min(this.begin(level, i + 1), run.first_frame + run.frames);
      const bytes = await getBytes(`api/tracks?first=${from}&stop=${to}&points=${2 * rows}`);
      return new Block(bytes, 1 + this.counts.get(revision), from, to);
    }, drawn, 160);
  }

  /** The tracks are others from now on. */
  use(revision, sheets) { this.revision = revision; this.counts.set(revision, sheets); }

  /** Frames of one row of a level. */
  step(level) { return this.factor ** level; }

  /** The first frame of a tile. */
  begin(level, i) { return this.run.first_frame + i * this.rows * this.step(level); }

  level(framesPerPixel) {
    const level = Math.log(Math.max(framesPerPixel, 1e-9)) / Math.log(this.factor);
    return Math.max(0, Math.min(this.levels - 1, Math.round(level)));
  }

  /** Tiles of a level along time between two frames. */
  *along(level, first, last) {
    const span = this.rows * this.step(level), origin = this.run.first_frame;
    const begin = Math.max(0, Math.floor((first - origin) / span));
    const end = Math.ceil((Math.min(last, origin + this.run.frames) - origin) / span);
    for (let i = begin; i < end; i++) yield i;
  }

  /** The coarsest level of the whole test is shown until the tiles have arrived. */
  holdCoarsest() {
    const level = this.levels - 1, across = Math.ceil(this.width / this.columns);
    for (let j = 0; j < across; j++) this.pictures.get(`${level}/${j}/0`);
    this.blocks.get(`${this.revision}/${level}/0`);
  }

  /** Blocks of tracks that cover the frames, coarser ones where the right ones are still on their way. */
  tracks(level, first, last) {
    const found = [];
    for (const i of this.along(level, first, last)) {
      const block = this.blocks.get(`${this.revision}/${level}/${i}`);
      if (block) found.push(block);
      else this.standIn(found, level, i);
    }
    return found;
  }

  standIn(found, level, i) {
    for (let up = level + 1, k = i; up < this.levels; up++) {
      k = Math.floor(k / this.factor);
      const block = this.blocks.peek(`${this.revision}/${up}/${k}`);
      if (block) { if (!found.includes(block)) found.push(block); return; }
    }
  }

  /** Function sheet → its column in one frame, NaN where it has none; null while it is on its way. */
  at(frame) {
    const row = frame - this.run.first_frame, block = this.blocks.get(`${this.revision}/0/${Math.floor(row / this.rows)}`);
    return block && ((sheet) => block.column(row % this.rows, sheet));
  }
}

/** Whether a drawing holds the range, not stretched too far. */
function within({ first, last, low, high, frames, columns }, view) {
  const like = (one, other) => one < STRETCH * other && other < STRETCH * one;
  return first <= view.first && view.last <= last && low <= view.low && view.high <= high
    && like(view.last - view.first, frames) && like(view.high - view.low, columns);
}

export class Diagram {
  constructor(canvas, view, tiles, page) {
    this.view = view; this.tiles = tiles; this.page = page; this.tracksShown = true;
    this.sketch = null; // the tracks as drawn last while the range moves
    this.surface = new Surface(canvas, { left: 58, right: 8, top: 4, bottom: 20 }, (s, c, colour) => this.draw(s, c, colour));
    this.listen();
  }

  redraw() { this.surface.redraw(); }

  places() {
    const { surface: s, view } = this;
    const perFrame = s.plotWidth / (view.last - view.first), perColumn = s.plotHeight / (view.high - view.low);
    return {
      perFrame, perColumn,
      x: (frame) => s.left + (frame - view.first) * perFrame,
      y: (column) => s.top + s.plotHeight - (column - view.low) * perColumn,
      frame: (x) => view.first + (x - s.left) / perFrame,
      column: (y) => view.low + (s.top + s.plotHeight - y) / perColumn,
    };
  }

  draw(s, c, colour) {
    const { view, tiles } = this, at = this.places();
    const level = tiles.level(1 / (at.perFrame * s.scale));
    tiles.holdCoarsest();
    s.clipped(() => {
      c.fillStyle = colour.grid; c.fillRect(s.left, s.top, s.plotWidth, s.plotHeight);
      this.pictures(c, at, level);
      if (this.tracksShown) this.tracks(c, at);
      this.marks(c, at);
    });
    s.yAxis(view.low, view.high, "x (px)", { grid: false });
    const place = timeAxis(s, view, true);
    s.frame();
    timeCursor(s, place, view, "#ffffff", "rgba(0,0,0,0.7)");
  }

  /** Tiles hold time downwards; here it runs to the right and columns upwards. */
  pictures(c, at, level) {
    const { tiles, view, surface: s } = this, first = tiles.run.first_column - 0.5;
    const across = Math.ceil(tiles.width / tiles.columns);
    for (const i of tiles.along(level, view.first, view.last)) for (let j = 0; j < across; j++) {
      const left = first + j * tiles.columns;
      if (left > view.high || left + tiles.columns < view.low) continue;
      let picture = tiles.pictures.get(`${level}/${j}/${i}`), l = level, k = i;
      while (!picture && l < tiles.levels - 1) { l += 1; k = Math.floor(k / tiles.factor); picture = tiles.pictures.peek(`${l}/${j}/${k}`); }
      if (!picture) continue;
      const begin = tiles.begin(l, k), step = tiles.step(l);
      const from = Math.max(tiles.begin(level, i), begin), to = Math.min(tiles.begin(level, i + 1), begin + picture.height * step);
      const sy = (from - begin) / step, high = (to - from) / step;
      c.save();
      c.transform(0, -at.perColumn, at.perFrame * step, 0, at.x(from), at.y(left));
      c.imageSmoothingEnabled = at.perFrame * step * s.scale < 1.5 || at.perColumn * s.scale < 1.5;
      c.drawImage(picture, 0, sy, picture.width, high, 0, 0, picture.width, high);
      c.restore();
    }
  }

  /** Lines are slow to draw: while the range moves they are drawn now and then, and stretched in between. */
  tracks(c, at) {
    const { view, tiles } = this;
    if (view.settled) { this.sketch = null; this.lines(c, at, tiles.level(1 / at.perFrame), view); return; }
    const key = `${tiles.revision} ${view.sheet}`, old = this.sketch;
    const late = old && old.arrivals !== tiles.arrivals && performance.now() - old.when > WAIT_MS;
    if (!old || late || old.key !== key || !within(old, view)) this.sketch = this.drawn(key, at);
    const { canvas, first, last, low, high } = this.sketch;
    const x = at.x(first), y = at.y(high);
    c.imageSmoothingEnabled = true;
    c.drawImage(canvas, x, y, at.x(last) - x, at.y(low) - y);
  }

  /** The tracks of the range and what lies beside it, on a canvas of their own. */
  drawn(key, at) {
    const { view, tiles, surface: s } = this, width = view.last - view.first, height = view.high - view.low;
    const range = { first: view.first - BESIDE * width, last: view.last + BESIDE * width, low: view.low - 0.1 * height, high: view.high + 0.1 * height };
    const canvas = this.sketch?.canvas ?? document.createElement("canvas");
    canvas.width = (range.last - range.first) * at.perFrame * s.scale; canvas.height = (range.high - range.low) * at.perColumn * s.scale;
    const c = canvas.getContext("2d");
    c.scale(s.scale, s.scale);
    this.lines(c, { ...at, x: (frame) => (frame - range.first) * at.perFrame, y: (column) => (range.high - column) * at.perColumn }, tiles.level(tiles.factor / at.perFrame), range);
    return { key, canvas, ...range, frames: width, columns: height, arrivals: tiles.arrivals, when: performance.now() };
  }

  lines(c, at, level, range) {
    const { view, tiles, page } = this, blocks = tiles.tracks(level, range.first, range.last);
    const groups = { left: new Path2D(), right: new Path2D(), chosen: new Path2D() };
    const matrix = (block) => new DOMMatrix([at.perFrame, 0, 0, -at.perColumn, at.x(block.from), at.y(0)]);
    const reach = 2 * page.state.pitch_px;
    for (const sheet of page.state.sheets) {
      if (sheet.x_px < range.low - reach || sheet.x_px > range.high + reach) continue;
      const name = sheet.index === view.sheet ? "chosen" : sheet.side < 0 ? "left" : "right";
      groups[name].addPath(curve(blocks, sheet.index, matrix));
    }
    const apart = at.perColumn * page.state.pitch_px, thin = apart < 12 ? 0.8 : apart < 40 ? 1.2 : 2;
    c.lineJoin = "bevel";
    if (apart > 24 && view.settled) {
      c.strokeStyle = ON_GREY.casing; c.lineWidth = thin + 1.6;
      c.stroke(groups.left); c.stroke(groups.right);
    }
    c.lineWidth = thin;
    c.globalAlpha = apart < 12 ? 0.65 : 1;
    for (const side of ["left", "right"]) { c.strokeStyle = ON_GREY[side]; c.stroke(groups[side]); }
    c.globalAlpha = 1;
    c.strokeStyle = ON_GREY.casing; c.lineWidth = thin + 2.6; c.stroke(groups.chosen);
    c.strokeStyle = ON_GREY.chosen; c.lineWidth = thin + 0.8; c.stroke(groups.chosen);
  }

  /** Doubts, the axis, and what the open decision would change. */
  marks(c, at) {
    const { view, page, surface: s } = this;
    c.setLineDash([7, 5]); c.strokeStyle = ON_GREY.axis; c.lineWidth = 1.2;
    const axis = at.y(view.tool?.axisShown?.() ?? page.state.axis_px);
    line(c, s.left, axis, s.left + s.plotWidth, axis);
    c.setLineDash([]);
    for (const doubt of page.state.doubts) {
      const column = page.whereabouts(doubt);
      const x0 = at.x(doubt.first), x1 = Math.max(x0 + 5, at.x(doubt.stop)), y = at.y(column);
      if (x1 < s.left || x0 > s.left + s.plotWidth) continue;
      const high = Math.max(5, Math.min(14, 6 * at.perColumn));
      c.lineWidth = 3.2; c.strokeStyle = ON_GREY.casing; c.strokeRect(x0, y - high / 2, x1 - x0, high);
      c.lineWidth = 1.6; c.strokeStyle = ON_GREY.doubt; c.strokeRect(x0, y - high / 2, x1 - x0, high);
      if (page.isChosen(doubt)) { s.font(1, "bold"); c.textAlign = "right"; c.textBaseline = "middle"; edged(c, "?", x0 - 3, y, ON_GREY.doubt); s.font(); }
    }
    this.preview(c, at);
  }

  preview(c, at) {
    const { curves: changed = [], many = false } = this.view.effect ?? {};
    c.globalAlpha = many ? 0.8 : 1;
    for (const { frames, x_px: columns } of changed) {
      const path = new Path2D();
      let pen = false;
      frames.forEach((frame, i) => {
        if (columns[i] == null) { pen = false; return; }
        const x = at.x(frame + 0.5), y = at.y(columns[i]);
        if (pen) path.lineTo(x, y); else { path.moveTo(x - 3, y); path.lineTo(x, y); }
        pen = true;
      });
      if (!many) { c.lineWidth = 4.2; c.strokeStyle = ON_GREY.casing; c.stroke(path); }
      c.setLineDash(many ? [] : [6, 3]); c.lineWidth = many ? 1 : 2.2; c.strokeStyle = ON_GREY.new; c.stroke(path); c.setLineDash([]);
    }
    c.globalAlpha = 1;
  }

  /** The sheet whose track is nearest to a place, -1 where none is near. */
  nearest(frame, column, within = Infinity) {
    let best = -1, least = within;
    const positions = this.tiles.at(frame);
    for (const sheet of this.page.state.sheets) {
      const here = positions?.(sheet.index) || sheet.x_px;
      if (Math.abs(here - column) < least) { least = Math.abs(here - column); best = sheet.index; }
    }
    return best;
  }

  listen() {
    const { view } = this;
    this.surface.handle({
      begin: () => ({ first: view.first, last: view.last, low: view.low, high: view.high }),
      drag: (held, dx, dy) => {
        const at = this.places();
        view.setFrames(held.first - dx / at.perFrame, held.last - dx / at.perFrame);
        view.setColumns(held.low + dy / at.perColumn, held.high + dy / at.perColumn);
      },
      click: (p) => {
        const at = this.places(), frame = Math.floor(at.frame(p.x)), column = at.column(p.y);
        view.goTo(frame);
        if (view.tool?.pick?.({ frame: view.frame, column })) return;
        const sheet = this.nearest(frame, column, NEAR_PX / at.perColumn);
        if (sheet >= 0) view.choose(sheet);
      },
      whole: () => view.whole(),
      zoom: (factor, p, event) => {
        const at = this.places();
        if (event.ctrlKey || !event.shiftKey) view.zoomFrames(factor, at.frame(p.x));
        if (event.ctrlKey || event.shiftKey) view.zoomColumns(factor, at.column(p.y));
      },
    });
  }
}
