#version 450
// Sums values into bins with float atomics. It is small on purpose: the tests drive the two sides of
// shared/atomic_float.glsl through it (src/gpu/tests.rs).
#extension GL_GOOGLE_include_directive : require
#include "shared/atomic_float.glsl"
layout(local_size_x = 128) in;

layout(std430, binding = 0) readonly buffer Values { float values[]; }; // [N]
layout(std430, binding = 1) readonly buffer Bins { uint bins[]; };      // [N]
layout(std430, binding = 2) buffer Sums { ATOMIC_FLOAT sums[]; };       // [B], added to
layout(push_constant) uniform Push { uint count; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i < count) ATOMIC_ADD(sums[bins[i]], values[i]);
}
