// Page of the viewer: connects canvas, controls and scene. All data are in the page (#v-manifest),
// or come from the server that sent it.
import { Camera, add, scale, upOf } from "splatvk/camera";
import { Tape } from "splatvk/measure";
import { pick } from "splatvk/pick";
import { Renderer } from "splatvk/render";
import { gunzip, unpack } from "splatvk/splats";

const manifest = JSON.parse(document.getElementById("v-manifest").textContent);
const root = document.querySelector(".viewer");
const find = (selector) => root.querySelector(selector);
const canvas = find("canvas");
const { views, levels } = manifest;
const up = manifest.up || upOf(views);

const state = { mode: "colour", level: levels.findLastIndex((l) => l.colours.length), selected: null, picked: null, query: null };
let splats, renderer, camera, worker, near = 0.01;
let request = 0, sortedFor = -1, waiting = false, drawn = true, flight = null, walking = new Set();
const idle = [];
const tape = new Tape(find(".v-tape"), find(".v-line"), manifest.metres, say);

// --- scene --------------------------------------------------------------------------------------

async function load() {
  const inline = document.getElementById("v-splats");
  const packed = inline ? Uint8Array.from(atob(inline.textContent.trim()), (c) => c.charCodeAt(0)).buffer
    : await (await fetch(manifest.scene)).arrayBuffer();
  splats = unpack(await gunzip(packed));
  inline?.remove();
  renderer = new Renderer(canvas, splats, levels);
  canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
  canvas.addEventListener("webglcontextrestored", restore);
  const source = JSON.parse(document.querySelector("script[type=importmap]").textContent).imports["splatvk/sort"];
  worker = new Worker(source);
  worker.onmessage = ({ data }) => {
    renderer.setOrder(data);
    sortedFor = data.id;
    waiting = false;
    drawn = false;
    if (request !== sortedFor) sort();
  };
  worker.postMessage({ positions: splats.positions.slice() });
  camera = views.length ? Camera.of(views[0], 1) : overview();
  near = 0.01 * medianDepth(camera);
  camera.distance = 100 * near;
  aimAt(camera);
  find(".v-wait").remove();
  new ResizeObserver(moved).observe(canvas);
  moved();
  requestAnimationFrame(frame);
  if (root.classList.contains("full")) root.focus();
}

/// Restores the graphics context, which phones take from pages in the background.
function restore() {
  renderer = new Renderer(canvas, splats, levels);
  if (state.selected) renderer.select(state.selected.level, state.selected.codes);
  if (state.query) renderer.answer(state.query.relevancy, state.query.level, state.query.codes);
  moved();
}

/// Camera for a scene without photos: outside, so that the central splats fill the picture.
function overview() {
  const sorted = [0, 1, 2].map((k) => Float32Array.from({ length: splats.count }, (_, i) => splats.positions[3 * i + k]).sort());
  const at = (share) => sorted.map((axis) => axis[Math.floor(share * (axis.length - 1))]);
  const size = Math.hypot(...at(0.9).map((v, k) => v - at(0.1)[k]));
  const rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  return new Camera({ rotation, position: add(at(0.5), scale([0, 0, 1], -1.2 * size)), focal: 1.2, distance: 1.2 * size });
}

function medianDepth(from) {
  const r = from.rotation, t = from.translation, z = [];
  for (let i = 0; i < splats.count; i += 7) {
    const depth = r[6] * splats.positions[3 * i] + r[7] * splats.positions[3 * i + 1] + r[8] * splats.positions[3 * i + 2] + t[2];
    if (depth > 0) z.push(depth);
  }
  return z.sort((a, b) => a - b)[z.length >> 1] || 1;
}

/// Sets the pivot of a camera to the surface in the middle of its image.
function aimAt(which) {
  const hit = pick(splats, which, 320, 240, 640, 480, near);
  if (hit) which.distance = hit.depth;
}

// --- drawing ------------------------------------------------------------------------------------

