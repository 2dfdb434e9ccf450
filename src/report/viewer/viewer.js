// Page of the viewer: connects canvas, controls and scene. All data are in the page (#v-manifest),
// or come from the server that sent it.
import { Camera, upOf } from "splatvk/camera";
import { button, controls, fullScreen } from "splatvk/controls";
import { Tape, lengthText } from "splatvk/measure";
import { MOST, Motion, Pace, firstCamera } from "splatvk/motion";
import { isClear, namesOf, perhaps } from "splatvk/names";
import { pick, sizeOfCode, wholeOf } from "splatvk/pick";
import { askOuter, tellOuter } from "splatvk/frame";
import { follow, kept } from "splatvk/preview";
import { Renderer } from "splatvk/render";
import { download, extentOf, gunzip, medianDepth, unpack } from "splatvk/splats";
import { connectPage } from "splatvk/things";

const manifest = JSON.parse(document.getElementById("v-manifest").textContent);
const root = document.querySelector(".viewer");
const find = (selector) => root.querySelector(selector);
const canvas = find("canvas");
const { views, levels } = manifest;
const up = manifest.up || upOf(views);

const state = { mode: "colour", level: levels.findLastIndex((l) => l.colours.length), selected: null, picked: null, query: null, guessed: true };
const STALE = 0, ROUGH = 1, SHARP = 2;
let splats, extent, renderer, motion, worker, next = null, near = 0.01;
let request = 0, sortedFor = -1, waiting = false, drawn = STALE, capturing = false;
const idle = [], pace = new Pace();
const tape = new Tape(find(".v-tape"), find(".v-line"), manifest.metres, say);

// --- scene --------------------------------------------------------------------------------------

async function load() {
  const inline = document.getElementById("v-splats"), wait = find(".v-wait");
  if (inline) {
    wait.textContent = "Unpacking …";
    await new Promise((go) => requestAnimationFrame(() => setTimeout(go)));
  }
  const packed = inline ? Uint8Array.from(atob(inline.textContent.trim()), (c) => c.charCodeAt(0))
    : await download(manifest.scene, (share) => { wait.textContent = `Loading the scene … ${Math.floor(100 * share)} %`; });
  splats = unpack(await gunzip(packed));
  inline?.remove();
  extent = extentOf(splats);
  renderer = new Renderer(canvas, splats, levels);
  canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
  canvas.addEventListener("webglcontextrestored", restore);
  const source = JSON.parse(document.querySelector("script[type=importmap]").textContent).imports["splatvk/sort"];
  worker = new Worker(source);
  worker.onmessage = ({ data }) => sorted(data);
  worker.postMessage({ positions: splats.positions.slice() });
  const home = firstCamera(views, extent, manifest.up);
  near = 0.01 * medianDepth(splats, home);
  home.distance = 100 * near;
  aimAt(home);
  // A tenth of the usual depth: nearer, a single surface fills the picture.
  motion = new Motion({ home, views, up, closest: 10 * near }, { aim: aimAt, moved, shown: markPhoto, playing });
  kept.take(motion);
  wait.remove();
  new ResizeObserver(resized).observe(canvas);
  new IntersectionObserver(([entry]) => { motion.onScreen = entry.isIntersecting; }).observe(canvas);
  moved();
  requestAnimationFrame(frame);
  if (root.classList.contains("full")) root.focus();
  if (manifest.renews) follow(manifest, { renew, say: (text) => say(text, true), leave: () => kept.put(motion) });
}

/// Shows other splats of the same scene from the present camera, once they are sorted.
async function renew() {
  const fresh = unpack(await gunzip(await download(manifest.scene, () => {})));
  next = { splats: fresh, renderer: new Renderer(canvas, fresh, levels), after: request };
  worker.postMessage({ positions: fresh.positions.slice() });
  moved();
}

/// Takes a sorted order; one that was requested before the splats changed belongs to the old ones.
function sorted(data) {
  waiting = false;
  if (next && data.id > next.after) {
    renderer.free();
    ({ splats, renderer } = next);
    extent = extentOf(splats);
    next = null;
  }
  if (!next) {
    renderer.setOrder(data);
    sortedFor = data.id;
    drawn = STALE;
  }
  if (request !== sortedFor) sort();
}

