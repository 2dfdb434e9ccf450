#version 460
// Adds the gradient of the penalty on needles to the log-scale gradients: without it, splats that
// few views constrain become needles.
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer LogScales { float log_scales[]; };  // [N, 3]
layout(std430, binding = 1) buffer Gradients { float gradients[]; };  // [N, 3]
layout(push_constant) uniform Push { uint count; float weight; float limit; };
#include "shared/ratio_penalty.glsl"
#include "shared/rows.glsl"

void main() {
    uint i = thread_number();
    if (i >= count) return;
    vec3 s = vec3(log_scales[3u * i], log_scales[3u * i + 1u], log_scales[3u * i + 2u]);
    vec3 gradient = ratio_gradient(s, weight, limit);
    if (gradient == vec3(0.0)) return;
    for (uint c = 0u; c < 3u; c++) gradients[3u * i + c] += gradient[c];
}
