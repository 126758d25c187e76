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

for (const table of all("table[data-sortable]")) {
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.querySelector("button").addEventListener("click", () =>
      sortBy(table, column, head.getAttribute("aria-sort") === "ascending"),
    );
  });
}

/** The numbers under a heat map, made when they are opened. */
for (const details of all("details[data-numbers]")) {
  details.addEventListener("toggle", () => {
    if (details.querySelector("table")) return;
    const head = element("tr", {}, ...["θ", "collide", "rate", "95 %"].map((text) => element("th", { scope: "col", textContent: text })));
    const rows = DATA.maps[details.dataset.numbers].map(([theta, hits, starts, seen, , extrapolated]) => {
      const bounds = DATA.intervals[`${hits}/${starts}`];
      const texts = [
        `${types(theta)}${seen ? " seen" : ""}${extrapolated ? " extrapolated" : ""}`, `${hits} of ${starts}`, percent(starts ? hits / starts : null),
        bounds ? `${percent(bounds[0])} to ${percent(bounds[1])}` : "n/a",
      ];
      return element("tr", {}, ...texts.map((text) => element("td", { textContent: text })));
    });
    details.append(element("table", {}, element("thead", {}, head), element("tbody", {}, ...rows)));
  });
}