/// Restores the graphics context, which phones take from pages in the background.
function restore() {
  renderer = new Renderer(canvas, splats, levels);
  if (state.selected) renderer.select(state.selected.level, state.selected.codes);
  if (state.query) highlight(state.query);
  moved();
}

/// Sets the pivot of a camera to the surface in the middle of its image.
function aimAt(which) {
  const hit = pick(splats, which, 320, 240, 640, 480, near, false);
  if (hit) which.distance = hit.depth;
}

// --- drawing ------------------------------------------------------------------------------------

function fit(width, height) {
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
}

/// Size of the picture in CSS pixels, or of one that is captured.
const size = () => (capturing ? [canvas.width, canvas.height] : [canvas.clientWidth, canvas.clientHeight]);

function sort() {
  if (waiting) return;
  waiting = true;
  const { camera } = motion, [width, height] = size(), [fx, fy, cx, cy] = camera.intrinsics(width, height);
  // Half an image more on every side, since splats reach beyond their centre.
  const slope = [(Math.max(cx, width - cx) + width / 2) / fx, (Math.max(cy, height - cy) + height / 2) / fy];
  worker.postMessage({ id: request, rotation: camera.rotation, translation: camera.translation, near, slope });
}

/// Redraws after a change of the camera or of the size of the picture.
function moved() {
  request++;
  drawn = STALE;
  sort();
}

function resized() {
  makeRoom();
  moved();
}

function changed() {
  drawn = STALE;
}

/// Whether what no photo shows is in the picture.
const showsGuessed = () => state.guessed || state.mode !== "colour";

function draw(camera, lean = false) {
  const { mode, level, selected } = state;
  renderer.draw(camera, { mode, level, selecting: selected !== null, near, guessed: showsGuessed() ? 1 : 0, lean });
}

let last = 0, slowest = 0, wasRough = false;
function frame(now) {
  requestAnimationFrame(frame);
  if (capturing) return;
  motion.step(now);
  // A frame that takes long delays one of the next calls, not always the very next.
  slowest = Math.max(slowest, now - last);
  last = now;
  const rough = motion.moving(now);
  if (rough ? drawn === STALE : drawn !== SHARP && request === sortedFor) {
    if (rough && wasRough) pace.note(slowest);
    slowest = 0;
    // Where frames are slow, a sharp picture is the better greeting.
    if (pace.lean) motion.rest();
    tape.draw(motion.camera, ...size(), near);
    legend();
    const most = Math.min(devicePixelRatio || 1, MOST), density = rough ? Math.min(most, pace.density) : most;
    fit(...size().map((v) => Math.max(1, Math.round(v * density))));
    draw(motion.camera, rough && pace.lean);
    drawn = rough ? ROUGH : SHARP;
    wasRough = rough;
  }
  if (drawn === SHARP && !rough && !input?.pending()) idle.splice(0).forEach((tell) => tell());
}

/// Resolves when the picture shows the current state in full quality, splats in their final order.
function settled() {
  motion.rest();
  return new Promise((tell) => idle.push(tell));
}

/// Returns the picture as a PNG blob; with the index of a photo, from its camera at its size.
async function picture(view) {
  await settled();
  const before = motion.camera;
  capturing = true;
  try {
    if (view !== undefined) {
      motion.camera = Camera.of(views[view], 1);
      fit(views[view].width, views[view].height);
      moved();
      while (request !== sortedFor) await new Promise((go) => setTimeout(go, 5));
    }
    draw(motion.camera);
    return await new Promise((done) => canvas.toBlob(done));
  } finally {
    capturing = false;
    motion.camera = before;
    moved();
  }
}

function markPhoto(index) {
  find(".v-photos").querySelectorAll("button").forEach((b, i) => b.setAttribute("aria-current", String(i === index)));
}

function playing(on) {
  find("[data-do=play]").setAttribute("aria-pressed", String(on));
}

// --- display ------------------------------------------------------------------------------------

const modes = [
  { name: "Colour", mode: "colour" },
  { name: "Depth", mode: "depth" },
  ...levels.flatMap((l, level) => (l.colours.length ? [{ name: l.title, mode: "level", level }] : [])),
  ...(!manifest.presented && levels.some((l) => l.colours.length) ? [{ name: "Relevancy", mode: "relevancy" }] : []),
  ...(manifest.unseen ? [{ name: "Guessed", mode: "unseen", title: "What no photo shows, in magenta" }] : []),
];

