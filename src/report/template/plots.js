// Plots over time, all with the same time axis and one cursor.

const LEFT = 58, RIGHT = 12, TOP = 8, BOTTOM = 24;

// Round numbers that cover a range.
function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= raw * 0.999) ?? 10 * power;
  const list = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) list.push(+(k * step).toPrecision(10));
  return list;
}

class TimeAxis {
  constructor(from, to) { this.set(from, to); this.plots = []; }
  set(from, to) { this.from = from; this.to = Math.max(to, from + 1e-3); }
  show(from, to) { this.set(from, to); this.plots.forEach((plot) => plot.draw()); }
}

// A frame with axes, events and a cursor; what is inside is drawn by `content`.
class Plot {
  constructor(parent, axis, { title, unit, note, height = 168, range, format = short, log = false, legend = [], categories, seek }) {
    Object.assign(this, { axis, unit, height, rangeOf: range, format, log, legend, categories });
    this.readouts = legend.map(() => element("b"));
    const keys = legend.map(({ name, mark, kind }, i) =>
      element("span", { class: "key" }, element("i", { class: `mark ${kind ?? "line"} ${mark}` }), name, this.readouts[i]));
    this.note = element("small", {}, note ?? "");
    this.svg = element("svg", { class: "plot", role: "img", "aria-label": title });
    // Not in the drawing: moving it must not paint the drawing again.
    this.cursor = element("div", { class: "cursor" });
    this.figure = element("figure", { class: "card chart" },
      element("figcaption", {}, element("span", { class: "name" }, title, unit ? element("em", {}, ` ${unit}`) : ""), this.note),
      element("div", { class: "keys" }, ...keys), element("div", { class: "sheet" }, this.svg, this.cursor));
    parent.append(this.figure);
    axis.plots.push(this);
    const seekTo = (event) => seek?.(this.timeAt(event.clientX - this.svg.getBoundingClientRect().left));
    this.svg.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "mouse") this.svg.setPointerCapture(event.pointerId);
      seekTo(event);
    });
    this.svg.addEventListener("pointermove", (event) => event.buttons && seekTo(event));
    new ResizeObserver(() => this.svg.clientWidth !== this.width && this.draw()).observe(this.svg);
  }

  x(time) { return LEFT + ((time - this.axis.from) / (this.axis.to - this.axis.from)) * (this.width - LEFT - RIGHT); }
  timeAt(x) {
    const part = (x - LEFT) / (this.width - LEFT - RIGHT);
    return this.axis.from + Math.max(0, Math.min(1, part)) * (this.axis.to - this.axis.from);
  }
  y(value) {
    const { low, high } = this;
    const part = this.log ? Math.log(Math.max(value, low) / low) / Math.log(high / low) : (value - low) / (high - low);
    return this.height - BOTTOM - part * (this.height - BOTTOM - TOP);
  }

  draw() {
    this.width = this.svg.clientWidth;
    if (!this.width) return;
    const { svg, width, height, axis } = this;
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.setAttribute("height", height);
    svg.replaceChildren();
    [this.low, this.high] = this.rangeOf();
    if (!(this.high > this.low)) this.high = this.low + 1;
    const bottom = height - BOTTOM, right = width - RIGHT;

    for (const { kind, from, to } of run.events) {
      const a = Math.max(LEFT, this.x(from)), b = Math.min(right, this.x(to));
      if (b > a) svg.append(element("rect", { class: `event ${kind}`, x: a, y: TOP, width: Math.max(1.5, b - a), height: bottom - TOP }));
    }
    const grid = element("g", { class: "grid" }), labels = element("g", { class: "labels" });
    for (const time of ticks(axis.from, axis.to, width / 80)) {
      const x = this.x(time);
      grid.append(element("line", { x1: x, x2: x, y1: TOP, y2: bottom }));
      labels.append(element("text", { x, y: height - 8, "text-anchor": "middle" }, `${String(time).replace("-", "−")} s`));
    }
    const levels = this.categories ? [] : this.log ? this.decades() : ticks(this.low, this.high, (bottom - TOP) / 34);
    for (const value of levels) {
      const y = this.y(value);
      grid.append(element("line", { x1: LEFT, x2: right, y1: y, y2: y }));
      labels.append(element("text", { x: LEFT - 7, y: y + 3.5, "text-anchor": "end" }, tickText(value)));
    }
    const id = `clip${axis.plots.indexOf(this)}`;
    const clip = element("clipPath", { id }, element("rect", { x: LEFT, y: TOP - 1, width: right - LEFT, height: bottom - TOP + 2 }));
    const inside = element("g", { "clip-path": `url(#${id})` });
    svg.append(element("defs", {}, clip), grid, labels, inside);
    this.content(inside, svg);
    Object.assign(this.cursor.style, { top: `${TOP}px`, height: `${bottom - TOP}px` });
    if (this.now !== undefined) this.moveCursor(this.now);
  }

  decades() {
    const list = [];
    for (let k = Math.ceil(Math.log10(this.low) - 1e-9); 10 ** k <= this.high * 1.001; k++) list.push(+(10 ** k).toPrecision(3));
    return list;
  }

  // Whether any of it is in the window.
  get inSight() {
    const { top, bottom } = this.svg.getBoundingClientRect();
    return bottom > 0 && top < innerHeight;
  }

  moveCursor(time, withNumbers = true) {
    this.now = time;
    if (!this.width) return;
    const inside = time >= this.axis.from && time <= this.axis.to;
    this.cursor.style.transform = `translateX(${this.x(time).toFixed(1)}px)`;
    this.cursor.style.visibility = inside ? "visible" : "hidden";
    if (withNumbers) this.legend.forEach(({ read }, i) => { if (read) this.readouts[i].textContent = read(time); });
  }

  // A line over the rows of a table; gaps where there is no number. Many rows per pixel become their extremes.
  line(inside, table, mark, value, { step = false, area = false, dash } = {}) {
    const points = this.points(table, value);
    let path = "", open = false, last = 0;
    for (const [time, v] of points) {
      if (!Number.isFinite(v)) { open = false; continue; }
      const x = this.x(time).toFixed(1), y = this.y(v).toFixed(1);
      path += !open ? `M${x} ${y}` : step ? `L${x} ${last}L${x} ${y}` : `L${x} ${y}`;
      open = true;
      last = y;
    }
    if (area && points.length) path += `L${this.x(points.at(-1)[0]).toFixed(1)} ${this.y(0).toFixed(1)}L${this.x(points[0][0]).toFixed(1)} ${this.y(0).toFixed(1)}Z`;
    inside.append(element("path", { class: `${area ? "area" : "line"} ${mark}`, d: path, "stroke-dasharray": dash }));
  }

  // The rows in sight, thinned to the first, least, greatest and last of each pixel.
  points(table, value) {
    if (!table.rows) return [];
    const first = Math.max(0, table.rowAt(this.axis.from)), last = Math.min(table.rows - 1, table.rowAt(this.axis.to) + 1);
    const group = Math.max(1, Math.floor((2 * (last - first)) / Math.max(1, this.width)));
    const list = [];
    for (let row = first; row <= last; row += group) {
      if (group < 3) {
        for (let k = row; k < Math.min(row + group, last + 1); k++) list.push([table.time(k), value(k)]);
        continue;
      }
      let least = row, most = row;
      for (let k = row; k < Math.min(row + group, last + 1); k++) {
        if (value(k) < value(least)) least = k;
        if (value(k) > value(most)) most = k;
      }
      for (const k of [...new Set([Math.min(least, most), Math.max(least, most)])]) list.push([table.time(k), value(k)]);
    }
    return list;
  }

  band(inside, table, mark, low, high) {
    const a = this.points(table, low).filter(([, v]) => Number.isFinite(v)), b = this.points(table, high).filter(([, v]) => Number.isFinite(v)).reverse();
    if (!a.length) return;
    const text = [...a, ...b].map(([t, v]) => `${this.x(t).toFixed(1)} ${this.y(v).toFixed(1)}`).join("L");
    inside.append(element("path", { class: `band ${mark}`, d: `M${text}Z` }));
  }

  level(inside, value, mark, label, from = this.axis.from, to = this.axis.to, below = false) {
    const y = this.y(value);
    inside.append(element("line", { class: `level ${mark}`, x1: this.x(from), x2: this.x(to), y1: y, y2: y }));
    if (label) inside.append(element("text", { class: "level-label", x: this.x(to) - 4, y: below ? y + 12 : y - 4, "text-anchor": "end" }, label));
  }
}

