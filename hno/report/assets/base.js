"use strict";
const DATA = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const all = (selector, root = document) => [...root.querySelectorAll(selector)];

/** An element with properties and children; text is always text, never markup. */
function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

for (const button of all("[data-copy]")) {
  button.addEventListener("click", async () => {
    const code = button.previousElementSibling;
    getSelection().selectAllChildren(code);
    try {
      await navigator.clipboard.writeText(code.textContent);
      button.textContent = "Copied";
    } catch {
      button.textContent = "Selected";
    }
  });
}

/** Tables sorted by the buttons in their heads: numbers by value with missing ones last, the rest as text. */
function sortBy(table, column, descending) {
  const key = (row) => {
    const cell = row.cells[column];
    return cell.dataset.o === undefined ? cell.textContent : Number(cell.dataset.o);
  };
  const sign = descending ? -1 : 1;
  const rows = [...table.tBodies[0].rows].sort((one, other) => {
    const [a, b] = [key(one), key(other)];
    if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1;
    return sign * (typeof a === "number" ? a - b : a.localeCompare(b, "en", { numeric: true }));
  });
  table.tBodies[0].append(...rows);
  [...table.tHead.rows[0].cells].forEach((head, k) => {
    if (k === column) head.setAttribute("aria-sort", descending ? "descending" : "ascending");
    else head.removeAttribute("aria-sort");
  });
}

function sortable(table) {
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.querySelector("button").addEventListener("click", () =>
      sortBy(table, column, head.getAttribute("aria-sort") === "ascending"),
    );
  });
  return table;
}
all("table").forEach(sortable);

/** A table from its texts, each with the number that it is sorted by. */
function tableOf({ columns, rows }) {
  const heads = columns.map((title) => element("th", { scope: "col" }, element("button", { type: "button", textContent: title })));
  const cell = ([text, order]) => {
    const made = element("td", { textContent: text, className: order === null && text !== "n/a" ? "" : "n" });
    if (order !== null) made.dataset.o = order;
    return made;
  };
  const lines = rows.map((row) => element("tr", {}, ...row.map(cell)));
  return sortable(element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...lines)));
}

/** A file beside the page calls one of these; a page from disk can load scripts alone. */
const arrivals = new WeakMap();
window.hnoLandscape = window.hnoPart = (content) => arrivals.get(document.currentScript)?.(content);

/** What a file hands over. `keep` says what must lie beside the page. */
function load(src, keep) {
  return new Promise((resolve, reject) => {
    const script = element("script", { src });
    const fail = () => reject(new Error(`${decodeURIComponent(src)} cannot be loaded: keep ${keep} beside this page.`));
    arrivals.set(script, resolve);
    script.addEventListener("error", fail);
    script.addEventListener("load", () => {
      script.remove();
      fail(); // does nothing once the content is here
    });
    document.body.append(script);
  });
}

/** What the page shows of a single run: its heat map and its episodes. */
const parts = new Map();
function part(k) {
  const found = DATA.parts[k];
  if (!parts.has(k)) {
    parts.set(k, typeof found === "string" ? load(found, `the folder ${decodeURIComponent(found.split("/")[0])}`) : Promise.resolve(found));
    parts.get(k).catch(() => parts.delete(k)); // somebody may put it back
  }
  return parts.get(k);
}