function show(mode, level = state.level) {
  if (mode === "relevancy" && !state.query) {
    return say(manifest.live ? "Ask for something first." : "Choose one of the queries first.");
  }
  if (mode === "relevancy") level = state.query.level;
  state.mode = mode;
  state.level = level;
  const at = modes.findIndex((m) => m.mode === mode && (mode !== "level" || m.level === level));
  find(".v-modes").querySelectorAll("button").forEach((b, i) => {
    b.setAttribute("aria-checked", String(i === at));
    b.tabIndex = i === at ? 0 : -1;
  });
  if (mode === "level" && state.picked && state.picked.codes[level] >= 0) select(level, state.picked);
  changed();
}

function select(level, picked) {
  const code = picked.codes[level];
  state.picked = picked;
  state.selected = { level, codes: [code] };
  // A selection is highlighted in colour and on its level; depth and relevancy would hide it.
  if (state.mode !== "level") state.mode = "colour";
  renderer.select(level, [code]);
  if (manifest.framed) tellOuter({ selected: { level, codes: [code] } });
  show(state.mode, level);
  const names = namesOf(levels, answers, level, code), size = `${sizeOf(level, code).toLocaleString("en")} splats`;
  const { one } = levels[level], asked = answers.find((a) => isSure(a) && a.level === level && a.codes.includes(code));
  if (asked || isClear(names)) card(asked?.text ?? names[0][0], `${one} · ${size}`, { picked, level, names });
  else card(one, names.length ? size : `${size}. ${manifest.names_note}`, { picked, level, doubt: perhaps(names) });
}

/// Shows the card of a selection or an answer. `names` are listed with their relevancy; `doubt` is
/// a line of what it may be.
function card(title, note, { picked, level, names = [], doubt = "" }) {
  const box = find(".v-card");
  box.hidden = false;
  box.querySelector("h3").textContent = title;
  box.querySelector(".v-note").textContent = note;
  box.querySelector(".v-doubt").textContent = doubt && `perhaps ${doubt}`;
  box.querySelector(".v-levels").replaceChildren(...(picked ? levels.flatMap((l, at) => {
    if (picked.codes[at] < 0) return [];
    return [button(l.one, () => select(at, picked), { "aria-pressed": String(at === level) })];
  }) : []));
  box.querySelector(".v-names").replaceChildren(...names.map(([name, share]) => {
    const item = document.createElement("li"), bar = document.createElement("i"), value = document.createElement("b");
    value.textContent = share.toFixed(2);
    bar.style.width = `${100 * share}%`;
    item.append(name, value, bar);
    return item;
  }));
  makeRoom();
}

function fold() {
  const folded = find(".v-card").classList.toggle("folded");
  find(".v-fold").setAttribute("aria-expanded", String(!folded));
  makeRoom();
}

/// Middle of the splats of some codes in view, in shares of the picture without its offset; null
/// without any.
function middleOf({ level, codes }) {
  const [width, height] = size();
  let sum = [0, 0], n = 0;
  splats.codes[level].forEach((code, i) => {
    if (!codes.includes(code - 1)) return;
    const [x, y, z] = motion.camera.project(splats.positions.subarray(3 * i, 3 * i + 3), width, height);
    if (z < near || x < 0 || y < 0 || x > width || y > height) return;
    sum = [sum[0] + x / width, sum[1] + y / height];
    n++;
  });
  return n ? sum.map((v, k) => v / n - motion.inset[k]) : null;
}

/// On a small screen, moves the image centre so that the card does not cover the selection.
function makeRoom() {
  const box = find(".v-card"), chosen = state.selected ?? state.query;
  const [all, own] = [root.getBoundingClientRect(), box.getBoundingClientRect()];
  const small = all.width <= 720 || all.height < 420;
  const middle = small && chosen && !box.hidden && !box.classList.contains("folded") && middleOf(chosen);
  const sheet = own.width > 0.8 * all.width;
  const covered = sheet ? (all.bottom - own.top) / all.height : (all.right - own.left) / all.width;
  // Along the other axis, into the middle of the picture.
  const off = ([x, y]) => [Math.min(covered, Math.max(0, x - (1 - covered) / 2)), y - Math.min(0.7, Math.max(0.3, y))];
  const [by, aside] = middle ? off(sheet ? [...middle].reverse() : middle) : [0, 0];
  motion.insetTo = sheet ? [-aside, -by] : [-by, -aside];
}

