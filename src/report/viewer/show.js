// Kinds of picture, and the selection.
import { card, makeRoom } from "splatvk/card";
import { tellOuter } from "splatvk/frame";
import { lengthText } from "splatvk/measure";
import { isClear, namesOf, perhaps } from "splatvk/names";
import { find, levels, manifest, say, scene, state } from "splatvk/page";
import { sizeOfCode } from "splatvk/pick";
import { answers, isSure } from "splatvk/queries";
import { changed } from "splatvk/stage";

export const modes = [
  { name: "Colour", mode: "colour" },
  { name: "Depth", mode: "depth" },
  ...levels.flatMap((l, level) => (l.colours.length ? [{ name: l.title, mode: "level", level }] : [])).reverse(),
  ...(!manifest.presented && levels.some((l) => l.colours.length) ? [{ name: "Relevancy", mode: "relevancy" }] : []),
  ...(manifest.unseen ? [{ name: "Guessed", mode: "unseen", title: "What no photo shows, in magenta" }] : []),
];

export function show(mode, level = state.level) {
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

export function nextMode(step) {
  const at = modes.findIndex((m) => m.mode === state.mode && (m.mode !== "level" || m.level === state.level));
  const around = modes.map((_, k) => modes[(at + step * (k + 1) + modes.length * modes.length) % modes.length]);
  const next = around.find((m) => m.mode !== "relevancy" || state.query);
  show(next.mode, next.level);
}

export function select(level, picked) {
  const code = picked.codes[level];
  state.picked = picked;
  state.selected = { level, codes: [code] };
  // A selection is highlighted in colour and on its level; depth and relevancy would hide it.
  if (state.mode !== "level") state.mode = "colour";
  scene.renderer.select(level, [code]);
  if (manifest.framed) tellOuter({ selected: { level, codes: [code] } });
  show(state.mode, level);
  const names = namesOf(levels, answers, level, code), size = `${sizeOfCode(scene.splats, level, code).toLocaleString("en")} splats`;
  const { one } = levels[level], asked = answers.find((a) => isSure(a) && a.level === levels[level].codes && a.codes.includes(code));
  if (asked || isClear(names)) card(asked?.text ?? names[0][0], `${one} · ${size}`, { picked, level, names });
  else card(one, names.length ? size : `${size}. ${manifest.names_note}`, { picked, level, doubt: perhaps(names) });
}

export function toggleGuessed() {
  state.guessed = !state.guessed;
  say(state.guessed ? "What no photo shows is shown as guessed." : "What no photo shows is hidden.");
  changed();
}

/// Shows the scale of the colours of depth and relevancy.
export function legend(metres) {
  const box = find(".v-legend"), { mode, query } = state;
  box.hidden = mode !== "depth" && mode !== "relevancy";
  if (box.hidden) return;
  box.className = `v-legend ${mode === "depth" || isSure(query) ? mode : "doubt"}`;
  const ends = mode === "depth" ? scene.renderer.range.map((z) => lengthText(Number(z.toPrecision(2)), metres)) : ["not at all", "exactly"];
  box.querySelectorAll("span").forEach((span, k) => { span.textContent = ends[k]; });
}
