// Triangles of the primitives: { points: [x y z ...], normals: [...] }, three corners per triangle.

function meshOfQuads(quads) {
  const points = [], normals = [];
  for (const corners of quads) {
    for (const i of [0, 1, 2, 0, 2, 3]) {
      points.push(...corners[i].p);
      normals.push(...corners[i].n);
    }
  }
  return { points: new Float32Array(points), normals: new Float32Array(normals) };
}

// A box with rounded edges: every point is an inner point plus the radius times the normal.
function boxMesh([sx, sy, sz]) {
  const half = [sx / 2, sy / 2, sz / 2];
  const radius = Math.min(0.06, 0.2 * Math.min(sx, sy, sz));
  const quads = [];
  const corner = (p) => {
    const inner = p.map((x, i) => Math.max(-(half[i] - radius), Math.min(half[i] - radius, x)));
    const d = p.map((x, i) => x - inner[i]);
    const length = Math.hypot(...d) || 1;
    const n = d.map((x) => x / length);
    return { p: inner.map((x, i) => x + radius * n[i]), n };
  };
  for (let axis = 0; axis < 3; axis++) {
    const u = (axis + 1) % 3, v = (axis + 2) % 3;
    const lines = (i) => [-half[i], -half[i] + 0.25 * radius, -half[i] + 0.6 * radius, -half[i] + radius, half[i] - radius, half[i] - 0.6 * radius, half[i] - 0.25 * radius, half[i]];
    const us = lines(u), vs = lines(v);
    for (const sign of [-1, 1]) {
      for (let i = 0; i < 7; i++) {
        for (let j = 0; j < 7; j++) {
          const at = (a, b) => {
            const p = [0, 0, 0];
            p[axis] = sign * half[axis]; p[u] = us[a]; p[v] = vs[b];
            return corner(p);
          };
          const quad = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
          quads.push(sign > 0 ? quad : quad.reverse());
        }
      }
    }
  }
  return meshOfQuads(quads);
}

// A profile of { r, z, nr, nz } turned about z.
function latheMesh(profile, segments = 28) {
  const quads = [];
  for (let k = 0; k + 1 < profile.length; k++) {
    const [a, b] = [profile[k], profile[k + 1]];
    for (let i = 0; i < segments; i++) {
      const at = ({ r, z, nr, nz }, step) => {
        const angle = (2 * Math.PI * step) / segments, c = Math.cos(angle), s = Math.sin(angle);
        return { p: [r * c, r * s, z], n: [nr * c, nr * s, nz] };
      };
      quads.push([at(a, i), at(a, i + 1), at(b, i + 1), at(b, i)]);
    }
  }
  return meshOfQuads(quads);
}

function arc(radius, z, from, to, steps = 8) {
  return Array.from({ length: steps + 1 }, (_, i) => {
    const angle = from + ((to - from) * i) / steps;
    const nr = Math.cos(angle), nz = Math.sin(angle);
    return { r: radius * nr, z: z + radius * nz, nr, nz };
  });
}

function cylinderMesh([radius, length]) {
  const bevel = Math.min(0.012, 0.2 * radius, 0.2 * length), z = length / 2 - bevel, r = radius - bevel;
  const rim = (at, from, to) => arc(bevel, at, from, to, 4).map((p) => ({ ...p, r: p.r + r }));
  return latheMesh([{ r: 0, z: -length / 2, nr: 0, nz: -1 }, ...rim(-z, -Math.PI / 2, 0), ...rim(z, 0, Math.PI / 2), { r: 0, z: length / 2, nr: 0, nz: 1 }]);
}

function capsuleMesh([radius, length]) {
  return latheMesh([...arc(radius, -length / 2, -Math.PI / 2, 0), ...arc(radius, length / 2, 0, Math.PI / 2)]);
}

const sphereMesh = ([radius]) => latheMesh(arc(radius, 0, -Math.PI / 2, Math.PI / 2, 16));
const coneMesh = () => latheMesh([{ r: 0, z: 0, nr: 0, nz: -1 }, { r: 1, z: 0, nr: 0, nz: -1 }, { r: 1, z: 0, nr: 0.9, nz: 0.44 }, { r: 0, z: 1, nr: 0.9, nz: 0.44 }]);
const rodMesh = () => latheMesh([{ r: 1, z: 0, nr: 1, nz: 0 }, { r: 1, z: 1, nr: 1, nz: 0 }]);
const discMesh = () => latheMesh([{ r: 1, z: 0, nr: 0, nz: 1 }, { r: 0, z: 0, nr: 0, nz: 1 }]);
const ringMesh = () => latheMesh([{ r: 1, z: 0, nr: 0, nz: 1 }, { r: 0.72, z: 0, nr: 0, nz: 1 }]);

// The edge of a polygon as a flat band in its plane.
function outlineMesh(polygon, width) {
  const n = polygon.length;
  const middle = polygon.reduce(([x, y], [a, b]) => [x + a / n, y + b / n], [0, 0]);
  const inset = polygon.map(([x, y]) => {
    const d = [middle[0] - x, middle[1] - y], length = Math.hypot(...d) || 1;
    return [x + (d[0] / length) * width, y + (d[1] / length) * width];
  });
  const corner = ([x, y]) => ({ p: [x, y, 0], n: [0, 0, 1] });
  return meshOfQuads(polygon.map((p, i) => [p, polygon[(i + 1) % n], inset[(i + 1) % n], inset[i]].map(corner)));
}

// Triangles of a file, flat.
function fileMesh(size, { points, faces }) {
  const triangles = { points: new Float32Array(3 * faces.length), normals: new Float32Array(3 * faces.length) };
  const corner = (i) => [0, 1, 2].map((k) => points[3 * i + k] * 1e-4);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [corner(faces[f]), corner(faces[f + 1]), corner(faces[f + 2])];
    const u = b.map((x, k) => x - a[k]), v = c.map((x, k) => x - a[k]);
    const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    const length = Math.hypot(...n) || 1;
    [a, b, c].forEach((p, i) => {
      triangles.points.set(p, 3 * (f + i));
      triangles.normals.set(n.map((x) => x / length), 3 * (f + i));
    });
  }
  return triangles;
}

const MESHES = { box: boxMesh, cylinder: cylinderMesh, capsule: capsuleMesh, sphere: sphereMesh, mesh: fileMesh };
