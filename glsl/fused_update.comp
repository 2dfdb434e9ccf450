#version 450
// variants: SH_DEGREE=0,1,2,3
// Projection backward and Adam in one pass, for GPUs: the gradients of the parameters stay in
// shared memory. First each thread computes the gradient of its splat, then the workgroup moves the
// parameters of its splats with their moments, in the order of memory. Equations and reference:
// pass::project_backward, pass::adam; host: pass::fused_update. Guard, faults and rates as in
// adam.comp. All stored SH coefficients are used.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x = 64) in;

layout(std430, binding = 1) buffer Means { vec4 means[]; };  // [N, 3]
layout(std430, binding = 2) buffer LogScales { vec4 log_scales[]; };  // [N, 3]
layout(std430, binding = 3) buffer Quats { vec4 quats[]; };  // [N]
layout(std430, binding = 4) buffer OpacityLogits { vec4 opacity_logits[]; };  // [N]
layout(std430, binding = 5) buffer Sh { vec4 sh[]; };  // [N, SH_COUNT, 3]
layout(std430, binding = 6) readonly buffer ProjectedGrad { vec4 projected_grad[]; };  // [N, 3]
// A word per parameter.
layout(std430, binding = 7) buffer MeansMoments { uvec4 means_moments[]; };
layout(std430, binding = 8) buffer LogScalesMoments { uvec4 log_scales_moments[]; };
layout(std430, binding = 9) buffer QuatsMoments { uvec4 quats_moments[]; };
layout(std430, binding = 10) buffer OpacityLogitsMoments { uvec4 opacity_logits_moments[]; };
layout(std430, binding = 11) buffer ShMoments { uvec4 sh_moments[]; };
// [CAMERA_GRADIENTS, workgroups].
layout(std430, binding = 12) writeonly buffer CameraParts { float camera_parts[]; };
layout(std430, binding = 13) buffer Faults { uint faults[]; };
layout(std430, binding = 14) readonly buffer Rates { vec4 rates[]; };
// [2]; the step is void where guard[1] is not 0.
layout(std430, binding = 15) readonly buffer Guard { uint guard[]; };
// Weight and limit of the penalty on needles; a weight of 0 for none.
layout(push_constant) uniform Push { uint count; uint antialiased; float weight; float limit; };

#include "shared/adam.glsl"
#include "shared/camera.glsl"
#include "shared/layout.glsl"
#include "shared/ratio_penalty.glsl"
#include "shared/sh.glsl"
#include "shared/splat.glsl"

// Rows of the rates after the first.
const uint MEANS_ROW = 0, LOG_SCALES_ROW = 1, QUATS_ROW = 2, OPACITY_LOGITS_ROW = 3, SH_ROW = 4;

vec3 mean_of(uint i) {
    vec3 mean;
    [[unroll]] for (uint c = 0; c < 3; c++) mean[c] = means[(3 * i + c) / 4][(3 * i + c) % 4];
    return mean;
}
vec3 log_scale_of(uint i) {
    vec3 s;
    [[unroll]] for (uint c = 0; c < 3; c++) s[c] = log_scales[(3 * i + c) / 4][(3 * i + c) % 4];
    return s;
}
vec4 quat_of(uint i) { return quats[i]; }
float opacity_logit_of(uint i) { return opacity_logits[i / 4][i % 4]; }
void sh_of(uint i, out float coefficients[3 * SH_COUNT]) {
#if SH_COUNT % 4 == 0
    [[unroll]] for (int k = 0; k < 3 * SH_COUNT / 4; k++) {
        vec4 four = sh[i * (3 * SH_COUNT / 4) + k];
        [[unroll]] for (int c = 0; c < 4; c++) coefficients[4 * k + c] = four[c];
    }
#else
    [[unroll]] for (int k = 0; k < 3 * SH_COUNT; k++) {
        uint at = 3 * SH_COUNT * i + k;
        coefficients[k] = sh[at / 4][at % 4];
    }
#endif
}

#include "shared/project_backward.glsl"

const uint GROUP = gl_WorkGroupSize.x;
// Gradient of a splat: SH basis, colour, mean, log scale, quaternion, opacity. An odd number of
// words apart, so that threads that write the same entry of their splats use different banks.
const uint COLOUR = SH_COUNT, MEAN = COLOUR + 3, LOG_SCALE = MEAN + 3, QUAT = LOG_SCALE + 3;
const uint OPACITY = QUAT + 4, ROW = OPACITY + 1 | 1;
shared float gradients[GROUP * ROW];

void keep(uint thread, SplatGradient g) {
    uint at = thread * ROW;
    [[unroll]] for (int k = 0; k < SH_COUNT; k++) gradients[at + k] = g.basis[k];
    [[unroll]] for (int c = 0; c < 3; c++) {
        gradients[at + COLOUR + c] = g.colour[c];
        gradients[at + MEAN + c] = g.mean[c];
        gradients[at + LOG_SCALE + c] = g.log_scale[c];
    }
    [[unroll]] for (int c = 0; c < 4; c++) gradients[at + QUAT + c] = g.quat[c];
    gradients[at + OPACITY] = g.opacity_logit;
}

