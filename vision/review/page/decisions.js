/* What can be decided, the form for each decision, and its effect before it is kept. */

import { number } from "./surface.js";

/** Kinds of decisions in the order of their buttons; `fields` in the order of the form. */
export const KINDS = [
  { kind: "accept", key: "a", label: "Accept", fields: ["sheet", "first", "stop"],
    explain: "The doubted ridge is this sheet: its positions count in these frames." },
  { kind: "leave_out", key: "l", label: "Leave out", fields: ["sheet", "first", "stop"],
    explain: "No position of this sheet counts in these frames." },
  { kind: "swap", key: "s", label: "Swap", fields: ["sheet", "other", "first", "stop"],
    explain: "Two sheets were taken for each other, from a frame on." },
  { kind: "assign", key: "g", label: "Assign ridge", fields: ["sheet", "first", "stop", "ridge"],
    explain: "The ridge at this column of the first frame is the sheet; it is followed from there. Click on a ridge, or choose one." },
  { kind: "add", key: "i", label: "Add sheet", fields: ["ridge"],
    explain: "A ridge that is a sheet, too. Click on it, or choose one of those that the program saw in this frame. An empty place with room for a sheet counts as one without positions." },
  { kind: "delete", key: "x", label: "Delete sheet", fields: ["sheet"],
    explain: "This is no sheet; the others are numbered anew." },
  { kind: "axis", key: "m", label: "Move axis", fields: ["axis"],
    explain: "Side and number n count from the axis. Drag it in the film, or give its column." },
  { kind: "strip", key: "z", label: "Strip", fields: ["z0", "z1"],
    explain: "Rows that are averaged. Drag an edge or the whole strip in the film, then track it again." },
  { kind: "clock", key: "c", label: "Clocks", fields: ["candidate", "offset"],
    explain: "Slide the force along the film until its drops meet the film's slips (dotted), or choose a candidate." },
];

const FIELDS = {
  sheet: "Sheet", other: "and sheet", first: "from frame", stop: "to frame", ridge: "Ridge at (px)", axis: "Axis at (px)",
  z0: "from row", z1: "to row", candidate: "Candidate", offset: "Force clock at video time 0 (s)",
};

export class Decisions {
  constructor(page, form, kinds) {
    this.page = page; this.view = page.view; this.form = form; this.open = null; this.values = {};
    this.asked = 0; this.timer = 0;
    this.trial = ""; // of another strip: "" before the film is tracked again, "running", then "done"
    for (const kind of KINDS) {
      const button = element("button", { type: "button", id: `decide-${kind.kind}`, "aria-pressed": "false", "aria-keyshortcuts": kind.key, title: `${kind.explain} (${kind.key})` }, `${kind.label} (${kind.key})`);
      button.addEventListener("click", () => (this.open?.kind === kind.kind ? this.cancel() : this.begin(kind.kind)));
      kinds.append(button);
    }
    form.addEventListener("submit", (event) => { event.preventDefault(); this.keep(); });
    form.addEventListener("input", (event) => this.entered(event.target));
  }

  /** Which decisions make sense for this run. */
  offer() {
    const { state } = this.page, without = { clock: !state.clock, strip: this.page.film.rows == null };
    for (const { kind } of KINDS) document.getElementById(`decide-${kind}`).disabled = Boolean(without[kind]) || !state.sheets.length;
  }

  /** Opens the form of a decision with what the cursor, the chosen sheet and the doubt suggest. */
  begin(kind) {
    if (document.getElementById(`decide-${kind}`).disabled) return;
    this.open = KINDS.find((k) => k.kind === kind);
    this.values = this.suggested(kind);
    this.view.tool = this.tool(kind);
    this.view.effect = null;
    this.build();
    this.press();
    this.changed(true);
    this.form.querySelector("select, input")?.focus();
    this.page.tell(`${this.open.label}. ${this.open.explain}`);
  }

  cancel(quietly = false) {
    if (!this.open) return;
    clearTimeout(this.timer); this.asked += 1;
    this.endTrial();
    this.open = null; this.view.tool = null; this.view.effect = null;
    this.form.hidden = true; this.form.replaceChildren();
    this.press(); this.view.changed();
    if (!quietly) this.page.tell("Nothing changed.");
  }

  press() {
    for (const { kind } of KINDS) document.getElementById(`decide-${kind}`).setAttribute("aria-pressed", String(this.open?.kind === kind));
  }

