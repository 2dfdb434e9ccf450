// Tape measure between two points of the scene.
import { sub } from "splatvk/camera";

const ENDS = ["A", "B"];

/// Rounds to four digits, the accuracy of a click.
const short = (value) => Number(value.toPrecision(4));

/// Formats a length with its unit.
export function lengthText(units, metres) {
  if (!metres) return `${short(units)} units`;
  const m = units * metres;
  if (m < 0.01) return `${short(1000 * m)} mm`;
  return m < 1 ? `${short(100 * m)} cm` : `${short(m)} m`;
}

export class Tape {
  /// `box` holds the length (output), the true length (input) and a button to copy; `drawing` is
  /// the svg. `metres` is the length of the scene unit, if it is known.
  constructor(box, drawing, metres, say) {
    Object.assign(this, { box, drawing, metres, points: [], active: false });
    this.input = box.querySelector("input");
    this.input.oninput = () => this.#updateScale();
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
    const is = Number(this.input.value) > 0 ? this.input.value : "METRES";
    return `--scale "${this.points.map(place).join(" - ")} = ${is}"`;
  }

  /// Sets the scale from a true length, so that other lengths are shown in metres.
  #updateScale() {
    const metres = Number(this.input.value);
    if (metres > 0 && this.units > 0) this.metres = metres / this.units;
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
