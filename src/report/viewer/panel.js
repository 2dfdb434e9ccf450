// Panels beside the picture: one is open at a time, each with a button among the tools. A tool of a
// panel may take the taps or the drags on the picture until it is done.
import { button } from "splatvk/controls";
import { find } from "splatvk/page";

const nameOf = (element) => element.ariaLabel || element.textContent;
const panels = new Map();
let tool = null, drags = null;

/// Adds a panel: `name` is that of its button (data-do), `title` its heading, and `fill` returns the
/// elements of its content whenever it is shown. Returns {open, show, hide, toggle, refresh}.
export function addPanel({ name, title, fill, opened = () => {}, closed = () => {} }) {
  const opener = find(`[data-do=${name}]`);
  const box = Object.assign(document.createElement("section"), { className: "v-panel", id: `v-${name}`, hidden: true });
  const heading = Object.assign(document.createElement("h2"), { textContent: title, id: `v-${name}-title` });
  const content = document.createElement("div");
  box.setAttribute("aria-labelledby", heading.id);
  opener.setAttribute("aria-expanded", "false");
  opener.setAttribute("aria-controls", box.id);
  opener.hidden = false;
  const panel = {
    get open() { return !box.hidden; },
    show() {
      panels.forEach((other) => other !== panel && other.hide());
      box.hidden = false;
      opener.setAttribute("aria-expanded", "true");
      panel.refresh();
      opened();
    },
    hide() {
      if (box.hidden) return;
      if (box.contains(document.activeElement)) opener.focus();
      box.hidden = true;
      opener.setAttribute("aria-expanded", "false");
      closed();
    },
    toggle: () => (box.hidden ? panel.show() : panel.hide()),
    refresh() {
      if (box.hidden) return;
      const focused = content.contains(document.activeElement) && nameOf(document.activeElement);
      content.replaceChildren(...fill());
      if (focused) [...content.querySelectorAll("button, input, select")].find((e) => nameOf(e) === focused)?.focus();
    },
  };
  const close = button("×", panel.hide, { class: "v-close", "aria-label": `Close ${title}` });
  box.append(close, heading, content);
  box.onkeydown = (e) => {
    e.stopPropagation();
    if (e.key === "Escape") panel.hide();
  };
  // Behind the picture and before the tools, in the order of the focus, too.
  find(".v-bottom").before(box);
  panels.set(name, panel);
  return panel;
}

/// Closes the open panel; returns whether there was one.
export function hidePanels() {
  const open = [...panels.values()].filter((panel) => panel.open);
  open.forEach((panel) => panel.hide());
  return open.length > 0;
}

/// Takes the taps on the picture: `tap` gets {x, y, point, codes}, or null where nothing is.
export function takeTaps(tap) {
  tool = tap;
}

/// The tool that takes the taps, or null.
export const tapTool = () => tool;

/// Takes the drags of one finger or the left button: {from(x, y), to(x, y), end(isDone)}.
export function takeDrags(drag) {
  drags = drag;
}

/// The tool that takes the drags, or null.
export const dragTool = () => drags;
