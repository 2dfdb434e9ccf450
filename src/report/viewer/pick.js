// Depth and codes at one pixel, by blending its splats on the CPU exactly as on the screen.
import { rotate } from "splatvk/camera";
import { MARKS } from "splatvk/splats";

const DILATION = 0.3, ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.99, VOID_ALPHA = 0.5;

/// Returns {depth, codes: [L] code or -1} at a pixel position, or null where alpha is below one
/// half. Without `guessed`, what no photo shows is left out.
export function pick(splats, camera, x, y, width, height, near, guessed) {
  const [fx, fy, cx, cy] = camera.intrinsics(width, height);
  const r = camera.rotation, t = camera.translation;
  const { positions, logScales, quats, opacity, marks, antialiased } = splats;
  const left = MARKS.hole | MARKS.hidden | (guessed ? 0 : MARKS.unseen);
  const hits = [];
  // As in the projection, the Jacobian is evaluated at most 15 % of the image beyond its border.
  const limits = [[-(cx + 0.15 * width) / fx, (1.15 * width - cx) / fx], [-(cy + 0.15 * height) / fy, (1.15 * height - cy) / fy]];
  const limit = (slope, [low, high]) => Math.min(Math.max(slope, low), high);
  for (let i = 0; i < splats.count; i++) {
    if (marks[i] & left) continue;
    const p = [positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]];
    const z = r[6] * p[0] + r[7] * p[1] + r[8] * p[2] + t[2];
    if (!(z > near)) continue;
    const u = (r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + t[0]) / z, v = (r[3] * p[0] + r[4] * p[1] + r[5] * p[2] + t[1]) / z;
    const dx = fx * u + cx - x, dy = fy * v + cy - y;
    const lu = limit(u, limits[0]), lv = limit(v, limits[1]);
    // Beyond 3.4 standard deviations even an opaque splat is below 1/255; off-axis splats project
    // up to (1 + u² + v²) larger.
    const s = Math.exp(Math.max(logScales[3 * i], logScales[3 * i + 1], logScales[3 * i + 2]));
    const reach = 3.4 * Math.sqrt((Math.max(fx, fy) * s / z) ** 2 * (1 + lu * lu + lv * lv) + DILATION);
    if (dx * dx + dy * dy > reach * reach) continue;
    const alpha = alphaAt(i, dx, dy, lu, lv, z, fx, fy, r, logScales, quats, opacity, antialiased);
    if (alpha >= ALPHA_MIN) hits.push([z, alpha, i]);
  }
  hits.sort((a, b) => a[0] - b[0]);
  const weights = splats.codes.map(() => new Map());
  let light = 1, depth = 0;
  for (const [z, alpha, i] of hits) {
    const weight = light * alpha;
    depth += weight * z;
    splats.codes.forEach((codes, l) => weights[l].set(codes[i], (weights[l].get(codes[i]) || 0) + weight));
    light -= weight;
    if (light < 1e-4) break;
  }
  if (1 - light < VOID_ALPHA) return null;
  const heaviest = (sums) => [...sums].reduce((a, b) => (b[1] > a[1] ? b : a), [0, 0])[0] - 1;
  return { depth: depth / (1 - light), codes: weights.map(heaviest) };
}

function alphaAt(i, dx, dy, u, v, z, fx, fy, r, logScales, quats, opacity, antialiased) {
  const [w, a, b, c] = quats.subarray(4 * i, 4 * i + 4);
  // Axes of the splat in the world.
  const axes = [
    [1 - 2 * (b * b + c * c), 2 * (a * b + w * c), 2 * (a * c - w * b)],
    [2 * (a * b - w * c), 1 - 2 * (a * a + c * c), 2 * (b * c + w * a)],
    [2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)],
  ];
  let xx = DILATION, xy = 0, yy = DILATION;
  for (let k = 0; k < 3; k++) {
    const s = Math.exp(logScales[3 * i + k]);
    const q = rotate(r, axes[k]);
    const jx = s * fx / z * (q[0] - u * q[2]), jy = s * fy / z * (q[1] - v * q[2]);
    xx += jx * jx;
    xy += jx * jy;
    yy += jy * jy;
  }
  const det = xx * yy - xy * xy;
  const undilated = (xx - DILATION) * (yy - DILATION) - xy * xy;
  const own = antialiased ? opacity[i] * Math.sqrt(Math.max(undilated, 0) / det) : opacity[i];
  const power = -0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det;
  return Math.min(ALPHA_MAX, own * Math.exp(power));
}

/// Number of splats of a code.
export const sizeOfCode = (splats, level, code) => splats.codes[level].reduce((n, c) => n + (c === code + 1), 0);

/// Level that a click on a pixel with these codes selects: that of things, or the coarsest mask
/// where there is none.
export const wholeOf = (codes) => codes.findLastIndex((code) => code >= 0);
