// Edits: a selection of splats by words, clicks, outlines and ranges, and operations on it. The
// server selects and keeps the edits in the scene (POST edit); the page keeps the selection, the
// hidden splats and the order of the steps.
import { button } from "splatvk/controls";
import { lengthText } from "splatvk/measure";
import { outliner } from "splatvk/outline";
import { canvas, find, levels, manifest, say, scene, state } from "splatvk/page";
import { addPanel, takeDrags, takeTaps } from "splatvk/panel";
import { forget } from "splatvk/queries";
import { MARKS } from "splatvk/splats";
import { remark, size } from "splatvk/stage";
import { make } from "splatvk/widgets";

const HOW = [["new", "New"], ["add", "Add"], ["remove", "Remove"], ["intersect", "Intersect"]];
const TOOLS = [["click", "Click"], ["rectangle", "Rectangle"], ["lasso", "Lasso"]];

/// Selection and hidden splats: parts as the server takes them, its answer, and per hidden selection
/// {parts, bits}. Bitmaps fit the splats of the page as long as the edits are the same.
let now = { parts: [], selected: null, hidden: [] };
/// The edits of the scene.
let list = { edits: [], undone: [] };
/// Steps of this page, {before, after, edit: whether the scene changed}, and those that were undone.
let steps = [], undone = [];
let how = "new", tool = "click", through = false, last = Promise.resolve(), panel, renew;

/// Sends a request; throws its refusal.
async function send(request) {
  let reply;
  try {
    reply = await fetch("edit", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ scene: scene.number, request }) });
  } catch {
    throw new Error("The server does not answer; is splatvk view still running?");
  }
  const body = await reply.json();
  if (reply.status === 409) await begin();
  if (!reply.ok) throw new Error(body.error);
  return body;
}

/// Begins again with the present scene, which was edited elsewhere.
async function begin() {
  [now, steps, undone] = [{ parts: [], selected: null, hidden: [] }, [], []];
  forget();
  await renew();
  list = await send({ list: {} });
}

/// Does one thing after the other, and shows why one is refused.
function alone(act) {
  last = last.then(act).catch((error) => say(error.message)).then(() => panel.refresh());
  return last;
}

/// Marks the splats of a bitmap of the server.
function mark(bit, bitmaps) {
  const { marks } = scene.splats;
  for (let i = 0; i < marks.length; i++) marks[i] &= ~bit;
  for (const text of bitmaps) {
    const bits = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    for (let i = 0; i < marks.length; i++) if (bits[i >> 3] >> (i & 7) & 1) marks[i] |= bit;
  }
}

/// Shows a selection and hidden splats.
function take(next) {
  now = next;
  mark(MARKS.selected, now.selected ? [now.selected.bits] : []);
  mark(MARKS.hidden, now.hidden.map(({ bits }) => bits));
  remark();
}

/// Goes on to another state; undo takes it back.
function go(after, edit = false) {
  steps.push({ before: now, after, edit });
  undone = [];
  take(after);
}

/// Selects by parts.
const select = (parts) => alone(async () => {
  go({ ...now, parts, selected: parts.length ? await send({ select: parts }) : null });
});

/// Sends a request that changes the scene, and shows the scene then.
async function change(request) {
  list = await send(request);
  if (!list.changed) return false;
  forget();
  await renew();
  return true;
}

/// Hidden splats in the bitmaps of the present scene, without a selection. Parts that the edit took
/// away are no longer hidden.
async function afresh() {
  const hidden = [];
  for (const { parts } of now.hidden) {
    try {
      hidden.push({ parts, bits: (await send({ select: parts })).bits });
    } catch {
      continue;
    }
  }
  return { parts: [], selected: null, hidden };
}

/// Applies an operation to the selection.
const edit = (operation, word) => alone(async () => {
  const { parts, selected } = now;
  if (!selected) return say("Select something first.");
  await change({ edit: { operation, selection: parts, force: selected.doubts.length > 0 } });
  go(await afresh(), true);
  const along = list.along ? `, and ${list.along.toLocaleString("en")} behind them that no photo shows` : "";
  say(`${selected.count.toLocaleString("en")} splats ${word}${along}. Undo takes it back.`);
});

/// Undoes the last step of this page, or else the last edit of the scene.
const undo = () => alone(async () => {
  const step = steps.at(-1);
  if (!step || step.edit) {
    if (!await change({ undo: {} })) return say("There is nothing to undo.");
  }
  take(step ? step.before : await afresh());
  if (step) undone.push(steps.pop());
});

