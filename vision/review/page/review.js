/* The page: joins the views, the lists, the decisions and the program that serves them. */

import { Displacement, Force, ForceRecording, Stick } from "./curves.js";
import { Decisions, element, KINDS } from "./decisions.js";
import { Diagram, Tiles } from "./diagram.js";
import { effectOfClock, effectOfStrip, effectOfTrial, effectOn } from "./effect.js";
import { Film } from "./film.js";
import { getBytes, getJson, Gone, leave, post, Store, tryOut } from "./server.js";
import { number, themeChanged } from "./surface.js";
import { View } from "./view.js";

const WATCH_MS = 2000;
const RETRY_MS = 1000;
const SLIP_FRAMES = 3; // in a slip the stick after it is shown
const by = (id) => document.getElementById(id);

const HELP = [
  ["← →", "one frame back or on (with Shift ten)"], ["n p", "next or previous slip"], ["d", "next doubtful stretch (with Shift the one before)"],
  ["↑ ↓", "next sheet to the right or left"], ["+ −", "zoom in and out in time"], [". ,", "zoom in and out across the columns"], ["0", "the whole test"],
  ["PageUp PageDown", "move in time"], ["Home End", "first and last frame"], ["t", "show or hide the tracks"], ["w", "whole picture of the film"],
  ...KINDS.map(({ key, label }) => [key, label]), ["Enter", "keep the decision that is shown"], ["Esc", "cancel it"],
  ["u Ctrl+Z", "undo"], ["r Ctrl+Shift+Z", "redo"], ["Ctrl+S", "save"], ["Tab", "from one control to the next"], ["?", "these keys"],
];

class Page {
  async start() {
    this.view = new View();
    this.state = await getJson("api/run");
    const { state } = this, { first_frame: begin, frames, first_column: left, columns } = state;
    const times = new Float64Array(await getBytes("api/times"));
    this.tiles = new Tiles(state, () => this.drawAll());
    this.force = new ForceRecording(() => this.views.force?.redraw());
    this.ridgeStore = new Store((key) => getJson(`api/ridges/${key.split("/")[1]}`), () => { this.drawAll(); if (this.decisions.open) this.decisions.offerRidges(); }, 200);
    this.stickStore = new Store((key) => getJson(`api/stick/${key.split("/")[1]}`), () => this.drawAll(), 100);
    this.view.measure({ begin, end: begin + frames, left: left - 0.5, right: left + columns - 0.5, sheets: this.columns(), times });
    this.film = { rows: null, error: "" }; // until it is known: rows of its picture, or why there is none
    this.filmSlips = []; // frames after the sheets' own steps
    this.doubt = null; // what the list shows as chosen
    this.views = {
      film: new Film(by("film"), this.view, this),
      diagram: new Diagram(by("diagram"), this.view, this.tiles, this),
      tracks: new Displacement(by("tracks"), this.view, this.tiles, this),
      stick: new Stick(by("stick"), this.view, this),
    };
    if (state.clock) this.views.force = new Force(by("force"), this.view, this);
    by("force-view").hidden = !state.clock;
    by("stick-view").classList.toggle("none", !state.clock);
    this.decisions = new Decisions(this, by("decision"), by("kinds"));
    this.view.addEventListener("change", () => this.drawAll());
    this.listen();
    this.keys();
    by("title").textContent = by("title").title = state.name; document.title = `${state.name} – review`;
    this.take(state);
    this.watch();
    this.film = await getJson("api/film");
    this.decisions.offer(); this.drawAll();
    await this.arrived();
    await this.begun();
  }

  /** Waits for the pictures: what the program has to read the run for is asked after them. */
  async arrived() {
    await new Promise((done) => { requestAnimationFrame(() => requestAnimationFrame(done)); });
    const stores = [this.tiles.pictures, this.tiles.blocks, this.views.film.pictures, this.force.parts, this.ridgeStore, this.stickStore];
    while (stores.some((one) => one.asked.size)) await Promise.all(stores.flatMap((one) => [...one.asked.values()]));
  }

  /** The program reads the run, if it has not done so, and prepares what is slow the first time. */
  async begun() {
    await getJson("api/state");
    this.force.coarse = false; this.drawAll();
    this.slipsNow();
    const [stick] = this.state.sticks;
    if (stick) getJson(`api/stick/${stick.event}`).catch((error) => this.failed(error)); // the first takes longer
    await this.tracking().catch((error) => this.failed(error)); // where that was begun before this page was loaded
  }

