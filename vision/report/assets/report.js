"use strict";
/* Draws the page's figures from its own data; nothing is loaded from anywhere. */
(() => {
  const page = JSON.parse(document.getElementById("data").textContent);
  const root = document.documentElement;
  const dark = () => root.dataset.theme === "dark";
  const ink = (pair) => pair[dark() ? 1 : 0];
  const css = (name) => getComputedStyle(root).getPropertyValue(name).trim();

  /* ---- arrays ---- */
  const blobs = page.blobs.map((text) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new DataView(bytes.buffer);
  });
  function decode(array) {
    if (array.v) return array.v;
    const view = blobs[array.b], count = view.byteLength / 2, out = new Array(count);
    for (let i = 0; i < count; i++) {
      const code = view.getInt16(2 * i, true);
      out[i] = code === -32768 ? null : array.start + array.slope * i + array.step * code;
    }
    return out;
  }
  /* One grid for all series: shared as it is, else every point a row of its own, sorted by x. */
  function grid(chart, arrays) {
    const all = chart.series.map((s) => [s.shift ? arrays[s.x].map((x) => x + s.shift) : arrays[s.x], arrays[s.y]]);
    if (chart.common_x) return { data: [all[0][0], ...all.map((p) => p[1])], rows: null };
    const rows = [];
    all.forEach(([xs], s) => xs.forEach((x, i) => rows.push([x, s, i])));
    rows.sort((a, b) => a[0] - b[0] || a[1] - b[1] || a[2] - b[2]);
    const data = [rows.map((r) => r[0]), ...all.map(() => new Array(rows.length).fill(null))];
    rows.forEach(([, s, i], k) => { data[s + 1][k] = all[s][1][i]; });
    return { data, rows };
  }
  const short = (v) => (v == null || !isFinite(v) ? "" : String(parseFloat(v.toPrecision(6))).replace("-", "−"));

  /* ---- what uPlot does not draw by itself ---- */
  function underlay(u, chart, image) {
    const c = u.ctx, timeDown = chart.time_down, box = u.bbox;
    const place = (v, key) => u.valToPos(v, key, true);
    c.save(); c.beginPath(); c.rect(box.left, box.top, box.width, box.height); c.clip();
    if (image) {
      const p = chart.picture, keys = timeDown ? ["y", "x"] : ["x", "y"];
      const x0 = place(p.left, keys[0]), x1 = place(p.right, keys[0]);
      const y0 = place(p.top, keys[1]), y1 = place(p.bottom, keys[1]);
      c.imageSmoothingEnabled = Math.abs(x1 - x0) < image.width;
      c.drawImage(image, x0, y0, x1 - x0, y1 - y0);
    }
    for (const band of chart.bands) {
      const y0 = place(band.high, "y"), y1 = place(band.low, "y");
      if (band.outline) {
        const [l, r] = band.across || chart.x_range, x0 = place(l, "x"), x1 = place(r, "x");
        c.strokeStyle = page.style.outline; c.lineWidth = 2 * devicePixelRatio;
        c.strokeRect(x0, Math.min(y0, y1), x1 - x0, Math.abs(y1 - y0));
      } else {
        c.fillStyle = dark() ? "rgba(190,195,205,0.18)" : "rgba(100,105,115,0.16)";
        c.fillRect(box.left, Math.min(y0, y1), box.width, Math.abs(y1 - y0));
      }
    }
    if (chart.picture && chart.switchable && chart.common_x) casing(u, chart);
    c.strokeStyle = chart.picture ? "#fff" : css("--soft"); c.lineWidth = 1.4 * devicePixelRatio;
    c.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const x of chart.x_lines) {
      const at = place(x, "x");
      c.beginPath(); c.moveTo(at, box.top); c.lineTo(at, box.top + box.height); c.stroke();
    }
    c.restore();
  }
  /* One track as a path. A jump in a space-time diagram is a gap, and a position between two jumps a dot: the
     lines of fast oscillations would fill areas, and hide the image. */
  function trace(u, chart, k, path) {
    const xs = u.data[0], r = devicePixelRatio;
    let last = null;
    u.data[k].forEach((v, i) => {
      if (v == null) { last = null; return; }
      const across = u.valToPos(v, "y", true), along = u.valToPos(xs[i], "x", true);
      const p = chart.time_down ? [across, along] : [along, across];
      const far = last && Math.abs(across - last[0]), jump = far > 4 * r && far > 4 * Math.abs(along - last[1]);
      if (last && !(chart.time_down && jump)) path.lineTo(...p);
      else { path.moveTo(p[0] - 0.6 * r, p[1]); path.lineTo(p[0] + 0.6 * r, p[1]); path.moveTo(...p); }
      last = [across, along];
    });
  }
  /* A dark edge under tracks, which would be lost on white ridges. */
  function casing(u, chart) {
    const c = u.ctx;
    c.save(); c.strokeStyle = `${page.style.casing}b3`; c.setLineDash([]);
    chart.series.forEach((s, k) => {
      if (!u.series[k + 1].show) return;
      c.lineWidth = 1.9 * s.width * devicePixelRatio; c.beginPath();
      trace(u, chart, k + 1, c);
      c.stroke();
    });
    c.restore();
  }
  /* Times marked at both edges of a space-time diagram. */
  function ticks(u, chart) {
    if (!chart.marks.length) return;
    const c = u.ctx, box = u.bbox, r = devicePixelRatio;
    c.save(); c.strokeStyle = page.style.slips; c.setLineDash([]); c.lineWidth = 1.4 * r; c.beginPath();
    for (const t of chart.marks) {
      const at = u.valToPos(t, "x", true);
      if (at < box.top || at > box.top + box.height) continue;
      for (const [from, to] of [[box.left - 4 * r, box.left + 7 * r], [box.left + box.width - 7 * r, box.left + box.width + 4 * r]]) {
        c.moveTo(from, at); c.lineTo(to, at);
      }
    }
    c.stroke(); c.restore();
  }
  /* Lengths that are pointed out, with a head at either end. */
  function lengths(u, chart) {
    const c = u.ctx, box = u.bbox, r = devicePixelRatio;
    c.save(); c.beginPath(); c.rect(box.left, box.top, box.width, box.height); c.clip();
    c.setLineDash([]); c.lineWidth = 1.3 * r; c.strokeStyle = c.fillStyle = css("--text");
    c.font = `${13 * r}px system-ui, sans-serif`;
    for (const a of chart.arrows) {
      const [x0, x1] = a.x.map((v) => u.valToPos(v, "x", true)), [y0, y1] = a.y.map((v) => u.valToPos(v, "y", true));
      const turn = Math.atan2(y1 - y0, x1 - x0), upright = Math.abs(x1 - x0) < 1;
      c.beginPath(); c.moveTo(x0, y0); c.lineTo(x1, y1);
      for (const [x, y, way] of [[x0, y0, turn], [x1, y1, turn + Math.PI]]) {
        for (const off of [-0.4, 0.4]) { c.moveTo(x, y); c.lineTo(x + 8 * r * Math.cos(way + off), y + 8 * r * Math.sin(way + off)); }
      }
      c.stroke();
      c.textAlign = upright ? "left" : "center"; c.textBaseline = upright ? "middle" : "bottom";
      c.fillText(a.label, (x0 + x1) / 2 + (upright ? 6 * r : 0), (y0 + y1) / 2 - (upright ? 0 : 3 * r));
    }
    c.restore();
  }
  /* Every how many-th sheet has room for its number: 1, 2, 5, 10, 20 … */
  function labelStep(u, c, xs, text) {
    if (xs.length < 2) return 1;
    const wide = Math.max(...text.map((t) => c.measureText(t).width)) + 5 * devicePixelRatio;
    const span = Math.abs(u.valToPos(xs[xs.length - 1], "x", true) - u.valToPos(xs[0], "x", true));
    const least = wide / Math.max(1, span / (xs.length - 1));
    return [1, 2, 5, 10, 20, 50, 100, 200, 500].find((step) => step >= least) || 1000;
  }
  function bars(u, chart, arrays) {
    const c = u.ctx, box = u.bbox, r = devicePixelRatio;
    const above = chart.picture ? 15 * r : 0; /* numbers over a flat frame */
    c.save(); c.beginPath(); c.rect(box.left, box.top - above, box.width, box.height + above); c.clip();
    c.setLineDash([]);
    c.font = `${11 * r}px system-ui, sans-serif`; c.textAlign = "center"; c.textBaseline = "bottom";
    const labels = [], numbered = chart.series.filter((s) => s.text && s.text.length);
    const step = Math.max(1, ...numbered.map((s) => labelStep(u, c, arrays[s.x], s.text)));
    const first = Math.min(1, ...numbered.flatMap((s) => s.text.map(Number))); /* indices begin at 0 */
    chart.series.forEach((s, k) => {
      if (s.low === undefined || !u.series[k + 1].show) return;
      const last = s.text ? Math.max(...s.text.map(Number)) : null;
      const xs = arrays[s.x], low = arrays[s.low], high = arrays[s.high], key = s.axis === "right" ? "y2" : "y";
      c.strokeStyle = chart.picture ? s.ink[1] : ink(s.ink); c.lineWidth = (s.text ? 1 : 1.3) * r;
      c.globalAlpha = s.text || xs.length <= page.style.many ? 1 : 0.3; /* the bars of many points would hide them */
      xs.forEach((x, i) => {
        if (low[i] == null || high[i] == null) return;
        const at = u.valToPos(x + s.shift, "x", true), y0 = u.valToPos(low[i], key, true), y1 = u.valToPos(high[i], key, true);
        const stroke = s.text ? 0.2 * (y1 - y0) : (y1 - y0) / 2; /* the ridge between two strokes stays in view */
        c.beginPath(); c.moveTo(at, y0); c.lineTo(at, y0 + stroke); c.moveTo(at, y1 - stroke); c.lineTo(at, y1); c.stroke();
        const top = s.textY == null ? Math.min(y0, y1) : u.valToPos(s.textY, key, true);
        if (!s.text) return;
        const n = Number(s.text[i]), end = n === first || n === last;
        if (end || (n - first) % step === 0) labels.push([n, at, top - 2 * r, end ? 0 : 1]);
      });
    });
    /* Numbers, the first and outermost at once, beside the axis and not on it. */
    const lines = chart.x_lines.map((x) => u.valToPos(x, "x", true)), taken = [];
    for (let [n, at, top] of labels.sort((a, b) => a[3] - b[3] || a[0] - b[0])) {
      const half = c.measureText(n).width / 2 + 2 * r, beside = half + 2 * r;
      const free = (x) => !taken.some(([from, to]) => x - half < to + r && x + half > from - r);
      for (const line of lines) {
        if (Math.abs(at - line) >= beside) continue;
        const onLine = Math.abs(at - line) < half / 4, to = at < line ? -beside : beside;
        at = onLine && !free(line + to) ? line - to : line + to; /* on the line: where there is room */
      }
      if (!free(at)) continue;
      taken.push([at - half, at + half]);
      c.globalAlpha = 1;
      c.fillStyle = "rgba(0,0,0,0.62)"; c.fillRect(at - half, top - 13 * r, 2 * half, 14 * r);
      c.fillStyle = "#fff"; c.fillText(n, at, top);
    }
    c.restore();
  }

  /* Series of many points take turns, as in the drawn figures: else the last would hide the others. */
  const TURNS = page.style.turns, crowd = (chart, arrays) => {
    const many = chart.series.filter((s) => s.look === "points" && arrays[s.x].length > page.style.many);
    return many.length > 1 ? many : [];
  };
  function turns(u, k, chart, arrays) {
    const shown = crowd(chart, arrays).filter((s) => u.series[chart.series.indexOf(s) + 1].show);
    if (!shown.length || chart.series.indexOf(shown[shown.length - 1]) + 1 !== k) return;
    const c = u.ctx, box = u.bbox, r = devicePixelRatio;
    c.save(); c.beginPath(); c.rect(box.left, box.top, box.width, box.height); c.clip();
    c.setLineDash([]); c.lineWidth = 1.3 * r;
    for (let turn = 0; turn < TURNS; turn++) shown.forEach((s, rank) => {
      const xs = arrays[s.x], ys = arrays[s.y], key = s.axis === "right" ? "y2" : "y", radius = pointSize(s, chart) * r / 2;
      c.strokeStyle = c.fillStyle = ink(s.ink); c.beginPath();
      for (let i = (turn + TURNS - Math.floor(rank * TURNS / shown.length)) % TURNS; i < xs.length; i += TURNS) {
        if (ys[i] == null) continue;
        const x = u.valToPos(xs[i] + s.shift, "x", true), y = u.valToPos(ys[i], key, true);
        c.moveTo(x + radius, y); c.arc(x, y, radius, 0, 2 * Math.PI);
      }
      c[s.hollow ? "stroke" : "fill"]();
    });
    c.restore();
  }

  /* ---- one chart ---- */
  const signed = (s) => s.sheet[0] * s.sheet[1];
  /* Outer sheets on top, of each pair the dashed one: both sides are seen where they coincide. */
  function stack(chart) {
    if (!chart.series.every((s) => s.sheet)) return;
    const most = [-1, 1].map((side) => Math.max(...chart.series.filter((s) => s.sheet[0] === side).map((s) => s.sheet[1])));
    const pairs = Math.min(...most.filter(isFinite)), pair = (s) => Math.min(s.sheet[1], pairs);
    chart.series.sort((a, b) => pair(a) - pair(b) || a.dashed - b.dashed);
  }
  const crowded = (s, chart) => { const a = chart.arrays[s.x]; return !a.v || a.v.length > 250; };
  const pointSize = (s, chart) => (s.hollow ? 9 : 5) * (crowded(s, chart) ? 0.75 : 1);
  /* Values with none before or after them, of which a line shows nothing; null for none. */
  function singles(u, k) {
    const y = u.data[k], alone = [];
    for (let i = 0; i < y.length; i++) if (y[i] != null && y[i - 1] == null && y[i + 1] == null) alone.push(i);
    return alone.length ? alone : null;
  }
  function seriesOf(s, chart, arrays) {
    const points = (s.look === "points" || s.look === "both") && !crowd(chart, arrays).includes(s), line = ["line", "both"].includes(s.look);
    const colour = () => (chart.picture ? s.ink[1] : ink(s.ink));
    const out = {
      label: s.label, class: s.label ? undefined : "unnamed", scale: s.axis === "right" ? "y2" : "y", stroke: colour, width: s.width,
      dash: s.dashed ? [5, 3] : undefined, spanGaps: !chart.common_x, value: (u, v) => short(v), pxAlign: 0,
      points: { show: points, size: pointSize(s, chart), width: 1.3, stroke: colour, fill: s.hollow ? "transparent" : colour },
    };
    if (s.look === "line" && chart.common_x) out.points.filter = singles;
    if (s.look === "line" && chart.time_down && chart.common_x) {
      out.paths = (u, k) => { const stroke = new Path2D(); trace(u, chart, k, stroke); return { stroke, flags: 1 }; };
    }
    if (s.look === "steps") {
      out.paths = uPlot.paths.bars({ size: [1, Infinity], align: 0 });
      out.fill = () => ink(s.ink) + "80";
    } else if (!line) out.paths = () => null;
    return out;
  }
  function axis(label, extra) {
    return Object.assign({
      label, labelSize: 22, labelFont: "13px system-ui, sans-serif", font: "12px system-ui, sans-serif",
      stroke: () => css("--text"), grid: { stroke: () => css("--line"), width: 1 },
      ticks: { stroke: () => css("--line"), width: 1 },
      values: (u, splits) => numbers(splits),
    }, extra);
  }
  function numbers(splits) {
    const step = splits.length > 1 ? Math.abs(splits[1] - splits[0]) : 1;
    let digits = 0;
    while (digits < 9 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6 * step * 10 ** digits) digits++;
    return splits.map((v) => (v == null ? "" : v.toFixed(digits).replace("-", "−")));
  }
  const legendOf = (chart) => !chart.switchable && chart.series.some((s) => s.label) && !chart.series.some((s) => s.look === "ticks");

  function scalesOf(chart, arrays) {
    const fixed = (range) => (range ? (u, low, high) => (u.zoomed ? [low, high] : range) : undefined);
    const x = { time: false, range: xRange(chart) };
    const y = {};
    if (chart.y_range) y.range = fixed(chart.y_range);
    if (chart.time_down) { x.ori = 1; x.dir = -1; y.ori = 0; y.range = fixed(chart.y_range); }
    if (chart.downwards) y.dir = -1;
    if (!chart.y2_label) {
      if (!y.range && chart.series.some((s) => s.low !== undefined)) y.range = withBars(chart, arrays, "left", 0.05, 0.05);
      return { x, y };
    }
    /* two quantities, one above the other: neither hides the other */
    y.range = withBars(chart, arrays, "left", 1.15, 0.05);
    return { x, y, y2: { range: withBars(chart, arrays, "right", 0.05, 1.15) } };
  }
  /* The range of an axis: the values in view with their error bars, and these margins in units of their span. */
  function withBars(chart, arrays, axis, below, above) {
    return (u, low, high) => {
      const { min, max } = u.scales.x;
      for (const s of chart.series) {
        if (s.low === undefined || s.axis !== axis) continue;
        arrays[s.x].forEach((x, i) => {
          const ends = [arrays[s.low][i], arrays[s.high][i]];
          if ((min != null && (x < min || x > max)) || ends.some((end) => end == null || Number.isNaN(end))) return;
          low = Math.min(low ?? ends[0], ends[0]);
          high = Math.max(high ?? ends[1], ends[1]);
        });
      }
      return low == null ? [0, 1] : [low - below * (high - low || 1), high + above * (high - low || 1)];
    };
  }
  function xRange(chart) {
    return (u, low, high) => {
      if (u.zoomed) return [low, high];
      if (chart.x_range) return chart.x_range;
      if (low == null) return [0, 1];
      const edge = chart.series.every((s) => s.look === "line") ? 0 : 0.03;
      const pad = (high - low) * edge || (high === low ? 0.5 : 0);
      return [low - pad, high + pad];
    };
  }
  function sizeOf(chart, holder) {
    let width = Math.max(260, Math.floor(holder.clientWidth));
    if (chart.picture && !chart.time_down) { /* the plotted area has the stated shape; the rest are the axes */
      const across = 62, along = 56;
      if ((width - across) * chart.aspect > 560) width = Math.max(260, Math.floor(560 / chart.aspect) + across);
      return { width, height: Math.round((width - across) * chart.aspect) + along };
    }
    const least = chart.aspect < 0.3 ? 160 : 230;
    const height = Math.round(Math.max(least, Math.min(620, width * chart.aspect + 60)));
    return { width, height };
  }
  function options(chart, holder, arrays, image, readout) {
    const both = Boolean(chart.picture);
    const side = { size: (u, values) => 26 + 7.5 * Math.max(2, ...(values || []).map((v) => v.length)) };
    const below = { size: 34 }, [xLabel, yLabel, y2Label] = chart.axis_labels;
    const axes = chart.time_down
      ? [axis(xLabel, Object.assign({ side: 3 }, side)), axis(yLabel, Object.assign({ side: 2, space: 70 }, below))]
      : [axis(xLabel, Object.assign({ space: 60 }, below)), axis(yLabel, side)];
    const whole = [1, 2, 5, 10, 20, 50, 100, 200, 500];
    if (chart.whole_numbers) axes[0].incrs = whole;
    if (chart.y_whole_numbers) axes[1].incrs = whole;
    if (both) axes.forEach((a) => { a.grid = { show: false }; });
    if (chart.downwards) { /* rows of a frame: the first and the last in view */
      const last = chart.picture.bottom - 0.5;
      axes[1].splits = (u, axis, low, high) => [...new Set([Math.max(0, Math.ceil(low)), Math.min(last, Math.floor(high))])];
    }
    if (chart.y2_label) axes.push(axis(y2Label, Object.assign({ scale: "y2", side: 1, grid: { show: false } }, side)));
    return Object.assign(sizeOf(chart, holder), {
      scales: scalesOf(chart, arrays), axes,
      series: [{ label: xLabel, value: (u, v) => short(v) }, ...chart.series.map((s) => seriesOf(s, chart, arrays))],
      legend: { show: legendOf(chart) },
      focus: chart.switchable ? { alpha: 0.35 } : undefined,
      cursor: { drag: { x: true, y: both, uni: both ? 20 : undefined, setScale: false }, focus: { prox: chart.switchable ? 24 : -1 },
        points: { show: !both } },
      hooks: {
        drawClear: [(u) => underlay(u, chart, image)],
        drawSeries: [(u, k) => turns(u, k, chart, arrays)],
        draw: [(u) => { bars(u, chart, arrays); ticks(u, chart); lengths(u, chart); holder.parentElement.dataset.drawn = "yes"; }],
        setSelect: [(u) => select(u, chart)],
        setCursor: [(u) => read(u, chart, readout)],
      },
    });
  }
  function read(u, chart, readout) {
    if (!chart.switchable) return;
    const at = u.cursor.idx;
    if (at == null) { readout.textContent = ""; return; }
    const near = chart.nearest;
    const which = near ? `${u.series[near].label}: ${short(u.data[near][at])}` : "";
    readout.textContent = `${chart.axis_labels[0]} ${short(u.data[0][at])}   ${which}`;
  }
  function select(u, chart) {
    const s = u.select, timeDown = chart.time_down;
    if (s.width < 4 && s.height < 4) return;
    u.zoomed = true;
    const pick = (key, vertical) => {
      const a = u.posToVal(vertical ? s.top : s.left, key);
      const b = u.posToVal(vertical ? s.top + s.height : s.left + s.width, key);
      return { min: Math.min(a, b), max: Math.max(a, b) };
    };
    const x = pick("x", timeDown), y = pick("y", !timeDown);
    u.batch(() => {
      if (timeDown ? s.height > 4 : s.width > 4) u.setScale("x", x);
      if (chart.picture && (timeDown ? s.width > 4 : s.height > 4)) u.setScale("y", y);
    });
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  }
  function reset(u) {
    u.zoomed = false;
    u.setData(u.data, true);
  }
  function zoom(u, factor, shift) {
    const { min, max } = u.scales.x, half = ((max - min) * factor) / 2, middle = (min + max) / 2 + shift * (max - min);
    u.zoomed = true;
    u.setScale("x", { min: middle - half, max: middle + half });
    if (!u.shared) return;
    const y = u.scales.y, tall = ((y.max - y.min) * factor) / 2, centre = (y.min + y.max) / 2;
    u.setScale("y", { min: centre - tall, max: centre + tall });
  }
  function button(text, label, action) {
    const b = document.createElement("button");
    b.type = "button"; b.textContent = text; b.setAttribute("aria-label", label); b.title = label;
    b.addEventListener("click", action);
    return b;
  }

  /* ---- numbers as a table ---- */
  const quote = (v) => (/[",\n]/.test(v) ? `"${String(v).replaceAll('"', '""')}"` : v);
  function table(chart, arrays) {
    const cell = (v) => (v == null ? "" : v), lines = [];
    const plain = chart.series.every((s) => s.low === undefined && !s.text);
    if (chart.common_x && plain) {
      const listed = chart.series.every((s) => s.sheet) ? [...chart.series].sort((a, b) => signed(a) - signed(b)) : chart.series;
      lines.push([chart.x_label, ...listed.map((s) => s.label)].map(quote).join(","));
      const xs = arrays[listed[0].x], ys = listed.map((s) => arrays[s.y]);
      xs.forEach((x, i) => lines.push([x, ...ys.map((y) => cell(y[i]))].map((v) => (typeof v === "number" ? +v.toPrecision(8) : v)).join(",")));
    } else {
      lines.push(["series", "quantity", chart.x_label, "y", "low", "high", "text"].map(quote).join(","));
      for (const s of chart.series) {
        const label = s.axis === "right" ? chart.y2_label : chart.y_label;
        arrays[s.x].forEach((x, i) => {
          const row = [s.label, label, x, arrays[s.y][i], ...(s.low === undefined ? ["", ""] : [arrays[s.low][i], arrays[s.high][i]])];
          lines.push([...row.map(cell), s.text ? s.text[i] : ""].map(quote).join(","));
        });
      }
    }
    return lines.join("\n") + "\n";
  }
  function download(name, blob) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  /* ---- figures as files: uPlot draws once more, on a context that writes SVG in place of pixels ---- */
  const two = (v) => +v.toFixed(2);
  const escaped = (text) => String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll('"', "&quot;");
  class VectorPath {
    d = "";
    moveTo(x, y) { this.d += `M${two(x)} ${two(y)}`; }
    lineTo(x, y) { this.d += `${this.d ? "L" : "M"}${two(x)} ${two(y)}`; }
    bezierCurveTo(...p) { this.d += `C${p.map(two).join(" ")}`; }
    closePath() { this.d += "Z"; }
    rect(x, y, w, h) { this.d += `M${two(x)} ${two(y)}h${two(w)}v${two(h)}h${two(-w)}Z`; }
    arc(x, y, r) { this.d += `M${two(x - r)} ${two(y)}a${two(r)} ${two(r)} 0 1 0 ${two(2 * r)} 0a${two(r)} ${two(r)} 0 1 0 ${two(-2 * r)} 0`; }
    addPath(other) { this.d += other.d; }
  }
  class VectorContext {
    parts = []; clips = 0; stack = []; path = new VectorPath();
    state = { strokeStyle: "#000", fillStyle: "#000", lineWidth: 1, lineJoin: "miter", lineCap: "butt", font: "10px sans-serif",
      textAlign: "start", textBaseline: "alphabetic", globalAlpha: 1, dash: [], move: "", within: "" };
    measure = document.createElement("canvas").getContext("2d");
    constructor() {
      for (const key of Object.keys(this.state)) Object.defineProperty(this, key, { get: () => this.state[key], set: (v) => { this.state[key] = v; } });
      for (const name of ["moveTo", "lineTo", "bezierCurveTo", "closePath", "rect", "arc"]) this[name] = (...p) => this.path[name](...p);
    }
    save() { this.stack.push({ ...this.state }); }
    restore() { this.state = this.stack.pop() || this.state; }
    beginPath() { this.path = new VectorPath(); }
    translate(x, y) { this.move += `translate(${two(x)} ${two(y)})`; }
    rotate(a) { this.move += `rotate(${two((a * 180) / Math.PI)})`; }
    setLineDash(dash) { this.dash = [...dash]; }
    clearRect() {}
    measureText(text) { this.measure.font = this.font; return this.measure.measureText(text); }
    put(element) { this.parts.push(this.within ? `<g clip-path="url(#${this.within})">${element}</g>` : element); }
    look(fill, stroke) {
      const dash = stroke && this.dash.length ? ` stroke-dasharray="${this.dash.join(" ")}"` : "";
      const line = stroke ? ` stroke="${escaped(this.strokeStyle)}" stroke-width="${two(this.lineWidth)}" stroke-linejoin="${this.lineJoin}" stroke-linecap="${this.lineCap}"${dash}` : "";
      return `fill="${fill ? escaped(this.fillStyle) : "none"}"${line}${this.globalAlpha < 1 ? ` opacity="${this.globalAlpha}"` : ""}${this.move ? ` transform="${this.move}"` : ""}`;
    }
    stroke(path = this.path) { if (path.d) this.put(`<path d="${path.d}" ${this.look(false, true)}/>`); }
    fill(path = this.path) { if (path.d) this.put(`<path d="${path.d}" ${this.look(true, false)}/>`); }
    strokeRect(...box) { const path = new VectorPath(); path.rect(...box); this.stroke(path); }
    fillRect(...box) { const path = new VectorPath(); path.rect(...box); this.fill(path); }
    clip(path = this.path) {
      const id = `clip${++this.clips}`, outer = this.within ? ` clip-path="url(#${this.within})"` : "";
      this.parts.push(`<clipPath id="${id}"${outer}><path d="${path.d}"${this.move ? ` transform="${this.move}"` : ""}/></clipPath>`);
      this.within = id;
    }
    drawImage(image, x, y, w, h) {
      this.put(`<image x="${two(x)}" y="${two(y)}" width="${two(w)}" height="${two(h)}" preserveAspectRatio="none" href="${image.src}"/>`);
    }
    fillText(text, x, y) {
      const size = parseFloat(/([\d.]+)px/.exec(this.font)[1]), anchor = { center: "middle", right: "end", end: "end" }[this.textAlign] || "start";
      const down = { top: 0.8, hanging: 0.8, middle: 0.34, bottom: -0.2 }[this.textBaseline] || 0;
      this.put(`<text x="${two(x)}" y="${two(y + down * size)}" font-size="${two(size)}" font-family="Helvetica, Arial, DejaVu Sans, sans-serif" text-anchor="${anchor}" ${this.look(true, false)}>${escaped(text)}</text>`);
    }
  }
  async function vector(shown, chart, arrays, image) {
    const holder = document.createElement("div"), frame = document.createElement("div"), theme = root.dataset.theme;
    const native = [HTMLCanvasElement.prototype.getContext, window.Path2D], context = new VectorContext();
    frame.style.cssText = "position:fixed;left:-9999px;width:800px"; frame.append(holder); document.body.append(frame);
    root.dataset.theme = "light";
    let u;
    try {
      HTMLCanvasElement.prototype.getContext = () => context; window.Path2D = VectorPath;
      const wanted = options(chart, holder, arrays, image, document.createElement("div"));
      u = new uPlot({ ...wanted, legend: { show: false } }, shown.data, holder);
      u.zoomed = true;
      u.batch(() => {
        shown.series.forEach((s, k) => { if (k && !s.show) u.setSeries(k, { show: false }); });
        for (const key of Object.keys(shown.scales)) { const { min, max } = shown.scales[key]; if (min != null) u.setScale(key, { min, max }); }
      });
      await null; await null; /* uPlot draws in a microtask */
    } finally {
      [HTMLCanvasElement.prototype.getContext, window.Path2D] = native;
      root.dataset.theme = theme; frame.remove();
    }
    const canvas = u.root.querySelector("canvas"), ratio = canvas.width / parseFloat(canvas.style.width || canvas.width);
    const { text, height } = caption(context, chart, canvas, ratio);
    const tall = canvas.height + height;
    return `<svg xmlns="http://www.w3.org/2000/svg" width="${two(canvas.width / ratio)}" height="${two(tall / ratio)}" viewBox="0 0 ${canvas.width} ${tall}"><rect width="100%" height="100%" fill="#fff"/>${text}</svg>\n`;
  }
  /* The drawn parts and, below them, the legend. */
  function caption(context, chart, canvas, ratio) {
    const size = 12 * ratio, entries = legendOf(chart) ? chart.series.filter((s) => s.label) : chart.switchable
      ? [[-1, "left sheets"], [1, "right sheets"]].map(([side, name]) => ({ s: chart.series.find((s) => s.sheet && s.sheet[0] === side), name })).filter(({ s }) => s).map(({ s, name }) => ({ ...s, textLabel: name })) : [];
    let x = 50 * ratio, y = canvas.height + size;
    Object.assign(context, { font: `${size}px sans-serif`, textAlign: "left", textBaseline: "middle", globalAlpha: 1, within: "", move: "" });
    for (const s of entries) {
      const wide = context.measureText(s.textLabel).width + 46 * ratio;
      if (x + wide > canvas.width && x > 60 * ratio) { x = 50 * ratio; y += 1.6 * size; }
      Object.assign(context, { strokeStyle: chart.picture ? s.ink[1] : s.ink[0], fillStyle: s.ink[0], lineWidth: 2 * ratio, dash: s.dashed ? [5 * ratio, 3 * ratio] : [] });
      context.beginPath();
      if (s.look === "points") { context.arc(x + 11 * ratio, y, 3 * ratio); context[s.hollow ? "stroke" : "fill"](); }
      else { context.moveTo(x, y); context.lineTo(x + 22 * ratio, y); context.stroke(); }
      context.fillStyle = "#1a1a1a"; context.fillText(s.textLabel, x + 28 * ratio, y);
      x += wide;
    }
    return { text: context.parts.join(""), height: entries.length ? y + size - canvas.height : 0 };
  }
  async function png(svg) {
    const image = new Image(), canvas = document.createElement("canvas");
    image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svg)}`;
    await image.decode();
    canvas.width = 2 * image.width; canvas.height = 2 * image.height;
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    return new Promise((done) => canvas.toBlob(done, "image/png"));
  }

  /* ---- sheets on and off ---- */
  function switches(figure, chart, u) {
    const box = document.createElement("div"), buttons = [];
    box.className = "sheets";
    const show = (wanted) => u.batch(() => buttons.forEach(({ b, k, side }) => {
      const on = wanted(side, u.series[k].show);
      b.setAttribute("aria-pressed", on);
      if (u.series[k].show !== on) u.setSeries(k, { show: on });
    }));
    const all = document.createElement("span");
    all.textContent = "show"; box.append(all);
    const row = document.createElement("div"); row.className = "row";
    row.append(button("all", "show all sheets", () => show(() => true)), button("none", "hide all sheets", () => show(() => false)),
      button("left", "left sheets only", () => show((side) => side < 0)), button("right", "right sheets only", () => show((side) => side > 0)));
    box.append(row);
    for (const [side, name] of [[-1, "left n"], [1, "right n"]]) {
      const mine = chart.series.map((s, k) => ({ s, k: k + 1 })).filter(({ s }) => s.sheet && s.sheet[0] === side).sort((a, b) => a.s.sheet[1] - b.s.sheet[1]);
      if (!mine.length) continue;
      const title = document.createElement("span"), line = document.createElement("div");
      title.textContent = name; line.className = "row";
      for (const { s, k } of mine) {
        const b = button(String(s.sheet[1]), `sheet ${s.label}`, () => {
          const on = !u.series[k].show;
          b.setAttribute("aria-pressed", on); u.setSeries(k, { show: on });
        });
        b.setAttribute("aria-pressed", "true"); b.ink = s.ink; buttons.push({ b, k, side }); line.append(b);
      }
      box.append(title, line);
    }
    figure.tint = () => buttons.forEach(({ b }) => { b.style.borderBottomColor = ink(b.ink); });
    figure.querySelector(".plot").before(box);
  }

  /* The legend's marks show colour, dashes and hollow points alike, so that grey print keeps them apart. */
  function key(figure, chart) {
    const marks = [...figure.querySelector(".u-legend").querySelectorAll(".u-series")].slice(1).map((row) => row.querySelector(".u-marker"));
    chart.series.forEach((s, k) => {
      const points = s.look === "points" || s.look === "both" || s.look === "steps";
      marks[k].nextElementSibling.innerHTML = s.html;
      if (!s.label) { marks[k].closest(".u-series").style.display = "none"; return; }
      if (s.look === "line") { /* a line as a line */
        Object.assign(marks[k].style, { border: "none", borderTop: `${Math.max(2, s.width)}px ${s.dashed ? "dashed" : "solid"} ${ink(s.ink)}`,
          background: "transparent", borderRadius: "0", width: "1.7em", height: "0", verticalAlign: "middle" });
        return;
      }
      Object.assign(marks[k].style, {
        border: `2px ${s.dashed ? "dashed" : "solid"} ${ink(s.ink)}`,
        background: points && !s.hollow ? ink(s.ink) : "transparent",
        borderRadius: s.look === "points" || s.look === "both" ? "50%" : "0",
      });
    });
  }

  function make(figure, chart, image) {
    const arrays = chart.arrays.map(decode), holder = figure.querySelector(".plot");
    const readout = figure.querySelector(".readout");
    const u = new uPlot(options(chart, holder, arrays, image, readout), grid(chart, arrays).data, holder);
    u.shared = Boolean(chart.picture) && !chart.time_down;
    const tools = figure.querySelector(".buttons");
    if (chart.switchable) u.hooks.setSeries = [(self, k) => { chart.nearest = k; }];
    u.over.addEventListener("dblclick", () => reset(u));
    tools.append(button("+", "zoom in", () => zoom(u, 0.5, 0)), button("−", "zoom out", () => zoom(u, 2, 0)),
      button(chart.time_down ? "▲" : "◀", "earlier", () => zoom(u, 1, -0.5)), button(chart.time_down ? "▼" : "▶", "later", () => zoom(u, 1, 0.5)),
      button("whole", "show the whole range (double click)", () => reset(u)),
      button("CSV", "download this figure's numbers", () => download(`${chart.name}.csv`, new Blob([table(chart, arrays)], { type: "text/csv" }))),
      button("SVG", "download this figure as SVG", async () => download(`${chart.name}.svg`, new Blob([await figure.svg()], { type: "image/svg+xml" }))),
      button("PNG", "download this figure as PNG", async () => download(`${chart.name}.png`, await png(await figure.svg()))));
    figure.svg = () => vector(u, chart, arrays, image);
    if (chart.first_view) { u.zoomed = true; u.setScale("x", { min: chart.first_view[0], max: chart.first_view[1] }); }
    if (chart.switchable) switches(figure, chart, u);
    else if (legendOf(chart)) figure.tint = () => key(figure, chart);
    if (figure.tint) figure.tint();
    Object.assign(figure, { plot: u, chart, table: () => table(chart, arrays) });
    return u;
  }

  /* ---- light, dark, print, size ---- */
  const figures = [];
  const repaint = () => figures.forEach((f) => { if (f.tint) f.tint(); f.plot.redraw(false, true); });
  const resize = () => figures.forEach((f) => {
    const size = sizeOf(f.chart, f.querySelector(".plot"));
    if (size.width !== f.plot.width || size.height !== f.plot.height) f.plot.setSize(size);
  });
  function theme(name) { root.dataset.theme = name; repaint(); }
  const preferred = matchMedia("(prefers-color-scheme: dark)");
  root.dataset.theme = preferred.matches ? "dark" : "light";
  preferred.addEventListener("change", () => theme(preferred.matches ? "dark" : "light"));
  document.querySelector(".theme").addEventListener("click", () => theme(dark() ? "light" : "dark"));
  let before = "light";
  addEventListener("beforeprint", () => {
    before = root.dataset.theme; theme("light");
    document.querySelectorAll("details").forEach((d) => { d.open = true; });
    const tall = (f) => f.chart.picture ? f.plot.height : Math.min(f.plot.height, 290); // two on a page
    figures.forEach((f) => f.plot.setSize({ width: 660, height: tall(f) }));
  });
  addEventListener("afterprint", () => { theme(before); resize(); });
  addEventListener("resize", resize);
  document.querySelectorAll("[data-copy]").forEach((b) => b.addEventListener("click", () => {
    const text = document.getElementById(b.dataset.copy), { hidden } = text;
    text.hidden = false; // what is hidden is not copied
    getSelection().selectAllChildren(text);
    document.execCommand("copy");
    text.hidden = hidden;
    b.textContent = "copied";
  }));

  document.querySelectorAll("[data-chart]").forEach((figure) => {
    const chart = page.charts[figure.dataset.chart];
    stack(chart);
    const ready = (image) => { make(figure, chart, image); figures.push(figure); };
    if (!chart.picture) { ready(null); return; }
    const image = new Image();
    image.onload = () => ready(image);
    image.src = chart.picture.uri;
  });
})();
