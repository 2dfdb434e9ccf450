#version 450
// subgroups: 4,8,16,32,64
// Counts per tile to start offsets, by one subgroup. If the lists do not fit, every tile is made empty and the
// status says how much room is needed: an image without splats, never one with a few of them missing.
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x = SUBGROUP_SIZE) in;

layout(std430, binding = 0) buffer TileRanges { uint tile_ranges[]; }; // [tiles + 1]
// [2]: entries needed by this frame; the largest number that did not fit since the host cleared it, or 0
layout(std430, binding = 1) buffer Status { uint status[]; };
layout(push_constant) uniform Push { uint tiles; uint capacity; };

void main() {
    uint lane = gl_SubgroupInvocationID;
    uint total = 0;
    for (uint base = 0; base < tiles; base += SUBGROUP_SIZE) {
        uint tile = base + lane;
        total += subgroupAdd(tile < tiles ? tile_ranges[tile] : 0);
    }
    bool fits = total <= capacity;
    uint carry = 0;
    for (uint base = 0; base < tiles; base += SUBGROUP_SIZE) {
        uint tile = base + lane;
        uint size = tile < tiles && fits ? tile_ranges[tile] : 0;
        uint before = subgroupExclusiveAdd(size);
        if (tile < tiles) tile_ranges[tile] = carry + before;
        carry += subgroupAdd(size);
    }
    if (lane == 0) {
        tile_ranges[tiles] = carry;
        status[0] = total;
        status[1] = fits ? status[1] : max(status[1], total);
    }
}
