/** Vega charts: drawn when they come into view, again when filters, width or colours change. */
const dark = matchMedia("(prefers-color-scheme: dark)");
const theme = () => DATA.themes[dark.matches && !("print" in document.documentElement.dataset) ? "dark" : "light"];
const [views, turns] = [new WeakMap(), new WeakMap()];
const tip = $("tip");

function showTip(_handler, event, _item, value) {
  tip.hidden = !value;
  if (!value) return;
  tip.textContent = typeof value === "string" ? value : Object.values(value).join("\n");
  const { width, height } = tip.getBoundingClientRect();
  tip.style.left = `${Math.max(8, Math.min(event.clientX + 14, innerWidth - width - 8))}px`;
  tip.style.top = `${event.clientY + height + 22 < innerHeight ? event.clientY + 16 : event.clientY - height - 12}px`;
}
addEventListener("scroll", () => (tip.hidden = true), { passive: true });

/**
 * Draw a chart into an element.
 * @param data rows by data set name.
 * @param values width, height and values of signals by name.
 * @returns a promise of the view, or of null where another drawing has come in between.
 */
async function draw(host, name, data, values = {}, renderer = "svg") {
  const turn = (turns.get(host) ?? 0) + 1;
  turns.set(host, turn);
  const { config, signals } = theme();
  const specification = structuredClone(DATA.charts[name]);
  const given = { ...signals, ...values };
  for (const signal of specification.signals) if (signal.name in given) signal.value = given[signal.name];
  for (const side of ["width", "height"]) if (side in values) specification[side] = values[side];
  for (const set of specification.data) if (set.name in data) set.values = data[set.name];
  const box = element("div");
  const options = { mode: "vega", config, renderer, ast: true, actions: false, defaultStyle: false, tooltip: showTip };
  views.get(host)?.finalize();
  host.replaceChildren(box);
  const made = await vegaEmbed(box, specification, options);
  if (turns.get(host) !== turn) {
    made.finalize();
    return null;
  }
  views.set(host, made);
  return made.view;
}

/** The heat map of a card: of a recipe in the page, of a single run in its part. */
const mapOf = ({ card, run }) => (run === undefined ? Promise.resolve(DATA.maps[card]) : part(Number(run)).then((found) => found.map));

async function drawHeat(host) {
  const card = host.closest(".map");
  const { cells } = await mapOf(card.dataset).catch((error) => {
    host.textContent = error.message;
    return {};
  });
  if (!cells) return;
  const columns = new Set(cells.map((cell) => cell.theta[0])).size;
  const step = Math.max(13, Math.min(38, Math.floor((host.clientWidth - 44) / columns)));
  const values = { x_step: step, y_step: step, small: step < 26, bound: $("shown").value };
  const view = await draw(host, "heat", { cells }, values);
  view?.addEventListener("click", (_event, item) => {
    const theta = item?.datum?.theta;
    if (!theta || !$("player")) return;
    choose_type(`(${theta.join(", ")})`, DATA.members[card.dataset.card]);
    $("episodes").scrollIntoView();
  });
}

for (const numbers of all(".numbers"))
  numbers.addEventListener("toggle", async () => {
    if (numbers.querySelector(".scroll")) return;
    const box = numbers.appendChild(element("div", { className: "scroll" }));
    mapOf(numbers.closest(".map").dataset).then(
      (found) => box.append(tableOf(found)),
      (error) => box.append(error.message),
    );
  });

function drawComparison(host) {
  const rows = DATA.comparison.filter((row) => row.game === host.dataset.of && (row.seed === null || matches(row)));
  draw(host, "comparison", { recipes: rows.filter((row) => matches({ ...row, seed: undefined })) });
}

/** How near episodes come: a line per recipe, and a dashed one for the equilibria from the same starts. */
function drawClearances(host) {
  const told = DATA.clearances.filter((one) => one.game === host.dataset.of && matches(one));
  host.closest("figure").hidden = !told.length;
  if (!told.length) return;
  const percent = (share) => `${Number((100 * share).toPrecision(3))} %`;
  const rows = ({ recipe, d, unit }, shares, label) =>
    shares.map((share, k) => ({ recipe, d: d[k], share, label, tip: `${label ? "equilibria" : recipe}\n${percent(share)} keep no more than ${d[k]} ${unit}` }));
  const labels = [...new Map(told.map((one) => [String(one.label), one])).values()];
  const points = [...told.flatMap((one) => rows(one, one.share, false)), ...labels.flatMap((one) => rows(one, one.label, true))];
  const unit = told[0].unit ? ` [${told[0].unit}]` : "";
  draw(host, "clearances", { points }, { near: `safe starts whose smallest clearance is at most d${unit}` });
}

