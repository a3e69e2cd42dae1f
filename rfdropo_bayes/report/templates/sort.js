// Tables whose rows are sorted by a click on a head, or by Enter on it; a second one turns the order round.
for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0], head = table.tHead && table.tHead.rows[0];
  if (!head || body.rows.length < 3 || body.querySelector("[colspan], [rowspan]")) continue;
  const text = (row, column) => row.cells[column].textContent.trim();
  const value = (words) => { const found = words.match(/[-\u2212]?\d[\d.]*(e[-+]?\d+)?/i); return found ? parseFloat(found[0].replace("\u2212", "-")) : NaN; };
  [...head.cells].forEach((cell, column) => {
    const sort = () => {
      const turn = cell.getAttribute("aria-sort") === "ascending" ? -1 : 1, numeric = cell.classList.contains("n");
      const ordered = [...body.rows].map((row) => [numeric ? value(text(row, column)) : text(row, column), row]);
      ordered.sort(([a], [b]) => numeric ? (isNaN(a) || isNaN(b) ? isNaN(a) - isNaN(b) : turn * (a - b)) : turn * a.localeCompare(b));
      for (const other of head.cells) other.removeAttribute("aria-sort");
      cell.setAttribute("aria-sort", turn > 0 ? "ascending" : "descending");
      body.append(...ordered.map(([, row]) => row));
    };
    cell.tabIndex = 0;
    cell.title = cell.title || "sort by this column";
    cell.addEventListener("click", sort);
    cell.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); sort(); } });
    cell.classList.add("sorts");
  });
}
