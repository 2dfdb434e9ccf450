#version 450
// subgroups: 4,8,16,32,64
// Gradients by the screen-space splats of the four base channels, for GPUs: reduced over the pixels
// of a tile through shared memory instead of by shuffles.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "gpu/atomic_float.glsl"
#define CHANNELS 4
#include "shared/layout.glsl"
layout(local_size_x = SUBGROUP_SIZE) in;

// [N, 3], see project.comp.
layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };
layout(std430, binding = 1) readonly buffer TileRanges { uint tile_ranges[]; };  // [tiles + 1]
// [capacity] (entry, splat), see bin_ranges.comp.
layout(std430, binding = 2) readonly buffer TileSplats { uvec2 tile_splats[]; };
layout(std430, binding = 3) readonly buffer Planes { float planes[]; };  // [4 + d, H, W]
// [4 + d + 1, H, W], alpha last.
layout(std430, binding = 4) readonly buffer PlanesGrad { float planes_grad[]; };
layout(std430, binding = 5) readonly buffer Transmittance { float transmittances[]; };  // [H, W]
// [N, GRADIENT_FLOATS], added to.
layout(std430, binding = 6) buffer ProjectedGrad { ATOMIC_FLOAT projected_grad[]; };
// Fields of raster_backward.comp.
layout(push_constant) uniform Push {
    uint width; uint top; uint rows; uint first_row; uint list_row; uint tiles_x; uint alpha_plane;
};

#define SHARED_SPLATS 1
#define SHARED_BATCHES 1
#include "shared/raster.glsl"

// A group of splats is evaluated pixel by pixel; then each lane sums one splat over one part of the
// tile: two rows of pixels.
#define TILE_PARTS 4 // the numbers of a vector
#define PART_ROWS (TILE / TILE_PARTS)
#define PART_PIXELS (TILE * PART_ROWS)
#define GROUP (SUBGROUP_SIZE / TILE_PARTS)
// One number of padding per part: the lanes of a half subgroup then read different banks.
#define PART_STRIDE (PART_PIXELS + 1)
#define SPLAT_STRIDE (TILE_PARTS * PART_STRIDE)

// (w, σ) of every splat of a group and pixel.
shared vec2 factors[GROUP * SPLAT_STRIDE];
// Gradient by RGB and depth of every pixel.
shared vec4 pixel_grad[TILE * TILE];

float T[PIXELS], behind[PIXELS];
vec4 upstream[PIXELS];

