"use strict";
// One rater's way through the study. Answers stay in this tab until the last page.
const sheet = JSON.parse(document.getElementById("sheet").textContent);
const by = (id) => document.getElementById(id);
const pages = ["consent", "instruction", "trial", "last", "stopped"];
const largestZoom = 8, clickZoom = 3, zoomStep = 1.25, panStep = 0.1;
// A key that is struck twice must not answer two pairs.
const deafMs = 400;

// ------------------------------------------------------------------------ what is remembered
const place = `study-${sheet.study}-${sheet.rater}`;
let state = { answers: [], resumed: 0, begun: false };
try {
  // Chromium has no storage for one reload in a hundred on a busy machine; the history it keeps.
  const { of, held } = history.state ?? {};
  const kept = of === place ? held : JSON.parse(sessionStorage.getItem(place));
  if (kept) {
    state = { ...kept, resumed: kept.resumed + 1 };
    remember(); // now: it may be loaded once more before anything is chosen
  }
} catch { /* storage is switched off: a page that is loaded again begins anew */ }

function remember() {
  history.replaceState({ of: place, held: state }, "");
  try { sessionStorage.setItem(place, JSON.stringify(state)); } catch { /* as above */ }
}
function forget() {
  history.replaceState(null, "");
  try { sessionStorage.removeItem(place); } catch { /* as above */ }
}

function show(page) {
  for (const name of pages) by(name).hidden = name !== page;
  window.scrollTo(0, 0);
  (page === "trial" ? by("question") : by(page)).focus({ preventScroll: true });
}

// ------------------------------------------------------------------------------------- zoom
const images = [by("image-1"), by("image-2"), by("image-photo")];
const view = { scale: 1, x: 0, y: 0 }; // offset of the picture in sizes of its frame
let zoomed = false;

function draw() {
  const least = 1 - view.scale;
  view.x = Math.min(0, Math.max(least, view.x));
  view.y = Math.min(0, Math.max(least, view.y));
  const where = `translate(${100 * view.x}%, ${100 * view.y}%) scale(${view.scale})`;
  for (const image of images) image.style.transform = where;
  by("pair").classList.toggle("zoomed", view.scale > 1);
  by("zoom").textContent = `${view.scale.toFixed(view.scale % 1 ? 1 : 0)}\u00d7`;
  by("zoom-out").disabled = by("zoom-reset").disabled = view.scale <= 1;
  by("zoom-in").disabled = view.scale >= largestZoom;
  zoomed = zoomed || view.scale > 1;
}
// Enlarge so that the point (u, v) of the frame stays where it is.
function zoomTo(scale, u = 0.5, v = 0.5) {
  scale = Math.min(largestZoom, Math.max(1, scale));
  view.x = u - (u - view.x) * scale / view.scale;
  view.y = v - (v - view.y) * scale / view.scale;
  view.scale = scale;
  draw();
}
function pan(dx, dy) {
  view.x += dx;
  view.y += dy;
  draw();
}
function point(frame, event) {
  const box = frame.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}
const away = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
for (const frame of document.querySelectorAll(".frame")) {
  const down = new Map(); // where each pointer is that is held down, by its id: two fingers pinch
  let moved = false;
  frame.addEventListener("wheel", (event) => {
    // Nothing to make smaller: let the page scroll.
    if (event.deltaY === 0 || (event.deltaY > 0 && view.scale === 1)) return;
    event.preventDefault();
    zoomTo(view.scale * Math.exp(-Math.sign(event.deltaY) * Math.log(zoomStep)), ...point(frame, event));
  }, { passive: false });
  frame.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || down.size === 2) return;
    if (down.size === 0) moved = false;
    down.set(event.pointerId, point(frame, event));
    frame.setPointerCapture(event.pointerId);
  });
  frame.addEventListener("pointermove", (event) => {
    const from = down.get(event.pointerId), to = point(frame, event);
    if (!from || (!moved && away(from, to) < 0.01)) return;
    moved = true;
    const [other] = [...down].filter(([id]) => id !== event.pointerId);
    // The point under the finger that rests stays there.
    if (other) zoomTo(view.scale * away(to, other[1]) / Math.max(away(from, other[1]), 0.01), ...other[1]);
    else if (view.scale > 1) pan(to[0] - from[0], to[1] - from[1]);
    down.set(event.pointerId, to);
  });
  frame.addEventListener("pointerup", (event) => {
    if (down.has(event.pointerId) && !moved && down.size === 1) {
      zoomTo(view.scale > 1 ? 1 : clickZoom, ...point(frame, event));
    }
  });
  frame.addEventListener("lostpointercapture", (event) => down.delete(event.pointerId));
}
by("zoom-in").addEventListener("click", () => zoomTo(view.scale * zoomStep ** 2));
by("zoom-out").addEventListener("click", () => zoomTo(view.scale / zoomStep ** 2));
by("zoom-reset").addEventListener("click", () => zoomTo(1));

