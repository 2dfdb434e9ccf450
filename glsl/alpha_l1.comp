#version 460
// Adds the gradient of weight * sum of |A - a| over the pixels with a wanted alpha a; A = 1 - T is
// the rendered alpha.
layout(local_size_x = 64) in;
// [H*W] alpha, negative = none.
layout(std430, binding = 0) readonly buffer Wanted { float wanted[]; };
// [H*W] 1 - A.
layout(std430, binding = 1) readonly buffer Transmittance { float transmittance[]; };
// [4 + d + 1, H*W], the last by A.
layout(std430, binding = 2) buffer Upstream { float upstream[]; };
layout(push_constant) uniform Push { uint pixels; uint alpha_plane; float weight; };

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) return;
    float a = wanted[pixel];
    float slope = weight * sign((1.0 - transmittance[pixel]) - a);
    if (a >= 0.0) upstream[alpha_plane * pixels + pixel] += slope;
}
