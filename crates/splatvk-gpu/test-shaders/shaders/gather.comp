#version 460
// to[i] = from[index[i]].
layout(local_size_x = 256) in;
layout(std430, binding = 0) readonly buffer Index { uint index[]; };
layout(std430, binding = 1) readonly buffer From { uint from[]; };
layout(std430, binding = 2) writeonly buffer To { uint to[]; };
layout(push_constant) uniform Push { uint rows; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i < rows) to[i] = from[index[i]];
}
