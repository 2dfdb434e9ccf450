#version 460
// Gradient of the depth regulariser, weight * sum over confident pixels of |D - A d| / d. D =
// sum w z and A = sum w are rendered, d is the stereo depth. Linear in D and A, so it is stable
// where alpha is small.
layout(local_size_x = 64) in;
// [H*W] depth, 0 = unknown.
layout(std430, binding = 0) readonly buffer Reference { float reference[]; };
// [4 + d, H*W]: RGB, sum w z, features.
layout(std430, binding = 1) readonly buffer Planes { float planes[]; };
// [H*W] 1 - A.
layout(std430, binding = 2) readonly buffer Transmittance { float transmittance[]; };
// [4 + d + 1, H*W], the last by A.
layout(std430, binding = 3) writeonly buffer Upstream { float upstream[]; };
layout(push_constant) uniform Push { uint pixels; uint alpha_plane; float weight; };

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) return;
    float d = reference[pixel];
    float by_depth = 0.0, by_alpha = 0.0;
    if (d > 0.0) {
        float slope = weight * sign(planes[3u * pixels + pixel] - (1.0 - transmittance[pixel]) * d);
        by_depth = slope / d;
        by_alpha = -slope;
    }
    upstream[3u * pixels + pixel] = by_depth;
    upstream[alpha_plane * pixels + pixel] = by_alpha;
}
