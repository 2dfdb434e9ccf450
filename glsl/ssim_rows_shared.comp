#version 450
// SSIM, pass 2 of 3, as ssim_rows.comp but for GPUs: a workgroup computes SPAN neighbouring outputs
// of a row with coalesced reads and writes; their windows overlap in shared memory.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Means { vec2 means[]; };  // [C, H, W]
layout(std430, binding = 1) readonly buffer Moments { vec2 moments[]; };  // [C, H, W]
// [C, H, W] blurred (dS/dE[x], dS/dE[x²]).
layout(std430, binding = 2) writeonly buffer Slopes { vec2 slopes[]; };
// [C, H, W] blurred dS/dE[xy].
layout(std430, binding = 3) writeonly buffer Cross { float cross_slopes[]; };
// [C, H, strips] sum of S over each strip.
layout(std430, binding = 4) writeonly buffer Sums { float sums[]; };
// Rows outside first .. end contribute to the derivatives of other rows, but are not summed.
layout(push_constant) uniform Push { int width; int height; int strips; int first; int end; };
#include "shared/ssim.glsl"

const int SPAN = 64; // outputs per workgroup
// (means, moments) of the columns, from 2 HALF before the first output on.
shared vec4 blurred[SPAN + 4 * HALF];
// Derivatives and S of the columns, from HALF before the first output on.
shared vec4 ssim[SPAN + 2 * HALF];

void main() {
    int thread = int(gl_LocalInvocationID.x), y = int(gl_WorkGroupID.y), x0 = int(gl_WorkGroupID.x) * SPAN;
    int base = (int(gl_WorkGroupID.z) * height + y) * width;
    for (int i = thread; i < SPAN + 4 * HALF; i += SPAN) {
        int x = x0 + i - 2 * HALF;
        blurred[i] = x >= 0 && x < width ? vec4(means[base + x], moments[base + x]) : vec4(0.0);
    }
    barrier();
    for (int i = thread; i < SPAN + 2 * HALF; i += SPAN) {
        int x = x0 + i - HALF;
        vec4 window = vec4(0.0);
        [[unroll]] for (int k = 0; k < TAPS; k++) window = fma(vec4(WINDOW[k]), blurred[i + k], window);
        // Columns outside the image have no SSIM.
        ssim[i] = x >= 0 && x < width ? ssim_of(window.xy, window.zw) : vec4(0.0);
    }
    barrier();
    int x = x0 + thread;
    if (x < width) {
        vec3 slope = vec3(0.0);
        [[unroll]] for (int k = 0; k < TAPS; k++) slope = fma(vec3(WINDOW[k]), ssim[thread + k].xyz, slope);
        slopes[base + x] = slope.xy;
        cross_slopes[base + x] = slope.z;
    }
    int strip = x0 / STRIP + thread;
    if (thread < SPAN / STRIP && strip < strips) {
        float sum = 0.0;
        for (int i = 0; i < STRIP; i++) sum += ssim[HALF + thread * STRIP + i].w;
        sums[(int(gl_WorkGroupID.z) * height + y) * strips + strip] = y >= first && y < end ? sum : 0.0;
    }
}
