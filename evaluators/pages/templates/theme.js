"use strict";
// Theme: automatic, dark, light. Storage may be refused for files; the choice then lasts as long as the page.
(() => {
  const root = document.documentElement;
  const themes = ["auto", "dark", "light"];
  const button = document.getElementById("theme");
  const store = (act) => { try { return act(window.localStorage); } catch { return null; } };
  const setTheme = (name) => {
    if (name === "auto") delete root.dataset.theme; else root.dataset.theme = name;
    button.textContent = "Theme: " + name;
    button.dataset.name = name;
    store((s) => s.setItem("simrun-theme", name));
  };
  const saved = store((s) => s.getItem("simrun-theme"));
  setTheme(themes.includes(saved) ? saved : "auto");
  button.addEventListener("click", () => setTheme(themes[(themes.indexOf(button.dataset.name) + 1) % 3]));
})();
