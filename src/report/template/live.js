// A run that is going on: rows come over a websocket, wishes go back.

class Live {
  constructor(page) {
    this.page = page;
    this.following = true;
    this.paused = false;
    this.over = false;
    run.frame_s ??= 0.025;
    $("kind").textContent = "Live run";
    $("outcome").className = "outcome";
    $("outcome").textContent = "connecting";
    $("criteria-card").hidden = true;
    document.querySelector(".about").hidden = true;
    this.follow = element("button", { type: "button", class: "on" }, "live");
    this.follow.addEventListener("click", () => this.goLive());
    this.hint = element("p", { class: "hint" }, "Drag a link to pull at it. Drag the ground to turn.");
    $("ranges").replaceChildren(this.follow);
    $("scene").append(this.hint);
    $("speed").hidden = true;
    this.takeOver();
    this.showPlay();
    this.socket = new WebSocket(`ws://${location.host}/stream`);
    this.socket.addEventListener("open", () => ($("outcome").textContent = "● running"));
    this.socket.addEventListener("message", ({ data }) => this.hear(JSON.parse(data)));
    this.socket.addEventListener("close", () => this.end(undefined));
  }

  // While the run goes on, the button pauses the plant, and looking back does not stop anything.
  takeOver() {
    const { page } = this;
    this.before = { play: page.play, stop: page.stop };
    page.play = () => this.pause(!this.paused);
    page.stop = () => { this.following = false; this.follow.classList.remove("on"); };
    page.view.ongrab = (event) => this.grab(event);
    page.adorn = (motion) => this.adorn(motion);
    addEventListener("pointermove", (event) => this.pull(event));
    for (const kind of ["pointerup", "pointercancel", "blur"]) addEventListener(kind, () => this.release());
  }

  goLive() {
    this.following = true;
    this.follow.classList.add("on");
    this.page.seek(frames.end);
  }

  say(line) { if (this.socket.readyState === WebSocket.OPEN) this.socket.send(line); }

  pause(paused) {
    this.paused = paused;
    this.say(paused ? "pause" : "resume");
    $("outcome").textContent = paused ? "❚❚ paused" : "● running";
    this.showPlay();
  }

  showPlay() {
    $("play").textContent = this.paused ? "▶" : "❚❚";
    $("play").setAttribute("aria-label", this.paused ? "Resume" : "Pause");
  }

  hear({ frame, cycle, end }) {
    if (end) { this.end(end); return; }
    const first = frames.rows === 0;
    frames.append(frame);
    if (cycle && !(cycles.rows && Math.fround(cycle.time[0]) === cycles.end)) cycles.append(cycle);
    const { page } = this;
    if (first) { page.aim(); page.plots.chooseBusiest?.(); }
    // Long runs show their last 20 s.
    const from = Math.max(0, frames.end - 20);
    if (run.duration_s > 20) page.axis.set(from, Math.max(from + 20, frames.end));
    $("time").max = Math.max(frames.end, 0.01);
    if (this.following) page.seek(frames.end);
    // Redrawing takes at most a tenth of the time.
    const now = performance.now();
    if (now < (this.redrawAt ?? 0)) return;
    page.axis.plots.forEach((plot) => plot.inSight && plot.draw());
    page.sole.trail(page.sole.all, Math.max(frames.begin, frames.end - 20), frames.end);
    this.redrawAt = now + Math.max(300, 10 * (performance.now() - now));
  }

  end(outcome) {
    if (this.over) return;
    this.over = true;
    this.release();
    const { page } = this;
    Object.assign(page, this.before);
    delete page.view.ongrab;
    this.hint.remove();
    $("speed").hidden = false;
    $("play").textContent = "▶";
    run.outcome = outcome;
    if (outcome) page.heading(); else $("outcome").textContent = "the connection is gone";
    $("criteria-card").hidden = true;
    page.plots.chooseBusiest?.();
    page.axis.set(frames.begin, frames.end);
    page.axis.plots.forEach((plot) => plot.draw());
    page.timeline();
  }

  // The link under the pointer: { link, body, point in the body, depth }.
  pick(x, y) {
    const { view, motion } = this.page;
    if (!motion) return undefined;
    const optics = view.optics(), box = view.canvas.getBoundingClientRect();
    const f = 1 / Math.tan(0.5 * 0.62), aspect = view.canvas.clientWidth / view.canvas.clientHeight;
    const u = ((2 * (x - box.left)) / box.width - 1) * (aspect / f), v = (1 - (2 * (y - box.top)) / box.height) / f;
    const ray = [0, 1, 2].map((i) => u * optics.right[i] + v * optics.up[i] - optics.back[i]);
    let best;
    for (const shape of run.robot.shapes) {
      if (shape.body === null) continue;
      const pose = poseOf(motion.poses, shape);
      const from = movedBack(pose, optics.eye), along = movedBack([...pose.slice(0, 9), 0, 0, 0], ray);
      const [a, b, c] = shape.size;
      const half = { box: [a / 2, b / 2, c / 2], mesh: [a / 2, b / 2, c / 2], cylinder: [a, a, b / 2], capsule: [a, a, b / 2 + a], sphere: [a, a, a] }[shape.kind];
      // Between the three pairs of faces at once.
      let enter = 0, leave = Infinity;
      for (let i = 0; i < 3; i++) {
        const s = (-half[i] - from[i]) / along[i], t = (half[i] - from[i]) / along[i];
        enter = Math.max(enter, Math.min(s, t));
        leave = Math.min(leave, Math.max(s, t));
      }
      if (enter >= leave || (best && best.depth <= enter)) continue;
      const hit = [0, 1, 2].map((i) => optics.eye[i] + enter * ray[i]);
      best = { link: shape.link, body: shape.body, point: movedBack(motion.poses[shape.body], hit), depth: enter };
    }
    return best;
  }

  grab(event) {
    if (this.over || event.button !== 0 || event.shiftKey) return false;
    if (!this.following) this.goLive();
    this.held = this.pick(event.clientX, event.clientY);
    if (!this.held) return false;
    this.pointer = [event.clientX, event.clientY];
    event.preventDefault();
    return true;
  }

  // A spring between the point and the pointer, in the plane of the screen: 400 N per m, at most 250 N.
  pull(event) {
    if (!this.held) return;
    this.pointer = [event.clientX, event.clientY];
    const now = performance.now();
    if (now - (this.said ?? 0) < 25) return;
    this.said = now;
    const { view, motion } = this.page, optics = view.optics(), box = view.canvas.getBoundingClientRect();
    const at = moved(motion.poses[this.held.body], this.held.point);
    const [x, y, depth] = view.project(at, optics);
    const metre = (depth * Math.tan(0.5 * 0.62) * 2) / box.height;
    const dx = (this.pointer[0] - box.left - x) * metre, dy = (this.pointer[1] - box.top - y) * metre;
    let force = [0, 1, 2].map((i) => 400 * (dx * optics.right[i] - dy * optics.up[i]));
    const size = Math.hypot(...force);
    if (size > 250) force = force.map((part) => (part * 250) / size);
    this.say(["pull", this.held.body, ...this.held.point.map((p) => p.toFixed(4)), ...force.map((p) => p.toFixed(2))].join(" "));
  }

  release() {
    if (!this.held) return;
    this.held = undefined;
    this.say("release");
  }

  // Where it is pulled at.
  adorn(motion) {
    if (!this.held) return;
    motion.grabbed = this.held.link;
    motion.pushed = moved(motion.poses[this.held.body], this.held.point);
  }
}

if (run.live) page.live = new Live(page);
