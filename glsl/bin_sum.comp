#version 450
// Number of splats per tile: the sum over the lanes of bin_emit.comp. Reference: pass::bin.
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer Counters { uint counters[]; };  // [tiles, lanes]
// [tiles + 1], here: counts.
layout(std430, binding = 1) writeonly buffer TileRanges { uint tile_ranges[]; };
layout(push_constant) uniform Push { uint tiles; uint lanes; };

void main() {
    uint tile = gl_GlobalInvocationID.x;
    if (tile >= tiles) return;
    uint sum = 0;
    for (uint k = 0; k < lanes; k++) sum += counters[tile * lanes + k];
    tile_ranges[tile] = sum;
}
