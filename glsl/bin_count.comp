#version 450
// Number of tiles of every splat, in depth order. Reference: pass::bin.
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };  // [N, 3]
// [N] (key, splat), sorted.
layout(std430, binding = 1) readonly buffer DepthPairs { uvec2 depth_pairs[]; };
layout(std430, binding = 2) writeonly buffer TileCounts { uint tile_counts[]; };  // [N]
layout(std430, binding = 3) readonly buffer SplatCount { uint count; };  // visible splats
layout(push_constant) uniform Push { uint tiles_x; uint first_row; uint end_row; };

#include "shared/tiles.glsl"
#include "shared/rows.glsl"

void main() {
    uint rank = thread_number();
    if (rank >= count) return;
    Ellipse e = ellipse_of(depth_pairs[rank].y, first_row, end_row, tiles_x);
    uint sum = 0;
    for (int row = e.first_row; row <= e.last_row; row++) {
        ivec2 interval = interval_of(e, row, tiles_x);
        sum += uint(max(interval.y - interval.x + 1, 0));
    }
    tile_counts[rank] = sum;
}
