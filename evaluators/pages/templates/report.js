"use strict";
(() => {
  const all = (selector, from = document) => [...from.querySelectorAll(selector)];

  // Sorting: numbers by data-v, text by the alphabet with numbers in it; cells without a value stay last.
  const compare = new Intl.Collator("en", { numeric: true }).compare;
  const key = (row, column) => {
    const cell = row.children[column];
    const text = cell.dataset.v ?? cell.textContent.trim();
    if (text === "" || text === "\u2014") return null;
    return cell.dataset.v !== undefined && !Number.isNaN(Number(text)) ? Number(text) : text;
  };
  for (const sorter of all("th .sort")) {
    sorter.addEventListener("click", () => {
      const head = sorter.closest("th");
      const column = [...head.parentNode.children].indexOf(head);
      const up = head.getAttribute("aria-sort") !== "ascending";
      all("th", head.parentNode).forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const body = head.closest("table").tBodies[0];
      const rows = [...body.rows].map((row) => [key(row, column), row]);
      rows.sort(([a], [b]) => {
        if (a === null || b === null) return (a === null) - (b === null);
        const order = typeof a === "number" && typeof b === "number" ? a - b : compare(String(a), String(b));
        return up ? order : -order;
      });
      body.append(...rows.map(([, row]) => row));
    });
  }

  // A link to a folded part opens it.
  for (const link of all("nav a")) {
    link.addEventListener("click", () => { all(":scope > details", document.querySelector(link.hash)).forEach((fold) => { fold.open = true; }); });
  }

  // A link to the frames of a changed outcome opens their card.
  for (const link of all("a.to-flip")) {
    link.addEventListener("click", () => { document.getElementById(link.hash.slice(1)).open = true; });
  }

  // Copy: the clipboard may be refused for files; the command is then selected instead.
  const copy = document.getElementById("copy");
  copy?.addEventListener("click", async () => {
    const command = document.getElementById("command");
    try { await navigator.clipboard.writeText(command.textContent); copy.textContent = "Copied"; }
    catch { window.getSelection().selectAllChildren(command); copy.textContent = "Selected"; }
  });
})();
