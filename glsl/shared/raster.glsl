// One subgroup blends one 8x8 tile, whose pixels live in registers. The lanes load a batch of
// SUBGROUP_SIZE splats together and then loop over it. Equations: pass::raster_forward.
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

// Subgroups of 32 and more belong to GPUs (those with fewer lanes shuffle). There the lanes read a
// splat from shared memory: one instruction for four numbers, where a shuffle takes one for each.
// CPU devices take about a microsecond per barrier, so they shuffle.
#ifndef SHARED_SPLATS
#define SHARED_SPLATS (SUBGROUP_SIZE >= 32)
#endif
// Batches in shared memory. With two, a lane that is ahead writes the next batch while others still
// read this one. One is enough for a shader with a barrier behind its last read.
#ifndef SHARED_BATCHES
#define SHARED_BATCHES 2
#endif

// (entry, splat) of this lane in the batch.
uvec2 own_item;

#if SHARED_SPLATS
#define VALUE_VECTORS ((CHANNELS + 3) / 4)
#define SPLAT_VECTORS (2 + VALUE_VECTORS)
// Values of the geometry and of the channels.
shared vec4 splats[SHARED_BATCHES * SPLAT_VECTORS * SUBGROUP_SIZE];
uint batch_start = 0; // vectors
// The next batch is on its way from memory while the lanes blend this one.
uvec2 next_item;
vec4 next_splat[SPLAT_VECTORS];
vec4 values[VALUE_VECTORS];

void fetch(uint at, uint last) {
    next_item = tile_splats[min(at, last - 1)];
    next_splat[0] = projected[PROJECTED_VECTORS * next_item.y];
    next_splat[1] = projected[PROJECTED_VECTORS * next_item.y + 1];
#if BASE
    next_splat[2] = projected[PROJECTED_VECTORS * next_item.y + 2];
#endif
#if FEATURES > 0
    [[unroll]] for (int k = 0; k < FEATURE_VECTORS; k++) {
        uint from = uint(k) + first_vector;
        next_splat[SPLAT_VECTORS - FEATURE_VECTORS + k] =
            from < code_vectors ? codes[next_item.y * code_vectors + from] : vec4(0.0);
    }
#endif
}

// Called once before the batches of entries first .. last.
void begin_batches(uint first, uint last, uint lane) {
    if (first < last) fetch(first + lane, last);
}

// Loads the batch that begins at entry j. Lanes behind the end hold a splat that reaches no pixel.
void load_batch(uint j, uint last, uint lane) {
    own_item = next_item;
    if (j + lane >= last) next_splat[1].y = -1e4;
    batch_start = (SHARED_BATCHES - 1) * SPLAT_VECTORS * SUBGROUP_SIZE - batch_start;
    [[unroll]] for (int k = 0; k < SPLAT_VECTORS; k++)
        splats[batch_start + SPLAT_VECTORS * lane + k] = next_splat[k];
    fetch(j + SUBGROUP_SIZE + lane, last);
    barrier();
}

vec4 vector_of(uint i, int k) { return splats[batch_start + SPLAT_VECTORS * i + k]; }
vec2 centre_of(uint i) { return vector_of(i, 0).xy; }
vec3 conic_of(uint i) { return vec3(vector_of(i, 0).zw, vector_of(i, 1).x); }
float log2_opacity_of(uint i) { return vector_of(i, 1).y; }
// Called before value_of.
void load_values(uint i) {
    [[unroll]] for (int k = 0; k < VALUE_VECTORS; k++) values[k] = vector_of(i, 2 + k);
}
float value_of(uint i, int channel) { return values[channel / 4][channel % 4]; }
#else
float own_u, own_v, own_a, own_b, own_c, own_log2_opacity;
float own_value[CHANNELS];

void begin_batches(uint first, uint last, uint lane) {}

void load_batch(uint j, uint last, uint lane) {
    own_item = tile_splats[min(j + lane, last - 1)];
    uint splat = own_item.y;
    vec4 p = projected[PROJECTED_VECTORS * splat], q = projected[PROJECTED_VECTORS * splat + 1];
    own_u = p.x;
    own_v = p.y;
    own_a = p.z;
    own_b = p.w;
    own_c = q.x;
    own_log2_opacity = select(j + lane < last, q.y, -1e4);
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

vec2 centre_of(uint i) { return vec2(subgroupShuffle(own_u, i), subgroupShuffle(own_v, i)); }
vec3 conic_of(uint i) {
    return vec3(subgroupShuffle(own_a, i), subgroupShuffle(own_b, i), subgroupShuffle(own_c, i));
}
float log2_opacity_of(uint i) { return subgroupShuffle(own_log2_opacity, i); }
void load_values(uint i) {}
float value_of(uint i, int channel) { return subgroupShuffle(own_value[channel], i); }
#endif

bool all_stopped(float transmittance[PIXELS]) {
    float most = transmittance[0];
    [[unroll]] for (int k = 1; k < PIXELS; k++) most = max(most, transmittance[k]);
    return subgroupAll(most < 0.0);
}
