// Poses of the bodies. A pose is twelve numbers: the rows of the rotation, then the translation.

const IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0];

function compose(a, b) {
  const c = new Array(12);
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
    c[9 + i] = a[3 * i] * b[9] + a[3 * i + 1] * b[10] + a[3 * i + 2] * b[11] + a[9 + i];
  }
  return c;
}

function turned(pose, v) {
  return [0, 3, 6].map((i) => pose[i] * v[0] + pose[i + 1] * v[1] + pose[i + 2] * v[2]);
}

function moved(pose, point) {
  return turned(pose, point).map((x, i) => x + pose[9 + i]);
}

// The point in the axes of the pose.
function movedBack(pose, point) {
  const d = [point[0] - pose[9], point[1] - pose[10], point[2] - pose[11]];
  return [0, 1, 2].map((i) => pose[i] * d[0] + pose[3 + i] * d[1] + pose[6 + i] * d[2]);
}

// Rodrigues' formula; the axis has length 1.
function rotation([x, y, z], angle) {
  const s = Math.sin(angle), c = Math.cos(angle), v = 1 - c;
  return [x * x * v + c, x * y * v - z * s, x * z * v + y * s,
    x * y * v + z * s, y * y * v + c, y * z * v - x * s,
    x * z * v - y * s, y * z * v + x * s, z * z * v + c, 0, 0, 0];
}

function poseOfQuaternion([px, py, pz, x, y, z, w]) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), px, py, pz];
}

// Poses of all bodies from the pose of the base link (position, quaternion x y z w) and the joint positions.
function bodyPoses(robot, base, position) {
  const poses = [];
  robot.bodies.forEach((body, index) => {
    if (body.joint === null) {
      poses[index] = robot.floating ? poseOfQuaternion(base) : IDENTITY;
      return;
    }
    const q = position[body.joint];
    const motion = body.slides ? [1, 0, 0, 0, 1, 0, 0, 0, 1, ...body.axis.map((x) => x * q)] : rotation(body.axis, q);
    const parent = body.parent === null ? IDENTITY : poses[body.parent];
    poses[index] = compose(parent, compose(body.placement, motion));
  });
  return poses;
}

function poseOf(poses, attachment) {
  return attachment.body === null ? attachment.pose : compose(poses[attachment.body], attachment.pose);
}

// The state between two frames.
function motionAt(table, time) {
  const row = table.rowAt(time), next = Math.min(row + 1, table.rows - 1);
  const span = table.time(next) - table.time(row);
  const part = span > 0 ? Math.min(1, Math.max(0, (time - table.time(row)) / span)) : 0;
  const mixed = (name) => Array.from({ length: table.width(name) }, (_, i) => {
    const a = table.at(name, row, i), b = table.at(name, next, i);
    return part === 0 ? a : a + part * (b - a);
  });
  const base = mixed("base");
  if (base.length) {
    // The shorter way round, then back to length 1.
    let dot = 0;
    for (let i = 3; i < 7; i++) dot += table.at("base", row, i) * table.at("base", next, i);
    if (dot < 0) for (let i = 3; i < 7; i++) base[i] = table.at("base", row, i);
    const length = Math.hypot(...base.slice(3));
    for (let i = 3; i < 7; i++) base[i] /= length;
  }
  const position = mixed("position");
  const poses = bodyPoses(run.robot, base, position);
  const motion = { time, row, poses, com: mixed("com"), velocity: mixed("com_velocity"), force: mixed("force"), pressure: mixed("pressure"), hand: mixed("hand") };
  motion.push = Array.from({ length: 3 }, (_, i) => table.at("push", row, i));
  const sole = run.robot.soles[run.stance];
  motion.sole = sole ? poseOf(poses, sole) : IDENTITY;
  motion.capture = capturePoint(motion.com, motion.velocity, motion.sole[11]);
  return motion;
}

// Where the robot would have to put its pressure point to come to rest: x + ẋ/ω, ω² = g/height (Pratt et al. 2006).
function capturePoint(com, velocity, ground) {
  const height = Math.max(0.05, com[2] - ground), omega = Math.sqrt(run.gravity / height);
  return [com[0] + velocity[0] / omega, com[1] + velocity[1] / omega, ground];
}