  suggested(kind) {
    const { page, view } = this, doubt = page.doubtAt(), { sheets } = page.state;
    const [z0, z1] = page.strip(), frame = view.frame;
    const within = doubt && (kind === "accept" || kind === "leave_out" || kind === "assign");
    const sheet = within ? doubt.sheet : view.sheet;
    return {
      sheet, other: sheets.length > sheet + 1 ? sheet + 1 : sheet - 1,
      first: within ? doubt.first : frame,
      stop: within ? doubt.stop : kind === "swap" ? view.end : frame + 1,
      frame, ridge: kind === "add" ? null : this.guess(sheet, doubt),
      axis: Math.round(page.state.axis_px * 10) / 10, z0, z1, candidate: "", offset: page.state.clock?.offset_s ?? 0, drift: page.state.clock?.drift_ppm ?? 0,
    };
  }

  /** The column where the doubted ridge, or the sheet, should be. */
  guess(sheet, doubt) {
    const here = this.page.column(sheet);
    const column = doubt?.x_withheld_px ?? doubt?.x_expected_px ?? here ?? this.page.state.sheets[sheet]?.x_px ?? 0;
    return Math.round(column * 10) / 10;
  }

  build() {
    const { form, open } = this;
    form.replaceChildren(element("p", { class: "explain" }, open.explain));
    const fields = element("div", { class: "fields" });
    for (const name of open.fields) {
      const field = element("span", { class: "field" }), label = element("label", {}, FIELDS[name]);
      label.append(this.control(name));
      field.append(label); fields.append(field);
      if (name === "first" || name === "stop") {
        const button = element("button", { type: "button", title: "Take the cursor's frame", "aria-label": `${FIELDS[name]}: take the cursor's` }, "cursor");
        button.addEventListener("click", () => this.set(name, this.view.frame + (name === "stop" ? 1 : 0)));
        field.append(button);
      }
    }
    const keep = element("button", { type: "submit", id: "keep", class: "main", disabled: "" }, "Keep (Enter)");
    const retrack = element("button", { type: "button", id: "retrack", class: "main", disabled: "" }, "Re-track (Enter)");
    retrack.addEventListener("click", () => this.retrack());
    retrack.hidden = open.kind !== "strip"; keep.hidden = !retrack.hidden;
    const cancel = element("button", { type: "button", id: "cancel" }, "Cancel (Esc)");
    cancel.addEventListener("click", () => this.cancel());
    const actions = element("div", { class: "actions" });
    actions.append(retrack, keep, cancel);
    form.append(fields, element("div", { id: "effect", role: "status", "aria-live": "polite" }), actions);
    form.hidden = false;
    this.show();
    if (open.fields.includes("ridge")) this.offerRidges();
  }

