#version 450
// Grouping by counting, last step: each lane of bin_emit.comp moves its entries, in order, to its
// part of the list of each tile. Reference: pass::bin.
layout(local_size_x = 8) in;

layout(std430, binding = 0) readonly buffer EntryCount { uint entry_count; };
// [capacity] (tile, splat).
layout(std430, binding = 1) readonly buffer Entries { uvec2 entries[]; };
layout(std430, binding = 2) buffer Counters { uint counters[]; };  // [tiles, lanes] positions
// [capacity] (entry, splat).
layout(std430, binding = 3) writeonly buffer TileSplats { uvec2 tile_splats[]; };
// [lanes] first entry.
layout(std430, binding = 4) readonly buffer LaneStarts { uint lane_starts[]; };
layout(push_constant) uniform Push { uint lanes; };

void main() {
    uint lane = gl_GlobalInvocationID.x;
    if (lane >= lanes) return;
    // 0 where the entries did not fit: none is written.
    uint total = entry_count, end = lane + 1 < lanes ? min(lane_starts[lane + 1], total) : total;
    for (uint i = lane_starts[lane]; i < end; i++) {
        uvec2 entry = entries[i];
        uint at = entry.x * lanes + lane, place = counters[at];
        counters[at] = place + 1;
        tile_splats[place] = uvec2(i, entry.y);
    }
}