// Stores (w, σ) of the pixels of this lane and splat i of the batch as splat `slot` of the group.
void evaluate(uint i, uint slot, uint lane, vec2 origin) {
    vec2 offset = centre_of(i) - origin;
    vec3 conic = conic_of(i);
    float log2_opacity = log2_opacity_of(i);
    load_values(i);
    [[unroll]] for (int n = 0; n < COLUMNS; n++) {
        float dx = offset.x - float(n * LANES_X);
        float ax = fma(conic.x * dx, dx, log2_opacity), bx = conic.y * dx;
        [[unroll]] for (int m = 0; m < ROWS; m++) {
            const int k = n * ROWS + m;
            float dy = offset.y - float(m * LANES_Y);
            float power = fma(fma(conic.z, dy, bx), dy, ax), raw = exp2(power);
            // The comparison of raster_forward.comp, so that both passes take the same splats.
            float alpha = select(power >= LOG2_ALPHA_MIN, min(ALPHA_MAX, raw), 0.0);
            float w = alpha * T[k], next = T[k] - w;
            bool stop = next < TRANSMITTANCE_MIN;
            float weight = select(stop, 0.0, w);
            // α / (1 − α), 0 where no gradient may reach the geometry.
            float ratio = select(both(!stop, raw <= ALPHA_MAX), alpha / (1.0 - alpha), 0.0);
            T[k] = select(stop, -abs(T[k]), next);
            float own = dot(values[0], upstream[k]);
            behind[k] = fma(-weight, own, behind[k]);
            float sigma = ratio * (T[k] * own - behind[k]);
            uint x = lane % LANES_X + n * LANES_X, y = lane / LANES_X + m * LANES_Y;
            uint at = y / PART_ROWS * PART_STRIDE + y % PART_ROWS * TILE + x;
            factors[slot * SPLAT_STRIDE + at] = vec2(weight, sigma);
        }
    }
}

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint tile_row = gl_WorkGroupID.y + first_row, bottom = top + rows;
    uint tile = (tile_row - list_row) * tiles_x + gl_WorkGroupID.x;
    uvec2 tile_corner = uvec2(gl_WorkGroupID.x, tile_row) * TILE;
    uvec2 corner = tile_corner + uvec2(lane % LANES_X, lane / LANES_X);
    uint first = tile_ranges[tile], last = tile_ranges[tile + 1], pixels = width * rows;

    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        uint x = corner.x + (k / ROWS) * LANES_X, y = corner.y + (k % ROWS) * LANES_Y;
        bool inside = both(x < width, y < bottom);
        uint pixel = select(inside, (y - top) * width + x, 0u);
        T[k] = select(inside, 1.0, -1.0);
        behind[k] = 0.0;
        [[unroll]] for (int channel = 0; channel < CHANNELS; channel++) {
            float g = select(inside, planes_grad[channel * pixels + pixel], 0.0);
            upstream[k][channel] = g;
            behind[k] = fma(g, planes[channel * pixels + pixel], behind[k]);
        }
        behind[k] -= select(inside, planes_grad[alpha_plane * pixels + pixel] * transmittances[pixel], 0.0);
        pixel_grad[(y - tile_corner.y) * TILE + x - tile_corner.x] = upstream[k];
    }
    barrier();
    uint slot = lane / TILE_PARTS, part = lane % TILE_PARTS;
    vec4 part_grad[PART_PIXELS];
    [[unroll]] for (int k = 0; k < PART_PIXELS; k++) part_grad[k] = pixel_grad[part * PART_PIXELS + k];

    begin_batches(first, last, lane);
    for (uint j = first; j < last; j += SUBGROUP_SIZE) {
        uint batch = min(uint(SUBGROUP_SIZE), last - j);
        load_batch(j, last, lane);
        for (uint base = 0; base < batch; base += GROUP) {
            [[unroll]] for (int n = 0; n < GROUP; n++) evaluate(base + n, n, lane, vec2(corner));
            barrier();
            uint i = base + slot;
            vec2 centre = centre_of(i) - vec2(tile_corner);
            vec4 colour = vec4(0.0);
            float sums[GRADIENT_FLOATS];
            [[unroll]] for (int n = 0; n < GRADIENT_FLOATS; n++) sums[n] = 0.0;
            [[unroll]] for (int row = 0; row < PART_ROWS; row++) {
                // Σσ, Σσx and Σσx² of the row, with x from the edge of the tile.
                float s0 = 0.0, s1 = 0.0, s2 = 0.0;
                [[unroll]] for (int x = 0; x < TILE; x++) {
                    vec2 f = factors[slot * SPLAT_STRIDE + part * PART_STRIDE + row * TILE + x];
                    colour = fma(vec4(f.x), part_grad[row * TILE + x], colour);
                    s0 += f.y;
                    s1 = fma(f.y, float(x), s1);
                    s2 = fma(f.y, float(x * x), s2);
                }
                float dy = centre.y - float(part * PART_ROWS + row);
                float by_x = fma(centre.x, s0, -s1);
                sums[0] += s0;
                sums[1] += by_x;
                sums[2] = fma(s0, dy, sums[2]);
                sums[3] += fma(centre.x, by_x - s1, s2);
                sums[4] = fma(by_x, dy, sums[4]);
                sums[5] = fma(s0 * dy, dy, sums[5]);
            }
            [[unroll]] for (int n = 0; n < CHANNELS; n++) sums[MOMENTS + n] = colour[n];
            // The four parts of a splat exchange halves, then quarters: part p keeps the sums of
            // numbers p, p + 4 and p + 8, so that the four parts add to one vector at a time.
            bool upper = (part & 2u) != 0u, odd = (part & 1u) != 0u;
            [[unroll]] for (int n = 0; n < 2 * GRADIENT_VECTORS; n++) {
                int at = TILE_PARTS * (n / 2) + n % 2;
                float low = sums[at], high = sums[at + 2];
                sums[at] = select(upper, high, low) + subgroupShuffleXor(select(upper, low, high), 2);
            }
            uint target = subgroupShuffle(own_item.y, i);
            [[unroll]] for (int n = 0; n < GRADIENT_VECTORS; n++) {
                float low = sums[TILE_PARTS * n], high = sums[TILE_PARTS * n + 1];
                float sum = select(odd, high, low) + subgroupShuffleXor(select(odd, low, high), 1);
                uint at = TILE_PARTS * n + part;
                // Some splats of a list reach no pixel of the tile.
                if (sum != 0.0 && at < MOMENTS + BASE_CHANNELS)
                    ATOMIC_ADD(projected_grad[GRADIENT_FLOATS * target + at], sum);
            }
            barrier();
        }
        if (all_stopped(T)) break;
    }
}
