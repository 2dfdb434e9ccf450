#version 460
// variants: SSIM=0,1
// SSIM, pass 3 of 3: vertical blur of the derivatives, then the gradient of
//   l1_weight * mean|x-y| + dssim_weight * (1 - mean SSIM)
// by x; the loss weights are given divided by the number of values. Also the sum of |x-y| per
// strip. Where pixels have weights w, x is y + w (x-y) in all three passes: a pixel of weight 0
// does not affect the windows of its neighbours. With SSIM=0 the loss is the first term alone, and
// this is the only pass.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Rendered { float rendered[]; };  // [C, H, W]
// [C, H, W], with [H, W] weights behind it where weighted is not 0.
layout(std430, binding = 1) readonly buffer Target { float target_image[]; };
#if SSIM
layout(std430, binding = 2) readonly buffer Slopes { vec2 slopes[]; };  // [C, H, W]
layout(std430, binding = 3) readonly buffer Cross { float cross_slopes[]; };  // [C, H, W]
#endif
// [C, H, W]: the first planes of the upstream stack.
layout(std430, binding = 4) writeonly buffer Gradient { float gradient[]; };
// From first_sum on [C, strips, W] sum of |x-y| over each strip.
layout(std430, binding = 5) writeonly buffer Sums { float sums[]; };
// Rows outside first .. end belong to other bands of the image: no gradient, no loss.
layout(push_constant) uniform Push {
    int width; int height; float l1_weight; float dssim_weight; int first; int end; int weighted; int first_sum;
};
#include "shared/ssim.glsl"

void main() {
    int x = int(gl_GlobalInvocationID.x);
    int y0 = int(gl_WorkGroupID.y) * STRIP;
    int channel = int(gl_WorkGroupID.z);
    int base = channel * width * height;
    if (x >= width) return;
#if SSIM
    float a[STRIP], b[STRIP], c[STRIP];
    [[unroll]] for (int k = 0; k < STRIP; k++) { a[k] = 0.0; b[k] = 0.0; c[k] = 0.0; }
    [[unroll]] for (int i = 0; i < STRIP + 2 * HALF; i++) {
        int y = y0 + i - HALF;
        bool inside = y >= 0 && y < height;
        int q = base + clamp(y, 0, height - 1) * width + x;
        vec2 slope = inside ? slopes[q] : vec2(0.0);
        float cross_slope = inside ? cross_slopes[q] : 0.0;
        [[unroll]] for (int k = 0; k < STRIP; k++) {
            if (i - k >= 0 && i - k < 2 * HALF + 1) {
                float w = WINDOW[i - k];
                a[k] = fma(w, slope.x, a[k]);
                b[k] = fma(w, slope.y, b[k]);
                c[k] = fma(w, cross_slope, c[k]);
            }
        }
    }
#endif
    float sum = 0.0;
    [[unroll]] for (int k = 0; k < STRIP; k++) {
        if (y0 + k < height) {
            int q = base + (y0 + k) * width + x;
            float u = rendered[q], v = target_image[q];
            float share = weighted != 0 ? target_image[3 * width * height + (q - base)] : 1.0;
            if (weighted != 0) u = fma(share, u - v, v);
            bool counts = y0 + k >= first && y0 + k < end;
            float slope = l1_weight * sign(u - v);
#if SSIM
            slope -= dssim_weight * (a[k] + 2.0 * u * b[k] + v * c[k]);
#endif
            gradient[q] = counts ? share * slope : 0.0;
            sum += counts ? abs(u - v) : 0.0;
        }
    }
    sums[first_sum + (channel * int(gl_NumWorkGroups.y) + int(gl_WorkGroupID.y)) * width + x] = sum;
}