function tickText(value) {
  const size = Math.abs(value);
  const text = size !== 0 && (size >= 1e5 || size < 1e-3) ? value.toExponential(0) : String(+value.toPrecision(6));
  return text.replace("-", "−");
}

// Least and greatest value over the rows in sight, with some room, and always with the given values inside.
function reach(axis, table, values, always = [], room = 0.06) {
  let low = Infinity, high = -Infinity;
  const take = (v) => { if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); } };
  always.forEach(take);
  if (table.rows) {
    const first = table.rowAt(axis.from), last = Math.min(table.rows - 1, table.rowAt(axis.to) + 1);
    for (let row = first; row <= last; row++) for (const value of values) take(value(row));
  }
  if (low > high) return [0, 1];
  const span = Math.max(high - low, 1e-6);
  return [low - room * span, high + room * span];
}

function quantile(table, name, part) {
  const list = Array.from({ length: table.rows }, (_, row) => table.at(name, row)).filter(Number.isFinite).sort((a, b) => a - b);
  return list.length ? list[Math.min(list.length - 1, Math.floor(part * list.length))] : NaN;
}

// All plots of a run. `seek` moves the cursor.
function makePlots(parent, axis, seek) {
  const mm = (x) => 1e3 * x;
  const value = (table, name, index = 0, scale = 1) => (row) => scale * table.at(name, row, index);
  const read = (table, of, digits = 1, unit = "") => (time) => {
    if (!table.rows) return "";
    const v = of(table.rowAt(time));
    return Number.isFinite(v) ? `${v.toFixed(digits).replace("-", "−")}${unit}` : "–";
  };
  const plots = {};
  const plot = (name, options) => (plots[name] = new Plot(parent, axis, { seek, ...options }));

  // Mass centre, relative to where it began.
  {
    const of = [0, 1, 2].map((i) => (row) => mm(frames.at("com", row, i) - frames.at("com", 0, i)));
    const made = plot("com", {
      title: "Mass centre", unit: "mm from its start",
      legend: ["x forward", "y left", "z up"].map((name, i) => ({ name, mark: `c${i}`, read: read(frames, of[i]) })),
      range: () => reach(axis, frames, of, [-5, 5]),
    });
    made.content = (inside) => of.forEach((v, i) => made.line(inside, frames, `c${i}`, v));
  }

  // Pressure point and capture point between the edges of the sole, in its axes.
  const sole = run.robot.soles[run.stance];
  if (sole) {
    ["x forward", "y left"].forEach((label, k) => {
      const edges = [Math.min(...sole.polygon.map((p) => p[k])), Math.max(...sole.polygon.map((p) => p[k]))].map(mm);
      const point = value(frames, "pressure", k, 1e3);
      const capture = (row) => {
        const height = Math.max(0.05, frames.at("com", row, 2)), at = frames.at("com", row, k) + frames.at("com_velocity", row, k) / Math.sqrt(run.gravity / height);
        return mm(at); // the sole begins at the origin and stays there, but for slip far below a millimetre
      };
      const made = plot(`cop_${"xy"[k]}`, {
        title: `Pressure point ${label}`, unit: "mm in the sole",
        note: k === 0 ? "" : "",
        legend: [
          { name: "pressure point", mark: "pressure", read: read(frames, point) },
          { name: "capture point", mark: "capture", read: read(frames, capture) },
          { name: "edge", mark: "edge" },
        ],
        range: () => {
          const [low, high] = reach(axis, frames, [point], edges, 0.1);
          return [Math.max(low, 2.2 * edges[0] - 1.2 * edges[1]), Math.min(high, 2.2 * edges[1] - 1.2 * edges[0])];
        },
      });
      made.content = (inside) => {
        const margin = mm(run.cop_margin_m);
        for (const [edge, sign, far] of [[edges[0], 1, made.low], [edges[1], -1, made.high]]) {
          const [top, end] = [made.y(Math.max(edge, far)), made.y(Math.min(edge, far))];
          inside.append(element("rect", { class: "outside", x: 0, width: made.width, y: Math.min(top, end), height: Math.abs(end - top) }));
          made.level(inside, edge, "edge");
          if (margin > 0) made.level(inside, edge + sign * margin, "edge thin");
        }
        made.band(inside, frames, "pressure", value(frames, "pressure_low", k, 1e3), value(frames, "pressure_high", k, 1e3));
        made.line(inside, frames, "capture", capture, { dash: "4 3" });
        made.line(inside, frames, "pressure", point);
      };
    });
  }

  // Hand to ball.
  if (run.ball) {
    const error = value(frames, "hand_error", 0, 1e3);
    const hold = run.events.find(({ kind }) => kind === "hold");
    const made = plot("hand", {
      title: "Hand to ball", unit: "mm, logarithmic", log: true,
      legend: [{ name: "distance", mark: "c0", read: read(frames, error, 1) }, { name: "allowed", mark: "limit" }],
      range: () => {
        const [low, high] = reach(axis, frames, [error], run.hand_limits_m.map(mm), 0);
        return [10 ** Math.floor(Math.log10(Math.max(0.1, low))), 10 ** Math.ceil(Math.log10(Math.max(high, 1)))];
      },
    });
    made.content = (inside) => {
      made.line(inside, frames, "c0", error);
      if (hold) {
        made.level(inside, mm(run.hand_limits_m[1]), "limit", `${mm(run.hand_limits_m[1])} mm`, hold.from, hold.to);
        const x = made.x(hold.from), y = made.y(mm(run.hand_limits_m[0]));
        inside.append(element("path", { class: "limit-mark", d: `M${x - 5} ${y - 8}L${x + 5} ${y - 8}L${x} ${y}Z` }, element("title", {}, `at most ${mm(run.hand_limits_m[0])} mm at the deadline`)));
      }
    };
  }

  // Torques relative to their limits: every joint a row, the darker the closer.
  const limited = run.robot.joints.map((joint, i) => ({ ...joint, index: i })).filter((joint) => joint.effort);
  if (limited.length) {
    const ROW = 13;
    let chosen = null;
    const peak = (joint) => {
      let most = 0;
      for (let row = 0; row < frames.rows; row++) most = Math.max(most, Math.abs(frames.at("torque", row, joint.index)));
      return most / joint.effort;
    };
    const map = plot("torque_map", {
      title: "Torques", unit: "share of the limit", note: "choose a joint", height: ROW * limited.length + TOP + BOTTOM,
      range: () => [0, limited.length], categories: true,
      legend: [{ name: "0", mark: "ramp0", kind: "swatch" }, { name: "50 %", mark: "ramp5", kind: "swatch" }, { name: "100 %", mark: "ramp10", kind: "swatch" }, { name: "over", mark: "over", kind: "swatch" }],
    });
    map.figure.classList.add("tall");
    map.content = (inside, svg) => {
      const columns = Math.max(1, Math.min(900, Math.round(map.width - LEFT - RIGHT)));
      const canvas = element("canvas", { width: columns, height: limited.length }), paper = canvas.getContext("2d");
      const stops = ["--ramp0", "--ramp5", "--ramp10"].map(styleColour);
      const picture = paper.createImageData(columns, limited.length);
      for (let k = 0; k < columns && frames.rows; k++) {
        const from = frames.rowAt(axis.from + (k / columns) * (axis.to - axis.from));
        const until = Math.max(from + 1, frames.rowAt(axis.from + ((k + 1) / columns) * (axis.to - axis.from)));
        const past = axis.from + (k / columns) * (axis.to - axis.from) > frames.end + run.frame_s;
        limited.forEach((joint, row) => {
          let most = 0;
          for (let f = from; f < Math.min(until, frames.rows); f++) most = Math.max(most, Math.abs(frames.at("torque", f, joint.index)));
          picture.data.set(past ? [0, 0, 0, 0] : [...ramp(most / joint.effort, stops), 255], 4 * (row * columns + k));
        });
      }
      paper.putImageData(picture, 0, 0);
      inside.append(element("image", { href: canvas.toDataURL(), x: LEFT, y: TOP, width: map.width - LEFT - RIGHT, height: ROW * limited.length, preserveAspectRatio: "none", style: "image-rendering: pixelated" }));
      limited.forEach((joint, row) => {
        const label = element("text", { class: `joint ${joint === chosen ? "chosen" : ""}`, x: LEFT - 3, y: TOP + ROW * row + 9.8, "text-anchor": "end" }, joint.name);
        label.addEventListener("pointerdown", (event) => { event.stopPropagation(); choose(joint); });
        svg.append(label);
        if (joint === chosen) svg.append(element("rect", { class: "chosen-row", x: LEFT, y: TOP + ROW * row, width: map.width - LEFT - RIGHT, height: ROW }));
      });
    };
    map.svg.addEventListener("pointerdown", (event) => {
      const row = Math.floor((event.clientY - map.svg.getBoundingClientRect().top - TOP) / ROW);
      if (limited[row]) choose(limited[row]);
    });

    const single = plot("torque", {
      title: "Torque of a joint", unit: "N m",
      legend: [{ name: "torque", mark: "c0", read: (time) => (chosen ? read(frames, value(frames, "torque", chosen.index))(time) : "") }, { name: "limit", mark: "limit" }, { name: "what the plan may use", mark: "limit-thin" }],
      range: () => (chosen ? [-1.12 * chosen.effort, 1.12 * chosen.effort] : [-1, 1]),
    });
    single.content = (inside) => {
      if (!chosen) return;
      for (const sign of [-1, 1]) {
        made(single, inside, sign * chosen.effort, "limit");
        made(single, inside, sign * chosen.effort * run.torque_fraction, "limit thin");
      }
      single.line(inside, frames, "c0", value(frames, "torque", chosen.index));
    };
    const made = (plot, inside, at, mark) => plot.level(inside, at, mark);
    const name = single.figure.querySelector(".name");
    const choose = (joint) => {
      chosen = joint;
      name.firstChild.textContent = `Torque of ${joint.name}`;
      map.draw();
      single.draw();
    };
    plots.chooseBusiest = () => choose(limited.reduce((a, b) => (peak(b) > peak(a) ? b : a)));
    if (frames.rows) plots.chooseBusiest(); else choose(limited[0]);
  }

  // Cycle time, stacked, against the deadline.
  {
    const parts = ["state_in", "shift", "linearize", "riccati", "qp", "publish"];
    const names = ["state in", "shift", "linearise", "riccati", "qp", "publish"];
    const deadline = 1e3 * run.cycle_s;
    const upTo = parts.map((_, k) => (row) => parts.slice(0, k + 1).reduce((sum, part) => sum + cycles.at(part, row), 0));
    const made = plot("cycle", {
      title: "Cycle time", unit: "ms", height: 200,
      note: run.timed ? "" : "a lockstep run has no wall clock",
      legend: [...names.map((name, k) => ({ name, mark: `s${k}`, kind: "swatch", read: run.timed ? read(cycles, value(cycles, parts[k]), 2) : undefined })), { name: `deadline ${deadline} ms`, mark: "limit" }],
      range: () => [0, Math.max(1.3 * deadline, 1.15 * Math.min(quantile(cycles, "total", 0.95) || 0, 12 * deadline))],
    });
    made.content = (inside) => {
      for (let k = parts.length - 1; k >= 0; k--) made.line(inside, cycles, `s${k}`, upTo[k], { step: true, area: true });
      made.level(inside, deadline, "limit");
      let beyond = 0;
      for (let row = 0; row < cycles.rows; row++) {
        if (cycles.at("total", row) <= made.high) continue;
        beyond += 1;
        const x = made.x(cycles.time(row));
        inside.append(element("path", { class: "beyond", d: `M${x - 3} ${TOP + 6}L${x + 3} ${TOP + 6}L${x} ${TOP}Z` }, element("title", {}, `${cycles.at("total", row).toFixed(1)} ms`)));
      }
      if (run.timed) made.note.textContent = beyond ? `${beyond} beyond the axis, longest ${quantile(cycles, "total", 1).toFixed(0)} ms` : "";
    };
  }

  // What the constrained problem had to do.
  {
    const list = [["active", "active rows", "c0"], ["solves", "QP solves", "c2"], ["dropped", "dropped rows", "c1"]];
    const made = plot("constraints", {
      title: "Active constraints", unit: "rows per cycle",
      legend: list.map(([name, label, mark]) => ({ name: label, mark, read: read(cycles, value(cycles, name), 0) })),
      range: () => [0, Math.max(4, reach(axis, cycles, list.map(([name]) => value(cycles, name)), [0])[1])],
    });
    made.content = (inside) => {
      list.forEach(([name, , mark]) => made.line(inside, cycles, mark, value(cycles, name), { step: true }));
      const worst = quantile(cycles, "violation", 1);
      made.note.textContent = worst > 1e-9 ? `largest softened violation ${short(worst)} (${CONSTRAINTS[quantile(cycles, "constraint", 1)] ?? "?"})` : "no constraint gave way";
    };
  }

  // What was decided, as bands of colour.
  {
    const feet = run.robot.soles.map((sole, i) => ({ name: `${sole.name} foot`, table: frames, code: (row) => (frames.at("feet", row) >> i) & 1, marks: ["v-air", "v-ground"], words: ["in the air", "on the ground"] }));
    const rows = [
      { name: "verdict", table: cycles, code: (row) => cycles.at("verdict", row), marks: ["v0", "v1", "v2", "v3", "v4"], words: VERDICTS },
      { name: "fallback", table: cycles, code: (row) => cycles.at("fallback", row), marks: ["l0", "l1", "l2", "l3", "l4", "l5"], words: LEVELS },
      { name: "watchdog", table: frames, code: (row) => frames.at("watchdog", row), marks: ["l0", "l1", "l2", "l3", "l4", "l5"], words: LEVELS },
      ...feet,
    ];
    const HEIGHT = 22;
    const made = plot("states", {
      title: "Verdict, fallback, contact", unit: "", height: HEIGHT * rows.length + TOP + BOTTOM, categories: true, range: () => [0, rows.length],
      legend: rows.map(({ name, table, code, words }) => ({ name, mark: "none", kind: "none", read: (time) => (table.rows ? words[code(table.rowAt(time))] ?? "?" : "") })),
    });
    made.content = (inside, svg) => rows.forEach(({ name, table, code, marks, words }, k) => {
      svg.append(element("text", { class: "joint", x: LEFT - 4, y: TOP + HEIGHT * k + 14, "text-anchor": "end" }, name));
      if (!table.rows) return;
      const first = table.rowAt(axis.from), last = Math.min(table.rows - 1, table.rowAt(axis.to) + 1);
      let begin = first;
      for (let row = first + 1; row <= last + 1; row++) {
        if (row <= last && code(row) === code(begin)) continue;
        const from = made.x(table.time(begin)), to = made.x(row <= last ? table.time(row) : table.time(last));
        inside.append(element("rect", { class: marks[code(begin)] ?? "v4", x: from, y: TOP + HEIGHT * k + 3, width: Math.max(1, to - from), height: HEIGHT - 6 }, element("title", {}, words[code(begin)] ?? "?")));
        begin = row;
      }
    });
  }
  return plots;
}

