#version 450
// Copies a buffer, for benchmarks: STEPS vec4 per thread, neighbours in neighbouring threads.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 256) in;
layout(std430, binding = 0) readonly buffer Source { vec4 source[]; };
layout(std430, binding = 1) writeonly buffer Target { vec4 target[]; };
const uint STEPS = 8u;

void main() {
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    uint first = group * 256u * STEPS + gl_LocalInvocationID.x;
    [[unroll]] for (uint k = 0u; k < STEPS; k++) target[first + 256u * k] = source[first + 256u * k];
}
