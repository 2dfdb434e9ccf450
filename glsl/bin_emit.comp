#version 450
// Grouping by counting: writes the entries, for every splat in depth order its tiles, row by row.
// All lanes have the same number of entries and splats together: many lanes share a splat that
// covers the screen, and none walks over most of the splats that have no tile (LOOP_ROUNDS).
// If the entries do not fit, none is written and the status holds the number needed: the image then
// has no splats at all, never a few missing. Reference: pass::bin.
//
// Rows of tiles from first_row up to end_row of the image are binned; tile 0 is the first of these.
//
// The lane counts its entries per tile, see bin_scatter.comp.
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 8) in;

layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };  // [N, 3]
// [N] (key, splat), sorted.
layout(std430, binding = 1) readonly buffer DepthPairs { uvec2 depth_pairs[]; };
// [N] first entry, in depth order.
layout(std430, binding = 2) readonly buffer Starts { uint starts[]; };
layout(std430, binding = 3) buffer Status { uint status[]; };  // [3] see FrameBuffers
// Entries, 0 if they do not fit.
layout(std430, binding = 4) writeonly buffer EntryCount { uint entry_count; };
layout(std430, binding = 5) writeonly buffer Entries { uvec2 entries[]; };  // [capacity] (tile, splat)
layout(std430, binding = 6) buffer Counters { uint counters[]; };  // [tiles, lanes]
// [lanes] first entry.
layout(std430, binding = 7) writeonly buffer LaneStarts { uint lane_starts[]; };
layout(std430, binding = 8) readonly buffer SplatCount { uint count; };  // visible splats
layout(push_constant) uniform Push {
    uint tiles_x; uint first_row; uint end_row; uint lanes; uint capacity;
};

#include "shared/tiles.glsl"

// Rank and entry at which a lane begins, `cost` entries and splats after the first: every splat
// counts one more than its entries.
uvec2 begin_at(uint cost, uint total) {
    uint low = 0, high = count;
    while (high - low > 1) {
        uint middle = (low + high) / 2;
        if (starts[middle] + middle <= cost) low = middle; else high = middle;
    }
    uint next = high < count ? starts[high] : total;
    return uvec2(low, min(cost - low, next));
}

void main() {
    uint lane = gl_GlobalInvocationID.x, total = status[0];
    if (lane >= lanes) return;
    bool fits = total <= capacity;
    if (lane == 0) {
        entry_count = fits ? total : 0;
        if (!fits) status[1] = max(status[1], total);
    }
    uint share = (total + count + lanes - 1) / lanes;
    uvec2 first = begin_at(lane * share, total);
    uint rank = first.x, begin = first.y, end = begin_at(lane * share + share, total).y;
    lane_starts[lane] = begin;
    if (!fits || begin >= end) return;

    uint entry = starts[rank], splat = depth_pairs[rank].y;
    Ellipse e = ellipse_of(splat, first_row, end_row, tiles_x);
    int row = e.first_row - 1, x = 0, last = -1;
    // One flat loop over (splat, row, tile): lanes with small splats do not wait for lanes with
    // large ones.
    while (entry < end && rank < count) {
        x++;
        if (x > last) {
            row++;
            if (row > e.last_row) {
                rank++;
                splat = depth_pairs[rank].y;
                e = ellipse_of(splat, first_row, end_row, tiles_x);
                row = e.first_row;
            }
            ivec2 interval = interval_of(e, row, tiles_x);
            x = interval.x;
            last = row <= e.last_row ? interval.y : -1;
            // Tiles before the share of this lane belong to other lanes.
            int skip = clamp(int(begin) - int(entry), 0, max(last - x + 1, 0));
            x += skip;
            entry += uint(skip);
        }
        if (x <= last) {
            uint tile = (uint(row) - first_row) * tiles_x + uint(x);
            entries[entry] = uvec2(tile, splat);
            counters[tile * lanes + lane]++;
            entry++;
        }
    }
}
