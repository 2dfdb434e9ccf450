// Input of the viewer: pointers, keys, buttons and the list of keys.

/// Milliseconds in which a second tap makes a double one, CSS pixels within which it is on the same
/// place, and movement up to which a press is a tap.
const DOUBLE = 250, SAME = 12, STEADY = 4;

/// Creates a button; attributes that are false are left out.
export function button(text, act, attributes = {}) {
  const made = Object.assign(document.createElement("button"), { type: "button", textContent: text, onclick: act });
  Object.entries(attributes).filter(([, value]) => value !== false).forEach(([name, value]) => made.setAttribute(name, value));
  return made;
}

/// Connects the input to the methods of `view`; returns {pending}: whether a tap waits for another.
export function controls(view) {
  const { root, motion } = view;
  const find = (selector) => root.querySelector(selector);
  root.querySelectorAll("[data-do]").forEach((b) => { b.onclick = () => view.actions[b.dataset.do](); });
  find(".v-modes").onkeydown = (e) => {
    const step = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 }[e.key];
    if (!step) return;
    e.preventDefault();
    e.stopPropagation();
    view.nextMode(step);
    find(".v-modes [aria-checked=true]").focus();
  };
  help(find(".v-help"));
  for (const kind of ["pointerdown", "keydown", "wheel"]) root.addEventListener(kind, () => motion.rest(), { capture: true, passive: true });
  const zoomAt = zoomer(view);
  keys(view, zoomAt);
  return pointers(view, zoomAt);
}

/// Zoom to the surface under a position of the canvas. A gesture keeps its point.
function zoomer({ motion, surface }) {
  let anchor = null;
  return (x, y, factor, keep = false) => {
    const now = performance.now();
    const same = anchor && now - anchor.at < 400 && (keep || Math.hypot(x - anchor.x, y - anchor.y) < SAME);
    if (!same) anchor = { x, y, point: surface(x, y) };
    anchor.at = now;
    motion.zoom(anchor.point, factor);
  };
}

function pointers({ root, canvas, motion, tap, tapsAtOnce, dragTool, fills }, zoomAt) {
  const down = new Map();
  let start = null, first = null, tool = null;
  const middle = () => {
    const all = [...down.values()];
    const sum = all.reduce((s, p) => [s[0] + p[0] / all.length, s[1] + p[1] / all.length], [0, 0]);
    const spread = all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0;
    return [...sum, spread];
  };
  const single = () => {
    if (!first) return;
    const { x, y, timer } = first;
    clearTimeout(timer);
    first = null;
    tap(x, y, false);
  };
  const tapped = (x, y) => {
    if (first && Math.hypot(x - first.x, y - first.y) < SAME) {
      clearTimeout(first.timer);
      first = null;
      return tap(x, y, true);
    }
    single();
    if (tapsAtOnce()) tap(x, y, false);
    else first = { x, y, timer: setTimeout(single, DOUBLE) };
  };
  canvas.addEventListener("pointerdown", (e) => {
    root.focus({ preventScroll: true });
    canvas.setPointerCapture(e.pointerId);
    down.set(e.pointerId, [e.offsetX, e.offsetY]);
    start = down.size === 1 ? [e.offsetX, e.offsetY] : null;
    // A second finger moves the camera instead.
    tool?.end(false);
    tool = start && e.button === 0 ? dragTool() : null;
    tool?.from(...start);
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!down.has(e.pointerId)) return;
    const [x0, y0, spread0] = middle();
    down.set(e.pointerId, [e.offsetX, e.offsetY]);
    const [x, y, spread] = middle();
    if (start && Math.hypot(e.offsetX - start[0], e.offsetY - start[1]) > STEADY) start = null;
    if (start) return;
    if (tool) return tool.to(x, y);
    const height = canvas.clientHeight, by = [(x - x0) / height, (y - y0) / height];
    // The right and the middle button.
    const pans = down.size > 1 || e.buttons & 6 || (e.shiftKey && !motion.walking.size);
    if (!pans) return motion.drag(...by);
    motion.pan(...by);
    if (spread0 > 0 && spread > 0) zoomAt(x, y, spread0 / spread, true);
  });
  const release = (e) => {
    down.delete(e.pointerId);
    tool?.end(e.type === "pointerup" && !start);
    tool = null;
    if (e.type === "pointerup" && start && e.button === 0) tapped(...start);
    start = null;
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  // Otherwise the middle button scrolls the page.
  canvas.addEventListener("mousedown", (e) => e.button === 1 && e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    // In a longer page the wheel scrolls until the view has been clicked.
    if (!fills() && !root.contains(document.activeElement)) return;
    e.preventDefault();
    zoomAt(e.offsetX, e.offsetY, Math.exp(Math.max(-0.3, Math.min(0.3, e.deltaY * (e.deltaMode ? 0.05 : 0.0015)))));
  }, { passive: false });
  return { pending: () => first !== null };
}

function keys(view, zoomAt) {
  const { root, canvas, motion, actions } = view;
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const zoom = (factor) => zoomAt(canvas.clientWidth / 2, canvas.clientHeight / 2, factor);
  const table = {
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
    r: actions.reset, home: actions.reset, 0: actions.all, m: () => view.nextMode(1), g: view.toggleGuessed,
    l: actions.measure, p: actions.save, v: actions.views, x: () => actions.edit?.(), delete: () => actions.erase?.(), backspace: () => actions.erase?.(), t: actions.mesh, f: actions.full, "?": actions.help, h: actions.help,
    "/": () => root.querySelector(".v-ask input").focus(), escape: view.clear,
  };
  root.addEventListener("keydown", (e) => {
    motion.fast = e.shiftKey;
    if (e.target.tagName === "INPUT") {
      if (e.key === "Escape") root.focus();
      return;
    }
    const key = e.key.toLowerCase();
    if ((e.ctrlKey || e.metaKey) && key === "z") {
      e.preventDefault();
      return e.shiftKey ? actions.redo?.() : actions.undo?.();
    }
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    if (arrows[e.key]) {
      const [x, y] = arrows[e.key];
      if (e.shiftKey) motion.pan(-0.05 * x, -0.05 * y);
      else motion.drag(-0.02 * x, -0.02 * y);
    } else if (key >= "1" && key <= "9" && motion.views[key - 1]) motion.goToView(key - 1);
    else if ("wasdqe".includes(key)) motion.walking.add(key);
    else if (key === " " && e.target === root) actions.play();
    else if (table[key]) table[key]();
    else return;
    e.preventDefault();
  });
  root.addEventListener("keyup", (e) => {
    motion.fast = e.shiftKey;
    motion.walking.delete(e.key.toLowerCase());
  });
  root.addEventListener("focusout", () => motion.walking.clear());
}

/// The list of keys, a modal dialog: the browser keeps the focus inside and gives it back.
function help(box) {
  box.querySelector(".v-close").onclick = () => box.close();
  // The list fills the dialog; a press on the dialog itself is one beside it.
  box.onclick = (e) => e.target === box && box.close();
  box.onkeydown = (e) => {
    e.stopPropagation();
    if (!["Escape", "?", "h"].includes(e.key)) return;
    e.preventDefault();
    box.close();
  };
}

/// Fills the screen, or gives it back; where the browser offers that for none but films, fills the
/// window.
export async function fullScreen(root) {
  if (document.fullscreenElement) return document.exitFullscreen();
  try {
    await root.requestFullscreen();
  } catch {
    root.classList.toggle("wide");
  }
}
