/* A canvas that fits its box and the screen's pixels, with the axes that all pictures share. */

const COLOURS = ["text", "soft", "line", "grid", "accent", "left", "right", "doubt", "new", "cursor", "card", "warn", "good"];
export const ON_GREY = { left: "#45b4ff", right: "#ff9a3d", chosen: "#ffffff", doubt: "#ff6fb5", new: "#4dffb8", strip: "#ff9a3d", axis: "#ffffff", casing: "rgba(0,0,0,0.75)" };
export const NEAR_PX = 14; // a click this near to a sheet chooses it
const FONT = "px system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', sans-serif";

let palette = null;
/** Colours of the page in its present theme. */
export function colours() {
  if (!palette) {
    const style = getComputedStyle(document.documentElement);
    palette = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  }
  return palette;
}
export function themeChanged() { palette = null; }

export class Surface {
  /** margins: px around the plot; draw: called with this surface, once per screen refresh where needed. */
  constructor(canvas, margins, draw) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.margins = margins;
    this.paint = draw;
    this.pending = false;
    this.size = 12;
    new ResizeObserver(() => { this.fit(); this.redraw(); }).observe(canvas);
  }

  fit() {
    const box = this.canvas.getBoundingClientRect(), scale = devicePixelRatio || 1;
    const width = Math.max(1, Math.round(box.width * scale)), height = Math.max(1, Math.round(box.height * scale));
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    this.scale = scale;
    this.width = box.width; this.height = box.height;
    this.size = innerWidth >= 1700 ? 14 : 12;
    const grow = this.size / 12, { left, right, top, bottom } = this.margins;
    this.left = left * grow; this.top = top * grow;
    this.plotWidth = Math.max(1, box.width - (left + right) * grow);
    this.plotHeight = Math.max(1, box.height - (top + bottom) * grow);
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      if (!this.scale) this.fit();
      if (this.width < 2 || this.height < 2) return;
      const c = this.context, colour = colours();
      c.setTransform(this.scale, 0, 0, this.scale, 0, 0);
      c.fillStyle = colour.card;
      c.fillRect(0, 0, this.width + 2, this.height + 2); // the last pixel of a fractional width, too
      this.font();
      this.paint(this, c, colour);
    });
  }

  font(factor = 1, weight = "") { this.context.font = `${weight} ${Math.round(this.size * factor)}${FONT}`; }

  /** Draw within the plot only. */
  clipped(work) {
    const c = this.context;
    c.save(); c.beginPath(); c.rect(this.left, this.top, this.plotWidth, this.plotHeight); c.clip();
    work(c); c.restore();
  }

  /** Where the pointer is, px in the canvas. */
  pointer(event) { return { x: event.offsetX, y: event.offsetY }; }

  /**
   * The pointer's actions, `p` being its place: begin(p) returns what a drag starts from; drag(held, dx, dy, p);
   * click(p, held), after less than 4 px; drop(held), at the end of both; whole(), a double click; zoom(factor, p, event).
   */
  handle({ begin, drag, click, drop = () => {}, whole, zoom }) {
    const { canvas } = this;
    let held = null;
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      const p = this.pointer(event);
      held = { ...p, moved: false, ...begin(p) };
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      const p = this.pointer(event), dx = p.x - held.x, dy = p.y - held.y;
      if (!held.moved && Math.hypot(dx, dy) < 4) return;
      held.moved = true;
      drag(held, dx, dy, p);
    });
    canvas.addEventListener("pointerup", (event) => {
      const was = held;
      held = null;
      if (!was) return;
      drop(was);
      if (!was.moved) click(this.pointer(event));
    });
    canvas.addEventListener("pointercancel", () => { held = null; });
    canvas.addEventListener("dblclick", whole);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(1.0018 ** ((event.deltaY || event.deltaX) * (event.deltaMode ? 30 : 1)), this.pointer(event), event);
    }, { passive: false });
  }

  frame() {
    const c = this.context;
    c.strokeStyle = colours().line; c.lineWidth = 1;
    c.strokeRect(this.left + 0.5, this.top + 0.5, this.plotWidth - 1, this.plotHeight - 1);
  }

  /** Ticks of a vertical axis at the left; returns value → y. */
  yAxis(low, high, label, { grid = true } = {}) {
    const c = this.context, colour = colours();
    const place = (value) => this.top + this.plotHeight * (1 - (value - low) / (high - low || 1));
    const [ticks, digits] = steps(low, high, Math.max(3, Math.floor(this.plotHeight / 26)));
    c.textAlign = "right"; c.textBaseline = "middle"; c.lineWidth = 1;
    for (const value of ticks) {
      const y = Math.round(place(value)) + 0.5;
      if (grid) { c.strokeStyle = colour.grid; line(c, this.left, y, this.left + this.plotWidth, y); }
      c.fillStyle = colour.soft;
      c.fillText(number(value, digits), this.left - 5, Math.max(this.top + 5, Math.min(this.top + this.plotHeight - 4, y)));
    }
    this.yLabel(label);
    return place;
  }

  yLabel(label) {
    const c = this.context;
    c.save(); c.translate(this.size * 0.75, this.top + this.plotHeight / 2); c.rotate(-Math.PI / 2);
    c.fillStyle = colours().text; c.textAlign = "center"; c.textBaseline = "middle"; c.fillText(label, 0, 0); c.restore();
  }
}

