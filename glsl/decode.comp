#version 450
// Code per pixel: k* = argmax_k F.c_k, ties to the lowest k. -1 where alpha < VOID_ALPHA and where
// |F| < MIN_FEATURE_SHARE alpha, since such a pixel shows splats without features. Reference:
// pass::decode::decode_pixels.
// variants: DIM=4,8,16,32
#extension GL_EXT_control_flow_attributes : require
// A pixel with a lower alpha has no code.
const float VOID_ALPHA = 0.5;
// A pixel whose feature is shorter than this share of its alpha has no code: surfaces continued
// beyond the photos carry no features. Splat features are unit vectors, so |F| is the alpha that
// they contribute, less the cancellation between differing codes (a factor of sqrt(1/2) where two
// meet); a quarter separates that from stray contributions.
const float MIN_FEATURE_SHARE = 0.25;
#include "shared/select.glsl"
// Pixels per thread: each code is loaded once for four, since on lavapipe a load costs as much as
// seven FMAs.
#define PIXELS 4u
#define QUADS (DIM / 4)
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Features { float features[]; };  // planar [planes, P]
layout(std430, binding = 1) readonly buffer Transmittance { float transmittance[]; };  // [P]
layout(std430, binding = 2) readonly buffer Codes { vec4 codes[]; };  // [K, DIM / 4], zero padded
layout(std430, binding = 3) writeonly buffer Decoded { int decoded[]; };  // [P]
// The features are planes first_plane .. first_plane + dim.
layout(push_constant) uniform Push { uint pixels; uint count; uint dim; uint first_plane; };

void main() {
    uint first = gl_WorkGroupID.x * (64u * PIXELS) + gl_LocalInvocationID.x;
    vec4 feature[PIXELS * QUADS];
    [[unroll]] for (uint j = 0u; j < PIXELS; j++) {
        uint pixel = min(first + j * 64u, pixels - 1u);
        [[unroll]] for (uint q = 0u; q < QUADS; q++) {
            vec4 f;
            // Channels beyond dim repeat the last one; their code components are zero.
            [[unroll]] for (uint c = 0u; c < 4u; c++)
                f[c] = features[(first_plane + min(q * 4u + c, dim - 1u)) * pixels + pixel];
            feature[j * QUADS + q] = f;
        }
    }
    const float LOWEST = -3.4e38;
    float best[PIXELS];
    int chosen[PIXELS];
    [[unroll]] for (uint j = 0u; j < PIXELS; j++) {
        best[j] = LOWEST;
        chosen[j] = -1;
    }
    for (uint k = 0u; k < count; k++) {
        vec4 code[QUADS];
        [[unroll]] for (uint q = 0u; q < QUADS; q++) code[q] = codes[k * QUADS + q];
        [[unroll]] for (uint j = 0u; j < PIXELS; j++) {
            vec4 sums = vec4(0.0);
            [[unroll]] for (uint q = 0u; q < QUADS; q++) sums += code[q] * feature[j * QUADS + q];
            float score = sums.x + sums.y + sums.z + sums.w;
            bool better = score > best[j];
            best[j] = better ? score : best[j];
            chosen[j] = better ? int(k) : chosen[j];
        }
    }
    [[unroll]] for (uint j = 0u; j < PIXELS; j++) {
        uint pixel = first + j * 64u;
        float norm2 = 0.0;
        [[unroll]] for (uint q = 0u; q < QUADS; q++)
            [[unroll]] for (uint c = 0u; c < 4u; c++) {
                float f = feature[j * QUADS + q][c];
                norm2 += select(q * 4u + c < dim, f * f, 0.0);
            }
        float norm = sqrt(norm2);
        if (pixel < pixels) {
            float alpha = 1.0 - transmittance[pixel];
            bool shown = alpha >= VOID_ALPHA && norm >= MIN_FEATURE_SHARE * alpha;
            decoded[pixel] = shown ? chosen[j] : -1;
        }
    }
}
