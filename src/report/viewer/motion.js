// Movement of the camera: flights to photos, walking, turning, and the resolution of moving
// pictures.
import { Camera } from "splatvk/camera";

const SECONDS_PER_LEG = 1.6;
/// Angle by which the first view turns to both sides, radians, time of a turn, and number of turns:
/// they end with the first input or, for the battery's sake, after a minute.
const SWAY = 4 * Math.PI / 180, SWAY_SECONDS = 12, SWAYS = 5;
/// Milliseconds without a change after which the picture is drawn in full quality.
const PAUSE = 150;

/// Bounds of pixels per CSS pixel in moving pictures. Below the least, things are hard to make out;
/// above two, no difference is visible.
const LEAST = 0.35;
/// Least share of the splats in moving pictures. Those that are left are larger, so that surfaces
/// stay closed.
const FEWEST = 0.2;
export const MOST = 2;

const ease = (t) => t * t * (3 - 2 * t);
const still = matchMedia("(prefers-reduced-motion: reduce)");

export class Motion {
  /// `home` is the first camera, `views` are those of photos, `closest` is the least distance to
  /// a surface. Callbacks: `aim` sets the pivot of a camera, `moved` follows every change, `shown`
  /// gets the index of the photo in view or -1, `playing` whether a flight goes on.
  constructor({ home, views, up, closest }, { aim, moved, shown, playing }) {
    Object.assign(this, { home, views, up, closest, aim, moved, shown, playing });
    this.camera = home.copy();
    this.flight = null;
    this.walking = new Set();
    this.fast = false;
    // Offset of the image centre that keeps a selection clear of its card, and its target.
    this.inset = [0, 0];
    this.insetTo = [0, 0];
    this.swayAt = still.matches ? null : Infinity;
    this.onScreen = false;
    this.used = false;
    // Whether the first picture stands, in full quality.
    this.greeted = false;
    this.stirredAt = this.last = -1e9;
  }

