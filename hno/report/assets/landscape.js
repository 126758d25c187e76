/** Slices of a controller, evaluated here from its graph; without a graph, Python's own values on the game's slice. */
const [FINE, COARSE, ARROWS, TYPES] = [33, 17, 9, 5];
/** Largest difference between the values of this page and Python's, relative to |value| + median |value|. */
const TOLERANCE = 0.01;
const land = { content: null, evaluate: null, file: null, error: null, turn: 0, across: "", up: "", tau: 0, theta: [], at: {} };

const coordinate = (name) => land.content.coordinates.find((one) => one.name === name);
const short = (value) => Number(Number(value).toPrecision(3));
const dot = (a, b, from = 0) => a.reduce((sum, one, k) => sum + one * b[from + k], 0);
const apart = (one, other) => dot(one.weights, other.weights) === 0;

function put(x, { weights, offset }, value) {
  const missing = (value - dot(weights, x) - offset) / dot(weights, weights);
  return x.map((one, k) => one + missing * weights[k]);
}

function ends(name) {
  const { plane } = land.content;
  const own = [plane.across, plane.up].find((side) => side.name === name);
  const { lo, hi } = own ?? coordinate(name);
  return [lo, hi];
}

/** Coordinates of single states that neither axis moves. */
function others() {
  const axes = [coordinate(land.across), coordinate(land.up)];
  return land.content.coordinates.filter((one) => one.weights.filter(Boolean).length === 1 && one.offset === 0 && axes.every((axis) => apart(axis, one)));
}

/** Joint states of a grid of n by n points, row by row upwards. */
function states(n) {
  const [across, up] = [coordinate(land.across), coordinate(land.up)];
  const [[left, right], [bottom, top]] = [ends(land.across), ends(land.up)];
  const left_over = others().reduce((x, one) => put(x, one, land.at[one.name]), land.content.start);
  const found = [];
  for (let row = 0; row < n; row++) {
    const placed = put(left_over, up, bottom + ((top - bottom) * row) / (n - 1));
    for (let column = 0; column < n; column++) found.push(...put(placed, across, left + ((right - left) * column) / (n - 1)));
  }
  return found;
}

/** What the graph says on a grid. */
function evaluated(n) {
  const { players, states: count } = land.content;
  const size = n * n;
  const inputs = {
    tau: { shape: [size], data: new Float64Array(size).fill(land.tau) },
    x: { shape: [size, players, count], data: Float64Array.from(states(n)) },
    theta: { shape: [size, players], data: Float64Array.from({ length: size * players }, (_, k) => land.theta[k % players]) },
  };
  const found = land.evaluate(inputs, size);
  return Object.fromEntries(Object.entries(found).map(([name, { data }]) => [name, data]));
}

/** What is shown, as entries of the arrays: the name of one, its number of entries per point, and which of them. */
function quantities() {
  const { players, states: count, potential, coordinates } = land.content;
  const each = [...Array(players).keys()];
  const found = each.map((i) => ({ title: `V${i + 1}`, array: "value", width: players, place: i }));
  if (potential) found.unshift({ title: "W", array: "potential", width: 1, place: 0 });
  for (const i of potential ? [0] : each) {
    coordinates.slice(0, players * count).forEach(({ name }, j) => {
      const title = `∂${potential ? "W" : `V${i + 1}`}/∂${name}`;
      found.push({ title, array: "costate", width: (potential ? 1 : players) * players * count, place: i * players * count + j, signed: true });
    });
  }
  return found;
}

const chosen = () => quantities()[$("land-shown").value];
const column = (data, { array, width, place }) => data[array] && Array.from({ length: data[array].length / width }, (_, k) => data[array][k * width + place]);

/** The largest constraint at every point. */
function violation({ constraint }, size) {
  const width = constraint.length / size;
  return Array.from({ length: size }, (_, k) => Math.max(...constraint.slice(k * width, (k + 1) * width)));
}

