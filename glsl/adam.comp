#version 460
// One Adam step (Kingma & Ba 2015) on `count` parameters; beta1 0.9, beta2 0.999, eps 1e-15 as in 3D Gaussian splatting.
// The host computes the bias corrections in f64 and writes rates[slot] = (head rate, tail rate, second, unused) before
// each step, so one recording serves all steps: rates include 1/(1-beta1^t), second is 1/sqrt(1-beta2^t).
//   p -= rate * m / (sqrt(v) * second + eps)
// The first `head` of every `stride` parameters use the head rate, the others the tail rate (SH: DC and the rest).
// The guard is the rasteriser's status: a frame whose tile lists overflowed has no gradients, and the step is repeated.
// A parameter whose gradient is not finite is left alone and counted in `faults`: the host stops with a clear error.
layout(local_size_x = 256) in;
layout(std430, binding = 0) buffer Parameters { float parameters[]; };
layout(std430, binding = 1) readonly buffer Gradients { float gradients[]; };
layout(std430, binding = 2) buffer Moments { vec2 moments[]; };  // (m, v) per parameter: one 64-bit access
layout(std430, binding = 3) buffer Faults { uint faults[]; };
layout(std430, binding = 4) readonly buffer Rates { vec4 rates[]; };
layout(std430, binding = 5) readonly buffer Guard { uint guard[]; };  // [2]; the step is void where guard[1] is not 0
layout(push_constant) uniform Push { uint count; uint stride; uint head; uint slot; };
const float BETA1 = 0.9, BETA2 = 0.999, EPS = 1e-15;

void main() {
    // Two-dimensional, since one dimension ends at 65535 workgroups on some devices.
    uint i = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * 256u + gl_LocalInvocationID.x;
    if (i >= count || guard[1] != 0u) return;
    float g = gradients[i];
    if ((floatBitsToUint(g) & 0x7f800000u) == 0x7f800000u) {  // isnan/isinf may be optimised away by drivers
        atomicAdd(faults[0], 1u);
        return;
    }
    vec2 mv = moments[i];
    float m = BETA1 * mv.x + (1.0 - BETA1) * g;
    float v = BETA2 * mv.y + (1.0 - BETA2) * g * g;
    moments[i] = vec2(m, v);
    vec4 step_rates = rates[slot];
    float rate = i % stride < head ? step_rates.x : step_rates.y;
    parameters[i] -= rate * m / (sqrt(v) * step_rates.z + EPS);
}