function fit(width, height) {
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
}

function fitToPage() {
  // More than two device pixels per CSS pixel cost power without a visible difference.
  const ratio = Math.min(devicePixelRatio || 1, 2);
  fit(Math.max(1, Math.round(canvas.clientWidth * ratio)), Math.max(1, Math.round(canvas.clientHeight * ratio)));
}

function sort() {
  if (waiting) return;
  waiting = true;
  const [fx, fy, cx, cy] = camera.intrinsics(canvas.width, canvas.height);
  // Half an image more on every side, since splats reach beyond their centre.
  const slope = [(Math.max(cx, canvas.width - cx) + canvas.width / 2) / fx, (Math.max(cy, canvas.height - cy) + canvas.height / 2) / fy];
  worker.postMessage({ id: request, rotation: camera.rotation, translation: camera.translation, near, slope });
}

/// Redraws after a change of the camera or of the size of the picture.
function moved() {
  if (!capturing) fitToPage();
  request++;
  drawn = false;
  sort();
}

function changed() {
  drawn = false;
}

function draw() {
  if (!capturing) tape.draw(camera, canvas.clientWidth, canvas.clientHeight, near);
  renderer.draw(camera, { mode: state.mode, level: state.level, selecting: state.selected !== null, near });
}

let last = 0;
function frame(now) {
  const seconds = Math.min((now - last) / 1000, 0.1);
  last = now;
  if (!capturing) {
    if (flight) fly(now);
    if (walking.size) walk(seconds);
    if (!drawn) {
      draw();
      drawn = true;
    }
    if (request === sortedFor && !flight && drawn) idle.splice(0).forEach((tell) => tell());
  }
  requestAnimationFrame(frame);
}

/// Resolves when the picture shows the current state, splats in their final order.
const settled = () => new Promise((tell) => idle.push(tell));

let capturing = false;

/// Returns the picture as a PNG blob; with the index of a photo, from its camera at its size.
async function picture(view) {
  await settled();
  const before = camera;
  capturing = true;
  try {
    if (view !== undefined) {
      camera = Camera.of(views[view], 1);
      fit(views[view].width, views[view].height);
      moved();
      while (request !== sortedFor) await new Promise((go) => setTimeout(go, 5));
    }
    draw();
    return await new Promise((done) => canvas.toBlob(done));
  } finally {
    capturing = false;
    camera = before;
    moved();
  }
}

// --- cameras ------------------------------------------------------------------------------------

const SECONDS_PER_LEG = 1.6;
const ease = (t) => t * t * (3 - 2 * t);
const still = matchMedia("(prefers-reduced-motion: reduce)");

function goTo(index, jump = false) {
  const to = Camera.of(views[index], camera.distance);
  aimAt(to);
  flight = null;
  if (jump || still.matches) {
    camera = to;
    moved();
  } else flight = { legs: [camera.copy(), to], at: performance.now(), views: [index] };
  current(index);
}

/// Moves through the cameras of all photos in a loop, from the present camera.
function play() {
  if (flight) return stop();
  if (!views.length) return;
  const stops = views.map((v) => Camera.of(v, camera.distance));
  stops.forEach(aimAt);
  flight = { legs: [camera.copy(), ...stops], at: performance.now(), views: views.map((_, i) => i), round: true };
  find("[data-do=play]").setAttribute("aria-pressed", "true");
}

function stop() {
  flight = null;
  find("[data-do=play]").setAttribute("aria-pressed", "false");
}

function fly(now) {
  const { legs, at, views: indices, round } = flight;
  const t = Math.max(0, now - at) / 1000 / SECONDS_PER_LEG, leg = Math.floor(t);
  if (leg >= legs.length - 1) {
    camera = legs[legs.length - 1].copy();
    if (round) {
      flight = { ...flight, legs: [camera.copy(), ...legs.slice(1)], at: now };
    } else stop();
  } else {
    camera = Camera.between(legs[leg], legs[leg + 1], ease(t - leg));
    current(indices[leg]);
  }
  moved();
}

