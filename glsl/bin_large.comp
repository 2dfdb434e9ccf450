#version 450
// variants: INDEXED=0,1
// subgroups: 4,8,16,32,64
// Grouping by sorting: writes the entries of the large splats that bin_sweep.comp left, one splat
// per workgroup at a time. Reference: pass::bin.
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#if SUBGROUP_SIZE < 64
layout(local_size_x = 8 * SUBGROUP_SIZE) in;
#else
layout(local_size_x = 4 * SUBGROUP_SIZE) in;
#endif

layout(std430, binding = 0) readonly buffer Projected { vec4 projected[]; };  // [N, 3]
// [most] (splat, first entry).
layout(std430, binding = 1) readonly buffer LargeSplats { uvec2 large_splats[]; };
layout(std430, binding = 2) writeonly buffer Entries { uvec2 entries[]; };  // [capacity]
layout(std430, binding = 3) buffer Zeros { uint zeros[]; };  // see bin_sweep.comp
#if INDEXED
layout(std430, binding = 4) writeonly buffer EntrySplats { uint entry_splats[]; };  // [capacity]
#endif
layout(push_constant) uniform Push {
    uint tiles_x; uint first_row; uint end_row; uint capacity; uint first_digit; uint passes; uint most;
};

#include "shared/entries.glsl"

void main() {
    uint subgroup = gl_SubgroupID, thread = subgroup * SUBGROUP_SIZE + gl_SubgroupInvocationID;
    uint number = min(zeros[1], most);
    if (gl_WorkGroupID.x >= number) return;
    clear_digits(thread);
    barrier();
    for (uint i = gl_WorkGroupID.x; i < number; i += gl_NumWorkGroups.x) {
        write_by_subgroup(large_splats[i].x, large_splats[i].y, subgroup, SUBGROUPS);
    }
    barrier();
    add_digits(thread);
}