/** Frames along the plot, labelled in s. */
export function timeAxis(surface, view, labelled) {
  const c = surface.context, colour = colours();
  const place = (frame) => surface.left + (surface.plotWidth * (frame - view.first)) / (view.last - view.first);
  const timed = Number.isFinite(view.seconds(view.first)), value = (frame) => (timed ? view.seconds(frame) : frame);
  const from = value(view.first), to = value(view.last);
  if (to > from) {
    const [ticks, digits] = steps(from, to, Math.max(2, Math.floor(surface.plotWidth / 90)));
    const y = surface.top + surface.plotHeight;
    c.strokeStyle = colour.line; c.lineWidth = 1; c.textAlign = "center"; c.textBaseline = "top"; c.fillStyle = colour.soft;
    for (const tick of ticks) {
      const x = Math.round(place(timed ? view.frameAt(tick) : tick)) + 0.5;
      line(c, x, y, x, y + 4);
      if (labelled && x > surface.left + 8 && x < surface.left + surface.plotWidth - 34) c.fillText(number(tick, digits), x, y + 5);
    }
    if (labelled) { c.textAlign = "right"; c.fillStyle = colour.text; c.fillText(timed ? "t (s)" : "frame", surface.left + surface.plotWidth, y + 5); }
  }
  return place;
}

/** The cursor in a picture along time. */
export function timeCursor(surface, place, view, colour, casing = null) {
  const x = place(view.frame + 0.5), c = surface.context;
  if (x < surface.left - 1 || x > surface.left + surface.plotWidth + 1) return;
  if (casing) { c.strokeStyle = casing; c.lineWidth = 3.5; line(c, x, surface.top, x, surface.top + surface.plotHeight); }
  c.strokeStyle = colour; c.lineWidth = 1.5;
  line(c, x, surface.top, x, surface.top + surface.plotHeight);
}

export function line(c, x0, y0, x1, y1) { c.beginPath(); c.moveTo(x0, y0); c.lineTo(x1, y1); c.stroke(); }

/** A curve through many points: a line where they lie apart, else what they span in every pixel column; `at(k)` gives [x, y], y NaN in a gap. */
export function curveThrough(c, from, to, at, width) {
  if (to <= from) return;
  const [first] = at(from), [last] = at(to - 1);
  if (to - from < 0.5 * Math.abs(last - first)) {
    c.lineWidth = width; c.lineJoin = "bevel"; c.beginPath();
    let pen = false;
    for (let k = from; k < to; k++) {
      const [x, y] = at(k);
      if (Number.isNaN(y)) { pen = false; continue; }
      if (!pen) c.moveTo(x - 0.5, y);
      c.lineTo(x, y); pen = true;
    }
    c.stroke();
    return;
  }
  c.fillStyle = c.strokeStyle;
  let column = NaN, low = Infinity, high = -Infinity, end = NaN;
  const bar = (next) => { if (low <= high) c.fillRect(column, low - width / 2, Math.max(1, Math.min(next - column, 4)), high - low + width); };
  for (let k = from; k < to; k++) {
    const [x, y] = at(k), here = Math.round(x);
    if (here !== column) { bar(here); column = here; low = high = end; if (Number.isNaN(end)) { low = Infinity; high = -Infinity; } }
    if (!Number.isNaN(y)) { if (y < low) low = y; if (y > high) high = y; }
    end = y;
  }
  bar(column + 1);
}

/** Text with an edge, readable on a picture. */
export function edged(c, text, x, y, colour) {
  c.lineJoin = "round"; c.lineWidth = 3.5; c.strokeStyle = "rgba(0,0,0,0.85)"; c.strokeText(text, x, y);
  c.fillStyle = colour; c.fillText(text, x, y);
}

/** Text broken into lines that fit, centred. */
export function wrapped(c, text, left, width, y, height) {
  const lines = [""];
  for (const word of text.split(" ")) {
    const longer = `${lines.at(-1)} ${word}`.trim();
    if (c.measureText(longer).width > width - 10 && lines.at(-1)) lines.push(word); else lines[lines.length - 1] = longer;
  }
  lines.forEach((part, i) => c.fillText(part, left + width / 2, y + (i - (lines.length - 1) / 2) * height));
}

/** Round values between two numbers, about `most` but no fewer than two, and the digits they need. */
export function steps(low, high, most) {
  const rough = (high - low) / Math.max(1, most), power = 10 ** Math.floor(Math.log10(rough));
  let ticks = [], digits = 0;
  for (const step of [10, 5, 2, 1].map((k) => k * power)) {
    if (ticks.length > 1 && step < rough * 0.999) break;
    ticks = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step && ticks.length < 200; k++) ticks.push(k * step);
    digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  }
  return [ticks, digits];
}

/** A number with so many digits and a true minus. */
export function number(value, digits = 2) {
  if (value == null || !Number.isFinite(value)) return "–";
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}
