// The first camera: level, and with the main things in the frame.
import { Camera, add, cross, rotate, scale, sub, unit } from "splatvk/camera";
import { find, levels, scene, views } from "splatvk/page";
import { MARKS } from "splatvk/splats";

/// Shares of the splats of a thing of its own: below are crumbs, above is the ground with all on it.
const CRUMB = 0.002, GROUND = 0.25;
/// Margin around the things, as a share of the picture.
const MARGIN = 0.03;
/// How far the photo is reduced for the things: 0 fills the picture, 1 shows it whole, above 1 also
/// what is beside it.
const LEAST = 1.3;
/// Angle from which a scene without photos is seen from above, radians.
const PITCH = Math.PI / 9;

/// First camera: the photo nearest to the middle of all, without roll; for a scene without photos
/// from outside, a little from above.
export function firstCamera(photos, extent, up) {
  if (!photos.length) return outside(extent, up);
  const all = photos.map((v) => Camera.of(v, 1));
  const middle = [0, 1, 2].map((k) => all.reduce((sum, c) => sum + c.position[k], 0) / all.length);
  const off = (c) => Math.hypot(...sub(c.position, middle));
  const camera = all.reduce((a, b) => (off(b) < off(a) ? b : a));
  camera.cover = 1;
  camera.straighten(up);
  return camera;
}

function outside({ centre, radius }, up) {
  // The axis nearest to +z that is level, since files of Gaussians are seen along +z.
  const level = sub([0, 0, 1], scale(up, up[2]));
  const ahead = Math.hypot(...level) > 0.1 ? unit(level) : unit(cross(up, [1, 0, 0]));
  const forward = unit(add(scale(ahead, Math.cos(PITCH)), scale(up, -Math.sin(PITCH))));
  const right = unit(cross(forward, up));
  const camera = new Camera({ rotation: [...right, ...cross(forward, right), ...forward], position: [0, 0, 0], focal: 1.2 });
  camera.frame(centre, radius);
  return camera;
}

/// Sets how much of the photo a camera of [`firstCamera`] shows in a picture of this size, and where
/// in it: as near as the main things fit into it between the controls.
export function frameStart(camera, width, height) {
  if (!views.length || !width || !height) return;
  // In units of the height of the photo, about its middle.
  scene.subject ??= subjectOf(scene.splats, camera);
  const { box, least } = scene.subject;
  if (!box) return;
  // On a low picture the controls would leave no room.
  const bars = height > 420 ? [".v-top", ".v-bottom"].map((bar) => barOf(find(bar))) : [0, 0], free = [width, height - bars[0] - bars[1]];
  const heights = [height, width / camera.ratio], [whole, filled] = [Math.min(...heights), Math.max(...heights)];
  const room = [0, 1].map((k) => free[k] * (1 - 2 * MARGIN) / (box[1][k] - box[0][k]));
  const unitLength = Math.min(Math.max(Math.min(...room), Math.max(0.8 * whole, least * whole + (1 - least) * filled)), filled);
  camera.cover = filled > 1.001 * whole ? Math.log(unitLength / whole) / Math.log(filled / whole) : 0;
  // Into the middle of the free part, but no edge of the photo into a picture that it fills.
  camera.shift = [0, 1].map((k) => {
    const to = (k ? (bars[0] - bars[1]) / 2 : 0) / unitLength - (box[0][k] + box[1][k]) / 2;
    const spare = ((k ? 1 : camera.ratio) - (k ? height : width) / unitLength) / 2;
    return spare > 0 ? Math.min(spare, Math.max(-spare, to)) : to;
  });
}

/// Height that a row of controls covers.
const barOf = ({ offsetHeight }) => (offsetHeight ? offsetHeight + 16 : 0);

/// Box of the main things in a camera, and how far the photo is reduced for it: of those that its
/// photo shows whole; where language knows none, of the splats within half of the photos, without a
/// tenth at every side.
function subjectOf({ count, codes, positions, marks }, camera) {
  const inside = (p) => views.filter((v) => {
    const [x, y, z] = add(rotate(v.rotation, p), v.translation);
    const [u, w] = [v.fx * x / z + v.cx, v.fy * y / z + v.cy];
    return z > 0 && u > 0 && w > 0 && u < v.width && w < v.height;
  }).length;
  const seen = [];
  for (let i = 0; i < count; i++) {
    if (!(marks[i] & (MARKS.unseen | MARKS.hole)) && inside(positions.subarray(3 * i, 3 * i + 3)) >= 0.5 * views.length) seen.push(i);
  }
  const things = thingsOf(seen, codes[levels.findLastIndex((l) => l.colours.length)]);
  const edges = [0.55 * camera.ratio, 0.55];
  const boxes = things.map((list) => boxOf(list, camera, 0.01)).filter((box) => box && edges.every((edge, k) => box[0][k] > -edge && box[1][k] < edge));
  // Without things the photo itself counts: beside it is less to see.
  if (!boxes.length) return { box: boxOf(seen, camera, 0.1), least: 0.5 };
  const over = (all, box) => [0, 1].map((end) => [0, 1].map((k) => (end ? Math.max : Math.min)(all[end][k], box[end][k])));
  return { box: boxes.reduce(over), least: LEAST };
}

/// Splats of each thing of its own; none without codes.
function thingsOf(list, codes) {
  if (!codes) return [];
  const things = new Map();
  for (const i of list) {
    if (!codes[i] || scene.splats.marks[i] & MARKS.surface) continue;
    if (!things.has(codes[i])) things.set(codes[i], []);
    things.get(codes[i]).push(i);
  }
  return [...things.values()].filter((own) => own.length > CRUMB * codes.length && own.length < GROUND * codes.length);
}

/// Least and largest (x, y) of splats in a camera, in units of the height of its photo, about the
/// principal point; without a share of the outermost at every side.
function boxOf(list, camera, away) {
  const places = [];
  for (const i of list) {
    const [x, y, z] = rotate(camera.rotation, sub(scene.splats.positions.subarray(3 * i, 3 * i + 3), camera.position));
    if (z > 0) places.push([camera.focal * camera.aspect * x / z, camera.focal * y / z]);
  }
  if (places.length < 10) return null;
  const [x, y] = [0, 1].map((k) => {
    const sorted = Float32Array.from(places, (p) => p[k]).sort(), at = Math.floor(away * sorted.length);
    return [sorted[at], sorted[sorted.length - 1 - at]];
  });
  return x[1] > x[0] && y[1] > y[0] ? [[x[0], y[0]], [x[1], y[1]]] : null;
}