  get #sways() {
    return this.swayAt !== null && this.onScreen && this.greeted;
  }

  /// Whether nobody has moved the camera yet.
  get untouched() {
    return !this.used && this.flight === null;
  }

  /// Whether the picture moves or moved just now.
  moving(now) {
    return this.flight !== null || this.walking.size > 0 || this.#sways || now - this.stirredAt < PAUSE;
  }

  /// Moves on to a time.
  step(now) {
    const seconds = (now - this.last) / 1000;
    this.last = now;
    const slides = this.#slide(seconds);
    if (this.flight) this.#fly(now);
    else if (this.walking.size) this.#walk(Math.min(seconds, 0.1));
    else if (this.#sways) this.#sway(now);
    else if (!slides) return;
    this.camera.inset = this.inset;
    this.moved();
  }

  /// Ends the sway.
  rest() {
    this.swayAt = null;
  }

  stop() {
    this.used = true;
    this.rest();
    this.flight = null;
    this.playing(false);
  }

  /// Changes the camera by hand.
  turn(change) {
    this.stop();
    this.shown(-1);
    change(this.camera);
    this.stirredAt = performance.now();
    this.moved();
  }

  /// Moves to a camera; at once with `jump`.
  goTo(to, index, jump = still.matches) {
    this.stop();
    to.inset = this.inset;
    if (jump) {
      this.camera = to;
      this.moved();
    } else this.flight = { legs: [this.camera.copy(), to], at: performance.now(), views: [index] };
    this.shown(index);
  }

  goToView(index, jump) {
    const to = Camera.of(this.views[index], this.camera.distance);
    this.aim(to);
    this.goTo(to, index, jump);
  }

  /// Turns towards a point.
  lookAt(point) {
    const to = this.camera.copy();
    to.face(point, this.up);
    this.goTo(to, -1);
  }

  /// Moves through the cameras of all photos in a loop, from the present camera; again, it stops.
  play() {
    if (this.flight || !this.views.length) return this.stop();
    this.rest();
    const stops = this.views.map((v) => Camera.of(v, this.camera.distance));
    stops.forEach(this.aim);
    this.flight = { legs: [this.camera.copy(), ...stops], at: performance.now(), views: this.views.map((_, i) => i), round: true };
    this.playing(true);
  }

  /// Turns by a drag in shares of the picture's height: about the pivot, while walking about the
  /// camera.
  drag(x, y) {
    const [yaw, pitch] = [-3 * x, -3 * y];
    this.turn((camera) => (this.walking.size ? camera.look(yaw, pitch, this.up) : camera.orbit(yaw, pitch, this.up)));
  }

  /// Moves across the picture, in shares of its height.
  pan(x, y) {
    const step = this.camera.distance / this.camera.focal;
    this.turn((camera) => camera.move(-x * step, -y * step, 0));
  }

  zoom(point, factor) {
    this.turn((camera) => camera.zoom(point, factor, this.closest));
  }

  #fly(now) {
    const { legs, at, views, round } = this.flight;
    const t = Math.max(0, now - at) / 1000 / SECONDS_PER_LEG, leg = Math.floor(t);
    if (leg < legs.length - 1) {
      this.camera = Camera.between(legs[leg], legs[leg + 1], ease(t - leg));
      this.shown(views[leg]);
    } else {
      this.camera = legs[legs.length - 1].copy();
      if (round) this.flight = { ...this.flight, legs: [this.camera.copy(), ...legs.slice(1)], at: now };
      else this.stop();
    }
  }

  #walk(seconds) {
    const step = (this.fast ? 1.8 : 0.6) * this.camera.distance * seconds;
    const has = (key) => (this.walking.has(key) ? 1 : 0);
    const by = [has("d") - has("a"), has("q") - has("e"), has("w") - has("s")].map((v) => v * step);
    this.turn((camera) => camera.move(...by));
  }

  #sway(now) {
    this.swayAt = Math.min(this.swayAt, now);
    const turns = (now - this.swayAt) / 1000 / SWAY_SECONDS;
    this.camera = this.home.copy();
    if (turns < SWAYS) this.camera.orbit(SWAY * Math.sin(2 * Math.PI * turns), 0, this.up);
    else this.rest();
  }

  /// Moves the image centre towards its target.
  #slide(seconds) {
    const left = this.insetTo.map((v, k) => v - this.inset[k]);
    if (!left[0] && !left[1]) return false;
    const near = still.matches || Math.hypot(...left) < 0.002;
    this.inset = near ? this.insetTo : this.inset.map((v, k) => v + left[k] * (1 - Math.exp(-12 * seconds)));
    this.stirredAt = this.last;
    return true;
  }
}

/// Chooses the quality of moving pictures by the time that frames take: first fewer pixels, then
/// fewer splats.
export class Pace {
  constructor() {
    // Pixels per CSS pixel, whether to save what can be saved, the share of splats, and the slow
    // frames in a row.
    this.density = 1;
    this.lean = false;
    this.share = 1;
    this.slow = 0;
  }

  /// Begins by the time of a picture in full quality, milliseconds: half of it is left without
  /// harmonics, and the pixels are not all of the rest.
  expect(time) {
    if (time < 100) return;
    this.lean = true;
    this.density = Math.max(LEAST, Math.min(1, Math.sqrt(80 / time)));
    if (this.density === LEAST) this.share = Math.max(FEWEST, Math.min(1, 600 / time));
  }

  /// Notes the time of a moving frame, milliseconds. Within 25 and 50, nothing changes.
  note(time) {
    this.slow = time > 50 ? this.slow + 1 : 0;
    // One frame of 100 ms may be the page's own work; three, or one of 200, are the pixels.
    if (time > 200 || this.slow >= 3) this.lean = true;
    if (time > 50 && this.density === LEAST) this.share = Math.max(FEWEST, this.share * Math.max(0.5, 50 / time));
    else if (time > 50) this.density = Math.max(LEAST, this.density * Math.max(0.5, Math.sqrt(40 / time)));
    else if (time < 25 && this.share < 1) this.share = Math.min(1, this.share * 1.2);
    else if (time < 25) this.density = Math.min(MOST, this.density * 1.1);
    if (time < 25 && this.density >= 1) this.lean = false;
  }
}
