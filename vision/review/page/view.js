/* What is looked at: one cursor, one range of time, one range of columns and one chosen sheet for all views. */

const REST_MS = 120;

export class View extends EventTarget {
  constructor() {
    super();
    this.frame = 0; // under the cursor, as numbered in the film
    this.begin = 0; // frames of the film, half-open: all there is
    this.end = 1;
    this.first = 0; // range of time shown, in frames; fractions while zooming
    this.last = 1;
    this.low = 0; // range of columns shown, px
    this.high = 1;
    this.left = 0; // all columns there are
    this.right = 1;
    this.sheets = [0, 1]; // columns between which the sheets stand
    this.sheet = 0;
    this.times = new Float64Array(0); // of every frame, s
    this.tool = null; // what a click or a drag in a picture means: the open decision
    this.effect = null; // preview of the open decision
    this.settled = true; // false while it is being zoomed or moved
    this.resting = 0;
  }

  /** Frames and columns there are; everything is shown. */
  measure({ begin, end, left, right, times, sheets }) {
    Object.assign(this, { begin, end, left, right, times: filled(times), sheets });
    this.frame = begin;
    this.whole();
  }

  changed() { this.dispatchEvent(new Event("change")); }

  /** The range changes, perhaps many times a second: pictures may be drawn plainly until it rests. */
  moved() {
    this.settled = false;
    clearTimeout(this.resting);
    this.resting = setTimeout(() => { this.settled = true; this.changed(); }, REST_MS);
    this.changed();
  }

  /** Moves the cursor; the range follows it. */
  goTo(frame) {
    this.frame = Math.max(this.begin, Math.min(this.end - 1, Math.round(frame)));
    const width = this.last - this.first;
    if (this.frame < this.first || this.frame >= this.last) this.setFrames(this.frame - width / 2, this.frame + width / 2);
    this.changed();
  }

  setFrames(first, last) {
    const all = this.end - this.begin;
    const width = Math.min(all, Math.max(6, last - first));
    const middle = (first + last) / 2;
    this.first = Math.max(this.begin, Math.min(this.end - width, middle - width / 2));
    this.last = this.first + width;
    this.moved();
  }

  setColumns(low, high) {
    const all = this.right - this.left;
    const width = Math.min(all, Math.max(8, high - low));
    const middle = (low + high) / 2;
    this.low = Math.max(this.left, Math.min(this.right - width, middle - width / 2));
    this.high = this.low + width;
    this.moved();
  }

  /** Zooms by a factor; `at` is what stays in place. */
  zoomFrames(factor, at = this.frame) {
    this.setFrames(at + (this.first - at) * factor, at + (this.last - at) * factor);
  }

  zoomColumns(factor, at) {
    this.setColumns(at + (this.low - at) * factor, at + (this.high - at) * factor);
  }

  whole() {
    this.first = this.begin; this.last = this.end;
    this.setColumns(...this.sheets);
  }

  choose(sheet) { this.sheet = sheet; this.changed(); }

  /** Time of a frame, s, also between frames. */
  seconds(frame) {
    const at = frame - this.begin, count = this.times.length;
    if (!count) return NaN;
    if (count === 1) return this.times[0];
    const i = Math.max(0, Math.min(count - 2, Math.floor(at)));
    return this.times[i] + (at - i) * (this.times[i + 1] - this.times[i]);
  }

  /** The frame, with its fraction, at a time in s. */
  frameAt(seconds) {
    const t = this.times, count = t.length;
    if (count < 2) return this.begin;
    let low = 0, high = count - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (t[middle] <= seconds) low = middle; else high = middle;
    }
    return this.begin + low + (seconds - t[low]) / (t[high] - t[low] || 1);
  }
}

/** Times of lost frames from those around them; all as they are where none is known. */
function filled(times) {
  let known = -1;
  for (let i = 0; i < times.length; i++) {
    if (Number.isNaN(times[i])) continue;
    for (let k = known + 1; k < i; k++) {
      const step = known >= 0 ? (times[i] - times[known]) / (i - known) : 1e-3;
      times[k] = times[i] - step * (i - k);
    }
    known = i;
  }
  for (let k = known + 1; known > 0 && k < times.length; k++) times[k] = times[known] + (k - known) * (times[known] - times[known - 1]);
  return times;
}
