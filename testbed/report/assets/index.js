"use strict";
(() => {
  const [root, button] = [document.documentElement, document.querySelector("#theme")];
  let stored = null;
  try { stored = localStorage.getItem("testbed-theme"); } catch { /* no storage for this page */ }
  function setTheme(name) {
    root.dataset.theme = name;
    button.textContent = name === "dark" ? "Light" : "Dark";
    button.setAttribute("aria-label", `Switch to ${name === "dark" ? "light" : "dark"} colours`);
  }
  setTheme(stored || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
  button.addEventListener("click", () => {
    setTheme(root.dataset.theme === "dark" ? "light" : "dark");
    try { localStorage.setItem("testbed-theme", root.dataset.theme); } catch { /* the choice lasts as long as the page */ }
  });
})();
