// State that the modules of the page share: data, elements, and the scene once it is loaded.
import { upOf } from "splatvk/camera";

export const manifest = JSON.parse(document.getElementById("v-manifest").textContent);
export const root = document.querySelector(".viewer");
export const find = (selector) => root.querySelector(selector);
export const canvas = find("canvas");
export const { views, levels } = manifest;
export const up = manifest.up || upOf(views);

export const state = { mode: "colour", level: levels.findLastIndex((l) => l.colours.length), selected: null, picked: null, query: null, guessed: true };

/// The loaded scene: splats, their extent, renderer, motion, and near, the least drawn depth.
export const scene = { near: 0.01 };

let saying;
/// Shows a line at the bottom for six seconds, or until the next one.
export function say(text, stays = false) {
  const box = find(".v-status");
  clearTimeout(saying);
  box.textContent = text;
  box.hidden = !text;
  if (text && !stays) saying = setTimeout(() => { box.hidden = true; }, 6000);
}
