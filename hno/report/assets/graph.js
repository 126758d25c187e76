/** Evaluates graphs of `hno.export.page_program` on batches: an array is {shape, data}, entries in rows. */
const count = (shape) => shape.reduce((a, b) => a * b, 1);

function stepsOf(shape) {
  const steps = new Array(shape.length).fill(1);
  for (let axis = shape.length - 2; axis >= 0; axis--) steps[axis] = steps[axis + 1] * shape[axis + 1];
  return steps;
}

/** Entries of an array, read with other steps. */
function strided(data, shape, steps, start = 0) {
  const [found, index] = [new Float64Array(count(shape)), new Array(shape.length).fill(0)];
  let at = start;
  for (let k = 0; k < found.length; k++) {
    found[k] = data[at];
    for (let axis = shape.length - 1; axis >= 0; axis--) {
      at += steps[axis];
      if (++index[axis] < shape[axis]) break;
      at -= steps[axis] * shape[axis];
      index[axis] = 0;
    }
  }
  return { shape, data: found };
}

function broadcast(x, shape) {
  if (x.data.length === count(shape)) return { shape, data: x.data };
  const steps = stepsOf(x.shape).map((step, axis) => (x.shape[axis] === 1 ? 0 : step));
  return strided(x.data, shape, [...new Array(shape.length - steps.length).fill(0), ...steps]);
}

const permuted = (x, order) => strided(x.data, order.map((k) => x.shape[k]), order.map((k) => stepsOf(x.shape)[k]));

/** Sizes before, at and after an axis. */
const around = (shape, axis) => [count(shape.slice(0, axis)), shape[axis], count(shape.slice(axis + 1))];

const UNARY = {
  neg: (a) => -a, sigmoid: (a) => 1 / (1 + Math.exp(-a)), relu: (a) => Math.max(a, 0), not: (a) => Number(!a),
};
for (const name of ["sin", "cos", "tan", "asin", "acos", "atan", "exp", "log", "sqrt", "abs", "floor", "tanh"]) UNARY[name] = Math[name];
const BINARY = {
  add: (a, b) => a + b, sub: (a, b) => a - b, mul: (a, b) => a * b, div: (a, b) => a / b, maximum: Math.max,
  minimum: Math.min, pow: Math.pow, remainder: (a, b) => a - b * Math.floor(a / b), lt: (a, b) => Number(a < b),
  le: (a, b) => Number(a <= b), gt: (a, b) => Number(a > b), ge: (a, b) => Number(a >= b),
  eq: (a, b) => Number(a === b), ne: (a, b) => Number(a !== b), and: (a, b) => Number(a && b), or: (a, b) => Number(a || b),
};
const REDUCTIONS = {
  sum: (row) => row.reduce((a, b) => a + b, 0), prod: (row) => row.reduce((a, b) => a * b, 1),
  max: (row) => row.reduce((a, b) => Math.max(a, b)), min: (row) => row.reduce((a, b) => Math.min(a, b)),
  argmax: (row) => row.indexOf(row.reduce((a, b) => Math.max(a, b))),
};

function matmul(x, y, shape) {
  const [rows, columns] = shape.slice(-2);
  const inner = x.shape.at(-1);
  const batch = shape.slice(0, -2);
  const [a, b] = [broadcast(x, [...batch, rows, inner]).data, broadcast(y, [...batch, inner, columns]).data];
  const found = new Float64Array(count(shape));
  for (let k = 0; k < count(batch); k++) {
    for (let i = 0; i < rows; i++) {
      const row = (k * rows + i) * columns;
      for (let j = 0; j < inner; j++) {
        const [factor, from] = [a[(k * rows + i) * inner + j], (k * inner + j) * columns];
        for (let l = 0; l < columns; l++) found[row + l] += factor * b[from + l];
      }
    }
  }
  return { shape, data: found };
}

function reduced(x, axes, reduce, shape) {
  const kept = x.shape.map((_, axis) => axis).filter((axis) => !axes.includes(axis));
  const rows = permuted(x, [...kept, ...axes]).data;
  const size = count(axes.map((axis) => x.shape[axis]));
  return { shape, data: Float64Array.from({ length: count(shape) }, (_, k) => reduce(rows.subarray(k * size, (k + 1) * size))) };
}

function concatenated(parts, axis, shape) {
  const [found, [before, , after]] = [new Float64Array(count(shape)), around(shape, axis)];
  let start = 0;
  for (const part of parts) {
    const size = part.shape[axis] * after;
    for (let k = 0; k < before; k++) found.set(part.data.subarray(k * size, (k + 1) * size), k * shape[axis] * after + start);
    start += size;
  }
  return { shape, data: found };
}

