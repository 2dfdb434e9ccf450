#version 450
// subgroups: 4,8,16,32,64
// Blending weights of the splats of a tile, summed over the pixels of each label set of the tile.
// The pixels of a tile show few label sets; a dispatch sums SLOTS of them. Reference:
// pass::label_weights.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/layout.glsl"
layout(local_size_x = SUBGROUP_SIZE) in;

// [N, 3], see project.comp.
layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };
layout(std430, binding = 1) readonly buffer TileRanges { uint tile_ranges[]; };  // [tiles + 1]
// [capacity] (entry, splat), see bin_ranges.comp.
layout(std430, binding = 2) readonly buffer TileSplats { uvec2 tile_splats[]; };
// [rows, W] label set of each pixel, counted per tile from 0; -1 = none.
layout(std430, binding = 3) readonly buffer Slots { int slots[]; };
layout(std430, binding = 4) readonly buffer SlotCounts { uint slot_counts[]; };  // [tiles of the band]
// [capacity] in the order of the lists: sums of label sets first_slot and first_slot + 1.
layout(std430, binding = 5) writeonly buffer Weights { vec2 weights[]; };
// Rows as in raster_forward.comp.
layout(push_constant) uniform Push {
    uint width; uint top; uint rows; uint first_row; uint list_row; uint tiles_x; uint first_slot;
};

const int SLOTS = 2;

#define CHANNELS BASE_CHANNELS
#include "shared/raster_shuffled.glsl"

float T[PIXELS], part[SLOTS];
int slot[PIXELS];

void evaluate(uint i, vec2 origin) {
    vec2 offset = centre_of(i) - origin;
    vec3 conic = conic_of(i);
    float log2_opacity = log2_opacity_of(i);
    [[unroll]] for (int s = 0; s < SLOTS; s++) part[s] = 0.0;
    [[unroll]] for (int n = 0; n < COLUMNS; n++) {
        float dx = offset.x - float(n * LANES_X);
        float ax = fma(conic.x * dx, dx, log2_opacity), bx = conic.y * dx;
        [[unroll]] for (int m = 0; m < ROWS; m++) {
            const int k = n * ROWS + m;
            float dy = offset.y - float(m * LANES_Y);
            float power = fma(fma(conic.z, dy, bx), dy, ax);
            float alpha = select(power >= LOG2_ALPHA_MIN, min(ALPHA_MAX, exp2(power)), 0.0);
            float w = alpha * T[k], next = T[k] - w;
            bool stop = next < TRANSMITTANCE_MIN;
            float weight = select(stop, 0.0, w);
            T[k] = select(stop, -abs(T[k]), next);
            [[unroll]] for (int s = 0; s < SLOTS; s++) part[s] += select(slot[k] == s, weight, 0.0);
        }
    }
}

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint tile_row = gl_WorkGroupID.y + first_row, bottom = top + rows;
    uint tile = (tile_row - list_row) * tiles_x + gl_WorkGroupID.x;
    if (slot_counts[(tile_row - top / TILE) * tiles_x + gl_WorkGroupID.x] <= first_slot) return;
    uvec2 corner = uvec2(gl_WorkGroupID.x, tile_row) * TILE + uvec2(lane % LANES_X, lane / LANES_X);
    vec2 origin = vec2(corner);
    uint first = tile_ranges[tile], last = tile_ranges[tile + 1];

    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        uint x = corner.x + (k / ROWS) * LANES_X, y = corner.y + (k % ROWS) * LANES_Y;
        bool inside = both(x < width, y < bottom);
        T[k] = select(inside, 1.0, -1.0);
        // A pixel without a label set has a negative slot, one of another dispatch is beyond SLOTS.
        int own = slots[select(inside, (y - top) * width + x, 0u)];
        slot[k] = own < 0 || !inside ? -1 : own - int(first_slot);
    }

    begin_batches(first, last, lane);
    uint j = first;
    while (j < last) {
        load_batch(j, last, lane);
        uint batch = min(uint(SUBGROUP_SIZE), last - j);
        // Each half of the subgroup keeps its half sum of splat i, see raster_backward.glsl.
        float low[SLOTS], high[SLOTS];
        [[unroll]] for (int s = 0; s < SLOTS; s++) low[s] = high[s] = 0.0;
        for (uint i = 0; i < batch; i++) {
            evaluate(i, origin);
            bool mine = (lane & (HALF - 1)) == (i & (HALF - 1));
            bool keep_low = both(mine, i < HALF), keep_high = both(mine, i >= HALF);
            [[unroll]] for (int s = 0; s < SLOTS; s++) {
                float sum = part[s];
                [[unroll]] for (int reach = 1; reach < HALF; reach *= 2) sum += subgroupShuffleXor(sum, reach);
                low[s] = select(keep_low, sum, low[s]);
                high[s] = select(keep_high, sum, high[s]);
            }
        }
        bool in_low = lane < HALF;
        vec2 sums;
        [[unroll]] for (int s = 0; s < SLOTS; s++) {
            float own = select(in_low, low[s], high[s]);
            sums[s] = own + subgroupShuffleXor(select(in_low, high[s], low[s]), HALF);
        }
        if (j + lane < last) weights[j + lane] = sums;
        j += SUBGROUP_SIZE;
        if (all_stopped(T)) break;
    }
    // Entries behind the last splat that any pixel sees.
    for (j += lane; j < last; j += SUBGROUP_SIZE) weights[j] = vec2(0.0);
}
