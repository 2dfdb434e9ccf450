#version 450
// Grouping by sorting, last step: the sorted entries become the tile lists, and where the tile changes a list begins.
// Reference: pass::bin.
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer EntryCount { uint entry_count; };
layout(std430, binding = 1) readonly buffer Entries { uvec2 entries[]; };            // [capacity] (tile, entry), sorted
layout(std430, binding = 2) readonly buffer EntrySplats { uint entry_splats[]; };    // [capacity]
layout(std430, binding = 3) writeonly buffer TileRanges { uint tile_ranges[]; };     // [tiles + 1]
layout(std430, binding = 4) writeonly buffer TileSplats { uvec2 tile_splats[]; };    // [capacity] (splat, entry)
layout(push_constant) uniform Push { uint tiles; uint lanes; };

void main() {
    // Read before the loop: of a read in its condition GPU-assisted validation makes a loop that lavapipe refuses.
    uint count = entry_count;
    // One more than there are entries: the end closes the list of the last tile and all empty ones after it.
    for (uint i = gl_GlobalInvocationID.x; i <= count; i += lanes) {
        bool real = i < count;
        uvec2 entry = real ? entries[i] : uvec2(tiles, 0);
        uint next = i > 0 ? entries[i - 1].x + 1 : 0;
        for (uint tile = next; tile <= entry.x; tile++) tile_ranges[tile] = i;
        if (real) tile_splats[i] = uvec2(entry_splats[entry.y], entry.y);
    }
}
