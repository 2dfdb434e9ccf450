#version 450
// variants: INDEXED=0,1
// Grouping by sorting, last step: a tile list begins where the tile of the sorted entries changes.
// Lists hold (entry, splat); where no pass needs the entry, the sorted (tile, splat) are the lists.
// Reference: pass::bin.
layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer EntryCount { uint entry_count; };
// [capacity] sorted: (tile, entry) with INDEXED, else (tile, splat).
layout(std430, binding = 1) readonly buffer Entries { uvec2 entries[]; };
layout(std430, binding = 2) writeonly buffer TileRanges { uint tile_ranges[]; };  // [tiles + 1]
#if INDEXED
layout(std430, binding = 3) writeonly buffer TileSplats { uvec2 tile_splats[]; };  // [capacity]
layout(std430, binding = 4) readonly buffer EntrySplats { uint entry_splats[]; };  // [capacity]
#endif
layout(push_constant) uniform Push { uint tiles; };

void main() {
    // Read before the loop: GPU-assisted validation turns a read in the condition into a loop that
    // lavapipe refuses.
    uint count = entry_count;
    // Includes i == count, which closes the list of the last tile and all empty ones after it.
    for (uint i = gl_GlobalInvocationID.x; i <= count; i += 256u * gl_NumWorkGroups.x) {
        bool real = i < count;
        uvec2 entry = real ? entries[i] : uvec2(tiles, 0);
        uint next = i > 0 ? entries[i - 1].x + 1 : 0;
        for (uint tile = next; tile <= entry.x; tile++) tile_ranges[tile] = i;
#if INDEXED
        if (real) tile_splats[i] = uvec2(entry.y, entry_splats[entry.y]);
#endif
    }
}