  control(name) {
    const { page } = this, id = `field-${name}`;
    if (name === "sheet" || name === "other") {
      const select = element("select", { id, "data-field": name });
      for (const sheet of page.state.sheets) select.append(element("option", { value: sheet.index }, `${page.name(sheet)} (index ${sheet.index})`));
      return select;
    }
    if (name === "candidate") {
      const select = element("select", { id, "data-field": name });
      select.append(element("option", { value: "" }, "as slid"));
      (page.state.clock?.candidates ?? []).forEach((one, i) => select.append(element("option", { value: i }, `${i + 1}: ${number(one.offset_s, 3)} s, ${one.matched} slips matched`)));
      return select;
    }
    const step = { axis: 0.5, ridge: 0.5, offset: 0.01 }[name] ?? 1;
    const input = element("input", { id, "data-field": name, type: "number", step: name === "ridge" || name === "axis" || name === "offset" ? "any" : step });
    if (step !== 1) input.addEventListener("keydown", (event) => {
      const way = { ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (way) { event.preventDefault(); this.set(name, Math.round((Number(input.value) + way * step) / step) * step); }
    });
    if (name !== "ridge") return input;
    const both = element("span"), list = element("select", { id: "field-ridges", "data-field": "ridges", "aria-label": "Ridges that the program saw" });
    both.append(input, " ", list);
    return both;
  }

  /** Ridges that the program saw in the decision's first frame. */
  offerRidges() {
    const list = this.form.querySelector("#field-ridges");
    if (!list) return;
    const seen = this.page.ridges(this.frame())?.candidates;
    if (seen && this.values.ridge == null) this.values.ridge = this.unowned(seen);
    const away = (ridge) => Math.abs(ridge.x_px - this.values.ridge);
    const nearest = (seen ?? []).reduce((best, ridge, i) => (best < 0 || away(ridge) < away(seen[best]) ? i : best), -1);
    list.replaceChildren(element("option", { value: "" }, seen ? `${seen.length} seen` : "reading …"));
    (seen ?? []).forEach((ridge, i) => {
      const owner = ridge.sheet == null ? "no sheet" : this.page.name(this.page.state.sheets[ridge.sheet]);
      const option = element("option", { value: ridge.x_px }, `${number(ridge.x_px, 1)}: ${owner}`);
      if (i === nearest && Math.abs(ridge.x_px - this.values.ridge) < 1) option.selected = true;
      list.append(option);
    });
  }

  /** A ridge that belongs to no sheet, the one nearest to the chosen sheet. */
  unowned(seen) {
    const place = this.page.state.sheets[this.view.sheet]?.x_px ?? 0, free = seen.filter((ridge) => ridge.sheet == null);
    const best = free.sort((a, b) => Math.abs(a.x_px - place) - Math.abs(b.x_px - place))[0];
    if (best) setTimeout(() => { this.show(); this.changed(); }, 0);
    return best ? Math.round(best.x_px * 10) / 10 : null;
  }

  /** The frame in which a ridge is chosen. */
  frame() { return this.open?.kind === "assign" ? this.values.first : this.values.frame; }

  entered(target) {
    const name = target.dataset.field;
    if (!name) return;
    if (name === "ridges") { if (target.value) this.set("ridge", Number(target.value)); return; }
    if (name === "candidate") {
      const one = this.page.state.clock?.candidates[target.value];
      this.values.candidate = target.value;
      if (one) { this.values.offset = one.offset_s; this.values.drift = one.drift_ppm; }
      this.show(); this.changed(); return;
    }
    if (target.value === "" || !Number.isFinite(Number(target.value))) return this.refuse("Give a number.");
    this.values[name] = Number(target.value);
    if (name === "offset") { this.values.candidate = ""; this.show("offset"); }
    if (name === "sheet") { this.view.choose(this.values.sheet); if (this.open.kind === "swap" && this.values.other === this.values.sheet) this.set("other", this.values.sheet + (this.values.sheet ? -1 : 1)); }
    if (name === "ridge" || (name === "first" && this.open.kind === "assign")) this.offerRidges();
    this.changed();
  }

  set(name, value) {
    this.values[name] = value;
    this.show(); this.changed();
    if (name === "first" || name === "ridge") this.offerRidges();
  }

  /** The values in their fields, but for the one that is being typed in. */
  show(but = "") {
    for (const field of this.form.querySelectorAll("[data-field]")) {
      const name = field.dataset.field;
      if (name === but || name === "ridges") continue;
      const value = this.values[name], digits = { ridge: 1, axis: 1, offset: 4 }[name];
      field.value = value == null ? "" : digits == null ? value : String(Number(Number(value).toFixed(digits)));
    }
  }

  /** What is sent to the program. */
  decision() {
    const v = this.values, kind = this.open.kind;
    const frames = { frames: `${v.first}:${v.stop >= this.view.end ? "" : v.stop}` };
    switch (kind) {
      case "swap": return { kind, sheets: [v.sheet, v.other], ...frames };
      case "assign": return { kind, sheet: v.sheet, ...frames, x_px: v.ridge };
      case "add": return { kind, frame: v.frame, x_px: v.ridge };
      case "delete": return { kind, sheet: v.sheet };
      case "axis": return { kind, x_px: v.axis };
      case "strip": return { kind, rows: `${v.z0}:${v.z1}` };
      case "clock": return { kind, offset_s: v.offset, drift_ppm: v.drift };
      default: return { kind, sheet: v.sheet, ...frames };
    }
  }

  /** Asks for the effect, soon: a slider moves faster than any answer. */
  changed(atOnce = false) {
    this.endTrial();
    this.asked += 1; // an answer on its way is about what stood there before
    this.enable(false);
    this.view.changed();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.preview(), atOnce ? 0 : 60);
  }

  async preview() {
    if (this.open?.fields.includes("ridge") && this.values.ridge == null) { this.refuse("Every ridge seen in this frame is a sheet's: click on a place, or give its column."); return; }
    const asked = (this.asked += 1), decision = this.decision();
    try {
      const effect = await this.page.preview(decision);
      if (asked !== this.asked || !this.open) return;
      this.view.effect = effect;
      this.enable(true);
      this.tell(effect);
    } catch (error) {
      if (asked !== this.asked || !this.open) return;
      this.view.effect = null;
      this.refuse(error.message);
    }
    this.view.changed();
  }

  tell(effect) {
    const box = this.form.querySelector("#effect");
    box.classList.remove("refused");
    const list = element("ul");
    for (const text of effect.lines) list.append(element("li", {}, text));
    box.replaceChildren(list);
  }

  refuse(text) {
    this.enable(false);
    const box = this.form.querySelector("#effect");
    box.classList.add("refused"); box.textContent = text;
  }

