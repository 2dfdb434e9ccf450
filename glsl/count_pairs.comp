#version 450
// subgroups: 4,8,16,32,64
// Walks the tile lists exactly as raster_forward.comp does and counts the pairs that it evaluates,
// those that it blends, and those in rows of a tile in which it blends any. For benchmarks.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(local_size_x = SUBGROUP_SIZE) in;

// [N, 3], see project.comp.
layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };
layout(std430, binding = 1) readonly buffer TileRanges { uint tile_ranges[]; };  // [tiles + 1]
// [capacity] (entry, splat), see bin_ranges.comp.
layout(std430, binding = 2) readonly buffer TileSplats { uvec2 tile_splats[]; };
// [tiles, 64] (evaluated, blended, in rows, 0), zero at first.
layout(std430, binding = 3) writeonly buffer Counts { uvec4 counts[]; };
layout(push_constant) uniform Push { uint width; uint height; uint tiles_x; };

#define CHANNELS BASE_CHANNELS
#include "shared/raster.glsl"

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint tile = gl_WorkGroupID.y * tiles_x + gl_WorkGroupID.x;
    uvec2 corner = gl_WorkGroupID.xy * TILE + uvec2(lane % LANES_X, lane / LANES_X);
    vec2 origin = vec2(corner);
    uint first = tile_ranges[tile], last = tile_ranges[tile + 1];
    uint evaluated = 0, blended = 0, in_rows = 0;
    float T[PIXELS];
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        uint x = corner.x + (k / ROWS) * LANES_X, y = corner.y + (k % ROWS) * LANES_Y;
        T[k] = select(both(x < width, y < height), 1.0, -1.0);
    }
    begin_batches(first, last, lane);
    for (uint j = first; j < last; j += SUBGROUP_SIZE) {
        load_batch(j, last, lane);
        uint batch = min(uint(SUBGROUP_SIZE), last - j);
        evaluated += batch * PIXELS;
        for (uint i = 0; i < batch; i++) {
            vec2 offset = centre_of(i) - origin;
            vec3 conic = conic_of(i);
            float log2_opacity = log2_opacity_of(i);
            bool shown_rows[ROWS];
            [[unroll]] for (int m = 0; m < ROWS; m++) shown_rows[m] = false;
            [[unroll]] for (int k = 0; k < PIXELS; k++) {
                float dx = offset.x - float((k / ROWS) * LANES_X), dy = offset.y - float((k % ROWS) * LANES_Y);
                float power = fma(fma(conic.z, dy, conic.y * dx), dy, fma(conic.x * dx, dx, log2_opacity));
                float alpha = select(power >= LOG2_ALPHA_MIN, min(ALPHA_MAX, exp2(power)), 0.0);
                float next = T[k] - alpha * T[k];
                bool stop = next < TRANSMITTANCE_MIN;
                bool shown = all(bvec3(alpha > 0.0, T[k] > 0.0, !stop));
                blended += uint(shown);
                shown_rows[k % ROWS] = any(bvec2(shown_rows[k % ROWS], shown));
                T[k] = select(stop, -abs(T[k]), next);
            }
            [[unroll]] for (int m = 0; m < ROWS; m++) {
                uvec4 lanes = subgroupBallot(shown_rows[m]);
                uint row = lane - lane % LANES_X;
                uint own = (lanes[row / 32] >> (row % 32)) & ((1u << LANES_X) - 1u);
                in_rows += own != 0u ? COLUMNS : 0;
            }
        }
        if (all_stopped(T)) break;
    }
    counts[tile * (TILE * TILE) + lane] = uvec4(evaluated, blended, in_rows, 0);
}
