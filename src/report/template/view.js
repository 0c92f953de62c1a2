// The robot in three dimensions: WebGL 2 where there is one, else a painter on the 2-D canvas. Both draw the same list of
// { mesh, pose, scale, colour, shade, shadow, flat }.

const LIGHT = (() => { const l = [0.45, 0.3, 1], n = Math.hypot(...l); return l.map((x) => x / n); })();

const VERTEX = `#version 300 es
uniform mat4 camera, model; in vec3 point, normal; out vec3 n, w;
void main() { vec4 at = model * vec4(point, 1.0); w = at.xyz; n = mat3(model) * normal; gl_Position = camera * at; }`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 colour; uniform vec3 light, eye, fog; uniform float lit; in vec3 n, w; out vec4 pixel;
void main() {
  vec3 m = normalize(n), v = normalize(eye - w);
  float key = max(dot(m, light), 0.0), sky = 0.5 + 0.5 * m.z;
  float back = max(dot(m, normalize(vec3(-light.x, -light.y, 0.35))), 0.0);
  float shine = pow(max(dot(m, normalize(light + v)), 0.0), 38.0);
  vec3 shaded = colour.rgb * (0.40 + 0.30 * sky + 0.56 * key + 0.16 * back) + 0.10 * shine;
  pixel = vec4(mix(colour.rgb, shaded, lit), colour.a);
}`;

const GROUND = `#version 300 es
precision highp float;
uniform vec3 line; uniform vec2 middle; in vec3 n, w; out vec4 pixel;
float grid(float size, float thick) {
  vec2 d = abs(fract(w.xy / size - 0.5) - 0.5) * size, f = fwidth(w.xy);
  vec2 a = 1.0 - smoothstep(thick * f, (thick + 1.0) * f, d);
  return max(a.x, a.y);
}
void main() {
  float far = length(w.xy - middle);
  float strength = max(0.45 * grid(0.25, 0.2), grid(1.0, 0.5));
  pixel = vec4(line, strength * (1.0 - smoothstep(0.8, 3.2, far)));
}`;

class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { alpha: false, antialias: true, stencil: true, preserveDrawingBuffer: true });
    this.camera = { azimuth: 0.95, elevation: 0.16, distance: 3.4, target: [0.12, 0, 0.78] };
    this.meshes = new Map();
    this.quality = 1;
    if (this.gl) this.prepare(); else this.paper = canvas.getContext("2d");
    this.listen();
  }

  prepare() {
    const gl = this.gl;
    const program = (fragment) => {
      const made = gl.createProgram();
      for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, fragment]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, text);
        gl.compileShader(shader);
        gl.attachShader(made, shader);
      }
      gl.bindAttribLocation(made, 0, "point");
      gl.bindAttribLocation(made, 1, "normal");
      gl.linkProgram(made);
      if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
      const at = {};
      for (const name of ["camera", "model", "colour", "light", "eye", "lit", "line", "middle"]) at[name] = gl.getUniformLocation(made, name);
      return { made, at };
    };
    this.solid = program(FRAGMENT);
    this.ground = program(GROUND);
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => { this.meshes.clear(); this.prepare(); this.onturn?.(); });
  }

  buffer(mesh) {
    const gl = this.gl;
    let made = this.meshes.get(mesh);
    if (!made) {
      made = { array: gl.createVertexArray(), count: mesh.points.length / 3 };
      gl.bindVertexArray(made.array);
      [mesh.points, mesh.normals].forEach((data, location) => {
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
        gl.enableVertexAttribArray(location);
        gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 0, 0);
      });
      this.meshes.set(mesh, made);
    }
    return made;
  }

  // Turning, shifting, coming closer: mouse, touch, wheel. One finger up and down stays the page's.
  listen() {
    const canvas = this.canvas, pointers = new Map();
    let spread = 0;
    const turn = () => this.onturn?.();
    canvas.addEventListener("pointerdown", (event) => {
      if (this.ongrab?.(event)) return;
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      spread = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (pointers.size === 2) {
        const [a, b] = [...pointers.values()];
        const now = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (spread) this.zoom(spread / now);
        spread = now;
      } else if (event.shiftKey || event.buttons === 2) {
        this.shift(dx, dy);
      } else {
        this.camera.azimuth -= 0.008 * dx;
        this.camera.elevation = Math.max(0.02, Math.min(1.55, this.camera.elevation + 0.006 * dy));
      }
      turn();
    });
    const release = (event) => { pointers.delete(event.pointerId); spread = 0; };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    // The wheel is the page's until the picture has been touched.
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      this.zoom(Math.exp(0.0012 * event.deltaY));
    }, { passive: false });
  }

  zoom(factor) {
    this.camera.distance = Math.max(0.5, Math.min(12, this.camera.distance * factor));
    this.onturn?.();
  }

  shift(dx, dy) {
    const { azimuth, distance, target } = this.camera, k = distance / this.canvas.clientHeight;
    target[0] += k * dx * Math.sin(azimuth);
    target[1] -= k * dx * Math.cos(azimuth);
    target[2] = Math.max(0, target[2] + k * dy);
  }

  // Where the eye is, and the matrix (by columns) to the cube of the screen.
  optics() {
    const { azimuth, elevation, distance, target } = this.camera;
    const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    // Narrow pictures need more distance for the same width.
    const away = distance * Math.max(1, 0.95 / aspect);
    const back = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    const eye = target.map((x, i) => x + away * back[i]);
    const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
    const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0]];
    const f = 1 / Math.tan(0.5 * 0.62), near = 0.05, far = 40;
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const rows = [right.map((x) => (x * f) / aspect), up.map((x) => x * f), back];
    const camera = new Float32Array(16);
    for (let j = 0; j < 3; j++) {
      camera[4 * j] = rows[0][j];
      camera[4 * j + 1] = rows[1][j];
      camera[4 * j + 2] = (back[j] * (far + near)) / (near - far);
      camera[4 * j + 3] = -back[j];
    }
    camera[12] = -dot(rows[0], eye);
    camera[13] = -dot(rows[1], eye);
    camera[14] = (-dot(back, eye) * (far + near)) / (near - far) + (2 * far * near) / (near - far);
    camera[15] = dot(back, eye);
    return { eye, camera, right, up, back, away };
  }

  // Where a point is on the canvas, in CSS pixels, and how far behind the eye's plane.
  project(point, { camera } = this.optics()) {
    const at = [0, 1, 3].map((i) => camera[i] * point[0] + camera[4 + i] * point[1] + camera[8 + i] * point[2] + camera[12 + i]);
    return [(0.5 + (0.5 * at[0]) / at[2]) * this.canvas.clientWidth, (0.5 - (0.5 * at[1]) / at[2]) * this.canvas.clientHeight, at[2]];
  }

  draw(items, colours) {
    const ratio = Math.min(2, window.devicePixelRatio || 1) * this.quality;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio)));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    if (this.gl) this.render(items, colours); else this.paint(items, colours, ratio);
  }

  render(items, colours) {
    const gl = this.gl, { eye, camera } = this.optics();
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...colours.background, 1);
    gl.clearStencil(0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);

    const send = ({ mesh, pose, scale }, before) => {
      const buffer = this.buffer(mesh);
      const s = scale ?? [1, 1, 1];
      let m = [pose[0] * s[0], pose[3] * s[0], pose[6] * s[0], 0, pose[1] * s[1], pose[4] * s[1], pose[7] * s[1], 0,
        pose[2] * s[2], pose[5] * s[2], pose[8] * s[2], 0, pose[9], pose[10], pose[11], 1];
      if (before) m = before(m);
      gl.uniformMatrix4fv(this.solid.at.model, false, m);
      gl.bindVertexArray(buffer.array);
      gl.drawArrays(gl.TRIANGLES, 0, buffer.count);
    };

    // Ground: shadows, each place once, then the grid over them.
    gl.useProgram(this.solid.made);
    gl.uniformMatrix4fv(this.solid.at.camera, false, camera);
    gl.uniform3fv(this.solid.at.light, LIGHT);
    gl.uniform3fv(this.solid.at.eye, eye);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.uniform1f(this.solid.at.lit, 0);
    gl.uniform4f(this.solid.at.colour, ...colours.shadow);
    const onGround = (m) => {
      const flat = [...m];
      for (let j = 0; j < 4; j++) {
        const z = m[4 * j + 2] / LIGHT[2];
        flat[4 * j] -= LIGHT[0] * z;
        flat[4 * j + 1] -= LIGHT[1] * z;
        flat[4 * j + 2] = 0;
      }
      return flat;
    };
    items.filter((item) => item.shadow).forEach((item) => send(item, onGround));
    gl.disable(gl.STENCIL_TEST);

    gl.useProgram(this.ground.made);
    gl.uniformMatrix4fv(this.ground.at.camera, false, camera);
    gl.uniform3fv(this.ground.at.line, colours.grid);
    gl.uniform2f(this.ground.at.middle, this.camera.target[0], this.camera.target[1]);
    this.plane ??= meshOfQuads([[[-8, -8], [8, -8], [8, 8], [-8, 8]].map(([x, y]) => ({ p: [x, y, 0], n: [0, 0, 1] }))]);
    const plane = this.buffer(this.plane);
    gl.uniformMatrix4fv(this.ground.at.model, false, [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    gl.bindVertexArray(plane.array);
    gl.drawArrays(gl.TRIANGLES, 0, plane.count);

    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.solid.made);
    for (const item of items) {
      gl.uniform1f(this.solid.at.lit, item.flat ? 0 : 1);
      gl.uniform4f(this.solid.at.colour, ...item.colour, item.alpha ?? 1);
      send(item);
    }
    // Forces inside the robot shine through it.
    gl.depthFunc(gl.GREATER);
    gl.depthMask(false);
    for (const item of items.filter(({ through }) => through)) {
      gl.uniform1f(this.solid.at.lit, 0);
      gl.uniform4f(this.solid.at.colour, ...item.colour, 0.45);
      send(item);
    }
    gl.depthMask(true);
    gl.depthFunc(gl.LESS);
  }

  // The same by the painter's algorithm: triangles from far to near.
  paint(items, colours, ratio) {
    const paper = this.paper, optics = this.optics();
    const css = (c, k = 1) => `rgb(${c.map((x) => Math.round(255 * Math.min(1, x * k))).join(" ")})`;
    paper.setTransform(ratio, 0, 0, ratio, 0, 0);
    paper.fillStyle = css(colours.background);
    paper.fillRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    paper.strokeStyle = css(colours.grid);
    paper.lineWidth = 0.5;
    for (let i = -8; i <= 8; i++) {
      for (const line of [[[i / 4, -2, 0], [i / 4, 2, 0]], [[-2, i / 4, 0], [2, i / 4, 0]]]) {
        const [a, b] = line.map((p) => this.project(p, optics));
        if (a[2] < 0.05 || b[2] < 0.05) continue;
        paper.beginPath();
        paper.moveTo(a[0], a[1]);
        paper.lineTo(b[0], b[1]);
        paper.stroke();
      }
    }
    const triangles = [];
    for (const { mesh, pose, scale, colour, flat } of items) {
      const s = scale ?? [1, 1, 1];
      const at = (data, i, turn) => turn(pose, [data[3 * i] * s[0], data[3 * i + 1] * s[1], data[3 * i + 2] * s[2]]);
      for (let i = 0; i < mesh.points.length / 3; i += 3) {
        const corners = [0, 1, 2].map((k) => at(mesh.points, i + k, moved));
        const [a, b, c] = corners.map((p) => this.project(p, optics));
        const front = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) < 0;
        if (!(front || flat) || Math.min(a[2], b[2], c[2]) < 0.05) continue;
        const n = turned(pose, [0, 1, 2].map((k) => mesh.normals[3 * i + k]));
        const key = Math.max(0, n[0] * LIGHT[0] + n[1] * LIGHT[1] + n[2] * LIGHT[2]);
        triangles.push({ a, b, c, depth: a[2] + b[2] + c[2] + (flat ? 1 : 0), style: css(colour, flat ? 1 : 0.5 + 0.13 * n[2] + 0.5 * key) });
      }
    }
    triangles.sort((x, y) => y.depth - x.depth);
    // Wide enough to close the seams between two triangles.
    paper.lineWidth = 1;
    paper.lineJoin = "round";
    for (const { a, b, c, style } of triangles) {
      paper.fillStyle = paper.strokeStyle = style;
      paper.beginPath();
      paper.moveTo(a[0], a[1]);
      paper.lineTo(b[0], b[1]);
      paper.lineTo(c[0], c[1]);
      paper.closePath();
      paper.fill();
      paper.stroke();
    }
  }
}

// A pose whose z axis points along a direction.
function poseAlong(origin, direction) {
  const length = Math.hypot(...direction) || 1, z = direction.map((x) => x / length);
  const helper = Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const x0 = cross(helper, z), n = Math.hypot(...x0), x = x0.map((v) => v / n), y = cross(z, x);
  return [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2], ...origin];
}

const mixed = (a, b, part) => a.map((x, i) => x + part * (b[i] - x));

// Lengths of arrows for a force like the robot's weight (m), for a robot of 175 kg; lighter ones have smaller signs.
const REACTION = 0.6, PUSH = 4.6;
const signSize = (mass_kg) => Math.max(0.3, Math.min(1, Math.cbrt(mass_kg / 175)));

// The things that are drawn at a moment.
class Actors {
  constructor(robot) {
    this.robot = robot;
    this.shapes = robot.shapes.map((shape) => ({ shape, mesh: MESHES[shape.kind](shape.size, shape) }));
    this.rod = rodMesh();
    this.cone = coneMesh();
    this.disc = discMesh();
    this.ring = ringMesh();
    this.ball = sphereMesh([0.04]);
    // Small robots have small signs.
    const size = (this.size = signSize(robot.mass_kg));
    this.bead = sphereMesh([0.016 * size]);
    this.outlines = robot.soles.map((sole) => outlineMesh(sole.polygon, 0.012));
  }

  arrow(from, vector, thickness, colour) {
    const length = Math.hypot(...vector);
    if (!(length > 0.01)) return [];
    const head = Math.min(0.5 * length, 4.2 * thickness), pose = poseAlong(from, vector);
    const neck = moved(pose, [0, 0, length - head]);
    return [
      { mesh: this.rod, pose, scale: [thickness, thickness, length - head], colour, through: true },
      { mesh: this.cone, pose: [...pose.slice(0, 9), ...neck], scale: [2.3 * thickness, 2.3 * thickness, head], colour, through: true },
    ];
  }

  at(motion, colours) {
    const { robot, size } = this, weight = robot.mass_kg * run.gravity;
    const items = this.shapes.map(({ shape, mesh }) => ({
      mesh,
      pose: poseOf(motion.poses, shape),
      colour: shape.link === motion.grabbed ? mixed(shape.colour ?? colours.body, [1, 1, 1], 0.35) : shape.colour ?? colours.body,
      shadow: true,
    }));
    const level = [1, 0, 0, 0, 1, 0, 0, 0, 1];
    const flat = (x, y, z, mesh, size, colour) => ({ mesh, pose: [...level, x, y, z], scale: [size, size, 1], colour, flat: true });
    const sole = robot.soles[run.stance];
    if (sole) {
      const lifted = compose(motion.sole, [...level, 0, 0, 0.001]);
      items.push({ mesh: this.outlines[run.stance], pose: lifted, colour: colours.sole, flat: true });
      items.push(flat(motion.com[0], motion.com[1], 0.003, this.ring, 0.022 * size, colours.com));
      items.push(flat(motion.capture[0], motion.capture[1], 0.004, this.disc, 0.013 * size, colours.capture));
      if (Number.isFinite(motion.pressure[0])) {
        const foot = moved(motion.sole, [motion.pressure[0], motion.pressure[1], 0]);
        const force = turned(motion.sole, motion.force).map((x) => (REACTION * size * x) / weight);
        items.push(flat(foot[0], foot[1], Math.max(0, foot[2]) + 0.005, this.disc, 0.013 * size, colours.pressure));
        items.push(...this.arrow([foot[0], foot[1], Math.max(0, foot[2])], force, 0.008 * size, colours.pressure));
      }
    }
    items.push({ mesh: this.bead, pose: [...level, ...motion.com], colour: colours.com, through: true });
    if (run.ball) items.push({ mesh: this.ball, pose: [...level, ...run.ball], colour: colours.ball, shadow: true });
    const push = Math.hypot(...motion.push);
    if (push > 0) {
      // Ends where it acts; never lost nor endless.
      const at = motion.pushed ?? this.pushedPoint(motion);
      const length = size * Math.max(0.18, Math.min(0.9, (PUSH * push) / weight));
      const arrow = motion.push.map((x) => (x / push) * length);
      items.push(...this.arrow(at.map((x, i) => x - arrow[i]), arrow, 0.014 * size, colours.push));
    }
    return items;
  }

  // Pushes act on the mass centre of a link.
  pushedPoint(motion) {
    const event = run.events.find(({ kind, from, to }) => kind === "push" && motion.time >= from - 0.02 && motion.time <= to + 0.02);
    const body = this.robot.bodies[event?.body ?? 0];
    return moved(motion.poses[event?.body ?? 0], body.com);
  }
}
