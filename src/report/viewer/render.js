// WebGL 2 renderer of splats. Projection and blending are those of the Vulkan renderer
// (glsl/shared/splat.glsl, glsl/raster_forward.comp). Three passes: the projection of every splat
// in sorted order into a texture, the quads blended far to near into a half-float image, and the
// map of that image to colours.
import { MARKS, half } from "splatvk/splats";

export const MODES = { colour: 0, depth: 1, level: 2, relevancy: 3, unseen: 4 };

/// Splats per instance. An instance has a fixed cost; measured in software, one splat per instance
/// takes longer than all its pixels.
const BATCH = 128;

/// Splats in a row of the sorted order: whole batches, and at most the texture size that WebGL 2
/// promises.
const ROW = 2048;

/// Width of the stripes of holes, pixels of the picture, and their brightness: src/run/view.rs.
const STRIPE = 6, HATCHING = [0.35, 0.65];

/// Alpha where splats of a lean picture end: half as many pixels as to the last step of a byte.
const FAINT = 0.05;

const TRIANGLE = `#version 300 es
void main() { gl_Position = vec4(vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID & 2) * 2 - 1), 0.0, 1.0); }`;

// Once per splat, not once per corner.
const PROJECT = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D; precision highp sampler2D;
uniform usampler2D data;     // two texels per splat: position, (r, g); (b, opacity), log scales, quaternion
uniform usampler2D order;    // splats, far to near
uniform usampler2D codes;    // code + 1 per level of things
uniform usampler2D marks;    // MARKS
uniform sampler2D sh;        // (degree + 1)² − 1 texels per splat, -1..1 of shScale
uniform sampler2D table;     // per level two rows: (label colour, selected), (relevancy, answers)
uniform vec3 shScale;
uniform int count, shCount, mode, level, selecting, antialiased;
uniform mat3 rotation;       // world to camera
uniform vec3 translation, position;
uniform vec4 intrinsics;     // fx, fy, cx, cy in pixels
uniform vec2 size;
uniform float near, guessed, grow, faint; // opacity of what no photo shows; added to log scales; alpha where quads end
layout(location = 0) out uvec4 place;   // centre in pixels, direction of the major axis
layout(location = 1) out uvec4 extent;  // standard deviations in pixels, reach in those, visible
layout(location = 2) out uvec4 payload; // blended values, opacity

const float DILATION = 0.3, ALPHA_MIN = 1.0 / 255.0;
const vec3 GREY = vec3(0.299, 0.587, 0.114);

ivec2 texel(int width, int i) { return ivec2(i % width, i / width); }

int splat;

vec3 coefficient(int k) {
  int i = splat * shCount + k;
  return texelFetch(sh, texel(textureSize(sh, 0).x, i), 0).rgb;
}

vec3 harmonics(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.4886025119029199 * shScale.x * (-y * coefficient(0) + z * coefficient(1) - x * coefficient(2));
  if (shCount >= 8)
    sum += shScale.y * (1.0925484305920792 * (x * y * coefficient(3) - y * z * coefficient(4) - x * z * coefficient(6))
      + 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(5) + 0.5462742152960396 * (xx - yy) * coefficient(7));
  if (shCount >= 15)
    sum += shScale.z * (-0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(8) + x * (xx - 3.0 * yy) * coefficient(14))
      + 2.890611442640554 * x * y * z * coefficient(9)
      - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * coefficient(10) + x * coefficient(12))
      + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(11)
      + 1.445305721320277 * z * (xx - yy) * coefficient(13));
  return sum;
}