// Vectors of SH coefficients that a thread loads before it stores one: enough reads in flight.
const uint SH_BATCH = SH_DEGREE == 0 ? 1 : 3;

// Moves the WIDTH numbers of each of `splats` splats from `first` on, four per thread. GRADIENT and
// RATE are expressions of `splat`, the word of its gradient, `column` and `row`.
#define MOVE(parameters, moments, WIDTH, BATCH, ROW_OF_RATES, GRADIENT, RATE) { \
    uint end = splats * (WIDTH), base = first / 4 * (WIDTH); \
    vec4 row = rates[1 + (ROW_OF_RATES)]; \
    uint seed = rounding_seed(rates[0].x, ROW_OF_RATES); \
    for (uint begin = thread; 4 * begin < end; begin += (BATCH) * GROUP) { \
        vec4 parameter[BATCH]; \
        uvec4 four[BATCH]; \
        [[unroll]] for (uint b = 0; b < (BATCH); b++) { \
            uint v = begin + b * GROUP; \
            parameter[b] = vec4(0.0); \
            four[b] = uvec4(0); \
            if (4 * v < end) { \
                parameter[b] = parameters[base + v]; \
                four[b] = moments[base + v]; \
            } \
        } \
        [[unroll]] for (uint b = 0; b < (BATCH); b++) { \
            uint v = begin + b * GROUP; \
            if (4 * v < end) { \
                vec4 gradient, rate; \
                [[unroll]] for (uint c = 0; c < 4; c++) { \
                    /* Whole vectors belong to one splat where the width is a multiple of four. */ \
                    uint at = (WIDTH) % 4 == 0 ? 4 * v : 4 * v + c; \
                    uint column = at % (WIDTH) + (4 * v + c - at), splat = at / (WIDTH) * ROW; \
                    gradient[c] = GRADIENT; \
                    rate[c] = RATE; \
                } \
                uvec4 noise = rounding_noise(4 * (base + v) + uvec4(0, 1, 2, 3), seed); \
                bvec4 finite = adam(parameter[b], four[b], gradient, rate, row.z, row.w, noise); \
                if (!all(finite)) { \
                    uvec4 bad = uvec4(not(finite)); \
                    atomicAdd(faults[0], bad.x + bad.y + bad.z + bad.w); \
                } \
                parameters[base + v] = parameter[b]; \
                moments[base + v] = four[b]; \
            } \
        } \
    } \
}

// Moves the parameters of `splats` splats from `first` on.
void move_splats(uint first, uint splats) {
    uint thread = gl_LocalInvocationID.x;
    MOVE(means, means_moments, 3, 1, MEANS_ROW, gradients[splat + MEAN + column], row.x)
    MOVE(log_scales, log_scales_moments, 3, 1, LOG_SCALES_ROW,
         gradients[splat + LOG_SCALE + column], row.x)
    MOVE(quats, quats_moments, 4, 1, QUATS_ROW, gradients[splat + QUAT + column], row.x)
    MOVE(opacity_logits, opacity_logits_moments, 1, 1, OPACITY_LOGITS_ROW,
         gradients[splat + OPACITY], row.x)
    MOVE(sh, sh_moments, 3 * SH_COUNT, SH_BATCH, SH_ROW,
         gradients[splat + column / 3] * gradients[splat + COLOUR + column % 3],
         (column < 3 ? row.x : row.y))
}

// Each workgroup walks the splats with a stride of all workgroups, so that there are few partial
// camera gradients to sum.
void main() {
    uint end = guard[1] == 0 ? count : 0;
    uint threads = gl_NumWorkGroups.x * GROUP, thread = gl_LocalInvocationID.x;
    CameraGradient by_camera = CameraGradient(vec3(0.0), vec3(0.0), vec4(0.0));
    // All threads of a workgroup take the same number of turns.
    for (uint first = gl_WorkGroupID.x * GROUP; first < end; first += threads) {
        uint i = first + thread;
        if (i < count) {
            SplatGradient g = splat_backward(i, antialiased != 0, by_camera);
            g.log_scale += ratio_gradient(log_scale_of(i), weight, limit);
            keep(thread, g);
        } else {
            // The numbers after the last splat, which fill its last vector, do not move.
            [[unroll]] for (uint k = 0; k < ROW; k++) gradients[thread * ROW + k] = 0.0;
        }
        // Other threads move the splats that this one has read.
        controlBarrier(gl_ScopeWorkgroup, gl_ScopeWorkgroup,
                       gl_StorageSemanticsBuffer | gl_StorageSemanticsShared, gl_SemanticsAcquireRelease);
        move_splats(first, min(GROUP, count - first));
        barrier(); // the next turn overwrites the gradients
    }
    write_camera_part(by_camera);
}