function current(index) {
  find(".v-photos").querySelectorAll("button").forEach((b, i) => b.setAttribute("aria-current", String(i === index)));
}

function turn(change) {
  stop();
  current(-1);
  change();
  moved();
}

function walk(seconds) {
  const step = 0.6 * camera.distance * seconds;
  const has = (key) => (walking.has(key) ? 1 : 0);
  const [x, y, z] = [has("d") - has("a"), has("q") - has("e"), has("w") - has("s")];
  turn(() => camera.move(x * step, y * step, z * step));
}

// --- display ------------------------------------------------------------------------------------

const modes = [
  { name: "Colour", mode: "colour" },
  { name: "Depth", mode: "depth" },
  ...levels.flatMap((l, level) => (l.colours.length ? [{ name: l.title, mode: "level", level }] : [])),
  ...(levels.some((l) => l.colours.length) ? [{ name: "Relevancy", mode: "relevancy" }] : []),
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
    if (i === at) b.scrollIntoView({ block: "nearest", inline: "nearest" });
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
  show(state.mode, level);
  const names = namesOf(level, code), size = `${sizeOf(level, code).toLocaleString("en")} splats`;
  if (names.length) card(names[0][0], `${levels[level].one} · ${size}`, picked, level, names);
  else card(levels[level].one, `${size}. ${manifest.names_note}`, picked, level, names);
}

/// Phrases that fit a code best, of the text model and of the queries so far. At 0.5 and below, a
/// phrase fits no better than "object" or "stuff".
function namesOf(level, code) {
  const all = new Map(levels[level].phrases[code] || []);
  answers.forEach((a) => all.set(a.text, a.relevancy[level][code]));
  return [...all].filter((name) => name[1] > 0.51).sort((a, b) => b[1] - a[1]).slice(0, 6);
}

function card(title, note, picked, level, names) {
  const box = find(".v-card");
  box.hidden = false;
  box.querySelector("h3").textContent = title;
  box.querySelector(".v-note").textContent = note;
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
}

function clear() {
  state.selected = state.picked = null;
  renderer.select(-1, []);
  find(".v-card").hidden = true;
  find(".v-help").hidden = true;
  if (tape.active) measure(false);
  setQuery(null);
  if (state.mode === "relevancy") show("colour");
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
      const reply = await fetch("query", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ text }) });
      const body = await reply.json();
      if (!reply.ok) return say(body.error);
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
  show("relevancy");
}

function setQuery(answer) {
  state.query = answer;
  if (answer) {
    renderer.answer(answer.relevancy, answer.level, answer.codes);
    find(".v-ask input").value = answer.text;
    const of = (k) => answer.relevancy[answer.level][k];
    const best = answer.codes.reduce((a, b) => (of(b) > of(a) ? b : a), answer.codes[0]);
    const where = `in ${answer.found} of ${answer.views} photos`;
    const as = `, as a ${levels[answer.level].one.toLowerCase()}`;
    const found = !answer.found ? "Not in this scene; the heat shows what is nearest"
      : (answer.presence === "unsure" ? `Unsure; if it is here, ${where}` : `Found ${where}`) + as;
    const notes = (answer.notes ?? []).map((note) => `; ${note}`).join("");
    const time = answer.milliseconds === undefined ? "" : `, ${answer.milliseconds.toFixed(0)} ms`;
    const names = best === undefined ? [] : namesOf(answer.level, best);
    card(answer.text, `${found}${notes}${time}`, null, answer.level, names);
  }
  find(".v-chips").querySelectorAll("button").forEach((b) => b.setAttribute("aria-pressed", String(b.textContent === answer?.text)));
}

