#version 450
// Grouping by sorting, last step: the sorted entries become the tile lists; a list begins where the
// tile changes. Reference: pass::bin.
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer EntryCount { uint entry_count; };
// [capacity] (tile, entry), sorted.
layout(std430, binding = 1) readonly buffer Entries { uvec2 entries[]; };
layout(std430, binding = 2) readonly buffer EntrySplats { uint entry_splats[]; };  // [capacity]
layout(std430, binding = 3) writeonly buffer TileRanges { uint tile_ranges[]; };  // [tiles + 1]
// [capacity] (splat, entry).
layout(std430, binding = 4) writeonly buffer TileSplats { uvec2 tile_splats[]; };
layout(push_constant) uniform Push { uint tiles; uint lanes; };

void main() {
    // Read before the loop: GPU-assisted validation turns a read in the condition into a loop that
    // lavapipe refuses.
    uint count = entry_count;
    // Includes i == count, which closes the list of the last tile and all empty ones after it.
    for (uint i = gl_GlobalInvocationID.x; i <= count; i += lanes) {
        bool real = i < count;
        uvec2 entry = real ? entries[i] : uvec2(tiles, 0);
        uint next = i > 0 ? entries[i - 1].x + 1 : 0;
        for (uint tile = next; tile <= entry.x; tile++) tile_ranges[tile] = i;
        if (real) tile_splats[i] = uvec2(entry_splats[entry.y], entry.y);
    }
}
