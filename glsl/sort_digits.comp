#version 450
// OneSweep radix sort, step 1 of 3: digit histograms of all passes, in one read of the keys.
layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Pairs { uvec2 pairs[]; };   // [N] (key, value)
layout(std430, binding = 1) readonly buffer Count { uint count; };      // N
layout(std430, binding = 2) buffer Digits { uint digits[]; };           // [4, 256], zero at first
layout(push_constant) uniform Push { uint mask; uint passes; };

const uint PAIRS_PER_THREAD = 32; // so many that the 1024 sums at the end cost little

shared uint counters[4 * 256];

void main() {
    uint thread = gl_LocalInvocationID.x;
    for (uint pass = 0u; pass < passes; pass++) counters[pass * 256u + thread] = 0u;
    barrier();
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    for (uint i = 0u; i < PAIRS_PER_THREAD; i++) {
        uint index = (group * PAIRS_PER_THREAD + i) * 256u + thread;
        if (index < count) {
            uint key = pairs[index].x & mask;
            for (uint pass = 0u; pass < passes; pass++) {
                atomicAdd(counters[pass * 256u + ((key >> (8u * pass)) & 255u)], 1u);
            }
        }
    }
    barrier();
    for (uint pass = 0u; pass < passes; pass++) {
        uint sum = counters[pass * 256u + thread];
        if (sum > 0u) atomicAdd(digits[pass * 256u + thread], sum);
    }
}
