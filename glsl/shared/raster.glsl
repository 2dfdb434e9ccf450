// One subgroup blends one 8x8 tile, whose pixels live in registers. The lanes load SUBGROUP_SIZE
// splats together and then loop over them with subgroupShuffle: no shared memory and no barrier.
// Equations: pass::raster_forward.
//
// CHANNELS is the size of a block of channels: 4 = RGB and depth, 7 / 12 / 20 = those and 3 / 8 /
// 16 features, 16 = sixteen further features only. A block with room for more features than there
// are reads zeros for the rest.
#include "shared/layout.glsl"
#include "shared/select.glsl"
#define BASE (CHANNELS != 16)
#if BASE
#define FEATURES (CHANNELS - BASE_CHANNELS)
#else
#define FEATURES CHANNELS
#endif
#define FEATURE_VECTORS ((FEATURES + 3) / 4)

// Pixels of a lane in the tile: column lane % LANES_X (+ LANES_X per column step), row
// lane / LANES_X (+ LANES_Y per row step).
#define LANES_X (SUBGROUP_SIZE < TILE ? SUBGROUP_SIZE : TILE)
#define LANES_Y (SUBGROUP_SIZE / LANES_X)
#define COLUMNS (TILE / LANES_X)
#define ROWS (TILE / LANES_Y)
#define PIXELS (COLUMNS * ROWS)

#include "shared/cutoffs.glsl"

// One splat per lane.
float own_u, own_v, own_a, own_b, own_c, own_log2_opacity;
float own_value[CHANNELS];

void load_splat(uint splat, bool valid) {
    vec4 p = projected[PROJECTED_VECTORS * splat], q = projected[PROJECTED_VECTORS * splat + 1];
    own_u = p.x;
    own_v = p.y;
    own_a = p.z;
    own_b = p.w;
    own_c = q.x;
    own_log2_opacity = select(valid, q.y, -1e4);
#if BASE
    vec4 r = projected[PROJECTED_VECTORS * splat + 2];
    [[unroll]] for (int k = 0; k < BASE_CHANNELS; k++) own_value[k] = r[k];
#endif
#if FEATURES > 0
    [[unroll]] for (int k = 0; k < FEATURE_VECTORS; k++) {
        uint at = uint(k) + first_vector;
        vec4 f = at < code_vectors ? codes[splat * code_vectors + at] : vec4(0.0);
        [[unroll]] for (int n = 0; n < 4; n++)
            if (4 * k + n < FEATURES) own_value[CHANNELS - FEATURES + 4 * k + n] = f[n];
    }
#endif
}

bool all_stopped(float transmittance[PIXELS]) {
    float most = transmittance[0];
    [[unroll]] for (int k = 1; k < PIXELS; k++) most = max(most, transmittance[k]);
    return subgroupAll(most < 0.0);
}