function listQueries() {
  const chips = answers.slice(-6).map((a) => button(a.text, () => (state.query === a ? clear() : ask(a.text)), { "aria-pressed": "false" }));
  find(".v-chips").replaceChildren(...chips);
  find("datalist").replaceChildren(...answers.map((a) => Object.assign(document.createElement("option"), { value: a.text })));
}

let saying;
function say(text) {
  const box = find(".v-status");
  clearTimeout(saying);
  box.textContent = text;
  box.hidden = !text;
  if (text) saying = setTimeout(() => { box.hidden = true; }, 6000);
}

// --- controls -----------------------------------------------------------------------------------

function button(text, act, attributes = {}) {
  const made = Object.assign(document.createElement("button"), { type: "button", textContent: text, onclick: act });
  Object.entries(attributes).forEach(([name, value]) => made.setAttribute(name, value));
  return made;
}

const sizeOf = (level, code) => splats.codes[level].reduce((n, c) => n + (c === code + 1), 0);

/// Level of a click: the coarsest level with a code at this position. A code with a quarter of the
/// splats is a table or a wall merged with its objects, so a finer level with fewer splats has
/// priority.
function levelOf(codes) {
  const thing = codes.findLastIndex((code, level) => code >= 0 && sizeOf(level, code) < splats.count / 4);
  return thing >= 0 ? thing : codes.findLastIndex((code) => code >= 0);
}

/// Selects the code at a position of the canvas, CSS pixels.
function clickAt(x, y, centre = false) {
  const ratio = canvas.width / canvas.clientWidth;
  const hit = pick(splats, camera, x * ratio, y * ratio, canvas.width, canvas.height, near);
  if (tape.active && !centre) return hit ? measureAt(x, y, hit.depth) : say("Nothing to measure to there.");
  if (!hit) return clear();
  if (centre) return turn(() => camera.aim(camera.unproject(x * ratio, y * ratio, hit.depth, canvas.width, canvas.height)));
  const level = state.mode === "level" && hit.codes[state.level] >= 0 ? state.level : levelOf(hit.codes);
  if (level < 0) return say("Nothing that the scene has words for.");
  setQuery(null);
  select(level, hit);
}

function measureAt(x, y, depth) {
  tape.place(camera.unproject(x, y, depth, canvas.clientWidth, canvas.clientHeight));
  changed();
}

function measure(on) {
  tape.toggle(on);
  find("[data-do=measure]").setAttribute("aria-pressed", String(tape.active));
  changed();
}

function pointers() {
  const down = new Map();
  let start = null, lastTap = null;
  const middle = () => {
    const all = [...down.values()];
    const sum = all.reduce((s, p) => [s[0] + p[0] / all.length, s[1] + p[1] / all.length], [0, 0]);
    const spread = all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0;
    return [...sum, spread];
  };
  canvas.addEventListener("pointerdown", (e) => {
    root.focus({ preventScroll: true });
    canvas.setPointerCapture(e.pointerId);
    down.set(e.pointerId, [e.offsetX, e.offsetY]);
    start = down.size === 1 ? [e.offsetX, e.offsetY] : null;
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!down.has(e.pointerId)) return;
    const [x0, y0, spread0] = middle();
    down.set(e.pointerId, [e.offsetX, e.offsetY]);
    const [x, y, spread] = middle();
    if (start && Math.hypot(e.offsetX - start[0], e.offsetY - start[1]) > 4) start = null;
    if (start) return;
    const [dx, dy] = [x - x0, y - y0], height = canvas.clientHeight;
    turn(() => {
      if (down.size > 1 || e.buttons === 2 || e.shiftKey) {
        const step = camera.distance / camera.focal / height;
        camera.move(-dx * step, -dy * step, 0);
        if (spread0 > 0 && spread > 0) camera.dolly(spread0 / spread);
      } else camera.orbit(-dx * 3 / height, dy * 3 / height, up);
    });
  });
  const release = (e) => {
    down.delete(e.pointerId);
    // A press without movement is a click; a second one there soon after, a double click.
    if (e.type === "pointerup" && start && e.button === 0) {
      const again = lastTap && e.timeStamp - lastTap[2] < 350 && Math.hypot(start[0] - lastTap[0], start[1] - lastTap[1]) < 12;
      clickAt(start[0], start[1], again);
      lastTap = [start[0], start[1], e.timeStamp];
    }
    start = null;
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    // In a longer page the wheel scrolls until the view has been clicked.
    if (!root.classList.contains("full") && !root.contains(document.activeElement)) return;
    e.preventDefault();
    turn(() => camera.dolly(Math.exp(Math.max(-0.3, Math.min(0.3, e.deltaY * (e.deltaMode ? 0.05 : 0.0015))))));
  }, { passive: false });
}

