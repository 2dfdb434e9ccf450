#version 450
// Exclusive scan, step 3 of 3: every lane scans its chunk from its start.
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Values { uint values[]; };  // [N]
layout(std430, binding = 1) readonly buffer Count { uint count; };  // N
layout(std430, binding = 2) readonly buffer Sums { uint sums[]; };  // [lanes] starts
// [N] sum of all values before.
layout(std430, binding = 3) writeonly buffer Starts { uint starts[]; };
layout(push_constant) uniform Push { uint lanes; };

#include "shared/saturate.glsl"

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= lanes) return;
    uint chunk = (count + lanes - 1u) / lanes;
    uint end = min((lane + 1u) * chunk, count);
    uint start = sums[lane];
    for (uint i = lane * chunk; i < end; i++) {
        starts[i] = start;
        start = saturated(start, values[i]);
    }
}
