"use strict";
function key(cell, numeric) {
  if (!numeric) return cell.textContent.trim();
  return cell.dataset.value === undefined ? null : Number(cell.dataset.value);
}
const KINDS = ["method", "unranked", "floor", "reported"];  // stay apart, whatever is sorted by
function sort(head) {
  const table = head.closest("table"), body = table.tBodies[0];
  const column = [...head.parentNode.children].indexOf(head);
  const first = head.dataset.better === "higher" ? "descending" : "ascending";
  const other = first === "descending" ? "ascending" : "descending";
  const order = head.getAttribute("aria-sort") === first ? other : first;
  table.querySelectorAll("[aria-sort]").forEach(each => each.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", order);
  const sign = order === "ascending" ? 1 : -1;
  const rows = [...body.rows].map(row => [key(row.cells[column], head.dataset.better), row]);
  rows.sort(([a, one], [b, other]) => {
    const apart = KINDS.indexOf(one.className) - KINDS.indexOf(other.className);  // -1, and so alike, in a table of runs
    if (apart) return apart;
    if (a === null || b === null) return (a === null) - (b === null);  // what has no figure comes last either way
    return sign * (typeof a === "number" ? a - b : a.localeCompare(b, undefined, {numeric: true}));
  });
  rows.forEach(([, row]) => body.append(row));
}
document.querySelectorAll(".heads th").forEach(head => {
  head.tabIndex = 0;
  head.addEventListener("click", () => sort(head));
  head.addEventListener("keydown", event => { if (event.key === "Enter") sort(head); });
});
document.querySelectorAll("[data-filters]").forEach(input => input.addEventListener("input", () => {
  const wanted = input.value.toLowerCase();
  for (const row of document.getElementById(input.dataset.filters).tBodies[0].rows)
    row.hidden = !row.textContent.toLowerCase().includes(wanted);
}));
