#version 450
// variants: SH_DEGREE=0,1,2,3
// Gradients of the raw splat parameters and of the camera. Equations and reference:
// pass::project_backward.
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

// Camera gradient of each subgroup: at most 16 subgroups, of 4 threads.
shared float by_camera[CAMERA_GRADIENTS][16];

// Gradient through the conic: rows of ∂B = 2 G' B.
void covariance_backward(Geometry g, vec3 by_conic, out vec3 by_b0, out vec3 by_b1) {
    mat2 q = mat2(g.conic.x, g.conic.y, g.conic.y, g.conic.z);
    mat2 by_sigma = -(q * mat2(by_conic.x, 0.5 * by_conic.y, 0.5 * by_conic.y, by_conic.z) * q);
    by_b0 = 2.0 * (g.b0 * by_sigma[0][0] + g.b1 * by_sigma[1][0]);
    by_b1 = 2.0 * (g.b0 * by_sigma[0][1] + g.b1 * by_sigma[1][1]);
}

// Gradient through the logarithm of the opacity of antialiased splats:
//   ∂ ln √(det BBᵀ / det Σ') = (BBᵀ)⁻¹ B − Σ'⁻¹ B
void filter_backward(Geometry g, float by_log_opacity, inout vec3 by_b0, inout vec3 by_b1) {
    float inv = 1.0 / max(dot(g.area, g.area), SMALLEST_AREA), xy = dot(g.b0, g.b1);
    vec3 own = vec3(dot(g.b1, g.b1) * inv, -xy * inv, dot(g.b0, g.b0) * inv) - g.conic;
    by_b0 += by_log_opacity * (own.x * g.b0 + own.y * g.b1);
    by_b1 += by_log_opacity * (own.y * g.b0 + own.z * g.b1);
}

// Gradient through one coordinate of the centre and one row of the Jacobian; adds to ∂t and to the
// gradient by the intrinsics.
void axis_backward(int axis, Geometry g, float by_centre, vec3 by_j, inout vec3 by_t, inout vec4 by_intrinsics) {
    float f = camera_focal()[axis], inv_z = 1.0 / g.t.z;
    float ratio = g.clamped[axis] * inv_z;
    by_t[axis] += f * inv_z * by_centre;
    by_t.z -= f * inv_z * inv_z * (g.t[axis] * by_centre + by_j[axis]);
    by_intrinsics[axis] += g.t[axis] * inv_z * by_centre + inv_z * (by_j[axis] - ratio * by_j.z);
    by_intrinsics[2 + axis] += by_centre;
    float by_ratio = -f * inv_z * by_j.z; // J[axis].z = -f ratio / z
    by_t.z -= by_ratio * inv_z * ratio;
    if (g.inside[axis]) {
        by_t[axis] += by_ratio * inv_z;
        by_t.z -= by_ratio * inv_z * ratio;
    } else { // the limit itself depends on the intrinsics
        by_intrinsics[axis] -= by_ratio * ratio / f;
        by_intrinsics[2 + axis] -= by_ratio / f;
    }
}

vec4 quat_backward(Geometry g, mat3 m) { // m = ∂R_q, m[col][row]
    float r = g.quat.x, x = g.quat.y, y = g.quat.z, z = g.quat.w;
    vec3 skew = vec3(m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0]);
    vec3 symmetric = vec3(m[2][1] + m[1][2], m[0][2] + m[2][0], m[1][0] + m[0][1]);
    vec4 by_unit = 2.0 * vec4(dot(vec3(x, y, z), skew),
        y * symmetric.z + z * symmetric.y + r * skew.x - 2.0 * x * (m[1][1] + m[2][2]),
        x * symmetric.z + z * symmetric.x + r * skew.y - 2.0 * y * (m[0][0] + m[2][2]),
        x * symmetric.y + y * symmetric.x + r * skew.z - 2.0 * z * (m[0][0] + m[1][1]));
    return (by_unit - g.quat * dot(g.quat, by_unit)) / g.quat_length;
}

// Writes the gradient by the SH coefficients and returns that by the mean through the viewing
// direction, world axes.
vec3 colour_backward(uint i, vec3 mean, vec3 by_colour) {
    vec3 offset = mean - camera_position();
    float distance = length(offset);
    vec3 direction = offset / distance, by_direction = vec3(0.0), colour = vec3(0.5);
    float basis[SH_COUNT];
    vec3 slope[SH_COUNT];
    sh_basis(direction, basis);
    sh_basis_gradient(direction, slope);
    vec3 coefficient[SH_COUNT];
    [[unroll]] for (int k = 0; k < SH_COUNT; k++) {
        uint at = 3 * (i * sh_stride + k);
        coefficient[k] = vec3(sh[at], sh[at + 1], sh[at + 2]);
        colour += basis[k] * coefficient[k];
    }
    by_colour = mix(by_colour, vec3(0.0), lessThan(colour, vec3(0.0)));
    [[unroll]] for (int k = 0; k < SH_COUNT; k++) {
        uint at = 3 * (i * sh_stride + k);
        sh_grad[at] = basis[k] * by_colour.r;
        sh_grad[at + 1] = basis[k] * by_colour.g;
        sh_grad[at + 2] = basis[k] * by_colour.b;
        by_direction += slope[k] * dot(coefficient[k], by_colour);
    }
    for (uint at = 3 * (i * sh_stride + SH_COUNT); at < 3 * (i + 1) * sh_stride; at++) sh_grad[at] = 0.0;
    return (by_direction - direction * dot(direction, by_direction)) / distance;
}

