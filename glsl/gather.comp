#version 460
// Rows of a [N, stride] array by index, to[i] = from[index[i]]: parameters and optimiser state.
layout(local_size_x = 256) in;
layout(std430, binding = 0) readonly buffer Index { uint index[]; };
layout(std430, binding = 1) readonly buffer From { uint from[]; };
layout(std430, binding = 2) writeonly buffer To { uint to[]; };
layout(push_constant) uniform Push { uint rows; uint stride; };

void main() {
    uint i = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * 256u + gl_LocalInvocationID.x;
    if (i >= rows * stride) return;
    uint row = i / stride;
    to[i] = from[index[row] * stride + (i - row * stride)];
}
