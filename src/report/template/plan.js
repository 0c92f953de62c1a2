"use strict";
// A plan: animation from the side, contact bars, forces, torques, clearance. All lengths in m, all times in s.
const plan = JSON.parse(document.getElementById("plan").textContent);
const $ = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const PALETTE = ["--c0", "--c1", "--c2", "--s4", "--s5", "--s1", "--s0", "--s3"];
const frames = plan.frames, end = plan.horizon_s;
let time = 0, playing = false;

function frameAt(t) {
  let low = 0, high = frames.length - 1;
  while (low < high) { const mid = (low + high + 1) >> 1; if (frames[mid].t <= t) low = mid; else high = mid - 1; }
  return low;
}

// Height of the ground with its gaps as holes of `depth`.
function ground(x, depth) {
  let z = 0;
  for (const step of plan.terrain.steps) if (x > step.x_m) z += step.rise_m;
  for (const gap of plan.terrain.gaps) if (x > gap.from_m && x < gap.to_m) z -= depth;
  return z;
}

function drawScene() {
  const canvas = $("scene"), ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
  const g = canvas.getContext("2d"), w = canvas.width, h = canvas.height;
  let [x0, x1, top] = [Infinity, -Infinity, 0.1];
  for (const f of frames) for (const [x, z] of f.p) { x0 = Math.min(x0, x); x1 = Math.max(x1, x); top = Math.max(top, z); }
  const depth = 0.12 * top;
  const scale = Math.min(0.94 * w / (x1 - x0), 0.9 * h / (top + depth));
  const X = (x) => w / 2 + scale * (x - (x0 + x1) / 2), Z = (z) => h - scale * (z + depth) - 0.04 * h;
  g.fillStyle = colour("--scene-background"); g.fillRect(0, 0, w, h);
  g.fillStyle = colour("--scene-grid"); g.beginPath(); g.moveTo(0, h);
  for (let px = 0; px <= w; px += 1) g.lineTo(px, Z(ground((x0 + x1) / 2 + (px - w / 2) / scale, depth)));
  g.lineTo(w, h); g.fill();
  for (const box of plan.terrain.obstacles)
    g.fillRect(X(box.x_m - box.thickness_m / 2), Z(box.height_m), scale * box.thickness_m, scale * box.height_m);
  const draw = (frame, alpha, width) => {
    g.globalAlpha = alpha; g.lineWidth = width * ratio; g.lineCap = "round"; g.lineJoin = "round";
    for (const [a, b] of plan.links) {
      const left = /^left|_left/.test(plan.names?.[b] ?? "");
      g.strokeStyle = colour(left ? "--c1" : "--scene-body");
      g.beginPath(); g.moveTo(X(frame.p[a][0]), Z(frame.p[a][1])); g.lineTo(X(frame.p[b][0]), Z(frame.p[b][1])); g.stroke();
    }
    g.globalAlpha = 1;
  };
  const ghosts = 9;
  for (let i = 0; i <= ghosts; i++) draw(frames[frameAt(end * i / ghosts)], 0.13, 2);
  const now = frames[frameAt(time)];
  draw(now, 1, 4);
  const k = stageAt(time), points = now.p.length - plan.contacts.length;
  plan.contacts.forEach((_, i) => {
    const [x, z] = now.p[points + i], force = plan.forces[i][k][0];
    if (plan.loaded[i][k] !== "#") return;
    const length = Math.min(0.35 * top, 0.25 * top * force / weight);
    g.strokeStyle = colour(PALETTE[i % PALETTE.length]); g.lineWidth = 3 * ratio;
    g.beginPath(); g.moveTo(X(x), Z(z)); g.lineTo(X(x), Z(z + length)); g.stroke();
  });
}

function stageAt(t) {
  let k = 0;
  while (k + 2 < plan.times.length && plan.times[k + 1] <= t) k++;
  return k;
}
const weight = Math.max(1e-9, plan.contacts.reduce((sum, _, i) =>
  sum + plan.forces[i].reduce((s, f, k) => s + f[0] * (plan.times[k + 1] - plan.times[k]), 0), 0) / end);

const LEFT = 92, RIGHT = 10, WIDTH = 900;
const T = (t) => LEFT + (WIDTH - LEFT - RIGHT) * t / end;
const cursors = [];

function chart(title, height, body) {
  const figure = document.createElement("figure");
  figure.className = "card";
  let ticks = "";
  for (let i = 0; i <= 5; i++) {
    const t = end * i / 5;
    ticks += `<text x="${T(t)}" y="${height + 14}" text-anchor="middle" fill="var(--faint)">${t.toFixed(1)}</text>`;
  }
  figure.innerHTML = `<figcaption>${title}</figcaption><svg viewBox="0 0 ${WIDTH} ${height + 18}">${body}${ticks}` +
    `<line class="cursor" y1="0" y2="${height}" stroke="var(--ink)" stroke-width="1"/></svg>`;
  $("charts").append(figure);
  cursors.push(figure.querySelector(".cursor"));
  figure.querySelector("svg").addEventListener("click", (event) => {
    const box = event.currentTarget.getBoundingClientRect();
    seek((WIDTH * (event.clientX - box.left) / box.width - LEFT) / (WIDTH - LEFT - RIGHT) * end);
  });
}

