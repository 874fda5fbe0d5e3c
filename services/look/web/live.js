// The live page: asks for the state every few seconds and puts in what is new.
"use strict";
const live = { every: 2500, version: Number(document.body.dataset.version), shape: document.body.dataset.shape, shown: "" };

async function ask(path) {
  const answer = await fetch(path, { cache: "no-store" });
  if (!answer.ok) throw new Error(String(answer.status));
  return answer.json();
}
function tell(gone) {
  const note = document.getElementById("live-gone");
  note.hidden = !gone;
}
async function takeSections() { // figures are put in; pictures that a person may be looking at stay until they ask
  const found = await ask("/sections.json");
  live.version = found.version;
  for (const name of ["overview", "figures", "effects", "failures", "captures"]) {
    const old = document.getElementById(name);
    if (old && found.sections[name]) old.outerHTML = found.sections[name];
  }
  document.getElementById("live-newer").hidden = false;
}
async function look() {
  try {
    const state = await ask("/live.json");
    document.title = state.title;
    document.querySelector("h1").textContent = state.name;
    if (state.live !== live.shown) { document.getElementById("live-now").innerHTML = live.shown = state.live; }
    tell(false);
    if (state.shape !== live.shape) { location.reload(); return; }
    if (state.version !== live.version) await takeSections();
  } catch { tell(true); }
  setTimeout(look, live.every);
}
document.getElementById("live-newer").addEventListener("click", () => location.reload());
look();