function drawCurves(host) {
  const metric = $("metric").value;
  const told = DATA.curves.filter((curve) => curve.game === host.dataset.of && curve.metrics[metric] && matches(curve));
  const points = told.flatMap(({ run, recipe, metrics }) =>
    metrics[metric].map(([step, value]) => ({ run, recipe, step, value })),
  );
  host.closest("figure").hidden = !points.length;
  if (!points.length) return;
  const scale = points.every((point) => point.value > 0) ? "log" : "linear";
  draw(host, scale, { points }, { metric: `${metric}, ${meaning(metric)}${scale === "log" ? ", log scale" : ""}` }, "canvas");
}

/** What a metric's numbers are, by the beginning of its name. */
function meaning(metric) {
  const known = [
    ["seconds/", "s"],
    ["closed_loop/collision_rate", "collisions per safe start"],
    ["closed_loop/excess", "joint cost above the equilibrium's, share of it"],
    ["val/", "error on held-out labels, share of their size"],
    ["lr", "learning rate"],
    ["loss/", "training loss, weighted, no unit"],
  ];
  return (known.find(([start]) => metric.startsWith(start)) ?? ["", "as logged"])[1];
}

function drawTrials(host) {
  draw(host, "trials", { trials: DATA.trials[host.dataset.of] }, { objective: host.dataset.of });
}

const kinds = { heat: drawHeat, comparison: drawComparison, clearances: drawClearances, curves: drawCurves, trials: drawTrials };
const pending = new Set(all("[data-chart]"));
const visible = new Set();

function drawPending(hosts) {
  for (const host of hosts) {
    if (!pending.has(host) || !host.clientWidth) continue;
    pending.delete(host);
    kinds[host.dataset.chart](host);
  }
}

/** Draw charts of some kinds again: those in view now, the others when they come into view. */
function redraw(...names) {
  for (const host of all("[data-chart]")) if (names.includes(host.dataset.chart)) pending.add(host);
  drawPending(visible);
}

const watcher = new IntersectionObserver(
  (entries) => {
    for (const entry of entries) visible[entry.isIntersecting ? "add" : "delete"](entry.target);
    drawPending(visible);
  },
  { rootMargin: "300px" },
);
for (const host of pending) watcher.observe(host);

/** Do something once: when a part of the page comes into view, or before it is printed. */
function whenSeen(host, then) {
  const once = () => {
    seen.disconnect();
    removeEventListener("beforeprint", once);
    then();
  };
  const seen = new IntersectionObserver((entries) => entries.some((entry) => entry.isIntersecting) && once(), { rootMargin: "300px" });
  seen.observe(host);
  addEventListener("beforeprint", once);
}

const FIRST = 12;
let unfolded = false;
/** Shows the first heat maps, and the others on demand. */
function foldMaps() {
  const maps = all(".map").filter((map) => !map.hasAttribute("data-out"));
  maps.forEach((map, k) => map.toggleAttribute("data-folded", !unfolded && k >= FIRST));
  const more = $("more");
  if (!more) return;
  more.hidden = unfolded || maps.length <= FIRST;
  more.textContent = `Show ${maps.length - FIRST} more heat maps`;
}
$("more")?.addEventListener("click", () => {
  unfolded = true;
  foldMaps();
});
listeners.push(foldMaps, () => redraw("comparison", "clearances", "curves"));

const metric = $("metric");
if (metric) {
  const names = [...new Set(DATA.curves.flatMap((curve) => Object.keys(curve.metrics)))].sort();
  metric.append(...names.map((name) => element("option", { value: name, textContent: name })));
  metric.value = ["closed_loop/collision_rate", "val/costate_error", "loss/total"].reduce((best, name) => (names.includes(name) ? name : best), names[0]);
  metric.addEventListener("change", () => {
    remember({ metric: metric.value });
    redraw("curves");
  });
}
$("shown")?.addEventListener("change", () => {
  remember({ shown: $("shown").value });
  redraw("heat");
});
recallers.push(() => {
  for (const select of [metric, $("shown")]) {
    const wanted = select && remembered()[select.id];
    if (wanted && [...select.options].some((option) => option.value === wanted)) select.value = wanted;
  }
  redraw("curves", "heat");
});

const everything = () => redraw(...Object.keys(kinds));
let width = innerWidth;
let later;
addEventListener("resize", () => {
  if (innerWidth === width) return;
  width = innerWidth;
  clearTimeout(later);
  later = setTimeout(() => listeners.concat(everything).forEach((listener) => listener()), 150);
});
dark.addEventListener("change", () => listeners.concat(everything).forEach((listener) => listener()));
addEventListener("beforeprint", () => {
  document.documentElement.dataset.print = "";
  everything();
  drawPending([...pending]);
});
addEventListener("afterprint", () => {
  delete document.documentElement.dataset.print;
  everything();
});