function label(y, text, fill = "var(--soft)") {
  return `<text x="${LEFT - 6}" y="${y}" text-anchor="end" fill="${fill}">${text}</text>`;
}

function contactBars() {
  let body = "";
  plan.contacts.forEach((name, i) => {
    const y = 6 + 18 * i, fill = `var(${PALETTE[i % PALETTE.length]})`;
    body += label(y + 11, name.replaceAll("_", " "));
    [...plan.loaded[i]].forEach((sign, k) => {
      const [a, b] = [T(plan.times[k]), T(plan.times[k + 1])];
      if (sign === "#") body += `<rect x="${a}" y="${y}" width="${b - a}" height="13" fill="${fill}"/>`;
      if (plan.forces[i][k][2] > 0.05) body += `<line x1="${b}" x2="${b}" y1="${y - 2}" y2="${y + 15}" stroke="${fill}" stroke-width="2"/>`;
    });
  });
  chart("Contacts: loaded stages, and impulses at their ends", 18 * plan.contacts.length + 6, body);
}

function steps(title, unit, series, names) {
  const height = 150, all = series.flat();
  let low = Math.min(0, ...all), high = Math.max(0, ...all);
  const room = 0.06 * (high - low || 1);
  low -= room; high += room;
  const Y = (y) => height - height * (y - low) / (high - low);
  let body = "";
  for (let i = 0; i <= 4; i++) {
    const y = low + (high - low) * i / 4;
    body += `<line x1="${LEFT}" x2="${WIDTH - RIGHT}" y1="${Y(y)}" y2="${Y(y)}" stroke="var(--rule)"/>` +
      label(Y(y) + (i === 4 ? 10 : 4), `${y.toFixed(high - low > 10 ? 0 : 2)}${i === 4 ? ` ${unit}` : ""}`.replace("-", "−"));
  }
  series.forEach((values, i) => {
    let path = "";
    values.forEach((y, k) => { path += `${k ? "L" : "M"}${T(plan.times[k])},${Y(y)}L${T(plan.times[k + 1])},${Y(y)}`; });
    body += `<path d="${path}" fill="none" stroke="var(${PALETTE[i % PALETTE.length]})" stroke-width="1.5"><title>${names[i]}</title></path>`;
  });
  chart(title, height, body);
}

function clearance() {
  const known = frames.filter((f) => f.clearance !== null);
  if (!known.length) return;
  const height = 130, high = Math.max(0.02, ...known.map((f) => f.clearance)), low = Math.min(0, ...known.map((f) => f.clearance));
  const Y = (y) => height - (height - 8) * (y - low) / (high - low);
  const path = known.map((f, i) => `${i ? "L" : "M"}${T(f.t)},${Y(f.clearance)}`).join("");
  chart("Lowest point of the legs over ground and boxes", height,
    label(Y(high) + 8, `${(1e3 * high).toFixed(0)} mm`) + label(Y(0) + 4, "0") +
    `<line x1="${LEFT}" x2="${WIDTH - RIGHT}" y1="${Y(0)}" y2="${Y(0)}" stroke="var(--faint)"/>` +
    `<path d="${path}" fill="none" stroke="var(--c2)" stroke-width="1.5"/>`);
}

function figures() {
  const short = (x) => (x === 0 || (Math.abs(x) >= 1e-2 && Math.abs(x) < 1e4) ? x.toPrecision(3) : x.toExponential(1)).replace("-", "−");
  $("figures").innerHTML = plan.judged.map(({ name, value, bound, unit, holds }) =>
    `<tr><td>${name}</td><td>${short(value)} ${unit}</td><td>${holds === undefined ? "" : `${holds ? "✓" : "✗"} ${short(bound)}`}</td></tr>`).join("");
  const good = !/^NOT/.test(plan.note) && plan.judged.every((one) => one.holds !== false);
  $("outcome").textContent = good ? plan.note || "checked" : plan.note || "does not hold its bounds";
  $("outcome").classList.add(good ? "good" : "bad");
  $("facts").textContent = `${plan.robot} · ${plan.times.length - 1} stages · ${end} s`;
}

function seek(t) {
  time = Math.max(0, Math.min(end, t));
  $("time").value = time / end;
  $("clock").textContent = `${time.toFixed(2)} s`;
  for (const line of cursors) { line.setAttribute("x1", T(time)); line.setAttribute("x2", T(time)); }
  drawScene();
}

let before = 0;
function tick(now) {
  if (!playing) return;
  seek(time >= end ? 0 : time + 0.5e-3 * (now - before));
  before = now;
  requestAnimationFrame(tick);
}
$("play").addEventListener("click", () => {
  playing = !playing; $("play").textContent = playing ? "❚❚" : "▶";
  before = performance.now(); requestAnimationFrame(tick);
});
$("time").addEventListener("input", () => seek(end * Number($("time").value)));
window.addEventListener("resize", drawScene);

figures();
if (plan.contacts.length) {
  contactBars();
  steps("Normal force, mean of a stage", "N", plan.forces.map((one) => one.map((f) => f[0])), plan.contacts);
}
clearance();
steps("Torque", "N m", plan.actuated.map((_, j) => plan.torques.map((u) => u[j])), plan.actuated);
const from = Number(new URLSearchParams(location.search).get("t"));
seek(from > 0 ? from : 0.35 * end);
