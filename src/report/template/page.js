// The page of a run: puts everything in its place and keeps animation and plots together.

const $ = (id) => document.getElementById(id);
const clean = (text) => text.replace("-", "−");

// Colours of the scene, from the style of the page.
function sceneColours() {
  const rgb = (name) => styleColour(name).map((x) => x / 255);
  const names = ["background", "grid", "body", "sole", "com", "capture", "pressure", "push", "ball"];
  const colours = Object.fromEntries(names.map((name) => [name, rgb(`--scene-${name}`)]));
  colours.shadow = [...rgb("--scene-shadow"), 0.2];
  return colours;
}

class Page {
  constructor() {
    this.time = frames.begin;
    this.playing = false;
    this.axis = new TimeAxis(frames.begin, Math.max(frames.end, frames.rows > 1 ? 0 : run.duration_s));
    this.actors = new Actors(run.robot);
    this.view = new View($("view"));
    this.colours = sceneColours();
    this.sole = new SolePicture($("sole"));
    this.plots = makePlots($("plots"), this.axis, (time) => { this.stop(); this.seek(time); });
    this.heading();
    this.transport();
    this.theme();
    this.sole.trail?.(this.sole.all ?? element("polyline"), frames.begin, frames.end);
    this.view.onturn = () => this.request();
    $("camera").addEventListener("click", ({ target }) => this.moveCamera(target));
    new ResizeObserver(() => this.request()).observe($("scene"));
    this.aim();
    this.seek(this.time);
  }

  // Looks at the whole robot, whatever its size.
  aim() {
    if (!frames.rows) return;
    const motion = motionAt(frames, frames.begin);
    let high = 0.2;
    for (const shape of run.robot.shapes) {
      const pose = poseOf(motion.poses, shape);
      high = Math.max(high, pose[11] + 0.5 * Math.max(...shape.size));
    }
    this.view.camera.target = [motion.com[0] + 0.05 * high, motion.com[1], 0.47 * high];
    this.view.camera.distance = 2.05 * high;
  }

  moveCamera(button) {
    const views = { quarter: [0.95, 0.16], front: [0.02, 0.12], side: [1.55, 0.12], top: [Math.PI, 1.5] };
    if (button.dataset.zoom) this.view.zoom(+button.dataset.zoom);
    const view = views[button.dataset.view];
    if (view) [this.view.camera.azimuth, this.view.camera.elevation] = view;
    this.request();
  }

  heading() {
    const { outcome, figures, about = {} } = run;
    if (outcome) {
      const good = outcome.success;
      $("outcome").className = `outcome ${good === true ? "good" : good === false ? "bad" : ""}`;
      $("outcome").textContent = good === true ? "✓ Success" : good === false ? `✗ ${outcome.failure ?? "failed"}` : "no summary";
    }
    const facts = [
      `robot ${run.robot.name}, ${run.robot.mass_kg.toFixed(1)} kg`,
      run.timed ? "real time, two processes" : "lockstep",
      `seed ${run.seed}`,
      run.live && !frames.rows ? `${run.duration_s} s planned` : `${(frames.end - frames.begin).toFixed(1)} s simulated`,
      figures ? `${figures.cycles ?? cycles.rows} control cycles` : null,
      about.program,
      about.git_revision ? `git ${about.git_revision.slice(0, 12)}` : null,
    ];
    $("facts").replaceChildren(...facts.filter(Boolean).map((fact) => element("span", {}, fact)));

    const rows = (run.criteria ?? []).map(({ name, value, limit, met }) =>
      element("tr", { class: met === false ? "bad" : met ? "good" : "" }, element("td", { class: "sign" }, met === false ? "✗" : met ? "✓" : "·"),
        element("th", { scope: "row" }, name), element("td", { class: "number" }, clean(value)), element("td", { class: "limit" }, limit)));
    $("criteria").replaceChildren(...rows);
    $("criteria-card").hidden = !rows.length;

    const known = { program: "Program", git_revision: "Git revision", model_hash: "Model hash", joint_set_hash: "Joint-set hash", run: "Run", scenario: "Scenario", seed: "Seed" };
    $("about").replaceChildren(...Object.entries(known).filter(([key]) => about[key]).flatMap(([key, label]) => [element("dt", {}, label), element("dd", {}, about[key])]));
    $("figures").replaceChildren(...Object.entries(figures ?? {}).map(([key, value]) =>
      element("tr", {}, element("th", { scope: "row" }, key), element("td", {}, value === null ? "–" : Array.isArray(value) ? value.map(short).join(", ") : typeof value === "number" ? (Number.isInteger(value) ? String(value) : clean(value.toPrecision(5))) : String(value)))));
    $("configuration").textContent = about.configuration ?? "";
    const size = signSize(run.robot.mass_kg);
    const notes = [
      `Frames every ${(1e3 * (run.frame_s ?? 0.01)).toFixed(0)} ms; torques, hand distance and the shaded band of the pressure point are the extremes between frames.`,
      `Arrows: ground reaction ${(REACTION * size).toFixed(2)} m for the robot's weight, push ${(0.1 * PUSH * size).toFixed(2)} m for a tenth of it. Dashed lines inside the sole: the margin the controller keeps.`,
      run.damage ? `The log is not whole: ${run.damage}` : null,
    ];
    $("notes").replaceChildren(...notes.filter(Boolean).map((note) => element("li", {}, note)));
    const legend = [["pressure", "pressure point and ground force"], ["capture", "capture point"], ["com", "mass centre"], ...(run.ball ? [["ball", "ball"]] : []), ["push", "push"]];
    $("scene-legend").replaceChildren(...legend.map(([mark, name]) => element("li", {}, element("i", { class: `dot ${mark}` }), name)));
  }