/** Equilibria may be those of values alone, whose own costates are a potential's. */
function truthOf(shown) {
  const { truth, players, states: count, potential } = land.content;
  if (!truth) return null;
  if (shown.array !== "costate" || !potential) return column(truth, shown);
  const player = Math.floor(shown.place / count);
  return column(truth, { array: "costate", width: players * players * count, place: player * players * count + shown.place });
}

/** Round numbers within the ends, evenly. */
function evenLevels(low, high) {
  const rough = (high - low) / 8;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((digit) => digit * power >= rough);
  const first = Math.ceil(low / step);
  return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, k) => (first + k) * step);
}

/** 1, 2 and 5 times powers of ten on both sides of 0 within the ends, thinned out to some ten; even ones where the ends
 * have the same size. */
function levels(low, high) {
  if (low * high > 0 && Math.max(low / high, high / low) < 20) return evenLevels(low, high);
  const steps = [0];
  for (let power = -2; power < 8; power++) for (const digit of [1, 2, 5]) steps.push(digit * 10 ** power, -digit * 10 ** power);
  const inside = steps.filter((step) => step >= low && step <= high).sort((a, b) => a - b);
  const bent = (value) => Math.sign(value) * Math.log1p(Math.abs(value));
  const gap = (bent(high) - bent(low)) / 10;
  return inside.reduce((kept, step) => (kept.length && bent(step) - bent(kept.at(-1)) < gap ? kept : [...kept, step]), []);
}

/** A raster begins at the top left. */
function raster(values, n) {
  const rows = Array.from({ length: n }, (_, row) => values.slice(row * n, (row + 1) * n)).reverse();
  return [{ width: n, height: n, values: rows.flat() }];
}

/** Where the controls push the plane, at some points. */
function arrows({ push }, n, width, height) {
  if (!push || !$("land-arrows").checked) return [];
  const [across, up] = [coordinate(land.across).weights, coordinate(land.up).weights];
  const [[left, right], [bottom, top]] = [ends(land.across), ends(land.up)];
  const [sx, sy] = [width / (right - left), height / (top - bottom)];
  const found = [];
  for (let a = 0; a < ARROWS; a++) {
    for (let b = 0; b < ARROWS; b++) {
      const [c, r] = [a, b].map((place) => Math.round(((place + 0.5) / ARROWS) * (n - 1)));
      const from = (r * n + c) * across.length;
      found.push({ x: left + ((right - left) * c) / (n - 1), y: bottom + ((top - bottom) * r) / (n - 1), dx: sx * dot(across, push, from), dy: sy * dot(up, push, from) });
    }
  }
  const longest = Math.max(...found.map(({ dx, dy }) => Math.hypot(dx, dy))) || 1;
  const length = (0.8 * Math.min(width, height)) / ARROWS / longest;
  return found
    .filter(({ dx, dy }) => Math.hypot(dx, dy) > 0.03 * longest)
    .map(({ x, y, dx, dy }) => ({ x, y, x2: x + (dx * length) / sx, y2: y + (dy * length) / sy, angle: (Math.atan2(dx, dy) * 180) / Math.PI }));
}

/** Rasters of equal types from the low to the high end of the type box, whose level sets are drawn in one picture. */
function family(n, shown) {
  const { theta, players } = land.content;
  const kept = land.theta;
  const found = Array.from({ length: TYPES }, (_, k) => {
    const share = k / (TYPES - 1);
    land.theta = Array.from({ length: players }, (_, i) => theta[0][i] + share * (theta[1][i] - theta[0][i]));
    return { theta: land.theta[0], raster: raster(column(evaluated(n), shown), n)[0] };
  });
  land.theta = kept;
  return found;
}

function showLevels(found) {
  const select = $("land-level");
  const before = select.value;
  const texts = found.map((level) => String(short(level)));
  select.replaceChildren(element("option", { value: "", textContent: "none" }), ...texts.map((text) => element("option", { value: text, textContent: text })));
  select.value = texts.includes(before) ? before : "";
  select.disabled = !land.evaluate;
}

