// Reader of the packed scene (format: src/report/viewer/pack.rs).
const BLOCK = 256;

/// Marks of a splat, bits: no photo shows it, of a hole, of the backdrop, of a surface that carries
/// things; and those of the page: it is selected, or hidden.
export const MARKS = { unseen: 1, hole: 2, backdrop: 4, surface: 8, selected: 16, hidden: 32 };

/// Downloads the packed scene; `tell` gets the received share where the server sends the length.
export async function download(url, tell) {
  const reply = await fetch(url);
  if (!reply.ok) throw new Error(`the scene is not there (${reply.status})`);
  const length = Number(reply.headers.get("Content-Length")), reader = reply.body.getReader(), parts = [];
  for (let got = 0, part; !(part = await reader.read()).done;) {
    parts.push(part.value);
    got += part.value.length;
    if (length) tell(Math.min(1, got / length));
  }
  return new Blob(parts).arrayBuffer();
}

/// Inflates a gzip stream.
export async function gunzip(buffer) {
  const stream = new Blob([buffer]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

const float = new Float32Array(1), bits = new Uint32Array(float.buffer);

/// Rounds to the nearest half-precision number; returns its 16 bits.
export function half(value) {
  float[0] = value;
  const b = bits[0], sign = (b >>> 16) & 0x8000, exponent = (b >>> 23) & 255, mantissa = b & 0x7fffff;
  if (exponent < 103) return sign;
  if (exponent > 142) return sign | 0x7bff;
  if (exponent < 113) return sign | (((mantissa | 0x800000) >>> (125 - exponent)) + 1) >>> 1;
  return sign + ((((exponent - 112) << 10) | (mantissa >>> 13)) + ((mantissa >>> 12) & 1));
}

/// Middle of the splats that photos show, the median per axis, and the radius about it that holds
/// three quarters of them: the rest is mostly background.
export function extentOf({ count, positions, marks }) {
  const seen = Uint32Array.from({ length: count }, (_, i) => i).filter((i) => !(marks[i] & (MARKS.unseen | MARKS.hole)));
  const quantile = (share, value) => Float32Array.from(seen, value).sort()[Math.floor(share * (seen.length - 1))] ?? 0;
  const centre = [0, 1, 2].map((k) => quantile(0.5, (i) => positions[3 * i + k]));
  const radius = quantile(0.75, (i) => Math.hypot(...centre.map((v, k) => positions[3 * i + k] - v)));
  return { centre, radius: radius || 1 };
}

/// Median depth of the splats in front of a camera.
export function medianDepth({ count, positions }, camera) {
  const r = camera.rotation, t = camera.translation, z = [];
  for (let i = 0; i < count; i += 7) {
    const depth = r[6] * positions[3 * i] + r[7] * positions[3 * i + 1] + r[8] * positions[3 * i + 2] + t[2];
    if (depth > 0) z.push(depth);
  }
  return z.sort((a, b) => a - b)[z.length >> 1] || 1;
}

/// Unpacks {count, degree, positions [N, 3], logScales [N, 3], quats [N, 4], packedQuats [N] as in
/// the file, opacity [N], colours [N, 3], shScale [3], sh: Int8Array [N, R, 3] or null, codes: [L]
/// x Uint16Array [N], marks: Uint8Array [N] of [`MARKS`], antialiased: whether opacities include the
/// 2-D Mip filter}.
export function unpack(buffer) {
  const view = new DataView(buffer), bytes = new Uint8Array(buffer);
  if (new TextDecoder().decode(bytes.subarray(0, 8)) !== "SVKVIEW1") throw new Error("the scene data is damaged");
  const [n, degree, levels, flags] = [8, 12, 16, 20].map((at) => view.getUint32(at, true));
  const shScale = [24, 28, 32].map((at) => view.getFloat32(at, true));
  const blocks = Math.ceil(n / BLOCK);
  const ranges = new Float32Array(buffer, 36, blocks * 10);
  let at = 36 + blocks * 40;
  const range = (i, k) => ranges[10 * (i >> 8) + k];
  const decode = (out, width, column, k, share) => {
    for (let i = 0; i < n; i++) {
      const low = range(i, 2 * k);
      out[width * i + column] = low + share(i) * (range(i, 2 * k + 1) - low);
    }
  };
  const shorts = () => {
    const start = at;
    at += 2 * n;
    return (i) => (bytes[start + 2 * i] | bytes[start + 2 * i + 1] << 8) / 65535;
  };
  const byteShares = () => {
    const start = at;
    at += n;
    return (i) => bytes[start + i] / 255;
  };
  const positions = new Float32Array(3 * n), logScales = new Float32Array(3 * n), quats = new Float32Array(4 * n);
  const packedQuats = new Uint32Array(n);
  for (let k = 0; k < 3; k++) decode(positions, 3, k, k, shorts());
  for (let k = 0; k < 3; k++) decode(logScales, 3, k, 3, byteShares());
  for (let i = 0; i < n; i++, at += 4) {
    const packed = view.getUint32(at, true), largest = packed >>> 30;
    packedQuats[i] = packed;
    let sum = 0, slot = 0;
    for (let k = 0; k < 4; k++) {
      if (k === largest) continue;
      const v = (((packed >>> (10 * slot++)) & 1023) / 511.5 - 1) * Math.SQRT1_2;
      quats[4 * i + k] = v;
      sum += v * v;
    }
    quats[4 * i + largest] = Math.sqrt(Math.max(0, 1 - sum));
  }
  const opacity = new Float32Array(n), alpha = byteShares();
  for (let i = 0; i < n; i++) opacity[i] = alpha(i);
  const colours = new Float32Array(3 * n);
  for (let k = 0; k < 3; k++) decode(colours, 3, k, 4, byteShares());
  const rest = (degree + 1) ** 2 - 1;
  const sh = rest ? new Int8Array(3 * rest * n) : null;
  for (let k = 0; k < 3 * rest; k++, at += n) {
    const plane = new Int8Array(buffer, at, n);
    for (let i = 0; i < n; i++) sh[3 * rest * i + k] = plane[i];
  }
  const codes = [];
  for (let l = 0; l < levels; l++, at += 2 * n) codes.push(new Uint16Array(buffer.slice(at, at + 2 * n)));
  const marks = flags & 1 ? bytes.slice(at, at + n) : new Uint8Array(n);
  const antialiased = (flags & 2) !== 0;
  return { count: n, degree, positions, logScales, quats, packedQuats, opacity, colours, shScale, sh, codes, marks, antialiased };
}
