// Things of the scene as buttons on the page around the viewer, and its questions.
import { button } from "splatvk/controls";
import { isClear, namesOf } from "splatvk/names";

/// Most things in the list.
const MOST = 12;
/// Smallest and largest share of all splats: below are crumbs, above is the ground with all on it.
const LEAST = 0.002, LARGEST = 0.25;

/// Lists the largest things of a level, by name where one is clear, and connects the questions of
/// the page. `select` gets a code, `ask` a text.
export function connectPage({ splats, levels, answers }, { select, ask }) {
  document.querySelectorAll("[data-ask]").forEach((b) => { b.onclick = () => ask(b.dataset.ask); });
  const section = document.getElementById("v-things"), level = levels.findLastIndex((l) => l.colours.length);
  if (!section || level < 0) return;
  const sizes = levels[level].colours.map(() => 0);
  splats.codes[level].forEach((code) => { if (code) sizes[code - 1]++; });
  const share = (code) => sizes[code] / splats.count;
  const things = [...sizes.keys()].filter((code) => share(code) >= LEAST && share(code) <= LARGEST);
  things.sort((a, b) => sizes[b] - sizes[a]);
  let unnamed = 0;
  section.querySelector(".things").replaceChildren(...things.slice(0, MOST).map((code) => {
    const names = namesOf(levels, answers, level, code), { one, colours } = levels[level];
    const made = button("", () => select(level, code)), colour = document.createElement("i");
    colour.style.background = `rgb(${colours[code].map((v) => Math.round(255 * v)).join(" ")})`;
    made.append(colour, isClear(names) ? names[0][0] : `${one} ${++unnamed}`);
    return made;
  }));
  section.hidden = !things.length;
}
