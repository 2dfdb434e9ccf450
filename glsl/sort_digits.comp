#version 450
// OneSweep radix sort, step 1 of 2: digit histograms of all passes, in one read of the keys.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly buffer Pairs { uvec2 pairs[]; };   // [N] (key, value)
layout(std430, binding = 1) readonly buffer Counts { uint counts[]; };  // see pass::sort
// From first_digit on [4, 256], zero at first.
layout(std430, binding = 2) buffer Zeros { uint zeros[]; };
// rounds: pairs per thread, a multiple of BLOCK.
layout(push_constant) uniform Push { uint mask; uint passes; uint first_digit; uint rounds; uint drop; };

const uint BLOCK = 4; // loads in flight at once

shared uint counters[4 * 256];

void main() {
    uint thread = gl_LocalInvocationID.x;
    for (uint pass = 0u; pass < passes; pass++) counters[pass * 256u + thread] = 0u;
    barrier();
    uint count = counts[drop];
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    for (uint i = 0u; i < rounds; i += BLOCK) {
        uint first = (group * rounds + i) * 256u + thread;
        uint keys[BLOCK];
        [[unroll]] for (uint k = 0u; k < BLOCK; k++) {
            keys[k] = first + k * 256u < count ? pairs[first + k * 256u].x & mask : 0u;
        }
        [[unroll]] for (uint k = 0u; k < BLOCK; k++) {
            if (first + k * 256u < count && (drop == 0u || keys[k] != mask)) {
                for (uint pass = 0u; pass < passes; pass++) {
                    atomicAdd(counters[pass * 256u + ((keys[k] >> (8u * pass)) & 255u)], 1u);
                }
            }
        }
    }
    barrier();
    for (uint pass = 0u; pass < passes; pass++) {
        uint sum = counters[pass * 256u + thread];
        if (sum > 0u) atomicAdd(zeros[first_digit + pass * 256u + thread], sum);
    }
}
