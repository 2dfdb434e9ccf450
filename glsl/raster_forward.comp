#version 450
// variants: CHANNELS=4,7,12,16,20
// subgroups: 4,8,16,32,64
// Blends the splats of a tile front to back. Reference: pass::raster_forward.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/layout.glsl"
layout(local_size_x = SUBGROUP_SIZE) in;

// [N, 3], see project.comp.
layout(std430, binding = 1) readonly buffer Projected { vec4 projected[]; };
layout(std430, binding = 2) readonly buffer TileRanges { uint tile_ranges[]; };  // [tiles + 1]
// [capacity] (entry, splat), see bin_ranges.comp.
layout(std430, binding = 3) readonly buffer TileSplats { uvec2 tile_splats[]; };
#if CHANNELS != BASE_CHANNELS
layout(std430, binding = 4) readonly buffer Codes { vec4 codes[]; };  // [N, code_vectors]
#endif
layout(std430, binding = 5) writeonly buffer Planes { float planes[]; };  // [4 + d, H, W]
#if CHANNELS != 16
layout(std430, binding = 6) writeonly buffer Transmittance { float transmittances[]; };  // [H, W]
#endif
// `planes` hold `rows` rows of the image, from row `top` on. The dispatch begins at row `first_row`
// of the tiles of the image, the lists at row `list_row`. Features of this block start at vector
// first_vector of the code of a splat and fill `features` planes from first_plane + (4 if the block
// has RGB and depth).
layout(push_constant) uniform Push {
    uint width; uint top; uint rows; uint first_row; uint list_row;
    uint tiles_x; uint code_vectors; uint first_vector; uint first_plane; uint features;
};

#include "shared/camera.glsl"
#include "shared/raster.glsl"

// Splats of a batch whose arithmetic overlaps. Splats behind the end of a list reach no pixel.
#define UNROLLED (!SHARED_SPLATS ? 1 : CHANNELS == BASE_CHANNELS ? 8 : 2)

// A negative T marks a pixel that has stopped; pixels beyond the border have one from the start.
float T[PIXELS], sum[CHANNELS * PIXELS];

void blend(uint i, vec2 origin) {
    vec2 offset = centre_of(i) - origin;
    vec3 conic = conic_of(i);
    float log2_opacity = log2_opacity_of(i);
    float weight[PIXELS];
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
            weight[k] = select(stop, 0.0, w);
            T[k] = select(stop, -abs(T[k]), next);
        }
    }
    load_values(i);
    [[unroll]] for (int channel = 0; channel < CHANNELS; channel++) {
        float value = value_of(i, channel);
        [[unroll]] for (int k = 0; k < PIXELS; k++)
            sum[channel * PIXELS + k] = fma(weight[k], value, sum[channel * PIXELS + k]);
    }
}

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint tile_row = gl_WorkGroupID.y + first_row, bottom = top + rows;
    uint tile = (tile_row - list_row) * tiles_x + gl_WorkGroupID.x;
    uvec2 corner = uvec2(gl_WorkGroupID.x, tile_row) * TILE + uvec2(lane % LANES_X, lane / LANES_X);
    vec2 origin = vec2(corner);
    uint first = tile_ranges[tile], last = tile_ranges[tile + 1];

    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        uint x = corner.x + (k / ROWS) * LANES_X, y = corner.y + (k % ROWS) * LANES_Y;
        T[k] = select(both(x < width, y < bottom), 1.0, -1.0);
    }
    [[unroll]] for (int k = 0; k < CHANNELS * PIXELS; k++) sum[k] = 0.0;

    begin_batches(first, last, lane);
    for (uint j = first; j < last; j += SUBGROUP_SIZE) {
        load_batch(j, last, lane);
        uint batch = min(uint(SUBGROUP_SIZE), last - j);
        for (uint i = 0; i < batch; i += UNROLLED)
            [[unroll]] for (int n = 0; n < UNROLLED; n++) blend(i + n, origin);
        if (all_stopped(T)) break;
    }

    uint pixels = width * rows;
    [[unroll]] for (int k = 0; k < PIXELS; k++) {
        uint x = corner.x + (k / ROWS) * LANES_X, y = corner.y + (k % ROWS) * LANES_Y;
        if (x < width && y < bottom) {
            uint pixel = (y - top) * width + x;
#if BASE
            vec3 background = camera_background() * abs(T[k]);
            planes[pixel] = sum[k] + background.r;
            planes[pixels + pixel] = sum[PIXELS + k] + background.g;
            planes[2 * pixels + pixel] = sum[2 * PIXELS + k] + background.b;
            planes[3 * pixels + pixel] = sum[3 * PIXELS + k];
            transmittances[pixel] = abs(T[k]);
#endif
            [[unroll]] for (int channel = CHANNELS - FEATURES; channel < CHANNELS; channel++)
                if (channel - (CHANNELS - FEATURES) < features)
                    planes[(first_plane + channel) * pixels + pixel] = sum[channel * PIXELS + k];
        }
    }
}
