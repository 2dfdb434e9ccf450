// Worker that sorts the splats in view of a camera in the order in which they are drawn: the
// backdrop, holes, the scene, each far to near. It receives positions and marks whenever they
// change, and requests {id, rotation, translation, near, slope, share: of the splats}; it posts
// sorted indices with the 1 % and 99 % quantiles of the depth of the scene. Radix sort on the bits
// of z, without the last: linear in the number of splats.
let positions = null, marks, keys, order, counts;

/// Bits of `MARKS` in splats.js; a worker imports nothing.
const HOLE = 2, BACKDROP = 4, HIDDEN = 32;

self.onmessage = ({ data }) => {
  marks = data.marks ?? marks;
  if (data.positions) {
    positions = data.positions;
    const n = positions.length / 3;
    keys = [new Uint32Array(n), new Uint32Array(n)];
    order = [new Uint32Array(n), new Uint32Array(n)];
    counts = new Uint32Array(65536);
  }
  if (data.id === undefined) return;
  const { id, rotation: r, translation: t, near, slope, share } = data, limit = share * 2 ** 32;
  const z = new Float32Array(1), bits = new Uint32Array(z.buffer);
  let m = 0, own = 0;
  for (let i = 0, p = 0; p < positions.length; i++, p += 3) {
    // Multiples of the golden ratio pick evenly, and neighbours are neighbours in the file, too.
    if (share < 1 && Math.imul(i, 0x9e3779b1) >>> 0 > limit) continue;
    if (marks[i] & HIDDEN) continue;
    const x = positions[p], y = positions[p + 1], w = positions[p + 2];
    z[0] = r[6] * x + r[7] * y + r[8] * w + t[2];
    if (!(z[0] > near)) continue;
    // Splats with a centre far outside reach into the image only where their projection is invalid.
    const u = r[0] * x + r[1] * y + r[2] * w + t[0], v = r[3] * x + r[4] * y + r[5] * w + t[1];
    if (Math.abs(u) > slope[0] * z[0] || Math.abs(v) > slope[1] * z[0]) continue;
    const layer = marks[i] & BACKDROP ? 2 : marks[i] & HOLE ? 1 : 0;
    if (!layer) own++;
    // Positive floats sort like their bits; the complement puts far splats first.
    keys[0][m] = ~(layer << 30 | bits[0] >>> 1);
    order[0][m++] = i;
  }
  for (const shift of [0, 16]) {
    const [from, to] = shift ? [1, 0] : [0, 1];
    counts.fill(0);
    for (let i = 0; i < m; i++) counts[(keys[from][i] >>> shift) & 65535]++;
    for (let k = 0, sum = 0; k < 65536; k++) {
      const count = counts[k];
      counts[k] = sum;
      sum += count;
    }
    for (let i = 0; i < m; i++) {
      const at = counts[(keys[from][i] >>> shift) & 65535]++;
      keys[to][at] = keys[from][i];
      order[to][at] = order[from][i];
    }
  }
  const sorted = order[0].slice(0, m);
  const depth = (share) => {
    if (!own) return 1;
    bits[0] = ~keys[0][m - 1 - Math.round((own - 1) * share)] << 1;
    return z[0];
  };
  self.postMessage({ id, share, sorted, near: depth(0.01), far: depth(0.99) }, [sorted.buffer]);
};
