#version 450
// variants: EXPONENTIALS=0,1
// Fused multiply-adds or exponentials on registers, for benchmarks: independent chains hide their
// latency.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(std430, binding = 0) buffer Values { float values[]; }; // [threads]
layout(push_constant) uniform Push { uint rounds; };
const int INDEPENDENT = 16;
const int PER_ROUND = 8; // INDEPENDENT * PER_ROUND operations per thread and round

void main() {
    uint i = gl_GlobalInvocationID.x;
    float start = values[i], chain[INDEPENDENT];
    [[unroll]] for (int k = 0; k < INDEPENDENT; k++) chain[k] = start / float(k + 1);
    for (uint round = 0u; round < rounds; round++)
        [[unroll]] for (int n = 0; n < PER_ROUND; n++)
            [[unroll]] for (int k = 0; k < INDEPENDENT; k++)
#if EXPONENTIALS
                chain[k] = exp2(-chain[k]); // converges to 0.641
#else
                chain[k] = fma(chain[k], 0.5, 0.25); // converges to 0.5
#endif
    float sum = 0.0;
    [[unroll]] for (int k = 0; k < INDEPENDENT; k++) sum += chain[k];
    values[i] = sum;
}
