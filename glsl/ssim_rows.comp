#version 460
// SSIM, pass 2 of 3, for CPU devices (for GPUs: ssim_rows_shared.comp): horizontal blur, SSIM and
// its derivatives by (E[x], E[x²], E[xy]), and the horizontal blur of these derivatives in the same
// registers. A strip needs halo 10: 5 for each blur.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 8, local_size_y = 8) in;
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
#include "shared/select.glsl"
#include "shared/ssim.glsl"

void main() {
    int strip = int(gl_GlobalInvocationID.x);
    int y = int(gl_GlobalInvocationID.y);
    int x0 = strip * STRIP;
    int base = int(gl_WorkGroupID.z) * width * height + y * width;
    if (y >= height || strip >= strips) return;
    // Sliding windows over the last 11 columns and over the derivatives of the last 11 windows.
    vec2 mean[TAPS], moment[TAPS];
    vec3 slope[TAPS];
    [[unroll]] for (int k = 0; k < TAPS; k++) {
        mean[k] = moment[k] = vec2(0.0);
        slope[k] = vec3(0.0);
    }
    float sum = 0.0;
    for (int i = 0; i < STRIP + 20; i++) {
        [[unroll]] for (int k = 0; k < TAPS - 1; k++) {
            mean[k] = mean[k + 1];
            moment[k] = moment[k + 1];
            slope[k] = slope[k + 1];
        }
        int x = x0 + i - 10;
        bool inside = both(x >= 0, x < width);
        int q = base + clamp(x, 0, width - 1);
        mean[TAPS - 1] = select(inside, means[q], vec2(0.0));
        moment[TAPS - 1] = select(inside, moments[q], vec2(0.0));
        vec2 m = vec2(0.0), n = vec2(0.0);
        [[unroll]] for (int k = 0; k < TAPS; k++) {
            m = fma(vec2(WINDOW[k]), mean[k], m);
            n = fma(vec2(WINDOW[k]), moment[k], n);
        }
        // The window around this column is complete from i = 10 on; columns outside the image have
        // no SSIM.
        int centre = x0 + i - 15;
        vec4 d = ssim_of(m, n);
        bool real = both(centre >= 0, centre < width);
        slope[TAPS - 1] = select(real, d.xyz, vec3(0.0));
        sum += select(both(real, both(i >= 15, i < STRIP + 15)), d.w, 0.0);
        // The derivatives of all windows around this column exist from i = 20 on.
        int out_x = x0 + i - 20;
        if (i >= 20 && out_x < width) {
            vec3 blurred = vec3(0.0);
            [[unroll]] for (int k = 0; k < TAPS; k++) blurred = fma(vec3(WINDOW[k]), slope[k], blurred);
            slopes[base + out_x] = blurred.xy;
            cross_slopes[base + out_x] = blurred.z;
        }
    }
    sums[(int(gl_WorkGroupID.z) * height + y) * strips + strip] = y >= first && y < end ? sum : 0.0;
}