function surface(host, values, n, given, barrier, moved) {
  const width = Math.max(160, Math.min(560, $(host).clientWidth - 130));
  const height = Math.round(Math.min(320, Math.max(200, width * 0.7)));
  const sides = ["across", "up"].map((side) => coordinate(land[side]));
  const [x_title, y_title] = sides.map(({ name, unit }) => (unit ? `${name} [${unit}]` : name));
  const known = values.map((one) => (Number.isFinite(one) ? one : given.hole));
  const data = { grid: raster(values.map((one) => one ?? NaN), n), shape: raster(known, n), barrier: raster(barrier, n), arrows: moved ? arrows(moved, n, width, height) : [] };
  const level = moved && land.evaluate ? $("land-level").value : "";
  if (level !== "") Object.assign(data, { family: family(COARSE, chosen()) });
  const signals = { width, height, columns: n, rows: n, coarse_points: COARSE, type_ends: land.content.theta.map(([end]) => end), x_title, y_title, x_ends: ends(land.across), y_ends: ends(land.up), level: level === "" ? [] : [Number(level)], ...given };
  draw($(host), "landscape", data, signals, "canvas").then((view) =>
    view?.addSignalListener("pointer", (_name, at) => showValue(at, values, n, given.title)),
  );
}

/** The value of the point of the grid that is nearest to the pointer. */
function showValue(at, values, n, title) {
  const sides = ["across", "up"].map((side, k) => {
    const [lo, hi] = ends(land[side]);
    const place = Math.round(((at[k] - lo) / (hi - lo)) * (n - 1));
    return { ...coordinate(land[side]), place, value: lo + ((hi - lo) * place) / (n - 1) };
  });
  if (!sides.every(({ place }) => place >= 0 && place < n)) return;
  const found = values[sides[1].place * n + sides[0].place];
  const where = sides.map(({ name, unit, value }) => `${name} ${short(value)} ${unit}`).join(", ");
  $("land-at").textContent = `${where}: ${title} ${Number.isFinite(found) ? Number(found.toPrecision(4)) : "n/a"}`;
}

/** Ends of a colour scale and its levels. */
function scaleOf(values, signed) {
  const finite = values.filter(Number.isFinite);
  let [low, high] = [Math.min(...finite), Math.max(...finite)];
  if (signed) [low, high] = [-Math.max(-low, high), Math.max(-low, high)];
  if (!(low < high)) [low, high] = [low - 1, high + 1];
  const [scheme, arrow] = signed ? ["blueorange", "#222"] : ["viridis", "#fff"];
  return { low, high, levels: levels(low, high), scheme, arrow, hole: signed ? 0 : low };
}

const atDefault = () => {
  const { python, plane, coordinates } = land.content;
  const same = land.across === plane.across.name && land.up === plane.up.name && land.tau === python.tau;
  return same && python.theta.every((one, k) => one === land.theta[k]) && others().every(({ name }) => land.at[name] === startOf(name));
};
const startOf = (name) => land.content.plane.at[name] ?? coordinate(name).start;

/** Draw everything; while a slider moves, on a coarse grid. */
function drawLandscape(coarse = false) {
  if (!land.content || !$("land-learned").clientWidth) return;
  const own = atDefault();
  const { python, truth } = land.content;
  const compared = Boolean(own && truth && truthOf(chosen()));
  const n = !land.evaluate || compared ? python.points : coarse ? COARSE : FINE;
  const found = land.evaluate ? evaluated(n) : python;
  const shown = chosen();
  const values = column(found, shown);
  const barrier = violation(found, n * n);
  const wanted = compared ? truthOf(shown) : [];
  const scale = { ...scaleOf([...values, ...wanted], shown.signed), title: shown.title };
  showLevels(scale.levels);
  for (const name of ["truth", "error"]) $(`land-${name}-box`).hidden = !compared;
  surface("land-learned", values, n, scale, barrier, found);
  if (compared) {
    const off = values.map((one, k) => (wanted[k] === null ? NaN : one - wanted[k]));
    surface("land-truth", wanted, n, scale, barrier);
    surface("land-error", off, n, { ...scaleOf(off, true), title: "difference" }, barrier);
  }
  const run = DATA.landscapes[$("land-run").value].run;
  $("land-what").textContent = `Learned: ${shown.title} of ${run}, θ = (${land.theta.map(short).join(", ")}), ${short(land.tau)} s to go`;
  $("land-said").textContent = said(compared, values, wanted);
  land.drawn = { n, values, shown };
}

