/** Filters live in the address (#game=drone&seed=0), so that a reload or a shared link keeps them. */
const form = $("filters");
const KEYS = [...form.querySelectorAll("select")].map((select) => select.name);
const state = Object.fromEntries(KEYS.map((key) => [key, ""]));
const listeners = [];

const matches = (names) => KEYS.every((key) => !state[key] || names[key] === undefined || String(names[key]) === state[key]);

function readAddress() {
  const chosen = new URLSearchParams(location.hash.includes("=") ? location.hash.slice(1) : "");
  for (const key of KEYS) {
    const known = [...form.elements[key].options].some((option) => option.value === chosen.get(key));
    state[key] = form.elements[key].value = known ? chosen.get(key) : "";
  }
  apply();
}

function choose() {
  for (const key of KEYS) state[key] = form.elements[key].value;
  const chosen = new URLSearchParams(KEYS.filter((key) => state[key]).map((key) => [key, state[key]]));
  history.replaceState(null, "", `#${chosen}`);
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