  /** Frames after slips: `slips` by the clock in force, `film` by the sheets' own steps. */
  slipsNow() {
    const { revision } = this.state;
    if (this.slipsOf !== revision) {
      this.slipsOf = revision;
      this.slips = getJson("api/slips");
      this.slips.then(({ film }) => { this.filmSlips = film; this.drawAll(); }, () => { this.slipsOf = null; });
    }
    return this.slips;
  }

  /* ---- what is shown ---- */

  drawAll() {
    for (const one of Object.values(this.views ?? {})) one.redraw();
    if (this.telling || !this.views) return;
    this.telling = true;
    requestAnimationFrame(() => { this.telling = false; this.facts(); });
  }

  /** Words beside the pictures, and in them for those who cannot see them. */
  facts() {
    const { view, state } = this, sheet = state.sheets[view.sheet], column = this.column(view.sheet);
    const time = number(view.seconds(view.frame), 3), name = this.name(sheet);
    const here = column == null ? this.flag(view.sheet) : `x = ${number(column, 2)} px`;
    this.say("where", `frame ${view.frame} of ${view.begin}–${view.end - 1} · ${time} s`);
    this.say("at-sheet", `${name}: ${here}`);
    by("at-sheet").title = `${name}: ${here}`;
    const [z0, z1] = this.strip();
    by("film-facts").textContent = `rows ${z0}:${z1} · ${state.sheets.length} sheets · axis ${number(state.axis_px, 1)} px`;
    by("diagram-facts").textContent = `${number(view.seconds(view.first), 2)}–${number(view.seconds(view.last), 2)} s · ${number(Math.max(0, view.low), 0)}–${number(view.high, 0)} px`;
    const others = this.views.tracks.sheets().filter((one) => one !== sheet);
    by("tracks-facts").textContent = `${name} (bold)${others.length > 4 ? ` and ${others.length} others` : others.map((one) => `, ${this.name(one)}`).join("")}`;
    const clock = this.clock();
    if (clock) by("force-facts").textContent = `${clock.status === "ambiguous" ? "clocks ambiguous, drawn at the likeliest " : ""}offset ${number(clock.offset_s, 3)} s, drift ${number(clock.drift_ppm, 0)} ppm${clock.status === "ambiguous" ? "" : ` · clocks ${clock.status}`}`;
    const stick = this.stick(view.frame), ratio = stick?.sheets.find((one) => one.index === view.sheet)?.ratio;
    by("stick-facts").textContent = stick ? `stick ${stick.event}${this.shellText(stick)}` : "";
    by("film").setAttribute("aria-label", `Film, frame ${view.frame}, ${time} s, strip of rows ${z0} to ${z1}, ${state.sheets.length} sheets; ${name} is chosen, ${here}`);
    by("diagram").setAttribute("aria-label", `Space-time diagram from ${number(view.seconds(view.first), 2)} to ${number(view.seconds(view.last), 2)} s, columns ${number(view.low, 0)} to ${number(view.high, 0)} px; cursor at frame ${view.frame}`);
    by("tracks").setAttribute("aria-label", `Displacement of the sheets around ${name}; at the cursor ${here}`);
    by("stick").setAttribute("aria-label", stick ? `Relative deformation in stick ${stick.event}; ${name}: ${number(ratio, 3)}; threshold ${state.threshold}${this.shellText(stick)}` : this.noStick());
    by("force").setAttribute("aria-label", `Force along the same time; ${by("force-facts").textContent}`);
  }

  shellText(stick) {
    const of = (side) => stick.shells?.find((one) => one.side === side)?.stiff_sheets ?? "–";
    return stick.shells?.length ? `, stiff: left ${of(-1)}, right ${of(1)}` : "";
  }

  /** Columns between which the sheets stand, with some room. */
  columns() {
    const { sheets, pitch_px: pitch, first_column: left, columns } = this.state;
    return sheets.length ? [sheets[0].x_px - 2.5 * pitch, sheets.at(-1).x_px + 2.5 * pitch] : [left, left + columns];
  }

