// Gradients by the screen-space splats. T is recomputed front to back. Six moments of σ and the
// channel sums are reduced over the tile by butterflies so that lane i keeps splat i. Blocks of
// channels add up, because the gradient by alpha is linear in the channels. Equations and
// reference: pass::raster_backward.
//
// BY_ENTRY 0: one atomic addition per value, tile and splat. 1: stored per entry for
// gradient_sum.comp, the same bits on every run.
#include "shared/layout.glsl"
layout(local_size_x = SUBGROUP_SIZE) in;

// [N, 3], see project.comp.
layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };
layout(std430, binding = 1) readonly buffer TileRanges { uint tile_ranges[]; };  // [tiles + 1]
// [capacity] (entry, splat), see bin_ranges.comp.
layout(std430, binding = 2) readonly buffer TileSplats { uvec2 tile_splats[]; };
#if CHANNELS != BASE_CHANNELS
layout(std430, binding = 3) readonly buffer Codes { vec4 codes[]; };  // [N, code_vectors]
#if BY_ENTRY
// [entries, FEATURE_VECTORS] of this block.
layout(std430, binding = 4) writeonly buffer CodeEntries { vec4 code_entries[]; };
#else
// [N, 4 * code_vectors], added to.
layout(std430, binding = 4) buffer CodesGrad { ATOMIC_FLOAT codes_grad[]; };
#endif
#endif
layout(std430, binding = 5) readonly buffer Planes { float planes[]; };  // [4 + d, H, W]
// [4 + d + 1, H, W], alpha last.
layout(std430, binding = 6) readonly buffer PlanesGrad { float planes_grad[]; };
#if CHANNELS != 16
layout(std430, binding = 7) readonly buffer Transmittance { float transmittances[]; };  // [H, W]
#endif
#if BY_ENTRY
// [entries, 3] as projected_grad.
layout(std430, binding = 8) buffer SplatEntries { vec4 splat_entries[]; };
#else
// [N, GRADIENT_FLOATS], added to.
layout(std430, binding = 8) buffer ProjectedGrad { ATOMIC_FLOAT projected_grad[]; };
#endif
// As in raster_forward.comp; coupling is 1 where the feature loss moves the geometry, else 0.
layout(push_constant) uniform Push {
    uint width; uint top; uint rows; uint first_row; uint list_row;
    uint tiles_x; uint code_vectors; uint first_vector; uint first_plane; uint features;
    uint alpha_plane; float coupling;
};

// A batch in shared memory takes 0.434 ms instead of 0.398 on an H200 (100,000 splats, 16
// features).
#include "shared/raster_shuffled.glsl"
#define VALUES (MOMENTS + CHANNELS)

float T[PIXELS], behind[PIXELS], upstream[CHANNELS * PIXELS];
float part[VALUES];

void evaluate(uint i, vec2 origin) {
    vec2 offset = centre_of(i) - origin;
    vec3 conic = conic_of(i);
    float log2_opacity = log2_opacity_of(i);
    // ratio = α / (1 − α), 0 where no gradient may reach the geometry
    float weight[PIXELS], ratio[PIXELS], own[PIXELS];
    [[unroll]] for (int n = 0; n < COLUMNS; n++) {
        float dx = offset.x - float(n * LANES_X);
        float ax = fma(conic.x * dx, dx, log2_opacity), bx = conic.y * dx;
        [[unroll]] for (int m = 0; m < ROWS; m++) {
            const int k = n * ROWS + m;
            float dy = offset.y - float(m * LANES_Y);
            float raw = exp2(fma(fma(conic.z, dy, bx), dy, ax));
            // The comparison of raster_forward.comp, so that both passes take the same splats.
            float alpha = select(fma(fma(conic.z, dy, bx), dy, ax) >= LOG2_ALPHA_MIN, min(ALPHA_MAX, raw), 0.0);
            float w = alpha * T[k], next = T[k] - w;
            bool stop = next < TRANSMITTANCE_MIN;
            weight[k] = select(stop, 0.0, w);
            ratio[k] = select(both(!stop, raw <= ALPHA_MAX), alpha / (1.0 - alpha), 0.0);
            T[k] = select(stop, -abs(T[k]), next);
            own[k] = 0.0;
        }
    }
    load_values(i);
    [[unroll]] for (int channel = 0; channel < CHANNELS; channel++) {
        float value = value_of(i, channel);
        float felt = value * (channel < CHANNELS - FEATURES ? 1.0 : coupling);
        float sum = 0.0;
        [[unroll]] for (int k = 0; k < PIXELS; k++) {
            own[k] = fma(felt, upstream[channel * PIXELS + k], own[k]);
            sum = fma(weight[k], upstream[channel * PIXELS + k], sum);
        }
        part[MOMENTS + channel] = sum;
    }
    [[unroll]] for (int k = 0; k < MOMENTS; k++) part[k] = 0.0;
    [[unroll]] for (int n = 0; n < COLUMNS; n++) {
        float dx = offset.x - float(n * LANES_X);
        float m0 = 0.0, m1 = 0.0, m2 = 0.0;
        [[unroll]] for (int m = 0; m < ROWS; m++) {
            const int k = n * ROWS + m;
            float dy = offset.y - float(m * LANES_Y);
            behind[k] = fma(-weight[k], own[k], behind[k]);
            float sigma = ratio[k] * (T[k] * own[k] - behind[k]);
            float sigma_y = sigma * dy;
            m0 += sigma;
            m1 += sigma_y;
            m2 = fma(sigma_y, dy, m2);
        }
        part[0] += m0;
        part[1] = fma(m0, dx, part[1]);
        part[2] += m1;
        part[3] = fma(m0 * dx, dx, part[3]);
        part[4] = fma(m1, dx, part[4]);
        part[5] += m2;
    }
}

