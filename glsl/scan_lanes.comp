#version 450
// Exclusive scan, step 2 of 3: the lanes' sums become their starts; the grand total goes behind them.
layout(local_size_x = 256) in;

layout(std430, binding = 0) buffer Sums { uint sums[]; };              // [lanes] sums in, starts out
layout(std430, binding = 1) writeonly buffer Total { uint total; };    // sum of everything
layout(push_constant) uniform Push { uint lanes; };                    // a multiple of 256

shared uint totals[2][256];

void main() {
    uint thread = gl_LocalInvocationID.x;
    uint each = lanes / 256u;
    uint first = thread * each;
    uint own = 0u;
    for (uint i = 0u; i < each; i++) own += sums[first + i];
    uint side = 0u;
    totals[0][thread] = own;
    barrier();
    for (uint reach = 1u; reach < 256u; reach <<= 1u) {
        uint sum = totals[side][thread];
        if (thread >= reach) sum += totals[side][thread - reach];
        totals[1u - side][thread] = sum;
        side = 1u - side;
        barrier();
    }
    uint start = totals[side][thread] - own;
    for (uint i = 0u; i < each; i++) {
        uint sum = sums[first + i];
        sums[first + i] = start;
        start += sum;
    }
    if (thread == 255u) total = start;
}
