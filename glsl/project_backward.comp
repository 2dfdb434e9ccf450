#version 450
// variants: SH_DEGREE=0,1,2,3
// variants: SHARED_SH=0,1
// Gradients of the raw splat parameters and of the camera. Equations and reference:
// pass::project_backward. A thread that writes the 48 SH gradients of its splat side by side is
// 192 bytes away from its neighbour. With SHARED_SH the workgroup keeps basis and colour of its
// splats in shared memory and writes their SH gradients in the order of the buffer. CPU devices
// write each splat by itself: a barrier costs them about a microsecond per workgroup.
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x = 64) in;

layout(std430, binding = 1) readonly buffer Means { float means[]; };  // [N, 3]
layout(std430, binding = 2) readonly buffer LogScales { float log_scales[]; };  // [N, 3]
layout(std430, binding = 3) readonly buffer Quats { vec4 quats[]; };  // [N]
layout(std430, binding = 4) readonly buffer OpacityLogits { float opacity_logits[]; };  // [N]
layout(std430, binding = 5) readonly buffer Sh { float sh[]; };  // [N, sh_stride, 3]
layout(std430, binding = 6) readonly buffer ProjectedGrad { vec4 projected_grad[]; };  // [N, 3]
layout(std430, binding = 7) writeonly buffer MeansGrad { float means_grad[]; };  // shapes as above
layout(std430, binding = 8) writeonly buffer LogScalesGrad { float log_scales_grad[]; };
layout(std430, binding = 9) writeonly buffer QuatsGrad { vec4 quats_grad[]; };
layout(std430, binding = 10) writeonly buffer OpacityLogitsGrad { float opacity_logits_grad[]; };
layout(std430, binding = 11) writeonly buffer ShGrad { float sh_grad[]; };
// [CAMERA_GRADIENTS, workgroups].
layout(std430, binding = 12) writeonly buffer CameraParts { float camera_parts[]; };
layout(push_constant) uniform Push { uint count; uint sh_stride; uint antialiased; };

#include "shared/camera.glsl"
#include "shared/layout.glsl"
#include "shared/sh.glsl"
#include "shared/splat.glsl"

vec3 mean_of(uint i) { return vec3(means[3 * i], means[3 * i + 1], means[3 * i + 2]); }
vec3 log_scale_of(uint i) {
    return vec3(log_scales[3 * i], log_scales[3 * i + 1], log_scales[3 * i + 2]);
}
vec4 quat_of(uint i) { return quats[i]; }
float opacity_logit_of(uint i) { return opacity_logits[i]; }
void sh_of(uint i, out float coefficients[3 * SH_COUNT]) {
    [[unroll]] for (int k = 0; k < 3 * SH_COUNT; k++) coefficients[k] = sh[3 * i * sh_stride + k];
}

#include "shared/project_backward.glsl"

#if SHARED_SH
const uint GROUP = gl_WorkGroupSize.x;
// Basis and colour gradient of each splat. An odd number of words apart, so that threads that write
// the same entry of their splats use different banks.
const uint COLOUR = SH_COUNT, ROW = SH_COUNT + 3 | 1;
shared float factors[GROUP * ROW];

// Writes the SH gradients, `width` numbers per splat, of the splats from `first` on.
void write_sh(uint first, uint width) {
    uint end = min(GROUP, count - first) * width;
    for (uint at = gl_LocalInvocationID.x; at < end; at += GROUP) {
        uint splat = at / width, column = at - splat * width, k = column / 3;
        float by_basis = k < SH_COUNT ? factors[splat * ROW + k] : 0.0;
        sh_grad[first * width + at] = by_basis * factors[splat * ROW + COLOUR + column - 3 * k];
    }
}
#endif

// Each thread walks the splats with a stride of all threads, so that there are few partial camera
// gradients to sum.
void main() {
    uint threads = gl_NumWorkGroups.x * gl_WorkGroupSize.x, thread = gl_LocalInvocationID.x;
    CameraGradient by_camera = CameraGradient(vec3(0.0), vec3(0.0), vec4(0.0));
    // All threads of a workgroup take the same number of turns.
    for (uint first = gl_WorkGroupID.x * gl_WorkGroupSize.x; first < count; first += threads) {
        uint i = first + thread;
        if (i < count) {
            SplatGradient g = splat_backward(i, antialiased != 0, by_camera);
            opacity_logits_grad[i] = g.opacity_logit;
            quats_grad[i] = g.quat;
            [[unroll]] for (int c = 0; c < 3; c++) {
                log_scales_grad[3 * i + c] = g.log_scale[c];
                means_grad[3 * i + c] = g.mean[c];
            }
#if SHARED_SH
            [[unroll]] for (int k = 0; k < SH_COUNT; k++) factors[thread * ROW + k] = g.basis[k];
            [[unroll]] for (int c = 0; c < 3; c++) factors[thread * ROW + COLOUR + c] = g.colour[c];
#else
            uint at = 3 * i * sh_stride;
            [[unroll]] for (int k = 0; k < 3 * SH_COUNT; k++) {
                sh_grad[at + k] = g.basis[k / 3] * g.colour[k % 3];
            }
            for (uint k = 3 * SH_COUNT; k < 3 * sh_stride; k++) sh_grad[at + k] = 0.0;
#endif
        }
#if SHARED_SH
        barrier();
        // Divisions by a constant are multiplications.
        if (sh_stride == SH_COUNT) write_sh(first, 3 * SH_COUNT);
        else write_sh(first, 3 * sh_stride);
        barrier(); // the next turn overwrites the factors
#endif
    }
    write_camera_part(by_camera);
}