  transport() {
    const slider = $("time");
    slider.addEventListener("input", () => { this.stop(); this.seek(+slider.value); });
    $("play").addEventListener("click", () => (this.playing ? this.stop() : this.play()));
    document.addEventListener("keydown", (event) => {
      if (event.target.closest?.("select, button, input, summary") || event.ctrlKey || event.metaKey || event.altKey) return;
      const step = { ArrowLeft: -run.frame_s, ArrowRight: run.frame_s }[event.key];
      if (event.key === " ") { event.preventDefault(); if (this.playing) this.stop(); else this.play(); }
      if (step) { event.preventDefault(); this.stop(); this.seek(this.time + step * (event.shiftKey ? 10 : 1)); }
    });
    this.timeline();
  }

  // Slider, marks and ranges of what there is.
  timeline() {
    $("time").min = frames.begin;
    $("time").max = Math.max(frames.end, frames.begin + 1e-3);
    const end = Math.max(frames.end, run.duration_s ?? 0.001);
    $("marks").replaceChildren(...run.events.map(({ kind, label, from, to }) =>
      element("span", { class: kind, title: label, style: `left:${(100 * from) / end}%;width:${Math.max(0.4, (100 * (to - from)) / end)}%` })));
    const ranges = [["whole run", frames.begin, frames.end]];
    const reach = run.events.find(({ kind }) => kind === "reach"), hold = run.events.find(({ kind }) => kind === "hold");
    if (reach) ranges.push(["reach", reach.from - 0.2, (hold ?? reach).to + 0.2]);
    run.events.filter(({ kind }) => kind === "push").forEach(({ label, from, to }) => ranges.push([label, from - 0.2, to + 1.3]));
    const buttons = ranges.map(([label, from, to]) => {
      const button = element("button", { type: "button" }, label);
      button.addEventListener("click", () => {
        buttons.forEach((other) => other.classList.toggle("on", other === button));
        this.axis.show(Math.max(frames.begin, from), Math.min(Math.max(frames.end, frames.begin + 0.01), to));
        if (this.time < from || this.time > to) this.seek(Math.max(frames.begin, from));
      });
      return button;
    });
    buttons[0].classList.add("on");
    $("ranges").replaceChildren(...buttons);
  }