// Stores or adds the sums of one (entry, splat).
void store_gradients(uvec2 item, float sums[VALUES]) {
#if BY_ENTRY
#if BASE
    splat_entries[GRADIENT_VECTORS * item.x] = vec4(sums[0], sums[1], sums[2], sums[3]);
    splat_entries[GRADIENT_VECTORS * item.x + 1] = vec4(sums[4], sums[5], sums[6], sums[7]);
    splat_entries[GRADIENT_VECTORS * item.x + 2] = vec4(sums[8], sums[9], 0.0, 0.0);
#else
    splat_entries[GRADIENT_VECTORS * item.x] += vec4(sums[0], sums[1], sums[2], sums[3]);
    splat_entries[GRADIENT_VECTORS * item.x + 1] += vec4(sums[4], sums[5], 0.0, 0.0);
#endif
#if FEATURES > 0
    [[unroll]] for (int k = 0; k < FEATURE_VECTORS; k++) {
        vec4 f = vec4(0.0);
        [[unroll]] for (int n = 0; n < 4; n++)
            if (4 * k + n < FEATURES) f[n] = sums[VALUES - FEATURES + 4 * k + n];
        code_entries[item.x * FEATURE_VECTORS + k] = f;
    }
#endif
#else
    [[unroll]] for (int n = 0; n < VALUES - FEATURES; n++) ATOMIC_ADD(projected_grad[GRADIENT_FLOATS * item.y + n], sums[n]);
#if FEATURES > 0
    [[unroll]] for (int n = 0; n < FEATURES; n++) {
        float sum = select(n < features, sums[VALUES - FEATURES + n], 0.0);
        ATOMIC_ADD(codes_grad[4 * (item.y * code_vectors + first_vector) + min(n, features - 1)], sum);
    }
#endif
#endif
}

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint tile_row = gl_WorkGroupID.y + first_row, bottom = top + rows;
    uint tile = (tile_row - list_row) * tiles_x + gl_WorkGroupID.x;
    uvec2 corner = uvec2(gl_WorkGroupID.x, tile_row) * TILE + uvec2(lane % LANES_X, lane / LANES_X);
    vec2 origin = vec2(corner);
    uint first = tile_ranges[tile], last = tile_ranges[tile + 1], pixels = width * rows;

    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        uint x = corner.x + (k / ROWS) * LANES_X, y = corner.y + (k % ROWS) * LANES_Y;
        bool inside = both(x < width, y < bottom);
        uint pixel = select(inside, (y - top) * width + x, 0u);
        T[k] = select(inside, 1.0, -1.0);
        behind[k] = 0.0;
        [[unroll]] for (int channel = 0; channel < CHANNELS; channel++) {
            bool used = both(inside, channel < CHANNELS - FEATURES || channel - (CHANNELS - FEATURES) < features);
            uint at = select(used, (first_plane + channel) * pixels + pixel, 0u);
            float g = select(used, planes_grad[at], 0.0);
            upstream[channel * PIXELS + k] = g;
            float felt = g * (channel < CHANNELS - FEATURES ? 1.0 : coupling);
            behind[k] = fma(felt, planes[at], behind[k]);
        }
#if BASE
        behind[k] -= select(inside, planes_grad[alpha_plane * pixels + pixel] * transmittances[pixel], 0.0);
#endif
    }

    begin_batches(first, last, lane);
    uint j = first;
    while (j < last) {
        load_batch(j, last, lane);
        uint batch = min(uint(SUBGROUP_SIZE), last - j);
        // Both halves of the subgroup keep their own half sum of splat i, and one exchange after
        // the loop completes them. That saves a shuffle per value and splat.
        float low[VALUES], high[VALUES];
        [[unroll]] for (int n = 0; n < VALUES; n++) low[n] = high[n] = 0.0;
        for (uint i = 0; i < batch; i++) {
            evaluate(i, origin);
            bool mine = (lane & (HALF - 1)) == (i & (HALF - 1));
            bool keep_low = both(mine, i < HALF), keep_high = both(mine, i >= HALF);
            [[unroll]] for (int n = 0; n < VALUES; n++) {
                float sum = part[n];
                sum += subgroupShuffleXor(sum, 1);
#if HALF > 2
                sum += subgroupShuffleXor(sum, 2);
#endif
#if HALF > 4
                sum += subgroupShuffleXor(sum, 4);
#endif
#if HALF > 8
                sum += subgroupShuffleXor(sum, 8);
#endif
#if HALF > 16
                sum += subgroupShuffleXor(sum, 16);
#endif
                low[n] = select(keep_low, sum, low[n]);
                high[n] = select(keep_high, sum, high[n]);
            }
        }
        bool in_low = lane < HALF;
        [[unroll]] for (int n = 0; n < VALUES; n++) {
            float own = select(in_low, low[n], high[n]);
            high[n] = subgroupShuffleXor(select(in_low, high[n], low[n]), HALF);
            low[n] = own;
        }
        [[unroll]] for (int n = 0; n < VALUES; n++) low[n] += high[n];
        if (j + lane < last) store_gradients(own_item, low);
        j += SUBGROUP_SIZE;
        if (all_stopped(T)) break;
    }
#if BY_ENTRY
    // Entries behind the last splat that any pixel sees.
    float zeros[VALUES];
    [[unroll]] for (int n = 0; n < VALUES; n++) zeros[n] = 0.0;
    for (j += lane; j < last; j += SUBGROUP_SIZE) store_gradients(tile_splats[j], zeros);
#endif
}
