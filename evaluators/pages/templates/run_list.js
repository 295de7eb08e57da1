"use strict";
// Rows that hold every word that is typed.
(() => {
  const input = document.getElementById("filter");
  const count = document.getElementById("count");
  const groups = [...document.querySelectorAll("#table-runs tbody")];
  const texts = groups.map((group) => group.textContent.toLowerCase());
  const update = () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    groups.forEach((group, i) => {
      group.hidden = !words.every((word) => texts[i].includes(word));
      if (!group.hidden) shown += 1;
    });
    count.textContent = words.length ? `${shown} of ${groups.length} runs` : "";
  };
  input.addEventListener("input", update);
  update();
})();