  name(sheet) { return sheet ? `${sheet.side < 0 ? "left" : "right"} ${sheet.n}` : "no sheet"; }
  strip() { return this.view.tool?.strip?.() ?? this.state.strip; }
  clock() { return this.view.tool?.clock?.() ?? this.state.clock; }
  ridges(frame) { return this.ridgeStore.get(`${this.state.revision}/${frame}`); }
  nearest(frame, column, within) { return this.views.diagram.nearest(frame, column, within); }

  /** A sheet's column in the cursor's frame, null where it has none or it is not known yet. */
  column(sheet) {
    const column = this.tiles.at(this.view.frame)?.(sheet);
    return Number.isFinite(column) ? column : null;
  }

  /** Why a sheet has no position in the cursor's frame. */
  flag(sheet) {
    const one = this.ridges(this.view.frame)?.sheets[sheet];
    return one ? one.why || one.flag.replace("_", " ") : "…";
  }

  /** Deformation in the stick phase of a frame; null where there is none, or it is on its way. */
  stick(frame) {
    const { sticks, revision, clock } = this.state;
    if (!clock || clock.status === "ambiguous") return null;
    const phase = sticks.find((one) => frame < one.stop);
    return phase && frame >= phase.first - SLIP_FRAMES ? this.stickStore.get(`${revision}/${phase.event}`) : null;
  }

  noStick() {
    if (!this.state.clock) return "Without a force recording there is no σₓ/Λₛₜ.";
    if (this.state.clock.status === "ambiguous") return "The clocks are ambiguous: choose one (Clocks) to get σₓ/Λₛₜ.";
    return "No complete stick phase at the cursor.";
  }

  whereabouts(doubt) { return doubt.x_expected_px ?? doubt.x_withheld_px ?? this.state.sheets[doubt.sheet]?.x_px ?? 0; }
  isChosen(doubt) { return this.doubt?.sheet === doubt.sheet && this.doubt.first === doubt.first; }

  /** The doubt about the chosen sheet at the cursor. */
  doubtAt() {
    const { frame, sheet } = this.view;
    return this.state.doubts.find((d) => d.sheet === sheet && frame >= d.first && frame < d.stop) ?? null;
  }

  /* ---- what the program says ---- */

  /** A new state of the run: everything that depends on decisions. */
  take(state) {
    const other = state.revision !== this.state.revision;
    this.state = state;
    this.tiles.use(state.revision, state.sheets.length);
    this.view.sheets = this.columns();
    this.view.sheet = Math.max(0, Math.min(state.sheets.length - 1, this.view.sheet));
    if (other && this.decisions.open) this.decisions.cancel(true);
    this.listWarnings(); this.listDoubts(); this.listHistory(); this.buttons(); this.decisions.offer();
    this.windows(state.other_windows);
    this.unseen(state.unseen ?? []);
    this.view.changed();
  }

  async refresh() { this.take(await getJson("api/run")); }

  buttons() {
    const { state } = this, last = state.decisions.at(-1)?.text, again = state.undone.at(-1)?.text;
    const busy = Boolean(this.saving || this.trying || this.lost || this.ended);
    by("undo").disabled = busy || !state.can_undo; by("undo").title = last ? `Undo: ${last} (u)` : "Nothing to undo";
    by("redo").disabled = busy || !state.can_redo; by("redo").title = again ? `Redo: ${again} (r)` : "Nothing to redo";
    by("save").disabled = busy || !state.changed; by("close").disabled = Boolean(this.ended);
    const waiting = state.decisions.filter((one) => !one.saved).length;
    // decisions are on the disk as soon as the history shows them; saving makes the run's tables follow
    const [kind, text] = this.ended ? ["lost", "The review has ended"]
      : this.lost ? ["lost", "Does not answer – trying again …"]
        : this.saving ? ["open", "Saving …"]
          : state.changed ? ["open", waiting ? `${waiting === 1 ? "1 decision" : `${waiting} decisions`} not in the tables yet` : "The tables still contain undone decisions"]
            : ["saved", this.savedAt ? `Saved at ${this.savedAt}` : "Tables are up to date"];
    this.say("connection", text);
    by("connection").dataset.state = kind;
  }

  listWarnings() {
    const { warnings } = this.state;
    by("warnings-view").hidden = !warnings.length;
    by("warnings-name").textContent = warnings.length === 1 ? "1 warning of the run" : `${warnings.length} warnings of the run`;
    by("warnings").replaceChildren(...warnings.map((line) => element("li", {}, line)));
  }

