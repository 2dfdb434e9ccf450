#version 450
// Radix sort in chunks, step 2 of 3: turns the counts, in place, into the position of the first
// element of each lane per digit: digits in order, and within a digit lanes in order. One thread
// per digit walks the lanes; one workgroup, so that the totals of the digits meet in shared memory.
layout(local_size_x = 256) in;

layout(std430, binding = 0) buffer Histogram { uint histogram[]; }; // [lanes, 256]
layout(std430, binding = 1) writeonly buffer Counts { uint counts[]; }; // see pass::sort
layout(push_constant) uniform Push { uint lanes; uint drop; };

shared uint totals[2][256];

void main() {
    uint digit = gl_LocalInvocationID.x;
    uint total = 0u;
    for (uint lane = 0u; lane < lanes; lane++) total += histogram[lane * 256u + digit];
    // Inclusive scan over the digits, double-buffered: one barrier per doubling.
    uint side = 0u;
    totals[0][digit] = total;
    barrier();
    for (uint reach = 1u; reach < 256u; reach <<= 1u) {
        uint sum = totals[side][digit];
        if (digit >= reach) sum += totals[side][digit - reach];
        totals[1u - side][digit] = sum;
        side = 1u - side;
        barrier();
    }
    uint place = totals[side][digit] - total;
    if (drop != 0u && digit == 255u) counts[0] = totals[side][digit];
    for (uint lane = 0u; lane < lanes; lane++) {
        uint slot = lane * 256u + digit;
        uint here = histogram[slot];
        histogram[slot] = place;
        place += here;
    }
}
