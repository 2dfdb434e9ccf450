// Cameras and their linear algebra. Conventions: OpenCV axes (+x right, +y down, +z forward), pixel
// (0, 0) covers [0, 1) x [0, 1), quaternions (w, x, y, z), rotations world -> camera, row-major.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => scale(a, 1 / (Math.hypot(...a) || 1));
const mix = (a, b, t) => a.map((v, i) => v + (b[i] - v) * t);

/// R v, with a row-major 3 x 3 matrix: world axes to camera axes.
export const rotate = (r, v) => [0, 3, 6].map((k) => r[k] * v[0] + r[k + 1] * v[1] + r[k + 2] * v[2]);
/// Rᵀ v: camera axes to world axes.
export const unrotate = (r, v) => [0, 1, 2].map((k) => r[k] * v[0] + r[k + 3] * v[1] + r[k + 6] * v[2]);
const multiply = (a, b) => [0, 3, 6].flatMap((i) => [0, 1, 2].map((j) => a[i] * b[j] + a[i + 1] * b[j + 3] + a[i + 2] * b[j + 6]));
const transpose = (r) => [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]];

/// Rotation by an angle about a unit axis (Rodrigues).
function about([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
  return [c + x * x * d, x * y * d - z * s, x * z * d + y * s,
    y * x * d + z * s, c + y * y * d, y * z * d - x * s,
    z * x * d - y * s, z * y * d + x * s, c + z * z * d];
}

export function toQuaternion(r) {
  const [xx, yy, zz] = [r[0], r[4], r[8]];
  const q = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz];
  const k = q.indexOf(Math.max(...q));
  const s = Math.sqrt(q[k]);
  const [a, b, c] = [r[7] - r[5], r[2] - r[6], r[3] - r[1]];
  const [d, e, f] = [r[1] + r[3], r[2] + r[6], r[5] + r[7]];
  const rows = [[q[0], a, b, c], [a, q[1], d, e], [b, d, q[2], f], [c, e, f, q[3]]];
  return rows[k].map((v) => v / (2 * s));
}

export function fromQuaternion([w, x, y, z]) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

const normalised = (q) => q.map((v) => v / Math.hypot(...q));

function slerp(a, b, t) {
  let c = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const to = c < 0 ? b.map((v) => -v) : b;
  c = Math.min(Math.abs(c), 1);
  const angle = Math.acos(c);
  // Below a hundredth of a radian the chord is the arc to 1e-5.
  const [p, q] = angle < 0.01 ? [1 - t, t] : [Math.sin((1 - t) * angle) / Math.sin(angle), Math.sin(t * angle) / Math.sin(angle)];
  return normalised(a.map((v, i) => p * v + q * to[i]));
}

/// Movable camera. `focal` and `shift`, the offset of the principal point from the image centre,
/// are in units of the image height; `distance` is the distance to the pivot. With `cover` 0 the
/// picture includes the whole photo, with 1 the photo fills the picture; `inset` moves the image
/// centre, in shares of width and height.
export class Camera {
  constructor({ rotation, position, focal, shift = [0, 0], ratio = 4 / 3, aspect = 1, distance = 1, cover = 0, inset = [0, 0] }) {
    Object.assign(this, { rotation, position, focal, shift, ratio, aspect, distance, cover, inset });
  }

  /// Camera of a photo.
  static of(view, distance) {
    return new Camera({
      rotation: view.rotation,
      position: scale(unrotate(view.rotation, view.translation), -1),
      focal: view.fy / view.height,
      aspect: view.fx / view.fy,
      shift: [(view.cx - view.width / 2) / view.height, (view.cy - view.height / 2) / view.height],
      ratio: view.width / view.height,
      distance,
    });
  }

  copy() {
    return new Camera(this);
  }

  get translation() {
    return scale(rotate(this.rotation, this.position), -1);
  }

  /// Centre of rotation in world coordinates.
  get pivot() {
    return add(this.position, scale(this.rotation.slice(6), this.distance));
  }

  /// fx, fy, cx, cy for an image of this size.
  intrinsics(width, height) {
    const heights = [height, width / this.ratio];
    const unitLength = Math.min(...heights) ** (1 - this.cover) * Math.max(...heights) ** this.cover;
    const fy = this.focal * unitLength, [x, y] = [0.5 + this.inset[0], 0.5 + this.inset[1]];
    return [fy * this.aspect, fy, width * x + this.shift[0] * unitLength, height * y + this.shift[1] * unitLength];
  }