  listDoubts() {
    const list = by("doubts"), { doubts } = this.state;
    by("doubts-view").classList.toggle("empty", !doubts.length);
    by("doubts-count").textContent = doubts.length ? `${doubts.length}, worst first` : "none left";
    list.replaceChildren();
    for (const doubt of doubts) {
      const button = element("button", { type: "button" });
      const frames = doubt.stop - doubt.first > 1 ? `frames ${doubt.first}–${doubt.stop - 1}` : `frame ${doubt.first}`;
      button.append(`${this.name(this.state.sheets[doubt.sheet])}, ${frames} (${number(this.view.seconds(doubt.first), 2)} s): `, element("span", { class: "why" }, doubt.why));
      button.addEventListener("click", () => this.goToDoubt(doubt));
      const item = element("li"); item.append(button); list.append(item);
    }
    if (!doubts.length) list.append(element("li", { class: "none" }, "No stretch is doubtful, or without a ridge."));
    this.markDoubt();
  }

  markDoubt() {
    const buttons = by("doubts").querySelectorAll("button");
    this.state.doubts.forEach((doubt, i) => {
      if (!this.isChosen(doubt)) { buttons[i].removeAttribute("aria-current"); return; }
      buttons[i].setAttribute("aria-current", "true"); buttons[i].scrollIntoView({ block: "nearest" });
    });
  }

  goToDoubt(doubt) {
    const { view, state } = this, width = Math.max(40, 2.5 * (doubt.stop - doubt.first)), middle = (doubt.first + doubt.stop) / 2;
    this.doubt = doubt;
    view.sheet = doubt.sheet;
    const column = this.whereabouts(doubt);
    view.setFrames(middle - width / 2, middle + width / 2);
    view.setColumns(column - 6 * state.pitch_px, column + 6 * state.pitch_px);
    view.goTo(doubt.first);
    this.markDoubt();
    this.tell(`${this.name(state.sheets[doubt.sheet])}, frames ${doubt.first} to ${doubt.stop - 1}: ${doubt.why}`);
  }

  nextDoubt(way) {
    const { doubts } = this.state, now = doubts.findIndex((d) => this.isChosen(d));
    if (!doubts.length) { this.tell("No stretch is doubtful, or without a ridge."); return; }
    this.goToDoubt(doubts[now < 0 ? (way > 0 ? 0 : doubts.length - 1) : (now + way + doubts.length) % doubts.length]);
  }

  listHistory() {
    const list = by("history"), { decisions, undone } = this.state;
    const entries = [...decisions.map((one) => [one, one.saved ? "in the tables" : ""]), ...undone.toReversed().map((one) => [one, "undone"])];
    list.replaceChildren();
    for (const [i, [one, state]] of entries.entries()) {
      const item = element("li", state === "undone" ? { class: "undone" } : {});
      item.append(element("span", { class: "what" }, `${i + 1}. ${one.text}`), " ", element("span", { class: "when" }, [clockTime(one.date), state].filter(Boolean).join(", ")));
      list.append(item);
    }
    if (!entries.length) list.append(element("li", { class: "none" }, "Nothing decided yet."));
    by("history-count").textContent = decisions.length ? `${decisions.length} in force` : "";
    list.scrollTop = Math.max(0, (list.children[Math.max(0, decisions.length - 1)]?.offsetTop ?? 0) - list.offsetTop - 30);
  }

  /* ---- what is decided ---- */

  /** What a decision would change: lines in words, curves, the stick at the cursor, ridges of another strip. */
  async preview(decision) {
    const { view, state } = this, { frame } = view, name = (sheet) => this.name(state.sheets[sheet]);
    if (decision.kind === "strip") {
      const rows = state.strip.join(":");
      if (this.present?.key !== `${rows} ${frame}`) this.present = { key: `${rows} ${frame}`, ridges: await tryOut("api/strip", { rows, frame }) };
      return effectOfStrip(this.present.ridges, await tryOut("api/strip", { rows: decision.rows, frame }));
    }
    if (decision.kind === "clock") {
      const answer = await tryOut("api/clock", { offset_s: decision.offset_s, drift_ppm: decision.drift_ppm, frame });
      return effectOfClock(answer, (await this.slipsNow()).film, (at) => view.seconds(at), view.seconds(view.begin + 1) - view.seconds(view.begin), this.stick(frame));
    }
    return effectOn(await tryOut("api/preview", { decision, frame }), decision, name, this.noStick());
  }