/// Shows the scale of the colours of depth and relevancy.
function legend() {
  const box = find(".v-legend"), { mode, query } = state;
  box.hidden = mode !== "depth" && mode !== "relevancy";
  if (box.hidden) return;
  box.className = `v-legend ${mode === "depth" || isSure(query) ? mode : "doubt"}`;
  const ends = mode === "depth" ? renderer.range.map((z) => lengthText(Number(z.toPrecision(2)), tape.metres)) : ["not at all", "exactly"];
  box.querySelectorAll("span").forEach((span, k) => { span.textContent = ends[k]; });
}

function clear() {
  if (manifest.framed) tellOuter({ selected: null });
  state.selected = state.picked = null;
  renderer.select(-1, []);
  find(".v-card").hidden = true;
  if (tape.active) measure(false);
  setQuery(null);
  if (state.mode === "relevancy") show("colour");
  makeRoom();
  changed();
}

// --- queries ------------------------------------------------------------------------------------

const answers = [...manifest.answers];

async function ask(text) {
  text = text.trim();
  if (!text) return;
  let answer = answers.find((a) => a.text.toLowerCase() === text.toLowerCase());
  if (!answer) {
    if (!manifest.live) return say(manifest.ask_note);
    say("Looking …");
    try {
      const { ok, body } = manifest.framed ? await askOuter(text) : await askServer(text);
      if (!ok) return say(body.error);
      answer = body;
    } catch {
      return say("The server does not answer; is splatvk view still running?");
    }
    answers.push(answer);
    listQueries();
  }
  say("");
  state.selected = state.picked = null;
  renderer.select(-1, []);
  setQuery(answer);
  if (manifest.framed) tellOuter({ selected: { level: answer.level, codes: answer.codes }, text: answer.text });
  show("relevancy");
}

async function askServer(text) {
  const reply = await fetch("query", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ text }) });
  return { ok: reply.ok, body: await reply.json() };
}

/// Whether an answer says that the thing is there.
const isSure = (answer) => answer.found > 0 && answer.presence !== "unsure";

function highlight(answer) {
  renderer.answer(answer.relevancy, answer.level, answer.codes, !isSure(answer));
}

function setQuery(answer) {
  state.query = answer;
  if (answer) {
    highlight(answer);
    find(".v-ask input").value = answer.text;
    const of = (k) => answer.relevancy[answer.level][k];
    const best = answer.codes.reduce((a, b) => (of(b) > of(a) ? b : a), answer.codes[0]);
    const as = answer.found ? `, as a ${levels[answer.level].one.toLowerCase()}` : "; the heat shows what is nearest";
    const found = answer.verdict[0].toUpperCase() + answer.verdict.slice(1) + as;
    const notes = (answer.notes ?? []).map((note) => `; ${note}`).join("");
    const time = answer.milliseconds === undefined ? "" : `, ${answer.milliseconds.toFixed(0)} ms`;
    const names = best === undefined ? [] : namesOf(levels, answers, answer.level, best);
    const others = names.filter(([phrase]) => phrase !== answer.text);
    card(answer.text, `${found}${notes}${time}`, isSure(answer) ? { names } : { doubt: perhaps(others) });
  }
  find(".v-chips").querySelectorAll("button").forEach((b) => b.setAttribute("aria-pressed", String(b.textContent === answer?.text)));
}

function listQueries() {
  const asked = (text) => answers.some((a) => a.text.toLowerCase() === text.toLowerCase());
  const open = manifest.suggested.filter((text) => !asked(text)).map((text) => button(text, () => ask(text), { "aria-pressed": "false" }));
  const chips = answers.slice(-6).map((a) => button(a.text, () => (state.query === a ? clear() : ask(a.text)), { "aria-pressed": "false" }));
  chips.push(...open);
  find(".v-chips").replaceChildren(...chips);
  find("datalist").replaceChildren(...answers.map((a) => Object.assign(document.createElement("option"), { value: a.text })));
}

