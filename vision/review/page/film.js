/* The film at the chosen frame, with the strip, the sheets' ridges and their numbers. */

import { getImage, Store } from "./server.js";
import { colours, edged, line, NEAR_PX, ON_GREY, Surface, wrapped } from "./surface.js";

export class Film {
  constructor(canvas, view, page) {
    this.view = view; this.page = page; this.wholePicture = false;
    this.pictures = new Store((frame) => getImage(`api/frame/${frame}.png`), () => this.redraw(), 24);
    this.surface = new Surface(canvas, { left: 58, right: 8, top: 4, bottom: 4 }, (s, c) => this.draw(s, c));
    this.shown = null; // the last picture that arrived, shown while the next is on its way
    this.listen();
  }

  redraw() { this.surface.redraw(); }

  rows() {
    const { page, view } = this, [z0, z1] = page.strip(), high = page.film.rows ?? z1;
    if (this.wholePicture || view.tool?.wholePicture) return [0, high];
    const beside = Math.max(0.35 * (z1 - z0), 12);
    return [Math.max(0, z0 - beside), Math.min(high, z1 + beside)];
  }

  places() {
    const { surface: s, view } = this, [top, bottom] = this.rows();
    const perColumn = s.plotWidth / (view.high - view.low), perRow = s.plotHeight / (bottom - top);
    return {
      top, bottom, perColumn, perRow,
      x: (column) => s.left + (column - view.low) * perColumn,
      y: (row) => s.top + (row - top) * perRow,
      column: (x) => view.low + (x - s.left) / perColumn,
      row: (y) => top + (y - s.top) / perRow,
    };
  }

  draw(s, c) {
    const { view, page } = this, at = this.places();
    const picture = page.film.rows != null ? this.pictures.get(view.frame) : null;
    const why = page.film.error || this.pictures.why(view.frame);
    if (picture || why) this.shown = picture; // else the one before, until this one arrives
    s.clipped(() => {
      c.fillStyle = "#3a3d41"; c.fillRect(s.left, s.top, s.plotWidth, s.plotHeight);
      if (this.shown?.width) { // none is left of one that was closed
        const x0 = at.x(-0.5), y0 = at.y(0); // pixel centres are at integers, rows count edges
        c.imageSmoothingEnabled = at.perColumn < 2;
        c.drawImage(this.shown, x0, y0, this.shown.width * at.perColumn, this.shown.height * at.perRow);
      }
      this.strip(s, c, at);
      this.sheets(s, c, at);
      if (!this.shown?.width) this.notice(s, c, why ? `The film is not shown: ${why}` : "reading the film …");
    });
    s.frame();
    c.fillStyle = colours().soft; c.textAlign = "right"; c.textBaseline = "top"; c.fillText(Math.round(at.top), s.left - 5, s.top);
    c.textBaseline = "bottom"; c.fillText(Math.round(at.bottom), s.left - 5, s.top + s.plotHeight);
    s.yLabel("row z (px)");
  }

  notice(s, c, text) {
    c.fillStyle = "rgba(0,0,0,0.85)"; c.fillRect(s.left, s.top, s.plotWidth, s.plotHeight);
    c.fillStyle = "#fff"; c.textAlign = "center"; c.textBaseline = "middle";
    wrapped(c, text, s.left, s.plotWidth, s.top + s.plotHeight / 2, s.size * 1.3);
  }

  strip(s, c, at) {
    const [z0, z1] = this.page.strip(), y0 = at.y(z0), y1 = at.y(z1);
    const box = [s.left + 2, y0 + 1, s.plotWidth - 4, y1 - y0 - 2];
    c.lineWidth = 4; c.strokeStyle = ON_GREY.casing; c.strokeRect(...box);
    c.lineWidth = 2; c.strokeStyle = ON_GREY.strip; c.setLineDash([12, 4]); c.strokeRect(...box); c.setLineDash([]);
  }

