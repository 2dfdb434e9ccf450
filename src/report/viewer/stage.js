// Drawing of the scene: order of the splats, frames in motion and at rest, pictures, and the
// surface at a position.
import { Camera, dot, sub } from "splatvk/camera";
import { MOST, Pace } from "splatvk/motion";
import { pick } from "splatvk/pick";
import { Renderer } from "splatvk/render";
import { canvas, levels, manifest, root, scene, state, views } from "splatvk/page";
import { extentOf } from "splatvk/splats";

const STALE = 0, ROUGH = 1, SHARP = 2;
/// Milliseconds after the first picture in which its time shows as a late frame.
const GREETING = 250;
let worker, next = null, request = 0, sortedFor = -1, waiting = false, drawn = STALE, capturing = false;
/// Camera of the last requested order, and the share of the splats in the shown one.
let asked = null, sortedShare = 1;
let last = 0, slowest = 0, wasRough = false, greetedAt = 0;
/// Turn (cosine) and move, in distances to the pivot, from which a moving picture needs another
/// order.
const TURN = Math.cos(2 * Math.PI / 180), MOVE = 0.02;
const idle = [], pace = new Pace(), overlays = [];
/// Whether something waits to be drawn before the picture counts as settled.
let pending = () => false;

/// Adds a function that draws over each new picture: (camera, width, height in CSS
/// pixels, whether it is in full quality).
export function overlay(drawOver) {
  overlays.push(drawOver);
}

/// Begins with the splats of the scene; they appear once they are sorted.
export function begin(splats) {
  scene.splats = splats;
  scene.extent = extentOf(splats);
  scene.renderer = new Renderer(canvas, splats, levels, Boolean(manifest.mesh));
  const source = JSON.parse(document.querySelector("script[type=importmap]").textContent).imports["splatvk/sort"];
  worker = new Worker(source);
  worker.onmessage = ({ data }) => sorted(data);
  send(splats);
}

/// Draws from now on; `busy` says whether a tap waits for another.
export function start(busy) {
  pending = busy;
  moved();
  requestAnimationFrame(frame);
}

/// Shows other splats of the same scene from the present camera; resolves once they are sorted and
/// in `scene`.
export function replace(splats) {
  const shown = new Promise((done) => {
    next = { splats, renderer: new Renderer(canvas, splats, levels, Boolean(manifest.mesh)), after: request, done };
  });
  send(splats);
  moved();
  return shown;
}

function send({ positions, marks }) {
  worker.postMessage({ positions: positions.slice(), marks: marks.slice() });
}

/// Shows changed marks of the splats.
export function remark() {
  scene.renderer.mark(scene.splats.marks);
  worker.postMessage({ marks: scene.splats.marks.slice() });
  moved();
}

/// Takes a sorted order; one requested before `scene.splats` changed belongs to the old ones.
function sorted(data) {
  waiting = false;
  if (next && data.id > next.after) {
    scene.renderer.free();
    const { splats, renderer, done } = next;
    Object.assign(scene, { splats, renderer, extent: extentOf(splats) });
    next = null;
    done();
  }
  if (!next) {
    scene.renderer.setOrder(data);
    sortedFor = data.id;
    sortedShare = data.share;
    drawn = STALE;
  }
  if (next || request !== sortedFor) sort();
}

/// Size of the picture in CSS pixels, or of one that is captured.
export const size = () => (capturing ? [canvas.width, canvas.height] : [canvas.clientWidth, canvas.clientHeight]);

function fit(width, height) {
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
}

/// Requests an order: in motion only where the last one no longer fits, since sorting takes the time
/// of drawing on small machines.
function sort() {
  const moving = scene.motion.moving(performance.now());
  if (waiting || moving && !next && isNear(asked, scene.motion.camera)) return;
  waiting = true;
  asked = scene.motion.camera.copy();
  const share = moving ? pace.share : 1;
  const { camera } = scene.motion, [width, height] = size(), [fx, fy, cx, cy] = camera.intrinsics(width, height);
  // Half an image more on every side, since splats reach beyond their centre.
  const slope = [(Math.max(cx, width - cx) + width / 2) / fx, (Math.max(cy, height - cy) + height / 2) / fy];
  worker.postMessage({ id: request, rotation: camera.rotation, translation: camera.translation, near: scene.near, slope, share });
}

