#version 450
// subgroups: 4,8,16,32,64
// Scans the counts per tile to start offsets, with one subgroup, and records the longest list.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x = SUBGROUP_SIZE) in;

layout(std430, binding = 0) buffer TileRanges { uint tile_ranges[]; }; // [tiles + 1]
layout(std430, binding = 1) buffer Status { uint status[]; };          // [3] see FrameBuffers
layout(push_constant) uniform Push { uint tiles; };

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint carry = 0, longest = 0;
    for (uint base = 0; base < tiles; base += SUBGROUP_SIZE) {
        uint tile = base + lane;
        uint size = tile < tiles ? tile_ranges[tile] : 0;
        uint before = subgroupExclusiveAdd(size);
        if (tile < tiles) tile_ranges[tile] = carry + before;
        carry += subgroupAdd(size);
        longest = max(longest, subgroupMax(size));
    }
    if (lane == 0) {
        tile_ranges[tiles] = carry;
        status[2] = max(status[2], longest); // of all frames since the host cleared it
    }
}