  theme() {
    const order = ["auto", "light", "dark"], button = $("theme");
    let now = "auto";
    const apply = () => {
      if (now === "auto") delete document.documentElement.dataset.theme; else document.documentElement.dataset.theme = now;
      button.textContent = now[0].toUpperCase() + now.slice(1);
      this.colours = sceneColours();
      this.plots.torque_map?.draw();
      this.request();
    };
    button.addEventListener("click", () => { now = order[(order.indexOf(now) + 1) % 3]; apply(); });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);
    // On paper everything is light, the plots have the width of the paper, and the robot is a still picture: WebGL is not printed.
    const print = $("print");
    addEventListener("beforeprint", () => {
      document.documentElement.dataset.theme = "light";
      this.colours = { ...sceneColours(), background: [1, 1, 1] };
      this.show();
      Object.assign(print, { width: this.view.canvas.width, height: this.view.canvas.height });
      print.getContext("2d").drawImage(this.view.canvas, 0, 0);
    });
    addEventListener("afterprint", apply);
    matchMedia("print").addEventListener("change", () => this.axis.plots.forEach((plot) => plot.draw()));
    apply();
  }

  play() {
    if (this.time >= frames.end - 1e-6) this.time = frames.begin;
    this.playing = true;
    $("play").textContent = "❚❚";
    $("play").setAttribute("aria-label", "Pause");
    let last = performance.now();
    const tick = (now) => {
      if (!this.playing) return;
      const next = this.time + ((now - last) / 1000) * +$("speed").value;
      last = now;
      this.seek(next);
      if (next >= frames.end) this.stop(); else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  stop() {
    if (this.playing) this.axis.plots.forEach((plot) => plot.moveCursor(this.time));
    this.playing = false;
    $("play").textContent = "▶";
    $("play").setAttribute("aria-label", "Play");
  }

  seek(time) {
    this.time = Math.max(frames.begin, Math.min(frames.end, time));
    $("time").value = this.time;
    $("clock").textContent = `${this.time.toFixed(2)} s`;
    // Numbers that change faster cannot be read, and cost the page more than the picture.
    const now = performance.now(), withNumbers = !(this.playing || this.live?.following) || now - (this.numbered ?? 0) > 120;
    if (withNumbers) this.numbered = now;
    this.axis.plots.forEach((plot) => plot.moveCursor(this.time, withNumbers));
    this.request();
  }

  // At most one drawing per picture of the screen.
  request() {
    this.wanted ??= requestAnimationFrame(() => { this.wanted = undefined; this.pace(); this.show(); });
  }

  // Where pictures take too long, smaller ones.
  pace() {
    const now = performance.now(), interval = now - (this.shown ?? 0);
    this.shown = now;
    if (interval > 500) return;
    this.interval = 0.9 * (this.interval ?? 16) + 0.1 * interval;
    if (this.interval > 80 && this.view.quality > 0.5) {
      this.view.quality *= 0.8;
      this.interval = 16;
    }
  }

  show() {
    if (!frames.rows) return;
    const motion = motionAt(frames, this.time);
    this.motion = motion;
    this.adorn?.(motion);
    this.view.draw(this.actors.at(motion, this.colours), this.colours);
    this.sole.show(motion);
    const cycle = cycles.rowAt(this.time), row = motion.row;
    const margin = frames.at("margin", row), push = Math.hypot(...motion.push);
    $("sole-margin").textContent = Number.isFinite(margin) ? `${(1e3 * margin).toFixed(1).replace("-", "−")} mm to the edge` : row === 0 ? "" : "in the air";
    const force = Math.hypot(...motion.force);
    const lines = [
      [`${this.time.toFixed(2)} s`, "when"],
      [`ground ${force.toFixed(0)} N`, ""],
      push > 0 ? [`push ${push.toFixed(0)} N`, "push"] : null,
      cycles.rows ? [LEVELS[cycles.at("fallback", cycle)] ?? "?", cycles.at("fallback", cycle) > 0 ? "warn" : ""] : null,
      frames.at("status", row) & 1 ? ["fell", "warn"] : null,
    ];
    $("hud").replaceChildren(...lines.filter(Boolean).map(([text, mark]) => element("span", { class: mark }, text)));
  }

  // For tests: how far the hand of our kinematics is from the logged one, at worst (m).
  handError() {
    if (!run.hand || !frames.has("hand")) return NaN;
    let worst = 0;
    for (let row = 0; row < frames.rows; row += 7) {
      const motion = motionAt(frames, frames.time(row)), pose = poseOf(motion.poses, run.hand);
      worst = Math.max(worst, Math.hypot(...[0, 1, 2].map((i) => pose[9 + i] - motion.hand[i])));
    }
    return worst;
  }
}

const page = new Page();
