#version 450
// Turns counters into the position of the first entry of each (tile, lane) of bin_emit.comp.
// Reference: pass::bin.
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly buffer TileRanges { uint tile_ranges[]; }; // [tiles + 1]
layout(std430, binding = 1) buffer Counters { uint counters[]; };               // [tiles, lanes]
layout(push_constant) uniform Push { uint tiles; uint lanes; };

void main() {
    uint tile = gl_GlobalInvocationID.x;
    if (tile >= tiles) return;
    uint position = tile_ranges[tile];
    for (uint k = 0; k < lanes; k++) {
        uint size = counters[tile * lanes + k];
        counters[tile * lanes + k] = position;
        position += size;
    }
}
