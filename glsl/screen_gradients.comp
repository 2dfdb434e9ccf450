#version 450
#extension GL_GOOGLE_include_directive : require
// Adds up the length of each splat's gradient by its centre on the screen, for density control.
// Equations and reference: pass::screen_gradients.
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };  // [N, 3], see project.comp
layout(std430, binding = 1) readonly buffer ProjectedGrad { vec4 projected_grad[]; };  // [N, 3]
layout(std430, binding = 2) readonly buffer Guard { uint guard[]; };  // the frame's status
layout(std430, binding = 3) buffer Sums { vec2 sums[]; };  // [N] (sum of lengths, number of frames)
layout(push_constant) uniform Push { uint count; float half_width; float half_height; };

#include "shared/layout.glsl"
#include "shared/rows.glsl"

const float TO_CONIC = -2.0 * 0.6931471805599453; // from the coefficients of log2(e^p)

void main() {
    uint i = thread_number();
    if (i >= count || guard[1] != 0u) return;
    vec4 head = projected[PROJECTED_VECTORS * i], rest = projected[PROJECTED_VECTORS * i + 1];
    if (rest.y <= -1e3) return; // not visible
    float a = TO_CONIC * head.z, b = 0.5 * TO_CONIC * head.w, c = TO_CONIC * rest.x;
    vec4 moments = projected_grad[GRADIENT_VECTORS * i];
    vec2 by_centre = -vec2(a * moments.y + b * moments.z, c * moments.z + b * moments.y);
    sums[i] += vec2(length(by_centre * vec2(half_width, half_height)), 1.0);
}