/** One frame of the training, on the game's own slice. */
function drawFilm(k) {
  const { film, truth, plane, potential } = land.content;
  Object.assign(land, { across: plane.across.name, up: plane.up.name });
  if ($("land-across").value !== land.across || $("land-up").value !== land.up) resetLandscape();
  const width = potential ? 1 : land.content.players;
  const place = chosen().array === "value" && !potential ? chosen().place : 0;
  const all_frames = film.frames.map(({ values }) => values.filter((_, at) => at % width === place));
  const wanted = truth ? column(truth, { array: potential ? "potential" : "value", width, place }) : [];
  const title = potential ? "W" : `V${place + 1}`;
  for (const name of ["truth", "error"]) $(`land-${name}-box`).hidden = true;
  surface("land-learned", all_frames[k], film.points, { ...scaleOf([...all_frames.flat(), ...wanted], false), title, level: [] }, film.violation);
  $("land-what").textContent = `Learned: ${title} after step ${film.frames[k].step}`;
  $("land-film-step").textContent = `step ${film.frames[k].step}`;
  $("land-said").textContent = `${title} after step ${film.frames[k].step}, frame ${k + 1} of ${film.frames.length}, from Python.`;
}

function showFilm() {
  const frames = land.content.film?.frames ?? [];
  $("land-film-box").hidden = frames.length < 2;
  $("land-film").max = frames.length - 1;
  $("land-film").value = frames.length - 1;
  $("land-film-step").textContent = frames.length ? `step ${frames.at(-1).step}` : "";
}

const median = (values) => values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)];

function said(compared, values, wanted) {
  const { reason, python, truth } = land.content;
  const parts = [];
  if (reason) parts.push(`Python's own values: this page cannot evaluate the controller (${reason}).`);
  else if (!land.evaluate) parts.push(`Python's own values: those of this page differ by ${(100 * land.error).toPrecision(2)} %, more than ${100 * TOLERANCE} %.`);
  else parts.push(`Evaluated in this page with weights in half precision: at most ${(100 * land.error).toPrecision(2)} % from Python's values on the game's own slice.`);
  if (compared) {
    const off = values.map((one, k) => Math.abs(one - wanted[k])).filter((_, k) => wanted[k] !== null);
    parts.push(`${truth.solved} of ${python.points ** 2} points have an equilibrium; median error ${median(off).toPrecision(2)}, largest ${Math.max(...off).toPrecision(2)}.`);
  } else if (truth) parts.push("Equilibria are known on the game's own slice.");
  else parts.push("A training with evaluation.landscape_truth=15 solves equilibria to compare with.");
  return parts.join(" ");
}

/** How far this page is from Python, see `TOLERANCE`. */
function difference() {
  const { python, potential } = land.content;
  const name = potential ? "potential" : "value";
  const found = evaluated(python.points)[name];
  const typical = median(python[name].map(Math.abs));
  return Math.max(...python[name].map((one, k) => Math.abs(found[k] - one) / (Math.abs(one) + typical)));
}

function slider(name, value, [lo, hi], unit, set) {
  const input = element("input", { type: "range", min: lo, max: hi, step: "any", value });
  const shown = element("output");
  const show = () => (shown.textContent = `${short(input.value)} ${unit}`);
  input.addEventListener("input", () => {
    set(Number(input.value));
    show();
    const turn = ++land.turn;
    requestAnimationFrame(() => turn === land.turn && drawLandscape(true));
  });
  input.addEventListener("change", () => drawLandscape());
  input.disabled = !land.evaluate;
  show();
  return element("label", {}, name, input, shown);
}

