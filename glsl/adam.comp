#version 460
// One Adam step on `count` parameters (shared/adam.glsl). The host computes the bias corrections in
// f64 and writes rates[1 + slot] = (head rate, tail rate, second, eps) before each step, so one
// recording serves all steps: the rates include 1/(1-beta1^t), second is 1/sqrt(1-beta2^t).
// rates[0].x is the number of the step.
// The first `head` of every `stride` parameters use the head rate, the others the tail rate (SH: DC
// and the rest). The guard is the status of the rasteriser: a frame whose tile lists overflowed has
// no gradients, and the step is repeated. A parameter whose gradient is not finite stays and is
// counted in `faults`; the host then stops with an error. Four parameters per thread: on a CPU
// device an access costs the same at any width, on a GPU it is coalesced either way. Buffers are
// padded to whole vectors.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 256) in;
layout(std430, binding = 0) buffer Parameters { vec4 parameters[]; };
layout(std430, binding = 1) readonly buffer Gradients { vec4 gradients[]; };
// A word per parameter.
layout(std430, binding = 2) buffer Moments { uvec4 moments[]; };
layout(std430, binding = 3) buffer Faults { uint faults[]; };
layout(std430, binding = 4) readonly buffer Rates { vec4 rates[]; };
// [2]; the step is void where guard[1] is not 0.
layout(std430, binding = 5) readonly buffer Guard { uint guard[]; };
layout(push_constant) uniform Push { uint count; uint stride; uint head; uint slot; };
#include "shared/adam.glsl"

void main() {
    // Two-dimensional, since one dimension ends at 65535 workgroups on some devices.
    uint i = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * 256u + gl_LocalInvocationID.x;
    if (4u * i >= count || guard[1] != 0u) return;
    vec4 gradient = gradients[i], parameter = parameters[i];
    bool two = 4u * i + 2u < count;
    vec4 step_rates = rates[1u + slot], rate;
    uint column = 4u * i % stride, bad = 0u;
    [[unroll]] for (uint k = 0u; k < 4u; k++) {
        rate[k] = column < head ? step_rates.x : step_rates.y;
        column = column + 1u == stride ? 0u : column + 1u;
    }
    uvec4 four = moments[i];
    uvec4 noise = rounding_noise(4u * i + uvec4(0u, 1u, 2u, 3u), rounding_seed(rates[0].x, slot));
    bvec4 finite = adam(parameter, four, gradient, rate, step_rates.z, step_rates.w, noise);
    [[unroll]] for (uint k = 0u; k < 4u; k++) bad += finite[k] || 4u * i + k >= count ? 0u : 1u;
    parameters[i] = parameter;
    moments[i] = four;
    if (bad > 0u) atomicAdd(faults[0], bad);
}