void main() {
  place = extent = payload = uvec4(0u); // invisible
  ivec2 cell = ivec2(gl_FragCoord.xy);
  if (cell.y * ${ROW} + cell.x >= count) return;
  splat = int(texelFetch(order, cell, 0).x);
  int width = textureSize(data, 0).x;
  uvec4 a = texelFetch(data, texel(width, 2 * splat), 0), b = texelFetch(data, texel(width, 2 * splat + 1), 0);
  vec3 mean = uintBitsToFloat(a.xyz);
  vec3 t = rotation * mean + translation;
  vec2 rg = unpackHalf2x16(a.w), bo = unpackHalf2x16(b.x), s01 = unpackHalf2x16(b.y), s2 = unpackHalf2x16(b.z);
  uint mark = texelFetch(marks, texel(textureSize(marks, 0).x, splat), 0).r;
  bool unseen = (mark & ${MARKS.unseen}u) != 0u, hole = (mark & ${MARKS.hole}u) != 0u;
  float opacity = unseen ? bo.y * guessed : bo.y;
  if (hole && mode == ${MODES.depth}) return;
  if (t.z <= near || opacity < ALPHA_MIN) return;
  vec3 scale = exp(vec3(s01, s2.x) + grow);
  // Smallest three, as in the file.
  vec3 small = (vec3(uvec3(b.w, b.w >> 10, b.w >> 20) & 1023u) / 511.5 - 1.0) * 0.7071067811865476;
  float big = sqrt(max(0.0, 1.0 - dot(small, small)));
  uint largest = b.w >> 30;
  vec4 q = largest == 0u ? vec4(big, small) : largest == 1u ? vec4(small.x, big, small.yz)
    : largest == 2u ? vec4(small.xy, big, small.z) : vec4(small, big);
  float r = q.x, x = q.y, y = q.z, z = q.w;
  mat3 axes = mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + r * z), 2.0 * (x * z - r * y),
                   2.0 * (x * y - r * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + r * x),
                   2.0 * (x * z + r * y), 2.0 * (y * z - r * x), 1.0 - 2.0 * (x * x + y * y));
  vec2 focal = intrinsics.xy, centre = intrinsics.zw, margin = 0.15 * size;
  vec2 slope = t.xy / t.z;
  vec2 limited = clamp(slope, -(centre + margin) / focal, (size - centre + margin) / focal);
  mat3 m = rotation * axes * mat3(scale.x, 0.0, 0.0, 0.0, scale.y, 0.0, 0.0, 0.0, scale.z);
  vec3 row2 = vec3(m[0].z, m[1].z, m[2].z);
  vec3 b0 = focal.x / t.z * (vec3(m[0].x, m[1].x, m[2].x) - limited.x * row2);
  vec3 b1 = focal.y / t.z * (vec3(m[0].y, m[1].y, m[2].y) - limited.y * row2);
  vec3 area = cross(b0, b1);
  float xx = dot(b0, b0) + DILATION, yy = dot(b1, b1) + DILATION, xy = dot(b0, b1);
  if (antialiased == 1) {
    float undilated = dot(area, area);
    opacity *= sqrt(undilated / (undilated + DILATION * (xx + yy - DILATION)));
    if (opacity < ALPHA_MIN) return;
  }
  float middle = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  float major = middle + spread, minor = max(middle - spread, 1e-6);
  vec2 along = abs(xy) > 1e-6 * major ? normalize(vec2(xy, major - xx)) : xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
  // The quad ends where alpha falls below 1/255, in motion earlier.
  if (opacity <= faint) return;
  float reach = sqrt(2.0 * log(opacity / faint));
  vec2 pixel = focal * slope + centre, deviations = vec2(sqrt(major), sqrt(minor));
  vec2 box = reach * (deviations.x * abs(along) + deviations.y * abs(along.yx));
  if (any(lessThan(pixel, -box)) || any(greaterThan(pixel, size + box))) return;

  vec4 shown = vec4(0.0, 0.0, 0.0, opacity);
  if (mode == ${MODES.depth}) shown.r = t.z;
  else {
    vec3 colour = vec3(rg, bo.x);
    if (shCount > 0) colour += harmonics(normalize(mean - position));
    colour = max(colour, vec3(0.0));
    float luma = dot(colour, GREY);
    int k = int(texelFetch(codes, texel(textureSize(codes, 0).x, splat), 0)[level]);
    vec4 label = texelFetch(table, ivec2(k, 2 * level), 0), answer = texelFetch(table, ivec2(k, 2 * level + 1), 0);
    if (mode == ${MODES.unseen}) shown.rgb = unseen ? vec3(0.9, 0.1, 0.6) : vec3(0.15 + 0.7 * luma);
    else if (mode == ${MODES.relevancy}) shown.rgb = vec3(luma, answer.xy);
    else {
      shown.rgb = mode == ${MODES.level} ? label.rgb : colour;
      if (selecting == 1 && label.a < 0.5) shown.rgb = 0.3 * mix(vec3(dot(shown.rgb, GREY)), shown.rgb, 0.25);
      if ((mark & ${MARKS.selected}u) != 0u) shown.rgb = mix(shown.rgb, vec3(1.0, 0.6, 0.05), 0.6);
    }
    // Holes are hatched by pixel.
    if (hole) shown = vec4(0.0, 0.0, 0.0, -opacity);
  }
  place = floatBitsToUint(vec4(pixel, along));
  extent = uvec4(floatBitsToUint(vec3(deviations, reach)), 1u);
  payload = floatBitsToUint(shown);
}`;

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D place, extent, payload;
uniform vec2 size;
flat out vec4 value;  // blended values, opacity
out vec2 offset;      // in standard deviations
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // nowhere
  int i = gl_InstanceID * ${BATCH} + (gl_VertexID >> 2);
  ivec2 cell = ivec2(i % ${ROW}, i / ${ROW});
  uvec4 e = texelFetch(extent, cell, 0);
  if (e.w == 0u) return;
  vec3 far = uintBitsToFloat(e.xyz);
  vec4 p = uintBitsToFloat(texelFetch(place, cell, 0));
  value = uintBitsToFloat(texelFetch(payload, cell, 0));
  // Corners of the square about the circle of radius 1.
  int x = (gl_VertexID & 1) * 2 - 1, y = (gl_VertexID & 2) - 1;
  offset = far.z * vec2(x, y);
  vec2 pixel = p.xy + offset.x * far.x * p.zw + offset.y * far.y * vec2(-p.w, p.z);
  gl_Position = vec4(pixel.x / size.x * 2.0 - 1.0, 1.0 - pixel.y / size.y * 2.0, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 value;
in vec2 offset;
out vec4 blended;
uniform int mode;
uniform float stripe; // width, pixels
void main() {
  float alpha = min(0.99, abs(value.a) * exp(-0.5 * dot(offset, offset)));
  if (alpha < 1.0 / 255.0) discard;
  vec3 shown = value.rgb;
  if (value.a < 0.0) {
    float grey = mod(floor((gl_FragCoord.x - gl_FragCoord.y - 1.0) / stripe), 2.0) < 0.5 ? ${HATCHING[0]} : ${HATCHING[1]};
    shown = mode == ${MODES.relevancy} ? vec3(grey, 0.0, 0.0) : vec3(grey);
  }
  blended = vec4(shown * alpha, alpha);
}`;

