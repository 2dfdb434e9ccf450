// Parameters of the page's address, for links and frames: docs/use/viewer.md.
import { find, levels, manifest, root, say, state } from "splatvk/page";

const given = new URLSearchParams(location.search);

/// Names of kinds of picture in the address, by mode and level.
const kinds = new Map([["colour", ["colour"]], ["depth", ["depth"]], ["relevancy", ["relevancy"]], ["guessed", ["unseen"]],
  ...levels.map((l, at) => [l.title.toLowerCase(), ["level", at]])]);

const isOff = (name) => ["0", "no", "false", "off"].includes(given.get(name));

/// State that holds before the first picture: hidden controls, guesses and notes.
export function early({ showNotes }) {
  root.classList.toggle("bare", isOff("ui"));
  if (isOff("guessed")) state.guessed = false;
  if (isOff("notes")) showNotes(false);
}

/// Camera of the address: a named view, or a photo by its name or number; null without.
export function cameraOf({ namedCamera, photoCamera }) {
  const name = given.get("view");
  if (!name) return null;
  const camera = namedCamera(name) ?? photoCamera(name);
  if (!camera) say(`No view and no photo is called “${name}”.`);
  return camera;
}

/// The question and the kind of picture of the address, and a flight.
export async function late({ ask, show, modes, play }) {
  const kind = given.get("show"), [mode, level] = kinds.get(kind?.toLowerCase()) ?? [];
  const text = given.get("query");
  const reason = manifest.ask_note || "this page answers no questions; splatvk view SCENE does.";
  if (text && find(".v-ask").hidden) say(`“${text}”: ${reason}`, true);
  else if (text) await ask(text);
  if (kind && !modes.some((m) => m.mode === mode && m.level === level)) say(`No kind of picture is called “${kind}” here.`);
  else if (kind) show(mode, level);
  if (given.get("fly") === "1") play();
}