// ------------------------------------------------------------------------------------ trials
let shownAt = null; // when both pictures of this pair were there [ms]; null until then
let turn = 0; // counts pairs that were shown: a picture that is late belongs to no other pair

async function showTrial() {
  const index = state.answers.length;
  if (index === sheet.trials.length) {
    show("last");
    return;
  }
  const trial = sheet.trials[index], mine = ++turn;
  shownAt = null;
  by("pair").classList.add("waiting");
  by("progress-text").textContent = `Pair ${index + 1} of ${sheet.trials.length}`;
  by("progress").value = index;
  by("broken").hidden = true;
  by("show-photo").hidden = !trial.photo;
  showPhoto(false);
  zoomTo(1);
  zoomed = false;
  by("pair").style.setProperty("--ratio", trial.width / trial.height);
  const files = [...trial.images, ...(trial.photo ? [trial.photo] : [])];
  try {
    await Promise.all(files.map((file, k) => {
      images[k].src = file;
      return images[k].decode();
    }));
  } catch {
    if (mine === turn) by("broken").hidden = false;
    return;
  }
  if (mine !== turn) return;
  by("pair").classList.remove("waiting");
  requestAnimationFrame(() => { if (mine === turn) shownAt = performance.now(); });
  for (const file of sheet.trials[index + 1]?.images ?? []) new Image().src = file;
}
function choose(side) {
  const now = performance.now();
  if (by("trial").hidden || by("ask-stop").open || shownAt === null || now - shownAt < deafMs) return;
  const trial = sheet.trials[state.answers.length];
  state.answers.push({ trial: trial.id, choice: side, ms: Math.round(now - shownAt), zoomed });
  remember();
  showTrial();
}
function showPhoto(on) {
  by("photo").hidden = !on;
  by("show-photo").setAttribute("aria-pressed", String(on));
}
// The second click of a double click counts as such however long the page was busy in between.
for (const side of [1, 2]) {
  by(`choose-${side}`).addEventListener("click", (event) => { if (event.detail < 2) choose(side); });
}
by("show-photo").addEventListener("click", () => {
  showPhoto(by("photo").hidden);
  by("photo").scrollIntoView({ block: "nearest" });
});
const pans = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const keys = {
  1: () => choose(1), 2: () => choose(2), ArrowLeft: () => choose(1), ArrowRight: () => choose(2),
  "+": () => zoomTo(view.scale * zoomStep), "=": () => zoomTo(view.scale * zoomStep),
  "-": () => zoomTo(view.scale / zoomStep), 0: () => zoomTo(1),
};
document.addEventListener("keydown", (event) => {
  if (by("trial").hidden || by("ask-stop").open || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.shiftKey && event.key in pans) {
    event.preventDefault();
    pan(...pans[event.key].map((step) => step * panStep));
  } else if (event.key in keys && !(event.repeat && ["1", "2", "ArrowLeft", "ArrowRight"].includes(event.key))) {
    event.preventDefault();
    keys[event.key]();
  }
});

// -------------------------------------------------------------------------------- the way on
by("agree").addEventListener("change", () => { by("to-instruction").disabled = !by("agree").checked; });
by("to-instruction").addEventListener("click", () => show("instruction"));
by("to-trials").addEventListener("click", () => {
  state.begun = true;
  remember();
  show("trial");
  showTrial();
});
function stop() {
  by("ask-stop").close();
  turn += 1;
  forget();
  show("stopped");
}
by("stop").addEventListener("click", () => by("ask-stop").showModal());
by("go-on").addEventListener("click", () => by("ask-stop").close());
by("stop-now").addEventListener("click", stop);
by("discard").addEventListener("click", () => by("ask-stop").showModal());

// ------------------------------------------------------------------------------------ saving
function content() {
  return JSON.stringify({
    format: 1, study: sheet.study, rater: sheet.rater,
    source: navigator.webdriver ? "automated" : "browser",
    resumed: state.resumed, answers: state.answers,
  }, null, 1) + "\n";
}
by("download").addEventListener("click", () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content()], { type: "application/json" }));
  link.download = `answers-${sheet.rater}.json`;
  link.click();
  URL.revokeObjectURL(link.href);
  by("how-to-save").hidden = by("discard").hidden = true;
  by("outcome").textContent = `Thank you. The file is called ${link.download}; see that it is among `
    + "your downloads before you close this page.";
});

if (state.begun) {
  show("trial");
  showTrial();
} else {
  show("consent");
}
