#version 460
// Partial sums of one or two ranges of floats, always in the same order: strided over the
// workgroups of a range, then a tree. The host adds the PARTIALS sums of a range, which begin at
// result[PARTIALS * (slot + range)].
layout(local_size_x = 256) in;
layout(std430, binding = 0) readonly buffer Values { float values[]; };
layout(std430, binding = 1) writeonly buffer Result { float result[]; };
// Begins and lengths of the ranges.
layout(push_constant) uniform Push { uint first0; uint count0; uint first1; uint count1; uint slot; };
const uint PARTIALS = 64; // workgroups of a range
shared float partial[256];

void main() {
    uint lane = gl_LocalInvocationID.x, range = gl_WorkGroupID.y;
    uint first = range == 0u ? first0 : first1, count = range == 0u ? count0 : count1;
    float sum = 0.0;
    for (uint i = gl_WorkGroupID.x * 256u + lane; i < count; i += PARTIALS * 256u) sum += values[first + i];
    partial[lane] = sum;
    barrier();
    for (uint width = 128u; width > 0u; width >>= 1) {
        if (lane < width) partial[lane] += partial[lane + width];
        barrier();
    }
    if (lane == 0u) result[PARTIALS * (slot + range) + gl_WorkGroupID.x] = partial[0];
}
