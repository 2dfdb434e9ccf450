#version 450
// variants: EMIT=0,1
// Visits, in depth order, every 8x8 tile that a splat can change. EMIT=0 counts, EMIT=1 writes the lists.
// A lane owns a contiguous chunk of the depth order and a counter per tile, so the lists come out depth sorted
// without sorting pairs. Twin: pass::bin.
layout(local_size_x = 8) in;

layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };     // [N, 3]
layout(std430, binding = 1) readonly buffer DepthPairs { uvec2 depth_pairs[]; }; // [N] (key, splat), sorted
layout(std430, binding = 2) buffer Counters { uint counters[]; };                // [tiles, chunks]
#if EMIT
layout(std430, binding = 3) writeonly buffer TileSplats { uint tile_splats[]; }; // [capacity]
#endif
layout(push_constant) uniform Push { uint count; uint tiles_x; uint tiles_y; uint chunks; uint capacity; };

const int TILE = 8;
const float LOG2_ALPHA_MIN = -7.994353436858858; // log2(1/255)
// The raster pass evaluates the same power in another order; 1e-3 covers the difference of up to 1e4 in size.
const float MARGIN = 1e-3;

void main() {
    uint chunk = gl_GlobalInvocationID.x;
    uint per_chunk = (count + chunks - 1) / chunks;
    int i = int(chunk * per_chunk), end = int(min(chunk * per_chunk + per_chunk, count));
    int x = 0, x0 = 0, x1 = -1, y = 0, y1 = -1;
    uint splat = 0;
    // `precise`: both variants must take exactly the same decisions.
    precise float u = 0.0, v = 0.0, a = 0.0, b = 0.0, c = 0.0, log2_opacity = 0.0;
    precise float slope_y = 0.0, slope_x = 0.0;
    i--;
    if (chunk >= chunks) return;
    // One flat loop over (splat, tile): lanes with small splats do not wait for lanes with large ones.
    while (true) {
        x++;
        bool next_row = x > x1;
        x = next_row ? x0 : x;
        y = next_row ? y + 1 : y;
        if (y > y1) {
            i++;
            if (i >= end) break;
            splat = depth_pairs[i].y;
            vec4 p = projected[3 * splat], q = projected[3 * splat + 1];
            u = p.x; v = p.y; a = p.z; b = p.w; c = q.x; log2_opacity = q.y;
            // Ellipse a dx² + b dx dy + c dy² = -k: its half extents and where it touches vertical, horizontal lines.
            precise float k = max(log2_opacity - LOG2_ALPHA_MIN + MARGIN, 0.0);
            precise float scale = -k / (a * c - 0.25 * b * b);
            precise float extent_x = sqrt(max(c * scale, 0.0)), extent_y = sqrt(max(a * scale, 0.0));
            slope_y = -0.5 * b / c;
            slope_x = -0.5 * b / a;
            // Clamping as floats first: a far splat must not overflow the conversion to int.
            float last_x = float(tiles_x) - 1.0, last_y = float(tiles_y) - 1.0;
            x0 = int(clamp(floor((u - extent_x) / float(TILE)), 0.0, last_x + 1.0));
            x1 = int(clamp(floor((u + extent_x) / float(TILE)), -1.0, last_x));
            y = int(clamp(floor((v - extent_y) / float(TILE)), 0.0, last_y + 1.0));
            y1 = int(clamp(floor((v + extent_y) / float(TILE)), -1.0, last_y));
            x = x0;
            if (x1 < x0 || log2_opacity < LOG2_ALPHA_MIN) y1 = -1;
        }
        // Largest power over the rectangle of the tile's pixel centres: at the point of an edge nearest to the
        // centre in the metric of the ellipse, or 0 inside.
        precise float dx0 = float(x * TILE) - u, dx1 = dx0 + float(TILE - 1);
        precise float dy0 = float(y * TILE) - v, dy1 = dy0 + float(TILE - 1);
        precise float cx = clamp(0.0, dx0, dx1), cy = clamp(0.0, dy0, dy1);
        precise float ya = clamp(slope_y * cx, dy0, dy1), xa = clamp(slope_x * cy, dx0, dx1);
        precise float q1 = (a * cx + b * ya) * cx + (c * ya * ya + log2_opacity);
        precise float q2 = (a * xa + b * cy) * xa + (c * cy * cy + log2_opacity);
        if (y <= y1 && max(q1, q2) >= LOG2_ALPHA_MIN - MARGIN) {
            uint at = (uint(y) * tiles_x + uint(x)) * chunks + chunk;
            uint slot = counters[at];
            counters[at] = slot + 1u;
#if EMIT
            if (slot < capacity) tile_splats[slot] = splat;
#endif
        }
    }
}