let saying;
function say(text, stays = false) {
  const box = find(".v-status");
  clearTimeout(saying);
  box.textContent = text;
  box.hidden = !text;
  if (text && !stays) saying = setTimeout(() => { box.hidden = true; }, 6000);
}

// --- controls -----------------------------------------------------------------------------------

const sizeOf = (level, code) => sizeOfCode(splats, level, code);

/// Depth and codes at a position of the canvas, CSS pixels.
function hitAt(x, y) {
  return pick(splats, motion.camera, x, y, ...size(), near, state.mode === "unseen");
}

const placeAt = (x, y, depth) => motion.camera.unproject(x, y, depth, ...size());

/// The point of the scene at a position; where nothing is, one at the distance of the pivot.
function surface(x, y) {
  return placeAt(x, y, hitAt(x, y)?.depth ?? Math.max(motion.camera.distance, 2 * motion.closest));
}

/// Selects the code at a position, measures to it, or makes it the centre of turning.
function tap(x, y, centre) {
  const hit = hitAt(x, y);
  if (centre) return hit && motion.turn((camera) => camera.aim(placeAt(x, y, hit.depth)));
  if (tape.active) return hit ? measureAt(x, y, hit.depth) : say("Nothing to measure to there.");
  if (!hit) return clear();
  const level = state.mode === "level" && hit.codes[state.level] >= 0 ? state.level : wholeOf(splats, levels, hit.codes);
  if (level < 0) return say("Nothing that the scene has words for.");
  setQuery(null);
  select(level, hit);
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

function nextMode(step) {
  const at = modes.findIndex((m) => m.mode === state.mode && (m.mode !== "level" || m.level === state.level));
  const around = modes.map((_, k) => modes[(at + step * (k + 1) + modes.length * modes.length) % modes.length]);
  const next = around.find((m) => m.mode !== "relevancy" || state.query);
  show(next.mode, next.level);
}

function toggleGuessed() {
  state.guessed = !state.guessed;
  say(state.guessed ? "What no photo shows is shown as guessed." : "What no photo shows is hidden.");
  changed();
}

/// Shows all that the photos show, from the present direction.
function all() {
  const to = motion.camera.copy();
  to.frame(extent.centre, extent.radius);
  motion.goTo(to, -1);
}

const actions = {
  save, all,
  play: () => motion.play(),
  reset: () => motion.goTo(motion.home.copy(), -1),
  full: () => fullScreen(root),
  measure: () => measure(),
  help: () => find(".v-help").showModal(),
};

let input;
function connect() {
  if (manifest.renews) say("A preview: the scene sharpens while it is being made.", true);
  find(".v-modes").replaceChildren(...modes.map((m) => button(m.name, () => show(m.mode, m.level), { role: "radio", title: m.title ?? "" })));
  show("colour");
  find(".v-photos").replaceChildren(...views.map((v, i) => {
    const made = button(v.thumbnail ? "" : String(i + 1), () => motion.goToView(i), { title: v.name, "aria-label": `photo ${v.name}` });
    if (v.thumbnail) made.style.backgroundImage = `url(${v.thumbnail})`;
    return made;
  }));
  find(".v-card .v-close").onclick = clear;
  find(".v-fold").onclick = fold;
  const form = find(".v-ask");
  form.onsubmit = (e) => {
    e.preventDefault();
    ask(form.elements.text.value);
  };
  form.hidden = find(".v-chips").hidden = manifest.presented || !levels.some((l) => l.colours.length);
  form.elements.text.placeholder = manifest.live ? "Ask for something you see" : "Queries of the run";
  listQueries();
  const toView = (act) => (...given) => (root.scrollIntoView({ block: "nearest" }), act(...given));
  const selectCode = (level, code) => (setQuery(null), select(level, { codes: levels.map((_, at) => (at === level ? code : -1)) }));
  connectPage({ splats, levels, answers }, { ask: toView(ask), select: toView(selectCode) });
  const fills = () => document.fullscreenElement === root || root.matches(".full, .wide");
  input = controls({ root, canvas, motion, actions, tap, tapsAtOnce: () => tape.active, surface, fills, nextMode, toggleGuessed, clear });
}

/// Interface for scripts and tests, `splatvk` in the console.
window.splatvk = {
  ready: load().then(connect),
  state,
  camera: () => motion.camera,
  tape,
  goTo: (view) => (motion.goToView(view, true), settled()),
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