  /** Whether the effect is known, so that the decision can be kept, or the film tracked again first. */
  enable(ready) {
    this.ready = ready;
    for (const button of this.form.querySelectorAll("#keep, #retrack")) button.disabled = !ready;
  }

  /** Tracks the film again in another strip, beside the run, and shows what that would change. */
  async retrack() {
    if (!this.ready) return;
    const asked = (this.asked += 1), decision = this.decision();
    this.enable(false); this.trial = "running";
    try {
      const effect = await this.page.retrack(decision);
      if (asked !== this.asked || !this.open) return;
      this.trial = effect ? "done" : "";
      this.enable(true);
      if (!effect) { this.form.querySelector("#retrack").focus(); return; }
      this.view.effect = effect;
      this.tell(effect);
      const keep = this.form.querySelector("#keep");
      this.form.querySelector("#retrack").hidden = true; keep.hidden = false; keep.focus();
    } catch (error) {
      if (asked !== this.asked || !this.open) return;
      this.trial = ""; this.refuse(error.message); this.page.failed(error);
    }
    this.view.changed();
  }

  /** What was tracked again is not wanted. */
  endTrial() {
    if (!this.trial) return;
    this.trial = "";
    this.page.endTrial();
    const keep = this.form.querySelector("#keep");
    if (keep) { keep.hidden = true; this.form.querySelector("#retrack").hidden = false; }
  }

  /** Kept only after its effect was shown. */
  async keep() {
    if (!this.open) return;
    if (!this.ready) { this.page.tell("Its effect is not known yet; nothing is kept."); return; }
    if (this.open.kind === "strip" && this.trial !== "done") { await this.retrack(); return; }
    const decision = this.decision(), tried = this.trial === "done";
    this.enable(false);
    if (await (tried ? this.page.keepTrial() : this.page.decide(decision))) { this.trial = ""; this.cancel(true); } else this.enable(true);
  }

  /** What the mouse does in the pictures while this decision is open. */
  tool(kind) {
    const own = this;
    if (kind === "assign" || kind === "add") return { pick: ({ frame, column }) => {
      if (kind === "assign" && frame !== own.values.first) own.values.first = frame;
      if (own.values.stop <= own.values.first) own.values.stop = own.values.first + 1;
      own.values.frame = frame;
      const seen = own.page.ridges(frame)?.candidates ?? [], near = seen.reduce((best, r) => (Math.abs(r.x_px - column) < Math.abs((best ?? Infinity) - column) ? r.x_px : best), null);
      own.set("ridge", near != null && Math.abs(near - column) < 0.5 * own.page.state.pitch_px ? near : Math.round(column * 10) / 10);
      return true;
    } };
    if (kind === "swap") return { pick: ({ frame, column }) => {
      const sheet = own.page.nearest(frame, column, own.page.state.pitch_px);
      if (sheet < 0) return false;
      own.values.first = frame;
      if (sheet !== own.values.sheet) own.values.other = sheet;
      own.set("first", frame); return true;
    } };
    if (kind === "axis") return {
      axisShown: () => own.values.axis,
      grab: ({ column, near }) => near(column, own.values.axis, "column"),
      drag: ({ column }) => own.set("axis", Math.round(column * 2) / 2),
      pick: ({ column }) => { own.set("axis", Math.round(column * 2) / 2); return true; },
    };
    if (kind === "strip") return this.stripTool();
    if (kind === "clock") return {
      clock: () => ({ ...own.page.state.clock, offset_s: own.values.offset, drift_ppm: own.values.drift }),
      slide: () => { const from = own.values.offset; return (seconds) => { own.values.candidate = ""; own.set("offset", from - seconds); }; },
    };
    return { pick: () => false };
  }

  stripTool() {
    const own = this, high = this.page.film.rows;
    let part = null;
    return {
      wholePicture: true,
      strip: () => [own.values.z0, own.values.z1],
      grab: ({ row, near }) => {
        const { z0, z1 } = own.values;
        part = near(row, z0, "row") ? "z0" : near(row, z1, "row") ? "z1" : row > z0 && row < z1 ? { row, z0, z1 } : null;
        return part !== null;
      },
      drag: ({ row }) => {
        const v = own.values;
        if (part === "z0") v.z0 = Math.max(0, Math.min(v.z1 - 1, Math.round(row)));
        else if (part === "z1") v.z1 = Math.max(v.z0 + 1, Math.min(high, Math.round(row)));
        else {
          const by = Math.max(-part.z0, Math.min(high - part.z1, Math.round(row - part.row)));
          v.z0 = part.z0 + by; v.z1 = part.z1 + by;
        }
        own.show(); own.changed();
      },
    };
  }
}

export function element(name, attributes = {}, text = null) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text != null) made.textContent = text;
  return made;
}
