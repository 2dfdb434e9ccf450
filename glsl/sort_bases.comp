#version 450
// OneSweep radix sort, step 2 of 3: exclusive scan of the digit histograms. One workgroup per pass.
layout(local_size_x = 256) in;

// [passes, 256] counts in, positions out.
layout(std430, binding = 0) buffer Digits { uint digits[]; };

shared uint sums[2][256];

void main() {
    uint digit = gl_LocalInvocationID.x;
    uint own = digits[gl_WorkGroupID.x * 256u + digit];
    uint side = 0u;
    sums[0][digit] = own;
    barrier();
    for (uint reach = 1u; reach < 256u; reach <<= 1u) {
        uint sum = sums[side][digit];
        if (digit >= reach) sum += sums[side][digit - reach];
        sums[1u - side][digit] = sum;
        side = 1u - side;
        barrier();
    }
    digits[gl_WorkGroupID.x * 256u + digit] = sums[side][digit] - own;
}