async function save() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await picture());
  link.download = `${manifest.title}-${state.mode}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function full() {
  root.classList.toggle("full");
  moved();
}

const actions = { play, save, full, measure: () => measure(), help: () => { find(".v-help").hidden = !find(".v-help").hidden; } };

function keys() {
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  root.addEventListener("keydown", (e) => {
    if (e.target.tagName === "INPUT") {
      if (e.key === "Escape") root.focus();
      return;
    }
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const key = e.key.toLowerCase();
    if (arrows[e.key]) {
      const [x, y] = arrows[e.key], step = 0.05 * camera.distance;
      turn(() => (e.shiftKey ? camera.move(x * step, y * step, 0) : camera.orbit(x * 0.06, -y * 0.06, up)));
    } else if (key >= "1" && key <= "9" && views[key - 1]) goTo(key - 1);
    else if ("wasdqe".includes(key)) walking.add(key);
    else if (key === "+" || key === "=") turn(() => camera.dolly(0.9));
    else if (key === "-") turn(() => camera.dolly(1 / 0.9));
    else if (key === " " && e.target === root) play();
    else if (key === "m") nextMode();
    else if (key === "l") measure();
    else if (key === "p") save();
    else if (key === "f") full();
    else if (key === "?" || key === "h") actions.help();
    else if (key === "/") find(".v-ask input").focus();
    else if (key === "escape") clear();
    else return;
    e.preventDefault();
  });
  root.addEventListener("keyup", (e) => walking.delete(e.key.toLowerCase()));
  root.addEventListener("blur", () => walking.clear());
}

function nextMode() {
  const at = modes.findIndex((m) => m.mode === state.mode && (m.mode !== "level" || m.level === state.level));
  const next = modes.slice(at + 1).concat(modes).find((m) => m.mode !== "relevancy" || state.query);
  show(next.mode, next.level);
}

function controls() {
  find(".v-modes").replaceChildren(...modes.map((m) => button(m.name, () => show(m.mode, m.level), { role: "radio", title: m.title ?? "", "aria-checked": String(m.mode === "colour") })));
  find(".v-photos").replaceChildren(...views.map((v, i) => {
    const made = button(v.thumbnail ? "" : String(i + 1), () => goTo(i), { title: v.name, "aria-label": `photo ${v.name}` });
    if (v.thumbnail) made.style.backgroundImage = `url(${v.thumbnail})`;
    return made;
  }));
  root.querySelectorAll("[data-do]").forEach((b) => { b.onclick = actions[b.dataset.do]; });
  find(".v-close").onclick = clear;
  const form = find(".v-ask");
  form.onsubmit = (e) => {
    e.preventDefault();
    ask(form.elements.text.value);
  };
  if (!levels.some((l) => l.colours.length)) find(".v-top").hidden = true;
  form.elements.text.placeholder = manifest.live ? "Ask for something you see" : "Queries of the run";
  listQueries();
  pointers();
  keys();
}

/// Interface for scripts and tests, `splatvk` in the console.
window.splatvk = {
  ready: load().then(controls),
  state,
  camera: () => camera,
  tape,
  goTo: (view) => (goTo(view, true), settled()),
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
