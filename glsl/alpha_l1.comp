#version 460
// Adds the gradient of weight * sum of |A - a| over the pixels with a wanted alpha a, with A = 1 - T as rendered.
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Wanted { float wanted[]; };  // [H*W] alpha, negative = no opinion
layout(std430, binding = 1) readonly buffer Transmittance { float transmittance[]; };  // [H*W] 1 - A
layout(std430, binding = 2) buffer Upstream { float upstream[]; };  // [4 + d + 1, H*W], the last by A
layout(push_constant) uniform Push { uint pixels; uint alpha_plane; float weight; };

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) return;
    float a = wanted[pixel];
    float slope = weight * sign((1.0 - transmittance[pixel]) - a);
    if (a >= 0.0) upstream[alpha_plane * pixels + pixel] += slope;
}
