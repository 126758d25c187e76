/** Filters, and what each part shows, live in the address (#game=drone&seed=0), which a reload or a link keeps. */
const form = $("filters");
const KEYS = [...form.querySelectorAll("select")].map((select) => select.name);
const state = Object.fromEntries(KEYS.map((key) => [key, ""]));
const listeners = [];

const matches = (names) => KEYS.every((key) => !state[key] || names[key] === undefined || String(names[key]) === state[key]);

/** What else the address keeps, such as an episode and a metric; each part of the page reads its own. */
const kept = {};
const recallers = [];
const remembered = () => kept;
const addressed = () => new URLSearchParams(location.hash.includes("=") ? location.hash.slice(1) : "");

function writeAddress() {
  const all = { ...Object.fromEntries(KEYS.map((key) => [key, state[key]])), ...kept };
  const chosen = new URLSearchParams(Object.entries(all).filter(([, value]) => value));
  history.replaceState(null, "", `#${chosen}`);
}

function remember(entries) {
  Object.assign(kept, entries);
  if (ready) writeAddress();
}

let ready = false;
function readAddress() {
  const chosen = addressed();
  ready = false;
  for (const key of Object.keys(kept)) delete kept[key];
  for (const key of KEYS) {
    const known = [...form.elements[key].options].some((option) => option.value === chosen.get(key));
    state[key] = form.elements[key].value = known ? chosen.get(key) : "";
  }
  const others = Object.fromEntries([...chosen].filter(([key]) => !KEYS.includes(key)));
  apply();
  Object.assign(kept, others);
  for (const recall of recallers) recall();
  ready = true;
}

function choose() {
  for (const key of KEYS) state[key] = form.elements[key].value;
  writeAddress();
  apply();
}

/** Hides what does not match. Pooled heat maps show for all seeds, those of single runs for one. */
function apply() {
  const level = state.seed ? "run" : "recipe";
  for (const one of all("[data-game]")) {
    const shown = matches(one.dataset) && [undefined, "any", level].includes(one.dataset.level);
    one.toggleAttribute("data-out", !shown);
  }
  const rows = all("#runs tbody tr");
  const left = rows.filter((row) => !row.hasAttribute("data-out")).length;
  const runs = `${rows.length} run${rows.length === 1 ? "" : "s"}`;
  $("matching").textContent = left === rows.length ? runs : `${left} of ${runs}`;
  for (const listener of listeners) listener();
}

form.addEventListener("change", choose);
form.addEventListener("submit", (event) => event.preventDefault());
form.addEventListener("reset", () => setTimeout(choose));
addEventListener("hashchange", () => location.hash.includes("=") && readAddress());
