#version 450
// Exclusive scan, step 1 of 3: every lane sums its own contiguous chunk.
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Values { uint values[]; };  // [N]
layout(std430, binding = 1) readonly buffer Count { uint count; };      // N
layout(std430, binding = 2) writeonly buffer Sums { uint sums[]; };     // [lanes]
layout(push_constant) uniform Push { uint lanes; };

#include "shared/saturate.glsl"

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= lanes) return;
    uint chunk = (count + lanes - 1u) / lanes;
    uint end = min((lane + 1u) * chunk, count);
    uint sum = 0u;
    for (uint i = lane * chunk; i < end; i++) sum = saturated(sum, values[i]);
    sums[lane] = sum;
}
