// Named views, the view at the start, and notes on points: a list in a panel, and the notes over
// the picture. The server keeps them in the scene; a page without one shows them.
import { Camera, fromQuaternion, toQuaternion } from "splatvk/camera";
import { button } from "splatvk/controls";
import { changed, overlay, seenAt, size } from "splatvk/stage";
import { find, manifest, say, scene } from "splatvk/page";
import { addPanel, takeTaps } from "splatvk/panel";

/// Format of the file: docs/use/schemas/views.schema.json.
let doc = manifest.named;
let panel, pins = [], shownNotes = true;
const layer = find(".v-notes");

/// Whether changes are kept.
const saves = () => Boolean(manifest.saves);

/// Loads the views of the scene from the server, where there is one.
export async function loadViews() {
  if (!saves()) return;
  const reply = await fetch("views");
  const body = await reply.json();
  if (reply.ok) doc = body;
  else say(body.error);
}

const same = (a, b) => a.toLowerCase() === b.toLowerCase();
const viewOf = (name) => doc.views.find((v) => same(v.name, name));

/// Camera of a named view; null where none has that name.
export function namedCamera(name) {
  const view = name && viewOf(name);
  if (!view) return null;
  const { position, focal, ratio, shift = [0, 0], distance } = view;
  return new Camera({ rotation: fromQuaternion(view.rotation), position, focal, ratio, shift, distance });
}

/// Camera of the view at the start, or null.
export const startCamera = () => namedCamera(doc.start);

/// The present camera, whatever its picture's size, as the file has it.
function present(name) {
  const { camera } = scene.motion, [width, height] = size(), [, fy, cx, cy] = camera.intrinsics(width, height);
  return {
    name, position: [...camera.position], rotation: toQuaternion(camera.rotation), focal: fy / height, ratio: width / height,
    shift: [(cx - width / 2) / height, (cy - height / 2) / height], distance: camera.distance,
  };
}

/// Saves a changed copy of the views; where that fails, all stays as it was.
async function change(how) {
  const next = structuredClone(doc);
  how(next);
  try {
    const reply = await fetch("views", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(next) });
    const body = await reply.json();
    if (!reply.ok) return say(body.error), false;
    doc = body;
  } catch {
    return say("Not saved: the server does not answer; is splatvk view still running?"), false;
  }
  refresh();
  return true;
}

function refresh() {
  panel?.refresh();
  drawPins();
  changed();
}

// --- panel --------------------------------------------------------------------------------------

/// Adds the panel where there are views, or where they can be made.
export function connectViews({ goTo }) {
  drawPins();
  overlay(placePins);
  if (!saves() && !doc.views.length && !doc.notes.length) return;
  panel = addPanel({ name: "views", title: "Views and notes", fill: () => fill(goTo), closed: () => pinning && pin(false) });
}

export const toggleViews = () => panel?.toggle();

function fill(goTo) {
  const list = Object.assign(document.createElement("ul"), { className: "v-list" });
  list.append(...doc.views.map((view) => row(view.name, () => goTo(view.name), [
    saves() && button("★", () => change((d) => { d.start = d.start && same(d.start, view.name) ? null : view.name; }), {
      "aria-label": `Start with ${view.name}`, "aria-pressed": String(Boolean(doc.start) && same(doc.start, view.name)), title: "The view at the start",
    }),
    saves() && button("✎", () => rename(view), { "aria-label": `Rename ${view.name}`, title: "Rename" }),
    saves() && button("×", () => change((d) => {
      d.views = d.views.filter((v) => v.name !== view.name);
      if (d.start && same(d.start, view.name)) d.start = null;
    }), { "aria-label": `Delete ${view.name}`, title: "Delete" }),
  ])));
  const notes = Object.assign(document.createElement("ul"), { className: "v-list" });
  notes.append(...doc.notes.map((note, at) => row(note.text, () => lookAt(note), [
    saves() && button("×", () => change((d) => d.notes.splice(at, 1)), { "aria-label": `Delete the note ${note.text}`, title: "Delete" }),
  ])));
  const parts = [list];
  if (!doc.views.length) parts.push(line("No named views yet."));
  if (saves()) parts.push(form("Name of this view", 80, "Save view", (name) => add(name)));
  parts.push(notes);
  if (saves()) parts.push(form("Text of a note", 500, "Pin note", (text) => pin(text)));
  return parts;
}

function row(text, act, tools) {
  const item = document.createElement("li");
  item.append(button(text, act, { class: "v-name" }), ...tools.filter(Boolean));
  return item;
}

const line = (text) => Object.assign(document.createElement("p"), { className: "v-note", textContent: text });

function form(label, longest, act, done) {
  const made = document.createElement("form"), input = document.createElement("input");
  Object.assign(input, { placeholder: label, maxLength: longest, autocomplete: "off", required: true });
  input.setAttribute("aria-label", label);
  made.append(input, Object.assign(document.createElement("button"), { textContent: act }));
  made.onsubmit = (e) => {
    e.preventDefault();
    const text = input.value.trim();
    if (text) done(text);
  };
  return made;
}

async function add(name) {
  const at = doc.views.findIndex((v) => same(v.name, name));
  if (at >= 0) return say(`A view is called “${name}” already; delete it, or give another name.`);
  if (await change((d) => d.views.push(present(name)))) say(`Saved as “${name}”.`);
}

function rename(view) {
  const item = [...panelRows()].find((row) => row.querySelector(".v-name").textContent === view.name);
  const made = form("New name", 80, "Rename", async (name) => {
    if (name === view.name) return refresh();
    await change((d) => {
      d.views.find((v) => v.name === view.name).name = name;
      if (d.start && same(d.start, view.name)) d.start = name;
    });
  });
  item.replaceChildren(made);
  made.firstChild.value = view.name;
  made.firstChild.select();
}

const panelRows = () => document.querySelectorAll("#v-views li");

// --- notes --------------------------------------------------------------------------------------

let pinning = false;

/// Waits for a tap on the point of a note; with `false` no longer.
function pin(text) {
  pinning = text !== false;
  takeTaps(pinning ? (hit) => place(text, hit) : null);
  say(pinning ? "Click on the point of the note; Esc gives up." : "", true);
}

async function place(text, hit) {
  if (!hit) return say("Nothing to pin it to there.");
  pin(false);
  await change((d) => d.notes.push({ text, at: hit.point }));
}

/// Turns towards a note from where the camera is.
function lookAt(note) {
  scene.motion.lookAt(note.at);
}

export function showNotes(on) {
  shownNotes = on;
  drawPins();
}

function drawPins() {
  pins = (shownNotes ? doc.notes : []).map((note) => {
    const element = Object.assign(document.createElement("p"), { className: "v-pin", textContent: note.text });
    return { element, at: note.at };
  });
  layer.replaceChildren(...pins.map((p) => p.element));
}

/// Moves the notes to their points. One whose point is hidden is pale; that is found at rest only.
function placePins(camera, width, height, sharp) {
  for (const { element, at } of pins) {
    const [x, y, z] = camera.project(at, width, height);
    element.hidden = !(z > scene.near && x > 0 && y > 0 && x < width && y < height);
    if (element.hidden) continue;
    element.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    if (sharp) element.classList.toggle("hid", !seenAt(x, y, z));
  }
}
