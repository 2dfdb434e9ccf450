#version 450
// Radix sort in chunks, step 1 of 3: every lane counts the digits of its own contiguous chunk.
// Contiguous chunks, one per lane, with private counters need neither atomics nor barriers, are
// stable by construction and do not depend on the subgroup size.
//
// 8 lanes x 256 counters fill 8 KiB of shared memory; lavapipe's subgroup is 8 wide.
layout(local_size_x = 8) in;

layout(std430, binding = 0) readonly buffer Pairs { uvec2 pairs[]; };            // [N] (key, value)
layout(std430, binding = 1) readonly buffer Counts { uint counts[]; };           // see pass::sort
layout(std430, binding = 2) writeonly buffer Histogram { uint histogram[]; };    // [lanes, 256]
layout(push_constant) uniform Push { uint shift; uint mask; uint lanes; uint drop; };

shared uint counters[256 * 8];

void main() {
    uint column = gl_LocalInvocationID.x;
    uint lane = gl_GlobalInvocationID.x;
    for (uint digit = 0u; digit < 256u; digit++) counters[digit * 8u + column] = 0u;
    uint count = counts[drop], chunk = (count + lanes - 1u) / lanes;
    uint end = min((lane + 1u) * chunk, count);
    for (uint i = lane * chunk; i < end; i++) {
        uint key = pairs[i].x & mask;
        uint slot = ((key >> shift) & 255u) * 8u + column;
        counters[slot] += drop != 0u && key == mask ? 0u : 1u;
    }
    for (uint digit = 0u; digit < 256u; digit++) histogram[lane * 256u + digit] = counters[digit * 8u + column];
}