  async decide(decision) { return this.ask("api/decisions", { decision }, () => `Kept: ${this.state.decisions.at(-1)?.text}`); }
  async undo() { if (!by("undo").disabled) { const text = this.state.decisions.at(-1)?.text; await this.ask("api/undo", {}, () => `Undone: ${text}`); } }
  async redo() { if (!by("redo").disabled) await this.ask("api/redo", {}, () => `Done again: ${this.state.decisions.at(-1)?.text}`); }

  async ask(path, body, done) {
    try {
      await post(path, { ...body, revision: this.state.revision });
      await this.refresh();
      this.tell(done());
      return true;
    } catch (error) { this.failed(error); return false; }
  }

  failed(error) {
    if (error instanceof Gone) this.gone();
    this.tell(error instanceof Gone ? "The program does not answer; nothing was changed." : error.message);
  }

  /** Tracks the film again under a decision that is not kept; what that would change, null where it was cancelled. */
  async retrack(decision) {
    this.trying = true; this.buttons();
    try {
      await post("api/retrack", { decision });
      this.tell("Tracking again …");
      const found = await this.tracking(), { frame } = this.view;
      if (!found) { this.tell("Not tracked again."); return null; }
      const waiting = this.state.decisions.filter((one) => !one.saved).length;
      const effect = effectOfTrial(found, await getJson(`api/retracked/${frame}`), waiting);
      this.tell("Tracked again: its effect is shown; nothing is kept yet.");
      return effect;
    } finally { this.trying = false; this.buttons(); }
  }

  /** Waits until the film has been tracked again; null where it is not, or was cancelled. */
  async tracking() {
    try {
      for (;;) {
        const news = await getJson("api/retrack");
        if (!news.running) {
          if (news.error && news.error !== "cancelled") throw new Error(news.error);
          return news.found;
        }
        this.progress({ ...news, stage: `Tracking again: ${news.stage}`, stops: true });
        await new Promise((done) => { setTimeout(done, 150); });
      }
    } finally { if (!this.saving) by("saving").hidden = true; }
  }

  endTrial() { post("api/retrack/cancel").catch((error) => this.failed(error)); }

  async keepTrial() {
    const kept = await this.ask("api/retrack/keep", {}, () => `Kept and saved: ${this.state.decisions.at(-1)?.text}`);
    if (kept) { this.savedAt = clockTime(new Date().toISOString()); this.buttons(); }
    return kept;
  }

  async save() {
    if (by("save").disabled) return;
    try {
      this.saving = true;
      this.buttons(); this.progress({ stage: "Saving" });
      await post("api/save", { revision: this.state.revision });
      this.tell("Saving …");
      await this.saved();
    } catch (error) { this.stopSaving(); this.failed(error); }
  }

  /** Waits until the program says that everything is in the run folder, or why it is not. */
  async saved() {
    for (;;) {
      const news = await getJson("api/save");
      if (news.error) { this.stopSaving(); this.notice(`Not saved: ${news.error}`); this.tell(`Not saved: ${news.error}`); return; }
      if (!news.running) break;
      this.progress({ ...news, stage: `Saving: ${news.stage}` });
      await new Promise((done) => { setTimeout(done, 150); });
    }
    this.savedAt = clockTime(new Date().toISOString());
    this.stopSaving();
    await this.refresh();
    this.notice(""); this.tell("Saved: the tables of the run folder hold these decisions.");
  }

  stopSaving() { this.saving = false; by("saving").hidden = true; this.buttons(); }

  progress({ stage, done, total, stops = false }) {
    const bar = by("progress");
    by("saving").hidden = false; by("stop").hidden = !stops;
    by("stage").textContent = total && done < total ? `${stage}, ${done} of ${total} frames` : stage;
    if (total) { bar.max = total; bar.value = done; } else bar.removeAttribute("value");
  }

  /* ---- the connection ---- */

