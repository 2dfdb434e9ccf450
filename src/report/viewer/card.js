// The card of a selection or an answer, and the room that it leaves to the picture.
import { button } from "splatvk/controls";
import { find, levels, root, scene, state } from "splatvk/page";
import { size } from "splatvk/stage";
import { select } from "splatvk/show";

/// Shows the card of a selection or an answer. `names` are listed with their relevancy; `doubt` is
/// a line of what it may be.
export function card(title, note, { picked, level, names = [], doubt = "" }) {
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

export function fold() {
  const folded = find(".v-card").classList.toggle("folded");
  find(".v-fold").setAttribute("aria-expanded", String(!folded));
  makeRoom();
}

/// Middle of the splats of some codes in view, in shares of the picture without its offset; null
/// without any.
function middleOf({ level, codes }) {
  const [width, height] = size();
  let sum = [0, 0], n = 0;
  scene.splats.codes[level].forEach((code, i) => {
    if (!codes.includes(code - 1)) return;
    const [x, y, z] = scene.motion.camera.project(scene.splats.positions.subarray(3 * i, 3 * i + 3), width, height);
    if (z < scene.near || x < 0 || y < 0 || x > width || y > height) return;
    sum = [sum[0] + x / width, sum[1] + y / height];
    n++;
  });
  return n ? sum.map((v, k) => v / n - scene.motion.inset[k]) : null;
}

/// On a small screen, moves the image centre so that the card does not cover the selection.
export function makeRoom() {
  const box = find(".v-card"), chosen = state.selected ?? state.query;
  const [all, own] = [root.getBoundingClientRect(), box.getBoundingClientRect()];
  const small = all.width <= 720 || all.height < 420;
  const middle = small && chosen && own.width > 0 && !box.classList.contains("folded") && middleOf(chosen);
  const sheet = own.width > 0.8 * all.width;
  const covered = sheet ? (all.bottom - own.top) / all.height : (all.right - own.left) / all.width;
  // Along the other axis, into the middle of the picture.
  const off = ([x, y]) => [Math.min(covered, Math.max(0, x - (1 - covered) / 2)), y - Math.min(0.7, Math.max(0.3, y))];
  const [by, aside] = middle ? off(sheet ? [...middle].reverse() : middle) : [0, 0];
  scene.motion.insetTo = sheet ? [-aside, -by] : [-by, -aside];
}
