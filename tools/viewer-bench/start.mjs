// The camera of the first photo: node start.mjs TRANSFORMS FOLDER writes camera.json for bench.mjs, and views.json with it as the
// view at the start.
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";

const [transforms, folder] = process.argv.slice(2);
const { frames, ...shared } = JSON.parse(readFileSync(transforms, "utf8"));
const m = frames[0].transform_matrix, { w, h, fl_y } = { ...shared, ...frames[0] };
// The file has OpenGL cameras: right, up, backwards.
const [right, up, back, at] = [0, 1, 2, 3].map((k) => m.slice(0, 3).map((row) => row[k]));
const to = at.map((v, k) => v - back[k]), rows = [right, up.map((v) => -v), back.map((v) => -v)];

/// Quaternion (w, x, y, z) of a rotation by its rows (Shepperd).
function quaternion([[a, b, c], [d, e, f], [g, i, j]]) {
  const all = [1 + a + e + j, 1 + a - e - j, 1 - a + e - j, 1 - a - e + j], k = all.indexOf(Math.max(...all)), s = 2 * Math.sqrt(all[k]);
  const off = [[s * s / 4, i - f, c - g, d - b], [i - f, s * s / 4, b + d, c + g], [c - g, b + d, s * s / 4, f + i], [d - b, c + g, f + i, s * s / 4]];
  return off[k].map((v) => v / s);
}

writeFileSync(join(folder, "camera.json"), JSON.stringify({ at, to, fov: 2 * Math.atan(h / (2 * fl_y)) * 180 / Math.PI }));
const view = { name: "Start", position: at, rotation: quaternion(rows), focal: fl_y / h, ratio: w / h, shift: [0, 0], distance: 1 };
writeFileSync(join(folder, "views.json"), JSON.stringify({ format: "splatvk-views", version: 1, start: "Start", views: [view], notes: [] }));
