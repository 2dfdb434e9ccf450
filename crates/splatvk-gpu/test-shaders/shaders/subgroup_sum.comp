#version 450
// The sum of all values, reduced per subgroup and added with float atomics.
// subgroups: 4,8,16,32,64
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "gpu/atomic_float.glsl"
layout(local_size_x = SUBGROUP_SIZE) in;
layout(std430, binding = 0) readonly buffer Values { float values[]; };
layout(std430, binding = 1) buffer Sum { ATOMIC_FLOAT sum[]; };
layout(push_constant) uniform Push { uint count; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    float group = subgroupAdd(i < count ? values[i] : 0.0);
    if (subgroupElect()) ATOMIC_ADD(sum[0], group);
}