function showSliders() {
  const { horizon, theta } = land.content;
  const types = land.theta.map((value, k) => slider(`θ${k + 1}`, value, [theta[0][k], theta[1][k]], "", (one) => (land.theta[k] = one)));
  const left = others().map(({ name, lo, hi, unit }) => slider(name, land.at[name], [lo, hi], unit, (one) => (land.at[name] = one)));
  $("land-sliders").replaceChildren(slider("τ", land.tau, [0, horizon], "s", (one) => (land.tau = one)), ...types, ...left);
}

/** Coordinates for an axis; those that the other axis moves cannot be chosen. */
function showAxes() {
  for (const [side, other] of [["across", "up"], ["up", "across"]]) {
    const options = land.content.coordinates.map((one) => element("option", { value: one.name, textContent: one.name, disabled: !apart(one, coordinate(land[other])) }));
    $(`land-${side}`).replaceChildren(...options);
    $(`land-${side}`).value = land[side];
    $(`land-${side}`).disabled = !land.evaluate;
  }
}

function resetLandscape() {
  const { plane, python, coordinates } = land.content;
  Object.assign(land, { across: plane.across.name, up: plane.up.name, tau: python.tau, theta: [...python.theta] });
  land.at = Object.fromEntries(coordinates.map(({ name }) => [name, startOf(name)]));
  showAxes();
  showSliders();
  drawLandscape();
}

function received(content) {
  Object.assign(land, { content, evaluate: content.program && graph(content.program) });
  const before = $("land-shown").value;
  const options = quantities().map(({ title }, k) => element("option", { value: k, textContent: title }));
  $("land-shown").replaceChildren(...options);
  if (before && before < options.length) $("land-shown").value = before;
  Object.assign(land, { across: content.plane.across.name, up: content.plane.up.name, tau: content.python.tau, theta: content.python.theta });
  land.at = Object.fromEntries(content.coordinates.map(({ name }) => [name, startOf(name)]));
  showFilm();
  land.error = land.evaluate && difference();
  if (!(land.error <= TOLERANCE)) land.evaluate = null;
  resetLandscape();
}

/** Load the file of the chosen run, and show it once the section is seen. */
async function loadLandscape() {
  const { src, run } = DATA.landscapes[$("land-run").value];
  $("land-said").textContent = `Loading ${decodeURIComponent(src)} ...`;
  const file = (land.file = load(src, `the folder of ${run}`));
  try {
    const content = await file;
    if (land.file !== file) return;
    land.arrived = content;
    if (land.seen) received(content);
  } catch (error) {
    if (land.file === file) $("land-said").textContent = error.message;
  }
}

function listLandscapes() {
  const select = $("land-run");
  const before = select.value;
  const left = [...DATA.landscapes.keys()].filter((k) => matches(DATA.landscapes[k]));
  select.replaceChildren(...left.map((k) => element("option", { value: k, textContent: DATA.landscapes[k].run })));
  $("landscape").hidden = !left.length;
  if (before && left.includes(Number(before))) select.value = before;
  else if (left.length) loadLandscape();
}

if ($("landscape")) {
  listeners.push(listLandscapes);
  $("land-run").addEventListener("change", loadLandscape);
  for (const name of ["shown", "level"]) $(`land-${name}`).addEventListener("change", () => drawLandscape());
  $("land-arrows").addEventListener("change", () => drawLandscape());
  $("land-film").addEventListener("input", () => drawFilm(Number($("land-film").value)));
  $("land-reset").addEventListener("click", resetLandscape);
  for (const side of ["across", "up"]) {
    $(`land-${side}`).addEventListener("change", () => {
      land[side] = $(`land-${side}`).value;
      showAxes();
      showSliders();
      drawLandscape();
    });
  }
  for (const event of ["resize", "afterprint"]) addEventListener(event, () => setTimeout(drawLandscape, 200));
  addEventListener("beforeprint", () => drawLandscape());
  dark.addEventListener("change", () => drawLandscape());
  whenSeen($("landscape"), () => {
    land.seen = true;
    if (land.arrived) received(land.arrived);
  });
}