// Colour maps of the report: src/report/colour.rs.
const RESOLVE = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D image;
uniform int mode, doubt;
uniform vec2 range; // near and far depth
out vec4 shown;

vec3 turbo(float v) {
  float x = clamp(v, 0.0, 1.0);
  vec4 p = vec4(1.0, x, x * x, x * x * x);
  vec2 q = p.zw * x * x;
  return clamp(vec3(
    dot(p, vec4(0.13572138, 4.6153926, -42.66032, 132.13108)) + dot(q.xy, vec2(-152.94240, 59.28638)),
    dot(p, vec4(0.09140261, 2.19418839, 4.84296658, -14.18503333)) + dot(q.xy, vec2(4.27729857, 2.82956604)),
    dot(p, vec4(0.10667330, 12.64194608, -60.58204836, 110.36276771)) + dot(q.xy, vec2(-89.90310912, 27.34824973))), 0.0, 1.0);
}

bool answers(ivec2 p) {
  vec4 v = texelFetch(image, clamp(p, ivec2(0), textureSize(image, 0) - 1), 0);
  return v.b > 0.5 * v.a && v.a > 0.5;
}

void main() {
  ivec2 p = ivec2(gl_FragCoord.xy);
  vec4 v = texelFetch(image, p, 0);
  shown = vec4(v.rgb, 1.0);
  if (mode == ${MODES.depth}) {
    float z = v.r / max(v.a, 1e-6);
    shown.rgb = v.a < 0.5 ? vec3(0.0) : turbo(0.05 + 0.9 * (1.0 / z - 1.0 / range.y) / max(1.0 / range.x - 1.0 / range.y, 1e-9));
  } else if (mode == ${MODES.relevancy}) {
    float alpha = max(v.a, 1e-6), heat = clamp((v.g / alpha - 0.5) * 2.0, 0.0, 1.0);
    vec3 base = vec3(0.25 + 0.5 * v.r / alpha);
    shown.rgb = v.a * mix(base, doubt == 1 ? vec3(0.95) : turbo(0.45 + 0.5 * heat), (doubt == 1 ? 0.6 : 0.85) * heat);
    bool around = answers(p + ivec2(1, 0)) && answers(p - ivec2(1, 0)) && answers(p + ivec2(0, 1)) && answers(p - ivec2(0, 1));
    if (answers(p) && !around) shown.rgb = vec3(doubt == 1 ? 0.6 : 1.0);
  }
}`;

/// Compiles a program; returns it with the locations of its uniforms.
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error(gl.getShaderInfoLog(shader) || "a shader does not compile");
    }
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(made));
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    at[name] = gl.getUniformLocation(made, name);
  }
  return { made, at };
}

export class Renderer {
  constructor(canvas, splats, levels, needsDepth = false) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, depth: needsDepth, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser offers no WebGL 2");
    this.gl = gl;
    // Without half floats the image is blended in bytes, with visible steps.
    const halves = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.coarse = [gl.RGBA8, gl.UNSIGNED_BYTE];
    this.fine = halves ? [gl.RGBA16F, gl.HALF_FLOAT] : this.coarse;
    this.project = program(gl, TRIANGLE, PROJECT);
    this.quads = program(gl, VERTEX, FRAGMENT);
    this.resolve = program(gl, TRIANGLE, RESOLVE);
    this.upload(splats);
    this.levels = levels;
    this.columns = 1 + Math.max(0, ...levels.map((l) => l.colours.length));
    this.table = new Float32Array(8 * this.columns * levels.length);
    levels.forEach((level, l) => [[0.13, 0.13, 0.13], ...level.colours].forEach((c, k) => this.table.set(c, 4 * (2 * l * this.columns + k))));
    this.textures.table = this.texture();
    this.sendTable();
    this.count = 0;
    this.grow = 0;
    this.range = [1, 2];
    this.doubt = false;
    const rows = Math.ceil(splats.count / ROW) || 1;
    const store = (format) => {
      const made = this.texture();
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, ROW, rows);
      return made;
    };
    this.textures.order = store(gl.R32UI);
    this.projected = { place: store(gl.RGBA32UI), extent: store(gl.RGBA32UI), payload: store(gl.RGBA32UI) };
    this.projection = this.framebuffer(Object.values(this.projected));
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    // Two triangles per splat.
    const of = (corners) => Array.from({ length: BATCH }, (_, k) => corners.map((c) => 4 * k + c)).flat();
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint16Array.from(of([0, 1, 2, 2, 1, 3])), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.images = new Map();
  }

  /// Frees what grows with the scene.
  free() {
    const { gl } = this, images = [...this.images.values()];
    [...Object.values(this.textures), ...Object.values(this.projected), ...images.map((i) => i.texture)].forEach((t) => gl.deleteTexture(t));
    [this.projection, ...images.map((i) => i.frame)].forEach((f) => gl.deleteFramebuffer(f));
    [this.project, this.quads, this.resolve].forEach((p) => gl.deleteProgram(p.made));
    gl.deleteVertexArray(this.array);
  }

  framebuffer(textures) {
    const { gl } = this, made = gl.createFramebuffer(), slots = textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k);
    gl.bindFramebuffer(gl.FRAMEBUFFER, made);
    textures.forEach((texture, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, slots[k], gl.TEXTURE_2D, texture, 0));
    gl.drawBuffers(slots);
    const complete = gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
    if (!complete && !gl.isContextLost()) throw new Error("this graphics device offers too few image formats");
    return made;
  }

  texture() {
    const { gl } = this, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, which, gl.NEAREST);
    return made;
  }

  /// Creates a texture of `count` texels in rows of a common width.
  filled(count, make, internal, format, type) {
    const { gl } = this, most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const width = Math.min(most, 4096), height = Math.max(1, Math.ceil(count / width));
    if (height > most) throw new Error("the scene is larger than this device's textures");
    const made = this.texture();
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, make(width * height));
    return made;
  }

  upload(splats) {
    const { gl } = this, n = splats.count;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const data = this.filled(2 * n, (texels) => {
      const out = new Uint32Array(4 * texels), floats = new Float32Array(out.buffer);
      const two = (a, b) => half(a) | half(b) << 16;
      for (let i = 0; i < n; i++) {
        const [p, c, s] = [splats.positions, splats.colours, splats.logScales].map((v) => v.subarray(3 * i, 3 * i + 3));
        floats.set(p, 8 * i);
        out[8 * i + 3] = two(c[0], c[1]);
        out[8 * i + 4] = two(c[2], splats.opacity[i]);
        out[8 * i + 5] = two(s[0], s[1]);
        out[8 * i + 6] = two(s[2], 0);
        out[8 * i + 7] = splats.packedQuats[i];
      }
      return out;
    }, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT);
    const codes = this.filled(n, (texels) => {
      const out = new Uint16Array(4 * texels);
      splats.codes.forEach((level, l) => level.forEach((code, i) => { out[4 * i + l] = code; }));
      return out;
    }, gl.RGBA16UI, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT);
    this.shScale = splats.shScale;
    this.antialiased = splats.antialiased;
    this.shCount = splats.sh ? (splats.degree + 1) ** 2 - 1 : 0;
    const sh = this.filled(n * this.shCount, (texels) => {
      const out = new Int8Array(4 * texels);
      for (let i = 0; i < n * this.shCount; i++) out.set(splats.sh.subarray(3 * i, 3 * i + 3), 4 * i);
      return out;
    }, gl.RGBA8_SNORM, gl.RGBA, gl.BYTE);
    this.textures = { data, codes, sh };
    this.mark(splats.marks);
  }

  /// Takes the marks of all splats.
  mark(marks) {
    const { gl } = this;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.deleteTexture(this.textures.marks ?? null);
    this.textures.marks = this.filled(marks.length, (texels) => {
      const out = new Uint8Array(texels);
      out.set(marks);
      return out;
    }, gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE);
  }

  sendTable() {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.textures.table);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, this.columns, 2 * this.levels.length, 0, gl.RGBA, gl.FLOAT, this.table);
  }

  /// Marks codes of a level as selected; none with level < 0.
  select(level, codes) {
    this.levels.forEach((l, at) => {
      for (let k = 0; k <= l.colours.length; k++) this.table[4 * (2 * at * this.columns + k) + 3] = at === level && codes.includes(k - 1) ? 1 : 0;
    });
    this.sendTable();
  }

  /// Sets the relevancy per level and code, and the codes of `level` that answer. An answer in
  /// `doubt` is drawn without colours.
  answer(relevancy, level, codes, doubt) {
    this.doubt = doubt;
    this.levels.forEach((l, at) => relevancy[l.codes]?.forEach((v, k) => {
      this.table.set([v, at === level && codes.includes(k) ? 1 : 0], 4 * ((2 * at + 1) * this.columns + k + 1));
    }));
    this.sendTable();
  }

  /// Takes a sorted order of a share of the splats.
  setOrder({ sorted, near, far, share }) {
    const { gl } = this, rows = Math.floor(sorted.length / ROW), rest = sorted.length - rows * ROW;
    const send = (y, width, height) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, y, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, sorted, y * ROW);
    gl.bindTexture(gl.TEXTURE_2D, this.textures.order);
    if (rows) send(0, ROW, rows);
    if (rest) send(rows, rest, 1);
    this.count = sorted.length;
    // Half of the area of those that are left out, in the logarithm: surfaces have several layers.
    this.grow = -0.25 * Math.log(share);
    this.range = [near, far];
  }

  /// Image of a format and size, with its framebuffer.
  image(format, width, height) {
    const { gl } = this, have = this.images.get(format);
    if (have?.width === width && have.height === height) return have;
    if (have) {
      gl.deleteTexture(have.texture);
      gl.deleteFramebuffer(have.frame);
    }
    const texture = this.texture();
    gl.texImage2D(gl.TEXTURE_2D, 0, format[0], width, height, 0, gl.RGBA, format[1], null);
    const made = { width, height, texture, frame: this.framebuffer([texture]) };
    this.images.set(format, made);
    return made;
  }

  /// Uses a program with its textures; returns the locations of its uniforms.
  use({ made, at }, textures) {
    const { gl } = this;
    gl.useProgram(made);
    Object.entries(textures).forEach(([name, texture], slot) => {
      gl.activeTexture(gl.TEXTURE0 + slot);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(at[name], slot);
    });
    return at;
  }

  /// Draws the image of a camera at the size of the canvas. `guessed` is the opacity of what no
  /// photo shows. `lean`, for moving pictures, omits harmonics, blends colours in bytes and ends
  /// splats early.
  draw(camera, { mode, level, selecting, near, guessed, lean }) {
    const { gl } = this, [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    let at = this.use(this.project, this.textures);
    gl.uniform3fv(at.shScale, this.shScale);
    gl.uniform1i(at.count, this.count);
    gl.uniform1i(at.shCount, lean ? 0 : this.shCount);
    gl.uniform1i(at.antialiased, this.antialiased ? 1 : 0);
    gl.uniform1i(at.mode, MODES[mode]);
    gl.uniform1i(at.level, level);
    gl.uniform1i(at.selecting, selecting ? 1 : 0);
    gl.uniformMatrix3fv(at.rotation, true, camera.rotation);
    gl.uniform3fv(at.translation, camera.translation);
    gl.uniform3fv(at.position, camera.position);
    gl.uniform4fv(at.intrinsics, camera.intrinsics(width, height));
    gl.uniform2f(at.size, width, height);
    gl.uniform1f(at.near, near);
    gl.uniform1f(at.guessed, guessed);
    gl.uniform1f(at.grow, this.grow);
    gl.uniform1f(at.faint, lean ? FAINT : 1 / 255);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projection);
    gl.viewport(0, 0, ROW, Math.ceil(this.count / ROW));
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    // Depths exceed the range of bytes, and heat shows their steps.
    const bytes = lean && mode !== "depth" && mode !== "relevancy";
    const image = this.image(bytes ? this.coarse : this.fine, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, image.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    at = this.use(this.quads, this.projected);
    gl.uniform2f(at.size, width, height);
    gl.uniform1i(at.mode, MODES[mode]);
    gl.uniform1f(at.stripe, STRIPE * Math.max(1, width / gl.canvas.clientWidth || 1));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.array);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.count / BATCH));
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    at = this.use(this.resolve, { image: image.texture });
    gl.uniform1i(at.mode, MODES[mode]);
    gl.uniform1i(at.doubt, this.doubt ? 1 : 0);
    gl.uniform2fv(at.range, this.range);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