  /** Asks now and then whether the program is there, and whether another window has decided something. */
  async watch() {
    while (!this.ended) {
      await new Promise((done) => { setTimeout(done, this.lost ? RETRY_MS : WATCH_MS); });
      if (this.saving || this.ended) continue;
      try {
        const { revision, other_windows: others } = await getJson("api/state");
        if (this.lost) { this.lost = false; this.notice(""); this.tell("The program answers again."); await this.refresh(); }
        if (revision !== this.state.revision) { await this.refresh(); this.tell("Decided in another window."); }
        this.windows(others);
      } catch (error) { if (error instanceof Gone) this.gone(); else this.tell(error.message); }
    }
  }

  windows(others) {
    if (others === this.others) return;
    this.others = others;
    this.notice(others ? `This run is open in ${others === 1 ? "another window, too" : `${others} other windows, too`}; all show the same decisions. Decide in one of them only.` : "");
  }

  /** What was taken back, but is shown as before until the run is saved. */
  unseen(texts) {
    if (texts.length) this.notice(`Undone, but still shown until you save: ${texts.join("; ")}.`);
    else if (by("notice").textContent.startsWith("Undone, but")) this.notice("");
  }

  /** The end is the last notice: a late answer does not replace it. */
  notice(text) {
    if (this.ended) return;
    by("notice").textContent = text; by("notice").hidden = !text;
  }

  gone() {
    if (this.lost || this.ended) return;
    this.lost = true; this.stopSaving();
    this.notice("The program does not answer. Everything in the history is kept in the run folder; if it has ended, start “track review” again.");
    this.buttons();
  }

  async close() {
    if (this.state.changed && !this.warned) {
      this.warned = true;
      this.notice("The tables do not hold all decisions yet. Save first, or press “End review” again: the decisions themselves are kept in corrections.toml.");
      return;
    }
    try {
      // The program's end may overtake its answer.
      await post("api/quit").catch((error) => { if (!(error instanceof Gone)) throw error; });
      this.notice("The review has ended; this window can be closed.");
      this.ended = true;
      this.buttons();
    } catch (error) { this.failed(error); }
  }

  tell(text) { by("message").textContent = text; }

  /** Words that a screen reader says when they change, and only then. */
  say(id, text) { if (by(id).textContent !== text) by(id).textContent = text; }

  /* ---- keys and buttons ---- */

  async slip(way) {
    const { view } = this;
    try {
      const { slips } = await this.slipsNow();
      const next = way > 0 ? slips.find((frame) => frame > view.frame) : slips.findLast((frame) => frame < view.frame);
      if (next == null) { this.tell(way > 0 ? "No slip after this." : "No slip before this."); return; }
      view.goTo(next);
      this.tell(`Slip at ${number(view.seconds(next), 3)} s`);
    } catch (error) { this.failed(error); }
  }

  step(sheets) {
    const { view, state } = this;
    view.choose(Math.max(0, Math.min(state.sheets.length - 1, view.sheet + sheets)));
    const column = state.sheets[view.sheet]?.x_px;
    if (column != null && (column < view.low || column > view.high)) view.setColumns(column - (view.high - view.low) / 2, column + (view.high - view.low) / 2);
  }

  zoomColumns(factor) { this.view.zoomColumns(factor, this.state.sheets[this.view.sheet]?.x_px ?? (this.view.low + this.view.high) / 2); }