function taken(x, index, axis, shape) {
  const [before, size, after] = around(x.shape, axis);
  const found = new Float64Array(count(shape));
  let at = 0;
  for (let k = 0; k < before; k++) {
    for (const place of index.data) {
      const from = (k * size + (place < 0 ? place + size : place)) * after;
      found.set(x.data.subarray(from, from + after), at);
      at += after;
    }
  }
  return { shape, data: found };
}

/** Along one axis every entry of the index says where the entry comes from. */
function gathered(x, index, axis) {
  const [, size, after] = around(x.shape, axis);
  const inner = index.shape[axis] * after;
  const from = (place, k) => x.data[Math.floor(k / inner) * size * after + (place < 0 ? place + size : place) * after + (k % after)];
  return { shape: index.shape, data: Float64Array.from(index.data, from) };
}

function sorted(x, axis, descending) {
  const order = [...x.shape.keys()].filter((k) => k !== axis).concat(axis);
  const rows = permuted(x, order);
  for (let k = 0; k < rows.data.length; k += x.shape[axis]) {
    const row = rows.data.subarray(k, k + x.shape[axis]).sort();
    if (descending) row.reverse();
  }
  return permuted(rows, [...x.shape.keys()].map((k) => order.indexOf(k)));
}

function sliced(x, { axis, start, step }, shape) {
  const steps = stepsOf(x.shape);
  const first = start * steps[axis];
  steps[axis] *= step;
  return strided(x.data, shape, steps, first);
}

const OTHERS = {
  reshape: ([x], _, shape) => ({ shape, data: x.data }),
  expand: ([x], _, shape) => broadcast(x, shape),
  permute: ([x], { order }) => permuted(x, order),
  slice: ([x], node, shape) => sliced(x, node, shape),
  cat: (parts, { axis }, shape) => concatenated(parts, axis, shape),
  take: ([x, index], { axis }, shape) => taken(x, index, axis, shape),
  gather: ([x, index], { axis }) => gathered(x, index, axis),
  matmul: ([x, y], _, shape) => matmul(x, y, shape),
  iota: (_inputs, _node, shape) => ({ shape, data: Float64Array.from({ length: count(shape) }, (_, k) => k) }),
  sort: ([x], { axis, descending }) => sorted(x, axis, descending),
  cast: ([x], { kind }) => ({ shape: x.shape, data: kind === "real" ? x.data : x.data.map(kind === "int" ? Math.trunc : (a) => Number(a !== 0)) }),
};

function computed(node, inputs, shape) {
  if (node.op in OTHERS) return OTHERS[node.op](inputs, node, shape);
  if (node.op in REDUCTIONS) return reduced(inputs[0], node.axes, REDUCTIONS[node.op], shape);
  const parts = inputs.map((x) => broadcast(x, shape).data);
  const [a, b, c] = parts;
  if (node.op === "where") return { shape, data: b.map((value, k) => (a[k] ? value : c[k])) };
  const op = UNARY[node.op] ?? BINARY[node.op];
  const found = new Float64Array(a.length);
  for (let k = 0; k < found.length; k++) found[k] = op(a[k], b?.[k]);
  return { shape, data: found };
}

function half(bits) {
  const [sign, exponent, fraction] = [bits & 0x8000 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}

function constant({ shape, values, halves, largest }) {
  if (values) return { shape, data: Float64Array.from(values, Number) };
  const bytes = Uint8Array.from(atob(halves), (letter) => letter.charCodeAt(0));
  return { shape, data: Float64Array.from({ length: bytes.length / 2 }, (_, k) => largest * half(bytes[2 * k] | (bytes[2 * k + 1] << 8))) };
}

/** A function from inputs, by name, of batches of n rows to outputs, by name. */
function graph({ nodes, outputs }) {
  const known = nodes.map((node) => (node.op === "constant" ? constant(node) : null));
  return (inputs, n) => {
    const found = [...known];
    nodes.forEach((node, k) => {
      if (node.op === "input") found[k] = inputs[node.name];
      const shape = node.shape.map((size) => (size < 0 ? -size * n : size));
      found[k] ??= computed(node, node.inputs.map((below) => found[below]), shape);
    });
    return Object.fromEntries(Object.entries(outputs).map(([name, k]) => [name, found[k]]));
  };
}