/// Does again the step that was undone last.
const redo = () => alone(async () => {
  const step = undone.at(-1);
  if (!step || step.edit) {
    if (!await change({ redo: {} })) return say("There is nothing to redo.");
  }
  take(step ? step.after : await afresh());
  if (step) steps.push(undone.pop());
});

const erase = () => now.selected && edit({ delete: {} }, "deleted");

/// Adds a part to the selection, or begins with it; Shift adds.
function add(part) {
  const combine = scene.motion.fast && how === "new" ? "add" : how;
  const kept = combine === "new" ? [] : now.parts;
  if (!kept.length && ["remove", "intersect"].includes(combine)) return say("Nothing is selected yet.");
  return select([...kept, { ...part, combine: kept.length ? combine : "add" }]);
}

function clickedAt(hit) {
  if (!hit) return select([]);
  const level = state.mode === "level" ? state.level : undefined;
  return add({ pick: { click: { camera: scene.motion.camera.stated(...size()), pixel: [hit.x, hit.y], level } } });
}

function outlined(polygon) {
  return add({ pick: { outline: { camera: scene.motion.camera.stated(...size()), polygon, through } } });
}

function useTool() {
  const open = panel.open;
  takeTaps(open ? clickedAt : null);
  takeDrags(open && tool !== "click" ? outliner(tool, outlined) : null);
  canvas.style.cursor = open && tool !== "click" ? "crosshair" : "";
}

/// The selection of the card beside the picture, as a part.
function ofCard() {
  if (state.query) return { text: state.query.text };
  const { level, codes } = state.selected;
  const { at } = state.picked;
  if (at) return { pick: { click: { ...at, level } } };
  return { pick: { thing: { id: `${levels[level].name}${codes[0] + 1}` } } };
}

// --- panel --------------------------------------------------------------------------------------

/// Adds the panel; returns the actions of buttons and keys. `load` loads the splats again, `clear`
/// takes away the selection of the card.
export function connectEdit({ load, clear }) {
  renew = load;
  panel = addPanel({ name: "edit", title: "Edit", fill, opened: () => alone(async () => { list = await send({ list: {} }); }), closed });
  const opener = find(".v-edit");
  opener.hidden = false;
  opener.onclick = () => {
    const part = ofCard();
    clear();
    panel.show();
    select([{ ...part, combine: "add" }]);
  };
  return { edit: panel.toggle, erase, undo, redo };
}

function closed() {
  useTool();
  if (now.parts.length) select([]);
}

function fill() {
  useTool();
  const behind = make("input", { type: "checkbox", checked: through, onchange: (e) => { through = e.target.checked; } });
  return [words(), choice("Tool in the picture", TOOLS, tool, (value) => { tool = value; }),
    tool === "click" ? "" : make("label", { class: "v-check" }, behind, "also what is hidden behind"),
    choice("How to combine", HOW, how, (value) => { how = value; }), summary(), actions(), range(), history()];
}

function choice(label, all, chosen, choose) {
  return make("div", { class: "v-choice", role: "group", "aria-label": label }, ...all.map(([value, text]) =>
    button(text, () => { choose(value); panel.refresh(); }, { "aria-pressed": String(value === chosen) })));
}

function words() {
  const input = make("input", { placeholder: "blue mug, id:o3, opacity<0.1", "aria-label": "Words, an id or a range", autocomplete: "off", maxLength: 300 });
  return make("form", { onsubmit: (e) => { e.preventDefault(); if (input.value.trim()) add({ text: input.value.trim(), grow: 0 }); } },
    input, make("button", { type: "submit" }, "Select"));
}

const PROPERTIES = ["opacity", "size", "reliability", "seen"];
/// Property of the range, its distribution, and the edges between which splats are selected.
let bounds = { property: "opacity", histogram: null, from: 0, to: 0 };

const measure = (property) => alone(async () => {
  bounds = { property, histogram: null, from: 0, to: 0 };
  const histogram = await send({ histogram: property });
  bounds = { property, histogram, from: 0, to: histogram.counts.length };
});

/// Value of a bound with its unit.
function valueText(value) {
  if (bounds.property === "size") return lengthText(value, manifest.metres, 2);
  return `${Number(value.toPrecision(2))}${bounds.property === "seen" ? " px" : ""}`;
}

