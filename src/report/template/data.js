// The run: what the page was made of, and columns that can grow while a run is going on.

const run = JSON.parse(document.getElementById("run").textContent);

function decode(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

class Table {
  constructor(columns) {
    this.columns = {};
    this.rows = 0;
    for (const [name, { width, base64 }] of Object.entries(columns ?? {})) {
      const values = decode(base64);
      this.columns[name] = { width, values };
      this.rows = values.length / width;
    }
  }

  has(name) { return name in this.columns; }

  at(name, row, index = 0) {
    const column = this.columns[name];
    return column ? column.values[row * column.width + index] : NaN;
  }

  width(name) { return this.columns[name]?.width ?? 0; }

  // Appends a row given by name; a name that comes for the first time makes a column.
  append(row) {
    for (const [name, value] of Object.entries(row)) {
      const numbers = Array.isArray(value) ? value : [value];
      const column = (this.columns[name] ??= { width: numbers.length, values: new Float32Array(1024 * numbers.length) });
      const end = (this.rows + 1) * column.width;
      if (end > column.values.length) {
        const larger = new Float32Array(2 * column.values.length);
        larger.set(column.values);
        column.values = larger;
      }
      for (let i = 0; i < column.width; i++) column.values[end - column.width + i] = numbers[i] ?? NaN;
    }
    this.rows += 1;
  }

  // Last row at or before a time; 0 when there is none.
  rowAt(time) {
    const times = this.columns.time?.values;
    if (!times) return 0;
    let low = 0, high = this.rows;
    while (low + 1 < high) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle; else high = middle;
    }
    return low;
  }

  time(row) { return this.at("time", row); }
  get begin() { return this.rows ? this.time(0) : 0; }
  get end() { return this.rows ? this.time(this.rows - 1) : 0; }
}

const frames = new Table(run.frames);
const cycles = new Table(run.cycles);

const VERDICTS = ["ok", "late", "infeasible", "model mismatch", "bad state"];
const LEVELS = ["fresh solution", "shifted plan", "static LQR", "gravity hold", "damping only", "no torque"];
const CONSTRAINTS = ["none", "torque", "unilateral", "friction", "pressure point", "yaw torque", "joint position", "joint velocity"];

function element(name, attributes = {}, ...children) {
  const svg = ["svg", "g", "path", "line", "text", "rect", "circle", "polygon", "polyline", "image", "clipPath", "defs", "title"];
  const made = svg.includes(name) ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) if (value !== undefined && value !== null) made.setAttribute(key, value);
  made.append(...children.filter((child) => child !== undefined && child !== null));
  return made;
}

// A number with so many significant digits that it can be read.
function short(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(1);
  return value.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : 3).replace("-", "−");
}
