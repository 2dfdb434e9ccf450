#version 450
// Sums the gradients that raster_backward_entries.comp stored, over the entries of each splat and
// in their order. One thread per splat and vector: neighbouring threads read neighbouring vectors.
// An entry has room for `width` vectors, of which the first `vectors` are summed.
layout(local_size_x = 256) in;

// [N] (key, splat), sorted.
layout(std430, binding = 0) readonly buffer DepthPairs { uvec2 depth_pairs[]; };
// [N] in that order.
layout(std430, binding = 1) readonly buffer TileCounts { uint tile_counts[]; };
layout(std430, binding = 2) readonly buffer Starts { uint starts[]; };  // [N] in that order
// 0 if the entries did not fit.
layout(std430, binding = 3) readonly buffer EntryCount { uint entry_count; };
layout(std430, binding = 4) readonly buffer Entries { vec4 entries[]; };  // [entries, width]
// [N, stride], from first_vector on.
layout(std430, binding = 5) buffer Sums { vec4 sums[]; };
// add: 0 overwrites the sums, 1 adds to those of other tiles.
layout(push_constant) uniform Push { uint count; uint width; uint vectors; uint stride; uint first_vector; uint add; };

void main() {
    uint thread = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * 256u + gl_LocalInvocationID.x;
    uint rank = thread / vectors, vector = thread % vectors;
    if (rank >= count) return;
    uint first = starts[rank], last = entry_count > 0 ? first + tile_counts[rank] : first;
    vec4 sum = vec4(0.0);
    for (uint entry = first; entry < last; entry++) sum += entries[entry * width + vector];
    uint at = depth_pairs[rank].y * stride + first_vector + vector;
    sums[at] = add > 0 ? sums[at] + sum : sum;
}
