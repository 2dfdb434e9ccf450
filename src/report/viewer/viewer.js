// Page of the viewer: loads the scene, and connects canvas, controls and panels. All data are in
// the page (#v-manifest), or come from the server that sent it.
import { cameraOf, early, late } from "splatvk/address";
import { Camera } from "splatvk/camera";
import { fold, makeRoom } from "splatvk/card";
import { button, controls, fullScreen } from "splatvk/controls";
import { tellOuter } from "splatvk/frame";
import { Tape } from "splatvk/measure";
import { connectMesh, nextMesh } from "splatvk/mesh";
import { Motion } from "splatvk/motion";
import { canvas, find, levels, manifest, root, say, scene, state, up, views } from "splatvk/page";
import { dragTool, hidePanels, takeDrags, takeTaps, tapTool } from "splatvk/panel";
import { wholeOf } from "splatvk/pick";
import { follow, kept } from "splatvk/preview";
import { answers, ask, highlight, listQueries, setQuery } from "splatvk/queries";
import { legend, modes, nextMode, select, show, toggleGuessed } from "splatvk/show";
import { download, gunzip, medianDepth, unpack } from "splatvk/splats";
import { aimAt, begin, changed, hitAt, keepContext, moved, overlay, picture, placeAt, replace, settled, size, start, surface } from "splatvk/stage";
import { firstCamera, frameStart } from "splatvk/start";
import { connectPage } from "splatvk/things";
import { connectViews, loadViews, namedCamera, showNotes, startCamera, toggleViews } from "splatvk/views";

const tape = new Tape(find(".v-tape"), find(".v-line"), manifest.metres, say);
/// Whether the start is that of [`frameStart`].
let input, isFramed = false;

// --- scene --------------------------------------------------------------------------------------

async function load() {
  early({ showNotes });
  const named = loadViews();
  const inline = document.getElementById("v-splats"), wait = find(".v-wait");
  if (inline) {
    wait.textContent = "Unpacking …";
    await new Promise((go) => requestAnimationFrame(() => setTimeout(go)));
  }
  const packed = inline ? Uint8Array.from(atob(inline.textContent.trim()), (c) => c.charCodeAt(0))
    : await fetchScene((share) => { wait.textContent = `Loading the scene … ${Math.floor(100 * share)} %`; });
  const splats = unpack(await gunzip(packed));
  inline?.remove();
  await named;
  begin(splats);
  keepContext(restore);
  const photo = firstCamera(views, scene.extent, up);
  scene.near = 0.01 * medianDepth(splats, photo);
  const chosen = cameraOf({ namedCamera, photoCamera }) ?? startCamera(), home = chosen ?? photo;
  if (!chosen) {
    home.distance = 100 * scene.near;
    aimAt(home);
    isFramed = true;
    frameStart(home, ...size());
  }
  // A tenth of the usual depth: nearer, a single surface fills the picture.
  scene.motion = new Motion({ home, views, up, closest: 10 * scene.near }, { aim: aimAt, moved, shown: markPhoto, playing });
  kept.take(scene.motion);
  wait.remove();
  new ResizeObserver(resized).observe(canvas);
  new IntersectionObserver(([entry]) => { scene.motion.onScreen = entry.isIntersecting; }).observe(canvas);
  overlay((camera, width, height) => tape.draw(camera, width, height, scene.near));
  overlay(() => legend(tape.metres));
  start(() => input?.pending());
  if (root.classList.contains("full")) root.focus();
  if (manifest.renews) follow(manifest, { renew, say: (text) => say(text, true), leave: () => kept.put(scene.motion) });
}

/// Camera of a photo by its name, or by its number from 1.
function photoCamera(name) {
  const at = views.findIndex((v, i) => v.name === name || String(i + 1) === name);
  if (at < 0) return null;
  const camera = Camera.of(views[at], 100 * scene.near);
  aimAt(camera);
  return camera;
}

/// Downloads the splats. Their number is asked first: the server takes an older one for outdated.
async function fetchScene(tell) {
  if (manifest.edits) scene.number = (await (await fetch("state")).json()).scene;
  return download(manifest.scene, tell);
}

/// Loads the splats again, of the same scene; selection and answer stay.
async function renew() {
  await replace(unpack(await gunzip(await fetchScene(() => {}))));
  restore();
}

/// Marks selection and answer in a new graphics context.
function restore() {
  if (state.selected) scene.renderer.select(state.selected.level, state.selected.codes);
  if (state.query) highlight(state.query);
}

/// Fits the start to another size of the window; the picture, too, while nobody has moved it.
function resized() {
  const { motion } = scene;
  if (!size()[0]) return;
  if (isFramed) frameStart(motion.home, ...size());
  if (motion.untouched) motion.camera = Object.assign(motion.home.copy(), { inset: motion.inset });
  makeRoom();
  moved();
}

function markPhoto(index) {
  find(".v-photos").querySelectorAll("button").forEach((b, i) => b.setAttribute("aria-current", String(i === index)));
}

function playing(on) {
  find("[data-do=play]").setAttribute("aria-pressed", String(on));
}

// --- actions ------------------------------------------------------------------------------------