  listen() {
    const { view } = this, on = (id, work) => by(id).addEventListener("click", work);
    on("undo", () => this.undo()); on("redo", () => this.redo()); on("save", () => this.save());
    on("theme", () => this.theme()); on("help", () => this.help()); on("close", () => this.close());
    on("stop", () => this.endTrial());
    on("keys-close", () => by("keys").close());
    on("next-doubt", () => this.nextDoubt(1));
    on("slip-before", () => this.slip(-1)); on("slip-after", () => this.slip(1));
    on("frame-before", () => view.goTo(view.frame - 1)); on("frame-after", () => view.goTo(view.frame + 1));
    on("time-in", () => { view.zoomFrames(0.6); this.zoomColumns(0.6); });
    on("time-out", () => { view.zoomFrames(1 / 0.6); this.zoomColumns(1 / 0.6); });
    on("whole", () => view.whole());
    on("tracks-shown", () => this.toggleTracks()); on("film-whole", () => this.toggleFilm());
    by("chosen").addEventListener("change", (event) => { this.views.tracks.which = event.target.value; this.drawAll(); });
    addEventListener("pagehide", leave);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (!this.ownTheme) this.paint(); });
    this.paint();
    for (const [press, what] of HELP) {
      const row = element("div"), keys = element("span", { class: "press" });
      for (const key of press.split(" ")) keys.append(element("kbd", {}, key), " ");
      row.append(keys, element("span", { class: "what" }, what)); by("keys-table").append(row);
    }
  }

  toggleTracks() { const { diagram } = this.views; diagram.tracksShown = !diagram.tracksShown; by("tracks-shown").setAttribute("aria-pressed", String(diagram.tracksShown)); this.drawAll(); }
  toggleFilm() { const { film } = this.views; film.wholePicture = !film.wholePicture; by("film-whole").setAttribute("aria-pressed", String(film.wholePicture)); this.drawAll(); }
  help() { if (!by("keys").open) by("keys").showModal(); }

  theme() { this.ownTheme = document.documentElement.dataset.theme === "dark" ? "light" : "dark"; this.paint(); }

  paint() {
    const theme = this.ownTheme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    document.documentElement.dataset.theme = theme;
    by("theme").textContent = theme === "dark" ? "Light" : "Dark";
    by("theme").setAttribute("aria-label", `${by("theme").textContent} colours`);
    themeChanged(); this.drawAll();
  }

  keys() {
    const { view } = this, page = () => 0.8 * (view.last - view.first);
    const plain = {
      ArrowLeft: (e) => view.goTo(view.frame - (e.shiftKey ? 10 : 1)), ArrowRight: (e) => view.goTo(view.frame + (e.shiftKey ? 10 : 1)),
      ArrowUp: () => this.step(1), ArrowDown: () => this.step(-1),
      PageUp: () => view.setFrames(view.first - page(), view.last - page()), PageDown: () => view.setFrames(view.first + page(), view.last + page()),
      Home: () => view.goTo(view.begin), End: () => view.goTo(view.end - 1),
      n: () => this.slip(1), p: () => this.slip(-1), d: () => this.nextDoubt(1), D: () => this.nextDoubt(-1),
      "+": () => view.zoomFrames(0.6), "=": () => view.zoomFrames(0.6), "-": () => view.zoomFrames(1 / 0.6),
      ".": () => this.zoomColumns(0.6), ",": () => this.zoomColumns(1 / 0.6), "0": () => view.whole(), t: () => this.toggleTracks(), w: () => this.toggleFilm(),
      u: () => this.undo(), r: () => this.redo(), "?": () => this.help(), Enter: (e) => this.enter(e),
      ...Object.fromEntries(KINDS.map(({ key, kind }) => [key, () => this.decisions.begin(kind)])),
    };
    document.addEventListener("keydown", (event) => {
      if (by("keys").open) return;
      const target = event.target, typing = target.matches("input, select, textarea");
      if (event.key === "Escape") { this.decisions.cancel(); target.blur?.(); return; }
      if (event.ctrlKey || event.metaKey) {
        const key = event.key.toLowerCase();
        if (key === "s") { event.preventDefault(); this.save(); }
        else if (!typing && key === "z") { event.preventDefault(); if (event.shiftKey) this.redo(); else this.undo(); }
        else if (!typing && key === "y") { event.preventDefault(); this.redo(); }
        return;
      }
      if (event.altKey || typing) { if (typing && event.key === "Enter" && target.matches("select")) { event.preventDefault(); this.decisions.keep(); } return; }
      if (target.matches("button") && (event.key === "Enter" || event.key === " ")) return;
      const work = plain[event.key];
      if (work) { event.preventDefault(); work(event); }
    });
  }

  enter() { if (this.decisions.open) this.decisions.keep(); }
}

/** Hours and minutes of a date, where the reader is; with its day where that is not today. */
function clockTime(date) {
  const at = new Date(date), two = (value) => String(value).padStart(2, "0"), time = `${two(at.getHours())}:${two(at.getMinutes())}`;
  if (Number.isNaN(at.getTime())) return "";
  if (at.toDateString() === new Date().toDateString()) return time;
  return `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())} ${time}`;
}

const page = new Page();
window.review = page; // for the console: what is shown, and where
page.start().catch((error) => {
  by("notice").textContent = `The run cannot be shown: ${error.message}`; by("notice").hidden = false;
});