  sheets(s, c, at) {
    const { view, page } = this, [z0, z1] = page.strip();
    const y0 = Math.max(s.top, at.y(z0)), y1 = Math.min(s.top + s.plotHeight, at.y(z1));
    const middle = (y0 + y1) / 2, here = page.tiles.at(view.frame);
    const axis = at.x(view.tool?.axisShown?.() ?? page.state.axis_px);
    for (const [width, colour] of [[3.5, ON_GREY.casing], [1.6, ON_GREY.axis]]) {
      c.setLineDash([9, 4, 2, 4]); c.lineWidth = width; c.strokeStyle = colour; line(c, axis, s.top, axis, s.top + s.plotHeight);
    }
    c.setLineDash([]);
    const seen = page.ridges(view.frame);
    for (const { x_px: x } of seen?.candidates ?? []) this.ridge(c, at.x(x), y1);
    const numbers = [];
    const { side, n } = view.effect?.numbering ?? {}; // as it would be
    for (const known of page.state.sheets) {
      const sheet = side ? { ...known, side: side[known.index], n: n[known.index] } : known;
      const chosen = sheet.index === view.sheet, column = here ? here(sheet.index) : sheet.x_px;
      const x = at.x(column || (seen?.sheets[sheet.index]?.withheld_px ?? sheet.x_px));
      if (x < s.left - 9 || x > s.left + s.plotWidth + 9) continue;
      if (!Number.isNaN(column)) {
        const colour = chosen ? ON_GREY.chosen : sheet.side < 0 ? ON_GREY.left : ON_GREY.right;
        c.lineWidth = chosen ? 5 : 3.5; c.strokeStyle = ON_GREY.casing; line(c, x, middle - 7, x, y1);
        c.lineWidth = chosen ? 2.6 : 1.5; c.strokeStyle = colour; line(c, x, middle - 7, x, y1);
      } else edged(c, "?", x, y1 - 8, ON_GREY.doubt);
      numbers.push({ x, sheet, chosen });
    }
    const { curves = [], many = false } = view.effect ?? {};
    for (const curve of curves) {
      const column = curve.x_px[curve.frames.indexOf(view.frame)], top = many ? y0 : s.top;
      if (column == null) continue;
      c.lineWidth = many ? 3.2 : 5; c.strokeStyle = ON_GREY.casing; line(c, at.x(column), top, at.x(column), y1);
      c.lineWidth = many ? 1.4 : 2.4; c.strokeStyle = ON_GREY.new; line(c, at.x(column), top, at.x(column), y1);
    }
    this.numbers(s, c, numbers, y1 - y0 > 3 * s.size ? y0 + 4 : y0 - 1.6 * s.size); // above a narrow strip
    for (const column of view.effect?.ridges_px ?? []) {
      c.lineWidth = 4; c.strokeStyle = ON_GREY.casing; line(c, at.x(column), y0, at.x(column), y1);
      c.lineWidth = 1.8; c.strokeStyle = ON_GREY.new; line(c, at.x(column), y0, at.x(column), y1);
    }
  }

  /** A small mark for a ridge that the program saw. */
  ridge(c, x, y) {
    c.beginPath(); c.moveTo(x, y - 1); c.lineTo(x - 3.5, y + 6); c.lineTo(x + 3.5, y + 6); c.closePath();
    c.fillStyle = "#fff"; c.strokeStyle = ON_GREY.casing; c.lineWidth = 1.5; c.stroke(); c.fill();
  }

  /** As many numbers as fit; the chosen sheet's always. */
  numbers(s, c, spots, at) {
    c.textAlign = "center"; c.textBaseline = "top";
    const y = Math.max(s.top + 3, at), width = s.size * 1.75;
    const chosen = spots.find((spot) => spot.chosen), xs = spots.map((spot) => spot.x);
    const apart = xs.slice(1).map((x, i) => x - xs[i]).sort((a, b) => a - b)[xs.length >> 1] ?? width;
    const every = Math.max(1, Math.ceil(width / apart)); // the same on both sides, from the axis outwards
    for (const spot of spots) {
      if (Math.min(spot.x - s.left, s.left + s.plotWidth - spot.x) < 0.4 * width) continue; // it would be cut off
      if (!spot.chosen && ((spot.sheet.n - 1) % every || (chosen && Math.abs(spot.x - chosen.x) < width))) continue;
      s.font(spot.chosen ? 1.15 : 1, spot.chosen ? "bold" : "");
      const wide = c.measureText(spot.sheet.n).width + 6;
      c.fillStyle = ON_GREY.casing; c.fillRect(spot.x - wide / 2, y - 3, wide, s.size * 1.15 + 5); // ridges are as bright as letters
      edged(c, spot.sheet.n, spot.x, y, spot.chosen ? ON_GREY.chosen : spot.sheet.side < 0 ? ON_GREY.left : ON_GREY.right);
    }
    s.font();
  }

  listen() {
    const { view } = this;
    this.surface.handle({
      begin: (p) => {
        const at = this.places();
        const near = (value, other, axis) => Math.abs(value - other) * (axis === "row" ? at.perRow : at.perColumn) < 9;
        const grabbed = view.tool?.grab?.({ row: at.row(p.y), column: at.column(p.x), near });
        return { low: view.low, high: view.high, tool: grabbed ? view.tool : null };
      },
      drag: (held, dx, dy, p) => {
        const at = this.places();
        if (held.tool) held.tool.drag({ row: at.row(p.y), column: at.column(p.x) });
        else view.setColumns(held.low - dx / at.perColumn, held.high - dx / at.perColumn);
      },
      drop: (held) => held.tool?.drop?.(),
      click: (p) => {
        const at = this.places(), column = at.column(p.x);
        if (view.tool?.pick?.({ frame: view.frame, column })) return;
        const sheet = this.page.nearest(view.frame, column, NEAR_PX / at.perColumn);
        if (sheet >= 0) view.choose(sheet);
      },
      whole: () => view.setColumns(view.left, view.right),
      zoom: (factor, p) => view.zoomColumns(factor, this.places().column(p.x)),
    });
  }
}
