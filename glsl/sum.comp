#version 460
// Sums `count` floats into result[slot + workgroup], always in the same order: strided over all
// workgroups, then a tree.
layout(local_size_x = 256) in;
layout(std430, binding = 0) readonly buffer Values { float values[]; };
layout(std430, binding = 1) writeonly buffer Result { float result[]; };
layout(push_constant) uniform Push { uint count; uint slot; };
shared float partial[256];

void main() {
    uint lane = gl_LocalInvocationID.x;
    float sum = 0.0;
    for (uint i = gl_WorkGroupID.x * 256u + lane; i < count; i += gl_NumWorkGroups.x * 256u) sum += values[i];
    partial[lane] = sum;
    barrier();
    for (uint width = 128u; width > 0u; width >>= 1) {
        if (lane < width) partial[lane] += partial[lane + width];
        barrier();
    }
    if (lane == 0u) result[slot + gl_WorkGroupID.x] = partial[0];
}
