#version 450
// Exclusive scan, step 2 of 3: turns the sums of the lanes into their starts and writes the total.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 256) in;

layout(std430, binding = 0) buffer Sums { uint sums[]; };  // [lanes] sums in, starts out
layout(std430, binding = 1) writeonly buffer Total { uint total; };  // sum of everything
layout(push_constant) uniform Push { uint lanes; };                    // a multiple of 256

const uint BLOCK = 8;
shared uint totals[2][256];

#include "shared/saturate.glsl"

void main() {
    uint thread = gl_LocalInvocationID.x;
    uint each = lanes / 256u;
    uint first = thread * each;
    uint own = 0u;
    for (uint i = 0u; i < each; i++) own = saturated(own, sums[first + i]);
    uint side = 0u;
    totals[0][thread] = own;
    barrier();
    for (uint reach = 1u; reach < 256u; reach <<= 1u) {
        uint sum = totals[side][thread];
        if (thread >= reach) sum = saturated(sum, totals[side][thread - reach]);
        totals[1u - side][thread] = sum;
        side = 1u - side;
        barrier();
    }
    uint start = thread == 0u ? 0u : totals[side][thread - 1u];
    // A load after a store to the same buffer waits for it: each block is loaded, then stored.
    for (uint i = 0u; i < each; i += BLOCK) {
        uint block[BLOCK];
        [[unroll]] for (uint k = 0u; k < BLOCK; k++) block[k] = i + k < each ? sums[first + i + k] : 0u;
        [[unroll]] for (uint k = 0u; k < BLOCK; k++) {
            if (i + k < each) sums[first + i + k] = start;
            start = saturated(start, block[k]);
        }
    }
    if (thread == 255u) total = start;
}
