#version 460
// Exclusive prefix sum in place, by one workgroup (Hillis and Steele), and the total.
// variants: THREADS=256
layout(local_size_x = THREADS) in;
layout(std430, binding = 0) buffer Values { uint values[]; };
layout(std430, binding = 1) writeonly buffer Total { uint total; };
layout(push_constant) uniform Push { uint count; };
shared uint sums[2][THREADS];

void main() {
    uint thread = gl_LocalInvocationID.x;
    uint start = 0u;
    for (uint first = 0u; first < count; first += THREADS) {
        uint own = first + thread < count ? values[first + thread] : 0u;
        uint side = 0u;
        sums[0][thread] = own;
        barrier();
        for (uint reach = 1u; reach < THREADS; reach <<= 1u) {
            uint sum = sums[side][thread];
            if (thread >= reach) sum += sums[side][thread - reach];
            sums[1u - side][thread] = sum;
            side = 1u - side;
            barrier();
        }
        if (first + thread < count) values[first + thread] = start + sums[side][thread] - own;
        start += sums[side][THREADS - 1u];
        barrier();
    }
    if (thread == 0u) total = start;
}
