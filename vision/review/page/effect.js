/* What the program answers to a decision that is not kept yet, as curves to draw and lines to read. */

import { number } from "./surface.js";

const MOST_LINES = 3; // of sheets whose deformation changes
const SIDES = [["left", -1], ["right", 1]];

/** What an effect on positions holds: `lines` in words, `curves` of sheets that change, `stick` at the cursor. */
export function effectOn(answer, decision, name, noStick) {
  const { before, after, frames } = answer, lines = [], curves = [];
  const where = (shown) => span(shown) + (shown.length < answer.concerned ? ` (near the cursor; the decision concerns ${answer.concerned} frames)` : "");
  const sheets = decision.sheets ?? (decision.sheet == null ? [] : [decision.sheet]);
  if (["accept", "leave_out", "swap", "assign"].includes(decision.kind)) {
    const [first, stop] = decision.frames.split(":").map((text) => (text === "" ? Infinity : Number(text)));
    const rows = frames.map((_, i) => i).filter((i) => frames[i] >= first && frames[i] < stop), shown = rows.map((i) => frames[i]);
    for (const sheet of sheets) {
      const was = rows.map((i) => before.x_px[i][sheet]), will = rows.map((i) => after.x_px[i][sheet]);
      const moved = will.map((x, i) => (x != null && was[i] != null && x !== was[i] ? x - was[i] : NaN)).filter(Number.isFinite).sort((a, b) => a - b);
      curves.push({ sheet, frames: shown, x_px: will });
      lines.push(`${name(sheet)}, ${where(shown)}: ${count(was)} → ${count(will)} of ${rows.length} positions${moved.length ? `, moved by ${number(moved[moved.length >> 1], 1)} px` : ""}`);
    }
  } else if (decision.kind === "add") {
    const place = after.x_px[0].length > before.x_px[0].length ? newColumn(before, after) : -1;
    if (place >= 0) {
      const will = after.x_px.map((row) => row[place]);
      curves.push({ sheet: null, frames, x_px: will });
      lines.push(`${count(will)} of ${frames.length} positions in ${where(frames)}; it becomes ${sideOf(after.side[place])} ${after.n[place]}`);
    }
  } else if (decision.kind === "delete") {
    lines.push(`${name(decision.sheet)}: ${count(before.x_px.map((row) => row[decision.sheet]))} → 0 positions in ${where(frames)}`);
  }
  const [was, will] = [before, after].map(({ side }) => SIDES.map(([word, sign]) => `${word} ${side.filter((s) => s === sign).length}`).join(", "));
  if (was !== will) lines.push(`sheets: ${was} → ${will}`);
  lines.push(...(answer.event == null ? [noStick] : deformation(answer.event, answer.stick_before, answer.stick_after)));
  return { lines, curves, stick: stickOf(answer), numbering: decision.kind === "axis" ? { side: after.side, n: after.n } : null };
}

/** What is drawn of the stick at the cursor, as it would be. */
function stickOf(answer) { return answer.stick_after?.sheets.length ? { event: answer.event, ...answer.stick_after } : null; }

function deformation(event, before, after) {
  if (!after?.sheets.length) return [`no σₓ/Λₛₜ in stick ${event}. ${after?.reason ?? ""}`];
  const shell = shellIn(event, before, after);
  if (!before?.sheets.length) return [shell];
  const key = (one) => `${sideOf(one.side)} ${one.n}`, was = new Map(before.sheets.map((one) => [key(one), one]));
  const changed = after.sheets.filter((one) => !close(one.ratio, was.get(key(one))?.ratio)).map((one) => {
    const old = was.get(key(one)), called = old?.shell && old.shell !== one.shell ? ` (${old.shell} → ${one.shell})` : "";
    return { by: Math.abs((one.ratio ?? 0) - (old?.ratio ?? 0)), text: `σₓ/Λₛₜ of ${key(one)}: ${ratio(old)} → ${ratio(one)}${called}` };
  }).sort((a, b) => b.by - a.by);
  const lines = [shell, ...changed.slice(0, MOST_LINES).map((one) => one.text)];
  if (changed.length > MOST_LINES) lines.push(`… and of ${changed.length - MOST_LINES} more sheets, by ${number(changed[MOST_LINES].by, 3)} at most`);
  if (!changed.length) lines.push(`σₓ/Λₛₜ in stick ${event}: no change`);
  return lines;
}