function range() {
  const { property, histogram, from, to } = bounds;
  const select = make("select", { "aria-label": "Property", onchange: (e) => measure(e.target.value) },
    make("option", { value: "", disabled: true, selected: !histogram }, "Range of …"),
    ...PROPERTIES.map((name) => make("option", { selected: histogram && name === property }, name)));
  if (!histogram) return make("form", {}, select);
  const bins = histogram.counts.length, bars = make("div", { class: "v-bars", "aria-hidden": "true" }), said = make("output");
  const go = (e) => {
    e.preventDefault();
    const edge = (at, open) => (at === open ? undefined : histogram.edges[at]);
    add({ pick: { range: { property, least: edge(bounds.from, 0), most: edge(bounds.to, bins) } } });
  };
  const most = Math.log1p(Math.max(...histogram.counts));
  bars.append(...histogram.counts.map((count) => make("i", { style: `height: ${(100 * Math.log1p(count) / most).toFixed(0)}%` })));
  const show = () => {
    [...bars.children].forEach((bar, k) => bar.classList.toggle("in", k >= bounds.from && k < bounds.to));
    said.value = `${valueText(histogram.edges[bounds.from])} to ${valueText(histogram.edges[bounds.to])}`;
  };
  const slider = (key, label, value) => make("input", { type: "range", min: 0, max: bins, step: 1, value, "aria-label": label, oninput: (e) => {
    bounds[key] = Number(e.target.value);
    bounds.from = Math.min(bounds.from, bounds.to - 1, bins - 1);
    bounds.from = Math.max(0, bounds.from);
    bounds.to = Math.max(bounds.to, bounds.from + 1);
    show();
  } });
  show();
  return make("form", { class: "v-range", onsubmit: go }, select, said, bars, slider("from", "Least", from), slider("to", "Most", to), make("button", { type: "submit" }, "Select"));
}

function summary() {
  const { selected, parts } = now;
  if (!selected) return make("p", { class: "v-note" }, "Nothing is selected. Click on a thing, or give words.");
  const { count, share, text, doubts } = selected;
  const said = make("div", {}, make("p", { class: "v-note" }, `${text}: ${count.toLocaleString("en")} splats, ${(100 * share).toFixed(1)} % of the scene`));
  if (doubts.length) said.append(make("p", { class: "v-doubtful" }, doubts.join("; ")));
  const at = parts.findLastIndex((part) => part.text && !part.text.startsWith("id:") && !/[<>]/.test(part.text));
  if (at >= 0) {
    const grow = (e) => select(parts.map((part, k) => (k === at ? { ...part, grow: Number(e.target.value) } : part)));
    said.append(make("label", { class: "v-grow" }, "less", make("input", { type: "range", min: -1, max: 1, step: 0.1, value: parts[at].grow ?? 0, "aria-label": "Less or more of the words", onchange: grow }), "more"));
  }
  return said;
}

function actions() {
  const { selected, parts, hidden } = now, none = { parts: [], selected: null };
  const off = { disabled: !selected }, anyway = selected?.doubts.length ? " anyway" : "";
  const colour = make("input", { type: "color", value: "#cc3333", "aria-label": "Colour" });
  const paint = () => edit({ recolour: { colour: [1, 3, 5].map((k) => parseInt(colour.value.slice(k, k + 2), 16) / 255) } }, "recoloured");
  return make("div", { class: "v-actions" },
    button(`Delete${anyway}`, erase, off), button(`Isolate${anyway}`, () => edit({ isolate: {} }, "isolated"), off),
    button("Hide", () => (go({ ...none, hidden: [...hidden, { parts, bits: selected.bits }] }), panel.refresh()), off),
    make("span", {}, button(`Recolour${anyway}`, paint, off), colour),
    hidden.length ? button("Show hidden", () => (go({ ...now, hidden: [] }), panel.refresh())) : "");
}

function history() {
  const lines = make("ol", { class: "v-list" }, ...list.edits.map((line) => make("li", {}, line)));
  return make("div", {}, make("div", { class: "v-actions" },
    button("Undo", undo, { disabled: !steps.length && !list.edits.length }), button("Redo", redo, { disabled: !undone.length && !list.undone.length })),
  lines, make("p", { class: "v-note" }, "Edits are saved in the scene at once; its reconstruction stays."));
}