  /// Rotates about the pivot, as [`look`].
  orbit(yaw, pitch, up) {
    const pivot = this.pivot;
    this.look(yaw, pitch, up);
    this.position = sub(pivot, scale(this.rotation.slice(6), this.distance));
  }

  /// Rotates about the camera: `yaw` about the world's up, `pitch` about the horizontal camera
  /// axis, radians.
  look(yaw, pitch, up) {
    const forward = this.rotation.slice(6), right = this.rotation.slice(0, 3);
    // Stays 5 degrees off the vertical, where left and right would swap.
    const height = Math.asin(Math.max(-1, Math.min(1, dot(forward, up))));
    const most = Math.PI / 2 - 0.09;
    const tilt = Math.max(-most - height, Math.min(most - height, pitch));
    const turn = multiply(about(up, yaw), about(right, tilt));
    // Normalised as a quaternion, so that many small rotations stay a rotation.
    this.rotation = fromQuaternion(normalised(toQuaternion(multiply(this.rotation, transpose(turn)))));
  }

  /// Removes the roll. A camera that looks along the vertical has none.
  straighten(up) {
    const forward = this.rotation.slice(6);
    if (Math.abs(dot(forward, up)) > 0.95) return;
    const right = unit(cross(forward, up));
    this.rotation = [...right, ...cross(forward, right), ...forward];
  }

  /// Moves along the camera axes, world units.
  move(x, y, z) {
    this.position = add(this.position, unrotate(this.rotation, [x, y, z]));
  }

  /// Moves towards a point (factor below 1) or away from it, not nearer than `closest`. The point
  /// keeps its place in the picture, and the pivot gets its depth.
  zoom(point, factor, closest) {
    this.aim(point);
    const by = factor < 1 ? Math.max(factor, Math.min(1, closest / this.distance)) : factor;
    this.position = add(point, scale(sub(this.position, point), by));
    this.distance *= by;
  }

  /// Turns towards a point, without roll.
  face(point, up) {
    const forward = unit(sub(point, this.position)), right = unit(cross(forward, up));
    if (Math.abs(dot(forward, up)) > 0.99) return;
    this.rotation = [...right, ...cross(forward, right), ...forward];
    this.aim(point);
  }

  /// Sets the depth of a point as the distance of the pivot, without rotation.
  aim(point) {
    this.distance = Math.max(dot(sub(point, this.position), this.rotation.slice(6)), 1e-6);
  }

  /// Moves back until a sphere is in the picture.
  frame(centre, radius) {
    this.distance = 2 * this.focal * radius / Math.min(1, this.ratio);
    this.position = sub(centre, scale(this.rotation.slice(6), this.distance));
    [this.cover, this.shift] = [0, [0, 0]];
  }

  /// The camera of a picture of this size as a JSON object of the server: OpenCV axes, the rotation
  /// from world to camera in columns.
  stated(width, height) {
    const [fx, fy, cx, cy] = this.intrinsics(width, height);
    return { name: "view", width, height, fx, fy, cx, cy, pose: { rotation: transpose(this.rotation), translation: this.translation } };
  }

  /// Pixel position and depth of a world point.
  project(point, width, height) {
    const t = rotate(this.rotation, sub(point, this.position));
    const [fx, fy, cx, cy] = this.intrinsics(width, height);
    return [fx * t[0] / t[2] + cx, fy * t[1] / t[2] + cy, t[2]];
  }

  /// World point of a pixel position at a depth.
  unproject(x, y, depth, width, height) {
    const [fx, fy, cx, cy] = this.intrinsics(width, height);
    return add(this.position, unrotate(this.rotation, [(x - cx) / fx * depth, (y - cy) / fy * depth, depth]));
  }

  /// Interpolates between two cameras at t in [0, 1].
  static between(a, b, t) {
    const numbers = (c) => [c.focal, c.ratio, c.aspect, c.distance, c.cover];
    const k = mix(numbers(a), numbers(b), t);
    return new Camera({
      rotation: fromQuaternion(slerp(toQuaternion(a.rotation), toQuaternion(b.rotation), t)),
      position: mix(a.position, b.position, t),
      shift: mix(a.shift, b.shift, t),
      focal: k[0], ratio: k[1], aspect: k[2], distance: k[3], cover: k[4],
    });
  }
}

/// Up direction of the scene: opposite to the mean direction of the image columns.
export function upOf(views) {
  const sum = views.reduce((s, v) => sub(s, v.rotation.slice(3, 6)), [0, 0, 0]);
  return Math.hypot(...sum) > 1e-3 ? unit(sum) : [0, -1, 0];
}
