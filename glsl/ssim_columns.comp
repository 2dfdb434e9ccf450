#version 460
// SSIM, pass 1 of 3: vertical blur of x, y, x²+y² and xy. One thread makes a strip of STRIP outputs
// of one column in registers, so each input is loaded once per strip (+10 halo rows) and no shared
// memory or barrier is needed. Threads along x are neighbours in memory: coalesced on a GPU, one
// vector load on a CPU device.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Rendered { float rendered[]; };  // [C, H, W]
// [C, H, W], with [H, W] weights behind it where weighted is not 0.
layout(std430, binding = 1) readonly buffer Target { float target_image[]; };
layout(std430, binding = 2) writeonly buffer Means { vec2 means[]; };  // [C, H, W] blurred (x, y)
// [C, H, W] blurred (x²+y², xy).
layout(std430, binding = 3) writeonly buffer Moments { vec2 moments[]; };
layout(push_constant) uniform Push { int width; int height; int weighted; };
#include "shared/ssim.glsl"

void main() {
    int x = int(gl_GlobalInvocationID.x);
    int y0 = int(gl_WorkGroupID.y) * STRIP;
    int base = int(gl_WorkGroupID.z) * width * height;
    if (x >= width) return;
    float a[STRIP], b[STRIP], e[STRIP], f[STRIP];
    [[unroll]] for (int k = 0; k < STRIP; k++) { a[k] = 0.0; b[k] = 0.0; e[k] = 0.0; f[k] = 0.0; }
    [[unroll]] for (int i = 0; i < STRIP + 2 * HALF; i++) {
        int y = y0 + i - HALF;
        bool inside = y >= 0 && y < height;
        int q = base + clamp(y, 0, height - 1) * width + x;
        float u = inside ? rendered[q] : 0.0;
        float v = inside ? target_image[q] : 0.0;
        // A pixel of weight 0 takes the value of the target.
        if (weighted != 0) u = fma(target_image[3 * width * height + (q - base)], u - v, v);
        float squares = u * u + v * v, product = u * v;
        [[unroll]] for (int k = 0; k < STRIP; k++) {
            if (i - k >= 0 && i - k < 2 * HALF + 1) {
                float w = WINDOW[i - k];
                a[k] = fma(w, u, a[k]);
                b[k] = fma(w, v, b[k]);
                e[k] = fma(w, squares, e[k]);
                f[k] = fma(w, product, f[k]);
            }
        }
    }
    [[unroll]] for (int k = 0; k < STRIP; k++) {
        if (y0 + k < height) {
            int q = base + (y0 + k) * width + x;
            means[q] = vec2(a[k], b[k]);
            moments[q] = vec2(e[k], f[k]);
        }
    }
}
