// The page's controls: colours, categories, the slider between the views. Without a script all pictures are simply shown.
"use strict";
const each = (where, what, act) => document.querySelectorAll(where).forEach((one) => one.addEventListener(what, (e) => act(one, e)));
const press = (buttons, pressed) => buttons.forEach((one) => one.setAttribute("aria-pressed", String(one === pressed)));

function setTheme(name) {
  const root = document.documentElement;
  if (name) root.dataset.theme = name; else delete root.dataset.theme;
  const buttons = [...document.querySelectorAll("[data-theme-to]")];
  press(buttons, buttons.find((one) => one.dataset.themeTo === name));
}
function kept(value) { // a page opened from a file may have no storage
  try { if (value === undefined) return localStorage.getItem("verso-theme") || ""; localStorage.setItem("verso-theme", value); } catch { /* not kept */ }
  return "";
}

function showCategory(name) {
  const buttons = [...document.querySelectorAll("[data-show]")];
  press(buttons, buttons.find((one) => one.dataset.show === name));
  document.querySelectorAll(".scene").forEach((one) => { one.hidden = Boolean(name) && one.dataset.category !== name; });
}

const wipe = { kind: "rgb" };
function pictureOf(scene, name) { return document.querySelector(`.scene[data-scene="${scene}"] img[data-name="${name}"]`); }
function drawWipe() {
  const select = document.getElementById("compare-scene");
  if (!select) return;
  for (const role of ["input", "mirror"]) {
    const shown = document.getElementById(`wipe-${role}`), found = pictureOf(select.value, `${role} ${wipe.kind}`);
    if (found && shown.src !== found.src) { shown.src = found.src; shown.alt = found.alt; shown.width = found.width; }
  }
  const range = document.getElementById("wipe-range"), share = Number(range.value);
  document.getElementById("wipe-input").style.clipPath = `inset(0 ${100 - share}% 0 0)`;
  document.querySelector("#wipe .edge").style.left = `${share}%`;
  range.setAttribute("aria-valuetext", `${share} % input view`);
}
function compare(scene) {
  const select = document.getElementById("compare-scene");
  select.value = scene;
  drawWipe();
  document.getElementById("compare").scrollIntoView();
  document.getElementById("wipe-range").focus({ preventScroll: true });
}

function connect() { // also after the live page has put new contents in
  each("[data-theme-to]", "click", (one) => { setTheme(one.dataset.themeTo); kept(one.dataset.themeTo); });
  connectPictures();
  setTheme(kept());
}
function connectPictures() {
  each("[data-show]", "click", (one) => showCategory(one.dataset.show));
  each("[data-compare]", "click", (one) => compare(one.dataset.compare));
  each("#wipe-range", "input", drawWipe);
  each("#compare-scene", "change", drawWipe);
  each("[data-kind]", "click", (one) => { wipe.kind = one.dataset.kind; press([...document.querySelectorAll("[data-kind]")], one); drawWipe(); });
  const first = document.querySelectorAll("[data-show]")[1];
  if (first) showCategory(first.dataset.show);
  drawWipe();
}
connect();