// Each thread walks the splats with a stride of all threads, so that there are few partial camera
// gradients to sum.
void main() {
    uint threads = gl_NumWorkGroups.x * gl_WorkGroupSize.x;
    vec3 by_rho = vec3(0.0), by_theta = vec3(0.0);
    vec4 by_intrinsics = vec4(0.0);
    for (uint i = gl_GlobalInvocationID.x; i < count; i += threads) {
        vec3 mean = vec3(means[3 * i], means[3 * i + 1], means[3 * i + 2]);
        vec3 log_scale = vec3(log_scales[3 * i], log_scales[3 * i + 1], log_scales[3 * i + 2]);
        Geometry g = geometry_of(mean, log_scale, quats[i]);
        // Zeros for a splat without pixels, whose gradients then are zero.
        float up[MOMENTS + BASE_CHANNELS];
        [[unroll]] for (int k = 0; k < MOMENTS + BASE_CHANNELS; k++) up[k] = projected_grad[GRADIENT_VECTORS * i + k / 4][k % 4];

        float opacity = 1.0 / (1.0 + exp(min(-opacity_logits[i], 80.0)));
        opacity_logits_grad[i] = up[0] * (1.0 - opacity);

        vec3 by_b0, by_b1;
        covariance_backward(g, vec3(-0.5 * up[3], -up[4], -0.5 * up[5]), by_b0, by_b1);
        if (antialiased != 0) filter_backward(g, up[0], by_b0, by_b1);
        mat3 m = mat3(g.rotation[0] * g.scale.x, g.rotation[1] * g.scale.y, g.rotation[2] * g.scale.z);
        vec3 by_j0 = to_camera_axes(m * by_b0), by_j1 = to_camera_axes(m * by_b1);
        vec3 by_t = vec3(0.0, 0.0, up[MOMENTS + 3]);
        vec4 by_k = vec4(0.0);
        axis_backward(0, g, -(g.conic.x * up[1] + g.conic.y * up[2]), by_j0, by_t, by_k);
        axis_backward(1, g, -(g.conic.z * up[2] + g.conic.y * up[1]), by_j1, by_t, by_k);

        mat3 by_m = outerProduct(g.t0, by_b0) + outerProduct(g.t1, by_b1);
        vec3 by_log_scale = g.scale * vec3(dot(g.rotation[0], by_m[0]), dot(g.rotation[1], by_m[1]),
                                           dot(g.rotation[2], by_m[2]));
        log_scales_grad[3 * i] = by_log_scale.x;
        log_scales_grad[3 * i + 1] = by_log_scale.y;
        log_scales_grad[3 * i + 2] = by_log_scale.z;
        quats_grad[i] = quat_backward(g, mat3(by_m[0] * g.scale.x, by_m[1] * g.scale.y, by_m[2] * g.scale.z));

        vec3 by_mean_colour = colour_backward(i, mean, vec3(up[MOMENTS], up[MOMENTS + 1], up[MOMENTS + 2]));
        vec3 by_mean = to_world_axes(by_t) + by_mean_colour;
        means_grad[3 * i] = by_mean.x;
        means_grad[3 * i + 1] = by_mean.y;
        means_grad[3 * i + 2] = by_mean.z;

        // Jᵀ ∂J, turn[col][row].
        mat3 turn = outerProduct(g.j0, by_j0) + outerProduct(g.j1, by_j1);
        if (g.visible) {
            by_rho += by_t + to_camera_axes(by_mean_colour);
            by_theta += cross(g.t, by_t) + vec3(turn[1][2] - turn[2][1], turn[2][0] - turn[0][2], turn[0][1] - turn[1][0]);
            by_intrinsics += by_k;
        }
    }
    float sums[CAMERA_GRADIENTS] = float[](by_rho.x, by_rho.y, by_rho.z, by_theta.x, by_theta.y, by_theta.z,
                               by_intrinsics.x, by_intrinsics.y, by_intrinsics.z, by_intrinsics.w);
    [[unroll]] for (int k = 0; k < CAMERA_GRADIENTS; k++) {
        float sum = subgroupAdd(sums[k]);
        if (gl_SubgroupInvocationID == 0) by_camera[k][gl_SubgroupID] = sum;
    }
    barrier();
    uint k = gl_LocalInvocationID.x;
    if (k >= CAMERA_GRADIENTS) return;
    float sum = 0.0;
    for (uint subgroup = 0; subgroup < gl_NumSubgroups; subgroup++) sum += by_camera[k][subgroup];
    camera_parts[k * gl_NumWorkGroups.x + gl_WorkGroupID.x] = sum;
}
