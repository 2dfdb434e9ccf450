// Tape measure between two points of the scene.
import { sub } from "splatvk/camera";

const ENDS = ["A", "B"];

/// Formats a length with its unit; a click is accurate to four digits.
export function lengthText(units, metres, digits = 4) {
  const short = (value) => Number(value.toPrecision(digits));
  if (!metres) return `${short(units)} units`;
  const m = units * metres;
  if (m < 0.01) return `${short(1000 * m)} mm`;
  return m < 1 ? `${short(100 * m)} cm` : `${short(m)} m`;
}

/// Metres per unit of length that people write; a plain number is in metres.
const METRES = { "": 1, mm: 0.001, cm: 0.01, dm: 0.1, m: 1, km: 1000, in: 0.0254, '"': 0.0254, ft: 0.3048, "'": 0.3048 };

/// Metres of a text such as 0.2, 0,2 m, 20 cm or 8 in; null if it is no length.
export function parseLength(text) {
  const parts = /^\s*(\d+(?:[.,]\d*)?|[.,]\d+)\s*([a-z"']*)\s*$/i.exec(text);
  const metres = parts && Number(parts[1].replace(",", ".")) * METRES[parts[2].toLowerCase()];
  return metres > 0 ? metres : null;
}

export class Tape {
  /// `box` holds the length (output), the true length (input) and a button to copy; `drawing` is
  /// the svg. `metres` is the length of the scene unit, if it is known.
  constructor(box, drawing, metres, say) {
    Object.assign(this, { box, drawing, metres, points: [], active: false });
    this.input = box.querySelector("input");
    this.input.oninput = () => this.#updateScale();
    this.input.onchange = () => {
      const text = this.input.value;
      if (text && !parseLength(text)) say(`“${text}” is not a length. Write it like 0.2, 20 cm, 200 mm or 8 in.`);
    };
    box.querySelector("button").onclick = async () => {
      try {
        await navigator.clipboard.writeText(this.stated());
        say("Copied: give it to splatvk measure.");
      } catch {
        say(this.stated());
      }
    };
  }

  /// Starts or ends measuring.
  toggle(on = !this.active) {
    this.active = on;
    this.points = [];
    this.#show();
  }

  /// Adds an end point; after two, begins another length.
  place(point) {
    if (this.points.length === 2) this.points = [];
    this.points.push(point);
    this.input.value = "";
    this.#show();
  }

  /// Length in scene units; null without two end points.
  get units() {
    return this.points.length === 2 ? Math.hypot(...sub(this.points[1], this.points[0])) : null;
  }

  /// Option text for `splatvk measure`.
  stated() {
    const place = (p) => p.map((v) => Number(v.toFixed(5))).join(",");
    const metres = parseLength(this.input.value), is = metres ? Number(metres.toPrecision(6)) : "METRES";
    return `--scale "${this.points.map(place).join(" - ")} = ${is}"`;
  }

  /// Sets the scale from a true length, so that other lengths are shown in metres.
  #updateScale() {
    const metres = parseLength(this.input.value);
    if (metres && this.units > 0) this.metres = metres / this.units;
    this.#show();
  }

  #show() {
    this.box.hidden = !this.active;
    this.drawing.toggleAttribute("hidden", !this.active);
    const units = this.units;
    this.box.querySelector("output").textContent = units === null ? `Click ${ENDS[this.points.length]}` : lengthText(units, this.metres);
    this.box.querySelectorAll("label, button").forEach((e) => { e.hidden = units === null; });
  }

  /// Draws the tape from a camera; `width` and `height` in CSS pixels.
  draw(camera, width, height, near) {
    if (!this.active) return;
    const seen = this.points.map((p) => camera.project(p, width, height)).filter((p) => p[2] > near);
    const node = (name, attributes, text = "") => {
      const made = document.createElementNS("http://www.w3.org/2000/svg", name);
      Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
      made.textContent = text;
      return made;
    };
    const marks = seen.flatMap(([x, y], i) => [node("circle", { cx: x, cy: y, r: 5 }), node("text", { x: x + 9, y: y - 7 }, ENDS[i])]);
    const line = seen.length < 2 ? [] : [node("line", { x1: seen[0][0], y1: seen[0][1], x2: seen[1][0], y2: seen[1][1] })];
    this.drawing.replaceChildren(...line, ...marks);
  }
}