/// Whether the order for one camera fits another.
function isNear(a, b) {
  if (!a) return false;
  const along = dot(a.rotation.slice(6), b.rotation.slice(6)), moved = Math.hypot(...sub(a.position, b.position));
  return along > TURN && moved < MOVE * b.distance;
}

/// Redraws after a change of the camera or of the size of the picture.
export function moved() {
  request++;
  drawn = STALE;
  sort();
}

export function changed() {
  drawn = STALE;
}

/// Whether what no photo shows is in the picture.
const showsGuessed = () => state.guessed || state.mode !== "colour";

export function draw(camera, lean = false) {
  const { mode, level, selected } = state;
  scene.renderer.draw(camera, { mode, level, selecting: selected !== null, near: scene.near, guessed: showsGuessed() ? 1 : 0, lean });
}

function frame(now) {
  requestAnimationFrame(frame);
  if (capturing) return;
  scene.motion.step(now);
  // A frame that takes long delays one of the next calls, not always the very next.
  slowest = Math.max(slowest, now - last);
  last = now;
  const rough = scene.motion.moving(now);
  if (greetedAt && !scene.motion.greeted && now - greetedAt > GREETING) {
    scene.motion.greeted = true;
    pace.expect(slowest);
  }
  const isOrdered = request === sortedFor && sortedShare === 1;
  if (!rough && !isOrdered) sort();
  if (rough ? drawn === STALE : drawn !== SHARP && isOrdered) {
    if (rough && wasRough) pace.note(slowest);
    slowest = 0;
    // Where frames are slow, a sharp picture is the better greeting.
    if (pace.lean) scene.motion.rest();
    const most = Math.min(devicePixelRatio || 1, MOST), density = rough ? Math.min(most, pace.density) : most;
    fit(...size().map((v) => Math.max(1, Math.round(v * density))));
    draw(scene.motion.camera, rough && pace.lean);
    overlays.forEach((drawOver) => drawOver(scene.motion.camera, ...size(), !rough));
    drawn = rough ? ROUGH : SHARP;
    wasRough = rough;
    // Blurred glass over a moving picture is slow to draw, too.
    root.classList.toggle("plain", rough && pace.lean);
    if (!rough) greetedAt ||= now;
  }
  if (drawn === SHARP && !rough && !pending()) idle.splice(0).forEach((tell) => tell());
}

/// Resolves when the picture shows the current state in full quality, splats in their final order.
export function settled() {
  scene.motion.rest();
  return new Promise((tell) => idle.push(tell));
}

/// Returns the picture as a PNG blob; with the index of a photo, from its camera at its size.
export async function picture(view) {
  await settled();
  const before = scene.motion.camera;
  capturing = true;
  try {
    if (view !== undefined) {
      scene.motion.camera = Camera.of(views[view], 1);
      fit(views[view].width, views[view].height);
      moved();
      while (request !== sortedFor) await new Promise((go) => setTimeout(go, 5));
    }
    draw(scene.motion.camera);
    overlays.forEach((drawOver) => drawOver(scene.motion.camera, ...size(), true));
    return await new Promise((done) => canvas.toBlob(done));
  } finally {
    capturing = false;
    scene.motion.camera = before;
    moved();
  }
}

/// Depth and codes at a position of the canvas, CSS pixels.
export function hitAt(x, y) {
  return pick(scene.splats, scene.motion.camera, x, y, ...size(), scene.near, state.mode === "unseen");
}

export const placeAt = (x, y, depth) => scene.motion.camera.unproject(x, y, depth, ...size());

/// Whether a point at a position and depth is in front of all surfaces, or on one.
export function seenAt(x, y, depth) {
  const hit = hitAt(x, y);
  return !hit || depth < 1.05 * hit.depth;
}

/// The point of the scene at a position; where nothing is, one at the distance of the pivot.
export function surface(x, y) {
  return placeAt(x, y, hitAt(x, y)?.depth ?? Math.max(scene.motion.camera.distance, 2 * scene.motion.closest));
}

/// Sets the pivot of a camera to the surface in the middle of its image.
export function aimAt(which) {
  const hit = pick(scene.splats, which, 320, 240, 640, 480, scene.near, false);
  if (hit) which.distance = hit.depth;
}

/// Restores the graphics context, which phones take from pages in the background; `again` marks
/// what was marked in the lost one.
export function keepContext(again) {
  canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    scene.renderer = new Renderer(canvas, scene.splats, levels, Boolean(manifest.mesh));
    again();
    moved();
  });
}
