// Gradients of the raw parameters of one splat and of the camera. Equations and reference:
// pass::project_backward. Needs shared/camera.glsl, layout.glsl, sh.glsl and splat.glsl, the buffers
// ProjectedGrad and CameraParts, and the functions mean_of, log_scale_of, quat_of,
// opacity_logit_of and sh_of, which read the parameters of a splat.

struct SplatGradient {
    vec3 mean;
    vec3 log_scale;
    vec4 quat;
    float opacity_logit;
    // The gradient by SH coefficient k is basis[k] * colour.
    float basis[SH_COUNT];
    vec3 colour;
};

struct CameraGradient {
    vec3 rho, theta;
    vec4 intrinsics;
};

// Camera gradient of each subgroup: at most 16 subgroups, of 4 threads.
shared float subgroup_sums[CAMERA_GRADIENTS][16];

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
void axis_backward(int axis, Geometry g, float by_centre, vec3 by_j, inout vec3 by_t,
                   inout vec4 by_intrinsics) {
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

// Sets basis and colour of the gradient and returns the gradient by the mean through the viewing
// direction, world axes. The coefficients are used as they are read: with degree 3 they would
// occupy 48 registers.
vec3 colour_backward(uint i, vec3 mean, vec3 by_colour, inout SplatGradient result) {
    vec3 offset = mean - camera_position();
    float distance = length(offset);
    vec3 direction = offset / distance, colour = vec3(0.5);
    // Derivatives of the three channels by the direction.
    vec3 slopes[3] = vec3[3](vec3(0.0), vec3(0.0), vec3(0.0));
    vec3 slope[SH_COUNT];
    sh_basis(direction, result.basis);
    sh_basis_gradient(direction, slope);
    float coefficients[3 * SH_COUNT];
    sh_of(i, coefficients);
    [[unroll]] for (int k = 0; k < SH_COUNT; k++) {
        vec3 coefficient = vec3(coefficients[3 * k], coefficients[3 * k + 1], coefficients[3 * k + 2]);
        colour += result.basis[k] * coefficient;
        slopes[0] += slope[k] * coefficient.r;
        slopes[1] += slope[k] * coefficient.g;
        slopes[2] += slope[k] * coefficient.b;
    }
    by_colour = mix(by_colour, vec3(0.0), lessThan(colour, vec3(0.0)));
    result.colour = by_colour;
    vec3 by_direction = slopes[0] * by_colour.r + slopes[1] * by_colour.g + slopes[2] * by_colour.b;
    return (by_direction - direction * dot(direction, by_direction)) / distance;
}

// Gradient of splat i; adds to that of the camera.
SplatGradient splat_backward(uint i, bool antialiased, inout CameraGradient camera_sum) {
    SplatGradient gradient;
    vec3 mean = mean_of(i);
    Geometry g = geometry_of(mean, log_scale_of(i), quat_of(i));
    // Zeros for a splat without pixels, whose gradients then are zero.
    float up[GRADIENT_FLOATS];
    [[unroll]] for (int k = 0; k < GRADIENT_VECTORS; k++) {
        vec4 four = projected_grad[GRADIENT_VECTORS * i + k];
        up[4 * k] = four.x;
        up[4 * k + 1] = four.y;
        up[4 * k + 2] = four.z;
        up[4 * k + 3] = four.w;
    }

    float opacity = 1.0 / (1.0 + exp(min(-opacity_logit_of(i), 80.0)));
    gradient.opacity_logit = up[0] * (1.0 - opacity);

    vec3 by_b0, by_b1;
    covariance_backward(g, vec3(-0.5 * up[3], -up[4], -0.5 * up[5]), by_b0, by_b1);
    if (antialiased) filter_backward(g, up[0], by_b0, by_b1);
    mat3 m = mat3(g.rotation[0] * g.scale.x, g.rotation[1] * g.scale.y, g.rotation[2] * g.scale.z);
    vec3 by_j0 = to_camera_axes(m * by_b0), by_j1 = to_camera_axes(m * by_b1);
    vec3 by_t = vec3(0.0, 0.0, up[MOMENTS + 3]);
    vec4 by_k = vec4(0.0);
    axis_backward(0, g, -(g.conic.x * up[1] + g.conic.y * up[2]), by_j0, by_t, by_k);
    axis_backward(1, g, -(g.conic.z * up[2] + g.conic.y * up[1]), by_j1, by_t, by_k);

    mat3 by_m = outerProduct(g.t0, by_b0) + outerProduct(g.t1, by_b1);
    gradient.log_scale = g.scale * vec3(dot(g.rotation[0], by_m[0]), dot(g.rotation[1], by_m[1]),
                                        dot(g.rotation[2], by_m[2]));
    mat3 by_rotation = mat3(by_m[0] * g.scale.x, by_m[1] * g.scale.y, by_m[2] * g.scale.z);
    gradient.quat = quat_backward(g, by_rotation);

    vec3 by_colour = vec3(up[MOMENTS], up[MOMENTS + 1], up[MOMENTS + 2]);
    vec3 by_mean_colour = colour_backward(i, mean, by_colour, gradient);
    gradient.mean = to_world_axes(by_t) + by_mean_colour;

    // Jᵀ ∂J, turn[col][row].
    mat3 turn = outerProduct(g.j0, by_j0) + outerProduct(g.j1, by_j1);
    if (g.visible) {
        camera_sum.rho += by_t + to_camera_axes(by_mean_colour);
        vec3 skew = vec3(turn[1][2] - turn[2][1], turn[2][0] - turn[0][2], turn[0][1] - turn[1][0]);
        camera_sum.theta += cross(g.t, by_t) + skew;
        camera_sum.intrinsics += by_k;
    }
    return gradient;
}

// Writes the sum of a workgroup's camera gradients to camera_parts.
void write_camera_part(CameraGradient g) {
    float sums[CAMERA_GRADIENTS] = float[](g.rho.x, g.rho.y, g.rho.z, g.theta.x, g.theta.y, g.theta.z,
                               g.intrinsics.x, g.intrinsics.y, g.intrinsics.z, g.intrinsics.w);
    [[unroll]] for (int k = 0; k < CAMERA_GRADIENTS; k++) {
        float sum = subgroupAdd(sums[k]);
        if (gl_SubgroupInvocationID == 0) subgroup_sums[k][gl_SubgroupID] = sum;
    }
    barrier();
    uint k = gl_LocalInvocationID.x;
    if (k >= CAMERA_GRADIENTS) return;
    float sum = 0.0;
    for (uint subgroup = 0; subgroup < gl_NumSubgroups; subgroup++) sum += subgroup_sums[k][subgroup];
    camera_parts[k * gl_NumWorkGroups.x + gl_WorkGroupID.x] = sum;
}