/** Stiff sheets of each side in one stick, with the interval that holds the number. */
function shellIn(event, before, after) {
  const of = (stick, sign) => stick?.shells?.find((one) => one.side === sign);
  const size = (one) => (one?.stiff_sheets == null ? "unknown" : `${one.stiff_sheets} (${one.stiff_low} to ${one.stiff_high})`);
  const sides = SIDES.map(([word, sign]) => {
    const [was, will] = [before, after].map((stick) => size(of(stick, sign)));
    return was === will || !before ? `${word} ${will}` : `${word} ${was} → ${will}`;
  });
  return `shell in stick ${event}, stiff sheets: ${sides.join(", ")}`;
}

/** What tracking the film again would change, over the whole run and in the stick at the cursor. */
export function effectOfTrial(found, answer, waiting) {
  const pair = ([a, b], digits = 0) => (a === b ? short(a, digits) : `${short(a, digits)} → ${short(b, digits)}`);
  const lines = [`positions: ${pair(found.positions)}; doubtful: ${pair(found.doubtful)}`];
  if (found.compared) lines.push(`${found.differ} of ${found.compared} differ by over 3 errors; median ${number(found.median_px, 3)}, most ${number(found.largest_px, 2)} px`);
  lines.push(`error of a position (median): ${pair(found.error_px, 4)} px`);
  const [was, will] = found.sheets.map((sides) => SIDES.map(([word], i) => `${word} ${sides[i]}`).join(", "));
  if (was !== will) lines.push(`sheets: ${was} → ${will}`);
  const { ratios, shells } = found;
  if (ratios) {
    lines.push(`σₓ/Λₛₜ, ${ratios.of} values: change ${number(ratios.median, 3)} (median), ${number(ratios.largest, 3)} (most)`);
    lines.push(`shell, stiff sheets (median): ${shells.map((one) => `${sideOf(one.side)} ${pair(one.median, 1)}, other in ${one.other} of ${one.of} sticks`).join("; ")}`);
    if (answer.event != null) lines.push(...deformation(answer.event, answer.stick_before, answer.stick_after));
  }
  if (waiting) lines.push(`all with the ${waiting} ${waiting === 1 ? "decision that waits" : "decisions that wait"}, against the run as it was saved`);
  const curves = answer.after.side.map((_, sheet) => ({ sheet: null, frames: answer.frames, x_px: answer.after.x_px.map((row) => row[sheet]) }));
  return { lines, curves, stick: stickOf(answer), many: true };
}

/** Ridges and noise of another strip, against those of the present one. */
export function effectOfStrip(now, then) {
  const change = (name, digits, unit) => `${number(now[name], digits)} → ${number(then[name], digits)}${unit}`;
  return {
    curves: [], ridges_px: then.ridges,
    lines: [
      `ridges in frame ${then.frame}: ${now.ridges.length} → ${then.ridges.length}, of these sheets: ${now.sheets_seen} → ${then.sheets_seen}`,
      `noise from frame to frame: ${change("noise_px", 4, " px")}`,
      `contrast: ${change("contrast", 1, " grey levels")}; ridge width: ${change("fwhm_px", 2, " px")}`,
      "Re-track to see positions, σₓ/Λₛₜ and shells before you keep it.",
    ],
  };
}

/** How another clock fits: drops of the force against the film's own slips. */
export function effectOfClock(answer, filmSlips, seconds, frameSeconds, before) {
  const away = filmSlips.map((frame) => Math.min(...answer.slips.map((other) => Math.abs(seconds(other) - seconds(frame))), Infinity));
  const met = away.filter((s) => s <= 2.5 * frameSeconds).sort((a, b) => a - b);
  const lines = [`${met.length} of the film's ${filmSlips.length} slips meet a drop of the force${met.length ? `, to ${number(1000 * met[met.length >> 1], 0)} ms (median)` : ""}`,
    `${answer.sticks.length} stick phases lie within the film`];
  if (answer.stick_after) lines.push(...deformation(answer.event, before?.event === answer.event ? before : null, answer.stick_after));
  return { lines, curves: [], stick: stickOf(answer) };
}

const sideOf = (side) => (side < 0 ? "left" : "right");
const span = (frames) => (frames.length > 1 ? `frames ${frames[0]}–${frames.at(-1)}` : frames.length ? `frame ${frames[0]}` : "no frame in view");
const short = (value, digits) => number(value, Number.isInteger(value) ? 0 : digits);
const count = (values) => values.filter((x) => x != null).length;
const ratio = (one) => (one?.ratio == null ? "none" : number(one.ratio, 3));
const close = (a, b) => (a == null && b == null) || Math.abs(a - b) < 5e-4;

/** The column that is in `after` alone. */
function newColumn(before, after) {
  const row = after.x_px.findIndex((values) => values.some((x) => x != null));
  if (row < 0) return -1;
  const old = before.x_px[row], more = after.x_px[row];
  for (let k = 0; k < more.length; k++) if (more[k] !== old[k]) return k;
  return more.length - 1;
}