// A byte triple of a colour of the style.
function styleColour(name) {
  const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
}

// From the colour of nothing to that of the whole, then orange for what is over: told apart by lightness alone.
function ramp(part, stops) {
  if (part > 1.0001) return [213, 94, 0];
  const at = Math.max(0, Math.min(1, part)) * (stops.length - 1), k = Math.min(stops.length - 2, Math.floor(at));
  return stops[k].map((x, i) => Math.round(x + (at - k) * (stops[k + 1][i] - x)));
}

// The sole from above, toes to the right: where the pressure goes.
class SolePicture {
  constructor(parent) {
    this.svg = element("svg", { class: "sole", role: "img", "aria-label": "Pressure point in the stance sole" });
    parent.append(this.svg);
    this.sole = run.robot.soles[run.stance];
    if (!this.sole) return;
    const xs = this.sole.polygon.map((p) => p[0]), ys = this.sole.polygon.map((p) => p[1]);
    const room = 0.022;
    this.box = { left: Math.min(...xs) - room, top: Math.max(...ys) + room, width: Math.max(...xs) - Math.min(...xs) + 2 * room, height: Math.max(...ys) - Math.min(...ys) + 2 * room };
    this.svg.setAttribute("viewBox", `0 0 ${1e3 * this.box.width} ${1e3 * this.box.height}`);
    const polygon = (margin, mark) => {
      const n = this.sole.polygon.length;
      const inner = this.sole.polygon.map((p, i) => {
        // Moved inwards from both of its edges.
        const a = this.sole.polygon[(i + n - 1) % n], b = this.sole.polygon[(i + 1) % n];
        const normal = (u, v) => { const d = [v[0] - u[0], v[1] - u[1]], l = Math.hypot(...d) || 1; return [-d[1] / l, d[0] / l]; };
        const [n1, n2] = [normal(a, p), normal(p, b)], k = 1 + n1[0] * n2[0] + n1[1] * n2[1];
        return [p[0] + (margin * (n1[0] + n2[0])) / k, p[1] + (margin * (n1[1] + n2[1])) / k];
      });
      return element("polygon", { class: mark, points: inner.map((p) => this.at(p).join(",")).join(" ") });
    };
    this.all = element("polyline", { class: "trail all" });
    this.recent = element("polyline", { class: "trail recent" });
    this.dots = ["com", "capture", "pressure"].map((mark) => element("circle", { class: mark, r: mark === "com" ? 5 : 4.2 }));
    const [x, y] = [1e3 * this.box.width - 72, 1e3 * this.box.height - 9];
    this.svg.append(polygon(0, "whole"), ...(run.cop_margin_m > 0 ? [polygon(run.cop_margin_m, "inner")] : []), this.all, this.recent, ...this.dots,
      element("line", { class: "scale", x1: x, x2: x + 50, y1: y, y2: y }), element("text", { class: "scale", x: x - 5, y: y + 3, "text-anchor": "end" }, "50 mm"),
      element("text", { class: "scale", x: 22, y: y + 3 }, "heel"), element("text", { class: "scale", x: 1e3 * this.box.width - 22, y: 14, "text-anchor": "end" }, "toes"));
  }

  at([x, y]) { return [1e3 * (x - this.box.left), 1e3 * (this.box.top - y)]; }

  trail(line, from, to) {
    const points = [];
    for (let row = frames.rowAt(from); row <= frames.rowAt(to) && frames.rows; row++) {
      const point = [frames.at("pressure", row, 0), frames.at("pressure", row, 1)];
      if (point.every(Number.isFinite)) points.push(this.at(point).map((x) => x.toFixed(1)).join(","));
    }
    line.setAttribute("points", points.join(" "));
  }

  show(motion) {
    if (!this.sole) return;
    this.trail(this.recent, motion.time - 0.6, motion.time);
    const inSole = (point) => movedBack(motion.sole, point);
    [inSole(motion.com), inSole(motion.capture), motion.pressure].forEach((point, i) => {
      const [x, y] = this.at(point);
      const seen = Number.isFinite(x);
      this.dots[i].style.display = seen ? "" : "none";
      if (seen) this.dots[i].setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
    });
  }
}
