#version 460
// Zeroes the gradients by depth and by alpha in an upstream stack, for views without a depth loss.
layout(local_size_x = 64) in;
// [4 + d + 1, H*W], the last by alpha.
layout(std430, binding = 0) writeonly buffer Upstream { float upstream[]; };
layout(push_constant) uniform Push { uint pixels; uint alpha_plane; };

void main() {
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) return;
    upstream[3u * pixels + pixel] = 0.0;
    upstream[alpha_plane * pixels + pixel] = 0.0;
}
