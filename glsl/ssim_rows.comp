#version 460
// SSIM, pass 2 of 3: horizontal blur, SSIM and its derivatives by (E[x], E[x²], E[xy]), and at once the horizontal
// blur of those derivatives, which stays in the same registers. A strip needs halo 10: 5 for each blur.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 8, local_size_y = 8) in;
layout(std430, binding = 0) readonly buffer Means { vec2 means[]; };  // [C, H, W]
layout(std430, binding = 1) readonly buffer Moments { vec2 moments[]; };  // [C, H, W]
layout(std430, binding = 2) writeonly buffer Slopes { vec2 slopes[]; };  // [C, H, W] blurred (dS/dE[x], dS/dE[x²])
layout(std430, binding = 3) writeonly buffer Cross { float cross_slopes[]; };  // [C, H, W] blurred dS/dE[xy]
layout(std430, binding = 4) writeonly buffer Sums { float sums[]; };  // [C, H, strips] sum of S over each strip
// Rows outside first .. end have their part in the derivatives of others, but are not summed.
layout(push_constant) uniform Push { int width; int height; int strips; int first; int end; };
#include "shared/select.glsl"
#include "shared/ssim.glsl"

void main() {
    int strip = int(gl_GlobalInvocationID.x);
    int y = int(gl_GlobalInvocationID.y);
    int x0 = strip * STRIP;
    int base = int(gl_WorkGroupID.z) * width * height + y * width;
    if (y >= height || strip >= strips) return;
    float a[STRIP + 10], b[STRIP + 10], e[STRIP + 10], f[STRIP + 10], oa[STRIP], ob[STRIP], oc[STRIP];
    [[unroll]] for (int k = 0; k < STRIP + 10; k++) { a[k] = 0.0; b[k] = 0.0; e[k] = 0.0; f[k] = 0.0; }
    [[unroll]] for (int k = 0; k < STRIP; k++) { oa[k] = 0.0; ob[k] = 0.0; oc[k] = 0.0; }
    float sum = 0.0;
    [[unroll]] for (int i = 0; i < STRIP + 20; i++) {
        int x = x0 + i - 10;
        bool inside = both(x >= 0, x < width);
        int q = base + clamp(x, 0, width - 1);
        vec2 mean = select(inside, means[q], vec2(0.0));
        vec2 moment = select(inside, moments[q], vec2(0.0));
        [[unroll]] for (int k = 0; k < STRIP + 10; k++) {
            if (i - k >= 0 && i - k < 2 * HALF + 1) {
                float w = WINDOW[i - k];
                a[k] = fma(w, mean.x, a[k]);
                b[k] = fma(w, mean.y, b[k]);
                e[k] = fma(w, moment.x, e[k]);
                f[k] = fma(w, moment.y, f[k]);
            }
        }
        // With tap i the window around column x0 + i - 15 is complete; columns outside the image have no SSIM. No branch stands here
        // before the first is complete: within one the compiler does not write the inner loop out.
        int k = max(i - 10, 0);
        int centre = x0 + i - 15;
        float mx = a[k], my = b[k];
        float product = mx * my, squares = mx * mx + my * my;
        float a1 = 2.0 * product + C1, a2 = 2.0 * (f[k] - product) + C2, b1 = squares + C1, b2 = (e[k] - squares) + C2;
        float inverse = 1.0 / (b1 * b2);
        float s = a1 * a2 * inverse;
        vec3 d = vec3(2.0 * my * (a2 - a1) * inverse - 2.0 * mx * s / b1 + 2.0 * mx * s / b2, -s / b2, 2.0 * a1 * inverse);
        bool real = both(centre >= 0, centre < width);
        d = select(real, d, vec3(0.0));
        if (i >= 15 && i < STRIP + 15) sum += select(real, s, 0.0);
        [[unroll]] for (int o = 0; o < STRIP; o++) {
            int tap = i - 10 - o;
            if (tap >= 0 && tap < 2 * HALF + 1) {
                float w = WINDOW[tap];
                oa[o] = fma(w, d.x, oa[o]);
                ob[o] = fma(w, d.y, ob[o]);
                oc[o] = fma(w, d.z, oc[o]);
            }
        }
    }
    [[unroll]] for (int k = 0; k < STRIP; k++) {
        if (x0 + k < width) {
            slopes[base + x0 + k] = vec2(oa[k], ob[k]);
            cross_slopes[base + x0 + k] = oc[k];
        }
    }
    sums[(int(gl_WorkGroupID.z) * height + y) * strips + strip] = y >= first && y < end ? sum : 0.0;
}
