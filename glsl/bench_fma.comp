#version 450
// Fused multiply-adds on registers, for benchmarks: 16 independent chains hide their latency.
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(std430, binding = 0) buffer Values { float values[]; }; // [threads]
const int CHAINS = 16;
const int STEPS = 256; // CHAINS * STEPS fused multiply-adds per thread

void main() {
    uint i = gl_GlobalInvocationID.x;
    float start = values[i], chain[CHAINS];
    [[unroll]] for (int k = 0; k < CHAINS; k++) chain[k] = start + float(k);
    for (int step = 0; step < STEPS; step += 8)
        [[unroll]] for (int n = 0; n < 8; n++)
            [[unroll]] for (int k = 0; k < CHAINS; k++) chain[k] = fma(chain[k], 0.5, 0.25);
    float sum = 0.0;
    [[unroll]] for (int k = 0; k < CHAINS; k++) sum += chain[k];
    values[i] = sum;
}