function clear() {
  if (tapTool()) return giveUp();
  if (manifest.framed) tellOuter({ selected: null });
  state.selected = state.picked = null;
  scene.renderer.select(-1, []);
  find(".v-card").hidden = true;
  if (tape.active) measure(false);
  setQuery(null);
  if (state.mode === "relevancy") show("colour");
  makeRoom();
  changed();
}

/// Ends the tool that takes taps.
function giveUp() {
  takeTaps(null);
  takeDrags(null);
  say("");
}

/// Selects the code at a position, measures to it, or makes it the centre of turning.
function tap(x, y, centre) {
  const hit = hitAt(x, y);
  if (centre) return hit && scene.motion.turn((camera) => camera.aim(placeAt(x, y, hit.depth)));
  if (tapTool()) return tapTool()(hit && { x, y, point: placeAt(x, y, hit.depth), codes: hit.codes });
  if (tape.active) return hit ? measureAt(x, y, hit.depth) : say("Nothing to measure to there.");
  if (!hit) return clear();
  const level = state.mode === "level" && hit.codes[state.level] >= 0 ? state.level : wholeOf(hit.codes);
  if (level < 0) return say("Nothing that the scene has words for.");
  setQuery(null);
  select(level, { ...hit, at: { camera: scene.motion.camera.stated(...size()), pixel: [x, y] } });
}

function measureAt(x, y, depth) {
  tape.place(placeAt(x, y, depth));
  changed();
}

function measure(on) {
  tape.toggle(on);
  find("[data-do=measure]").setAttribute("aria-pressed", String(tape.active));
  changed();
}

async function save() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await picture());
  link.download = `${manifest.title}-${state.mode}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/// Shows all that the photos show, from the present direction.
function all() {
  const to = scene.motion.camera.copy();
  to.frame(scene.extent.centre, scene.extent.radius);
  scene.motion.goTo(to, -1);
}

const actions = {
  save, all,
  play: () => scene.motion.play(),
  reset: () => scene.motion.goTo(scene.motion.home.copy(), -1),
  full: () => fullScreen(root),
  measure: () => measure(),
  views: toggleViews,
  mesh: nextMesh,
  help: () => find(".v-help").showModal(),
};

// --- connection ---------------------------------------------------------------------------------

async function connect() {
  if (manifest.renews) say("A preview: the scene sharpens while it is being made.", true);
  find(".v-modes").replaceChildren(...modes.map((m) => button(m.name, () => show(m.mode, m.level), { role: "radio", title: m.title ?? "" })));
  show("colour");
  find(".v-photos").replaceChildren(...views.map((v, i) => {
    const made = button(v.thumbnail ? "" : String(i + 1), () => scene.motion.goToView(i), { title: v.name, "aria-label": `photo ${v.name}` });
    if (v.thumbnail) made.style.backgroundImage = `url(${v.thumbnail})`;
    return made;
  }));
  find(".v-card .v-close").onclick = clear;
  find(".v-fold").onclick = fold;
  connectBudget();
  connectQueries();
  connectMesh();
  // A page that edits nothing lacks the module.
  if (manifest.edits) Object.assign(actions, (await import("splatvk/edit")).connectEdit({ load: renew, clear }));
  connectViews({ goTo: (name) => scene.motion.goTo(namedCamera(name), -1) });
  const toView = (act) => (...given) => (root.scrollIntoView({ block: "nearest" }), act(...given));
  const selectCode = (level, code) => (setQuery(null), select(level, { codes: levels.map((_, at) => (at === level ? code : -1)) }));
  connectPage({ splats: scene.splats, levels, answers }, { ask: toView(ask), select: toView(selectCode) });
  const fills = () => document.fullscreenElement === root || root.matches(".full, .wide");
  input = controls({ root, canvas, motion: scene.motion, actions, tap, tapsAtOnce: () => tape.active || tapTool() !== null, dragTool, surface, fills, nextMode, toggleGuessed, clear: () => hidePanels() || clear() });
}

/// States how many of the splats the page has, where it has not all.
function connectBudget() {
  const { shown, total } = manifest, box = find(".v-budget");
  if (!(shown < total)) return;
  const [unit, name, digits] = total >= 1e6 ? [1e6, " million", 1] : [1, "", 0];
  const text = (n) => (n / unit).toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  box.textContent = `shows ${text(shown)} of ${text(total)}${name} splats`;
  box.hidden = false;
}

function connectQueries() {
  const form = find(".v-ask");
  form.onsubmit = (e) => {
    e.preventDefault();
    ask(form.elements.text.value);
  };
  form.hidden = find(".v-chips").hidden = manifest.presented || !levels.some((l) => l.colours.length);
  form.elements.text.placeholder = manifest.live ? "Ask for something you see" : "Queries of the run";
  listQueries();
  resized();
}

/// Interface for scripts and tests, `splatvk` in the console.
window.splatvk = {
  ready: load().then(connect).then(() => late({ ask, show, modes, play: actions.play })),
  state,
  marks: () => scene.splats.marks,
  camera: () => scene.motion.camera,
  tape,
  goTo: (view) => (scene.motion.goToView(view, true), settled()),
  show: (mode, level) => (show(mode, level), settled()),
  ask: async (text) => (await ask(text), settled()),
  settled,
  picture,
};
window.splatvk.ready.catch((error) => {
  const box = find(".v-wait") || find(".v-status");
  box.hidden = false;
  box.textContent = `The 3D view cannot be shown: ${error.message}`;
});
