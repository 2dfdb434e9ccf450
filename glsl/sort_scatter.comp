#version 450
// Radix sort in chunks, step 3 of 3: every lane moves its chunk, in order.
layout(local_size_x = 8) in; // as in step 1

layout(std430, binding = 0) readonly buffer Pairs { uvec2 pairs[]; };  // [N] (key, value)
layout(std430, binding = 1) readonly buffer Counts { uint counts[]; };  // see pass::sort
// [lanes, 256] positions.
layout(std430, binding = 2) readonly buffer Histogram { uint histogram[]; };
layout(std430, binding = 3) writeonly buffer Sorted { uvec2 sorted[]; };  // [N]
layout(push_constant) uniform Push { uint shift; uint mask; uint lanes; uint drop; };

shared uint places[256 * 8];

void main() {
    uint column = gl_LocalInvocationID.x;
    uint lane = gl_GlobalInvocationID.x;
    for (uint digit = 0u; digit < 256u; digit++) places[digit * 8u + column] = histogram[lane * 256u + digit];
    uint count = counts[drop], chunk = (count + lanes - 1u) / lanes;
    uint end = min((lane + 1u) * chunk, count);
    for (uint i = lane * chunk; i < end; i++) {
        uvec2 pair = pairs[i];
        uint key = pair.x & mask;
        if (drop != 0u && key == mask) continue;
        uint slot = ((key >> shift) & 255u) * 8u + column;
        uint place = places[slot];
        places[slot] = place + 1u;
        sorted[place] = pair;
    }
}
