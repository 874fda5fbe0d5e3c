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

function pictureOf(scene, name) { return document.querySelector(`.scene[data-scene="${scene}"] img[data-name="${name}"]`); }
function drawWipe() { // a button stands for one kind of image, or for a series of which a second slider chooses one
  const select = document.getElementById("compare-scene");
  if (!select) return;
  const series = document.querySelector('[data-kind][aria-pressed="true"]').dataset.kind.split(" ");
  const member = document.getElementById("wipe-member"), box = document.getElementById("wipe");
  if (member) { member.max = series.length - 1; member.closest("label").hidden = series.length < 2; }
  const kind = series[member ? member.value : 0], roles = ["input", "mirror"];
  const close = document.getElementById("wipe-close")?.checked && roles.every((role) => pictureOf(select.value, `${role} ${kind} patch`));
  box.classList.toggle("close", Boolean(close));
  for (const role of roles) {
    const shown = document.getElementById(`wipe-${role}`), found = pictureOf(select.value, `${role} ${kind}${close ? " patch" : ""}`);
    if (found && shown.src !== found.src) { shown.src = found.src; shown.alt = found.alt; shown.width = found.width; }
    if (found && member && role === "input") {
      const told = found.closest("figure").querySelector("figcaption").textContent.split(" · ")[1];
      document.getElementById("wipe-told").textContent = told;
      member.setAttribute("aria-valuetext", told);
    }
  }
  const range = document.getElementById("wipe-range"), share = Number(range.value);
  document.getElementById("wipe-input").style.clipPath = `inset(0 ${100 - share}% 0 0)`;
  box.querySelector(".edge").style.left = `${share}%`;
  range.setAttribute("aria-valuetext", `${share} % input view`);
}
function compare(scene) {
  const select = document.getElementById("compare-scene");
  select.value = scene;
  drawWipe();
  document.getElementById("compare").scrollIntoView();
  document.getElementById("wipe-range").focus({ preventScroll: true });
}

function sortScenes(head) { // pressed once the largest are first, pressed again the smallest
  const rows = [...document.querySelectorAll("#scenes-table tbody tr")], at = head.cellIndex, up = head.getAttribute("aria-sort") === "descending";
  document.querySelectorAll("#scenes-table thead th").forEach((one) => one.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const of = (row) => { const text = row.cells[at].textContent, value = Number(text.replaceAll(",", "")); return text === "–" ? NaN : Number.isNaN(value) ? text : value; };
  const order = (a, b) => { // unknown last
    const [x, y] = [of(a), of(b)];
    return Number.isNaN(x) || Number.isNaN(y) ? Number.isNaN(x) - Number.isNaN(y) : (x < y ? -1 : x > y ? 1 : 0) * (up ? 1 : -1);
  };
  rows.sort(order).forEach((row) => row.parentElement.append(row));
}
function filterScenes(words) {
  const wanted = words.toLowerCase().split(/\s+/).filter(Boolean);
  document.querySelectorAll("#scenes-table tbody tr").forEach((row) => {
    const texts = [...row.cells].slice(0, 3).map((one) => one.textContent.toLowerCase());
    row.hidden = !wanted.every((word) => texts.some((text) => text.includes(word)));
  });
}

function connect() { // also after the live page has put new contents in
  each("[data-theme-to]", "click", (one) => { setTheme(one.dataset.themeTo); kept(one.dataset.themeTo); });
  connectPictures();
  setTheme(kept());
}
function connectPictures() {
  each("[data-show]", "click", (one) => showCategory(one.dataset.show));
  each("[data-compare]", "click", (one) => compare(one.dataset.compare));
  each("#wipe-range, #wipe-member", "input", drawWipe);
  each("#compare-scene, #wipe-close", "change", drawWipe);
  each("#scenes-filter", "input", (one) => filterScenes(one.value));
  each("#scenes-table thead th", "click", sortScenes);
  each("#scenes-table thead th", "keydown", (one, event) => { if (event.key === "Enter") sortScenes(one); });
  document.querySelectorAll("#scenes-table thead th").forEach((one) => { one.tabIndex = 0; });
  each("[data-kind]", "click", (one) => { press([...document.querySelectorAll("[data-kind]")], one); drawWipe(); });
  const first = document.querySelectorAll("[data-show]")[1];
  if (first) showCategory(first.dataset.show);
  drawWipe();
}
connect();
