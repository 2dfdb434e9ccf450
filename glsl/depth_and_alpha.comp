#version 460
// variants: DEPTH=0,1
// variants: ALPHA=0,1
// Gradients by depth and by alpha. Both planes are overwritten. With DEPTH the loss is weight * sum
// of |D - A d| / d over confident pixels, with ALPHA weight * sum of |A - a| over pixels with a
// wanted alpha a. D = sum w z and A = sum w are rendered, d is the stereo depth. The first loss is
// linear in D and A, so it is stable where alpha is small.
layout(local_size_x = 64) in;
#if DEPTH
// [H*W] depth, 0 = unknown.
layout(std430, binding = 0) readonly buffer Reference { float reference[]; };
// [4 + d, H*W]: RGB, sum w z, features.
layout(std430, binding = 1) readonly buffer Planes { float planes[]; };
#endif
#if ALPHA
// [H*W] alpha, negative = none.
layout(std430, binding = 2) readonly buffer Wanted { float wanted[]; };
#endif
#if DEPTH || ALPHA
// [H*W] 1 - A.
layout(std430, binding = 3) readonly buffer Transmittance { float transmittance[]; };
#endif
// [4 + d + 1, H*W], the last by A.
layout(std430, binding = 4) writeonly buffer Upstream { float upstream[]; };
layout(push_constant) uniform Push {
    uint pixels; uint alpha_plane; float depth_weight; float alpha_weight;
};

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) return;
    float by_depth = 0.0, by_alpha = 0.0;
#if DEPTH || ALPHA
    float alpha = 1.0 - transmittance[pixel];
#endif
#if DEPTH
    float d = reference[pixel];
    if (d > 0.0) {
        float slope = depth_weight * sign(planes[3u * pixels + pixel] - alpha * d);
        by_depth = slope / d;
        by_alpha = -slope;
    }
#endif
#if ALPHA
    float a = wanted[pixel];
    if (a >= 0.0) by_alpha += alpha_weight * sign(alpha - a);
#endif
    upstream[3u * pixels + pixel] = by_depth;
    upstream[alpha_plane * pixels + pixel] = by_alpha;
}
