//! Gradients by the raw parameters and by the camera from those by the screen-space splats
//! (docs/internals/method.md#backward-rasterisation).
//!
//! With Q the conic matrix and G_M = [[∂A, ½∂B], [½∂B, ∂C]]: `G' = −Q G_M Q`, `∂B = 2 G' B` (2×3),
//! `∂M = Tᵀ ∂B`, `∂J = ∂B Mᵀ Rᵀ`, `∂R_cov Rᵀ = Jᵀ ∂J`. From there means, log scales, raw quaternion
//! (through its normalisation), opacity logit, SH coefficients, and the left pose twist ξ = (ρ, θ),
//! T_cw ← exp(ξ) T_cw: `∂ρ = Σ ∂t + R g_sh`, `∂θ = Σ t × ∂t + vee(Jᵀ∂J)`.
use super::frame::{CAMERA_GRADIENTS, FrameBuffers};
use super::options::FeatureMode;
use super::params::{Gradients, Params};
use super::project::{Geometry, geometry, raw_colour};
use super::raster_backward::SplatGradient;
use super::sort::rows_of_groups;
use super::splat_buffers::SplatBuffers;
use super::view::View;
use crate::gpu::shaders::structs::CameraView;
use crate::gpu::{Buffer, Device, KernelVariant, Recorder, VariantPair, shaders};
use crate::scene::sh;
use glam::{DMat3, DVec3, DVec4};

/// Kernel that writes the gradients by the SH coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ShGradientKernel {
    /// Each thread writes those of its splat, for CPU devices.
    PerThread,
    /// A workgroup writes those of its splats in the order of memory, for GPUs.
    Shared,
}

impl ShGradientKernel {
    /// The faster kernel for the device, unless it is disabled.
    pub fn of(device: &Device) -> ShGradientKernel {
        match VariantPair::SH.chosen(device.info()) {
            KernelVariant::ShPerThread => ShGradientKernel::PerThread,
            _ => ShGradientKernel::Shared,
        }
    }
}

/// Largest number of workgroups, each with a partial camera gradient: several times as many as a
/// large GPU runs at once (132 processors with 8 to 16 each), so that the last of them end
/// together, or few enough to start quickly on a few cores.
pub(super) fn most_groups(device: &Device) -> u32 {
    if device.info().is_cpu { 64 } else { 8192 }
}

/// Number of workgroups for this many splats.
pub(super) fn groups(splats: usize, most: u32) -> u32 {
    splats.div_ceil(shaders::project_backward::WORKGROUP[0] as usize).clamp(1, most.max(1) as usize) as u32
}

/// Records the gradients by all raw parameters (overwrites `gradients`; zero for splats without
/// pixels) and by the camera (`frame.camera_grad`).
pub fn record(
    rec: &mut Recorder,
    splats: &SplatBuffers,
    camera: &Buffer<CameraView>,
    frame: &FrameBuffers,
    sh_degree: u32,
    (kernel, most_groups): (ShGradientKernel, u32),
    gradients: &SplatBuffers,
) {
    let count = splats.count as u32;
    let call = shaders::project_backward::call(
        shaders::project_backward::Variant {
            sh_degree,
            shared_sh: u32::from(kernel == ShGradientKernel::Shared),
        },
        &shaders::project_backward::Bindings {
            camera,
            means: &splats.means,
            log_scales: &splats.log_scales,
            quats: &splats.quats,
            opacity_logits: &splats.opacity_logits,
            sh: &splats.sh,
            projected_grad: &frame.projected_grad,
            means_grad: &gradients.means,
            log_scales_grad: &gradients.log_scales,
            quats_grad: &gradients.quats,
            opacity_logits_grad: &gradients.opacity_logits,
            sh_grad: &gradients.sh,
            camera_parts: &frame.camera_parts,
        },
        &shaders::project_backward::Push {
            count,
            sh_stride: splats.sh_len() as u32,
            antialiased: splats.antialiased.into(),
        },
    );
    rec.dispatch(call, [groups(splats.count, most_groups), 1, 1]);
    record_camera(rec, frame, groups(splats.count, most_groups));
}

/// Records the sum of the camera gradients of `parts` workgroups.
pub(super) fn record_camera(rec: &mut Recorder, frame: &FrameBuffers, parts: u32) {
    let call = shaders::camera_sum::call(
        &shaders::camera_sum::Bindings { camera_parts: &frame.camera_parts, camera_grad: &frame.camera_grad },
        &shaders::camera_sum::Push { parts },
    );
    rec.dispatch(call, [CAMERA_GRADIENTS as u32, 1, 1]);
}

/// Records the gradient by the stored features. Records nothing without features.
pub fn record_features(
    rec: &mut Recorder,
    splats: &SplatBuffers,
    frame: &FrameBuffers,
    mode: FeatureMode,
    features_grad: &Buffer<f32>,
) {
    if splats.feature_dim == 0 {
        return;
    }
    let (count, dim) = (splats.count as u32, splats.feature_dim as u32);
    let call = shaders::features_backward::call(
        &shaders::features_backward::Bindings {
            features: &splats.features,
            codes_grad: &frame.codes_grad,
            features_grad,
        },
        &shaders::features_backward::Push {
            count,
            dim,
            stride: frame.code_stride(),
            width: mode.width(splats.feature_dim) as u32,
            epsilon: mode.epsilon(),
        },
    );
    rec.dispatch(
        call,
        rows_of_groups(splats.count.div_ceil(shaders::features_backward::WORKGROUP[0] as usize)),
    );
}

/// CPU reference: adds the gradients through splat `i`, which must be visible, to `out`.
pub fn reference(params: &Params, i: usize, view: &View, upstream: &SplatGradient, out: &mut Gradients) {
    let Some(g) = geometry(params, i, view) else { return };
    let [m0, m1, m2, m3, m4, m5] = upstream.moments;
    let opacity = 1.0 / (1.0 + (-params.opacity_logits[i]).exp());
    out.params.opacity_logits[i] += m0 * (1.0 - opacity);

    let [a, b, c] = g.conic;
    let by_centre = [-(a * m1 + b * m2), -(c * m2 + b * m1)];
    let mut by_b = covariance_backward(&g, [-0.5 * m3, -m4, -0.5 * m5]);
    if params.antialiased {
        // ∂ ln √(det B Bᵀ / det Σ') = (B Bᵀ)⁻¹ B − Σ'⁻¹ B.
        let [xx, xy, yy] = g.undilated.map(|v| v / g.undilated_det);
        let [own_a, own_b, own_c] = [yy - a, -xy - b, xx - c];
        by_b[0] += m0 * (own_a * g.b[0] + own_b * g.b[1]);
        by_b[1] += m0 * (own_b * g.b[0] + own_c * g.b[1]);
    }
    let m = DMat3::from_cols(
        g.rotation.x_axis * g.scale.x,
        g.rotation.y_axis * g.scale.y,
        g.rotation.z_axis * g.scale.z,
    );
    let by_jacobian = by_b.map(|row| view.rotation * (m * row));
    let by_t = camera_point_backward(&g, view, by_centre, by_jacobian, upstream.channels[3]);
    let by_m = outer(g.to_screen[0], by_b[0]) + outer(g.to_screen[1], by_b[1]);
    shape_backward(&g, by_m, i, out);

    let by_mean_sh = colour_backward(params, i, view, upstream, out);
    out.params.means[i] += view.rotation.transpose() * by_t + by_mean_sh;

    let rho = by_t + view.rotation * by_mean_sh;
    // vee of Q − Qᵀ with Q = Jᵀ ∂J; only the rows of J enter.
    let q = outer(g.jacobian[0], by_jacobian[0]) + outer(g.jacobian[1], by_jacobian[1]);
    let vee = DVec3::new(q.row(2).y - q.row(1).z, q.row(0).z - q.row(2).x, q.row(1).x - q.row(0).y);
    let theta = g.t.cross(by_t) + vee;
    for k in 0..3 {
        out.twist[k] += rho[k];
        out.twist[3 + k] += theta[k];
    }
    for axis in 0..2 {
        let z = g.t.z;
        out.intrinsics[axis] += g.t[axis] / z * by_centre[axis] + by_jacobian[axis][axis] / z
            - g.clamped[axis] / (z * z) * by_jacobian[axis].z
            + clamp_limit_backward(&g, view, axis, by_jacobian[axis].z).0;
        out.intrinsics[2 + axis] +=
            by_centre[axis] + clamp_limit_backward(&g, view, axis, by_jacobian[axis].z).1;
    }
}

/// Gradient (∂f, ∂c) through the limit of the clamped branch, which depends on the focal length and
/// the principal point: l⁺ = (W − c + 0.15 W)/f, −l⁻ = −(c + 0.15 W)/f, so that t̃ = ±l z.
fn clamp_limit_backward(g: &Geometry, view: &View, axis: usize, by_j2: f64) -> (f64, f64) {
    if g.inside[axis] {
        return (0.0, 0.0);
    }
    // J[axis].z = −f t̃/z², so ∂t̃ = −f/z² ∂J; t̃ = limit·z.
    let focal = view.focal[axis];
    let by_limit = -focal / g.t.z * by_j2;
    let limit = g.clamped[axis] / g.t.z;
    (by_limit * (-limit / focal), by_limit * (-1.0 / focal))
}

/// ∂B (rows) from ∂(A, B, C), through Σ'⁻¹ and Σ' = B Bᵀ + 0.3 I.
fn covariance_backward(g: &Geometry, by_conic: [f64; 3]) -> [DVec3; 2] {
    let [a, b, c] = g.conic;
    let (ga, gb, gc) = (by_conic[0], 0.5 * by_conic[1], by_conic[2]);
    // Q G_M, then times Q.
    let (p00, p01) = (a * ga + b * gb, a * gb + b * gc);
    let (p10, p11) = (b * ga + c * gb, b * gb + c * gc);
    let (s00, s01, s11) = (-(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c));
    [(g.b[0] * s00 + g.b[1] * s01) * 2.0, (g.b[0] * s01 + g.b[1] * s11) * 2.0]
}

/// ∂t in camera axes: through the centre, the Jacobian and the depth channel.
fn camera_point_backward(
    g: &Geometry,
    view: &View,
    by_centre: [f64; 2],
    by_jacobian: [DVec3; 2],
    by_depth: f64,
) -> DVec3 {
    let z = g.t.z;
    let mut by_t = DVec3::new(0.0, 0.0, by_depth);
    for axis in 0..2 {
        let f = view.focal[axis];
        by_t[axis] += f / z * by_centre[axis];
        by_t.z -= f * g.t[axis] / (z * z) * by_centre[axis];
        by_t.z -= f / (z * z) * by_jacobian[axis][axis];
        let by_j2 = by_jacobian[axis].z;
        if g.inside[axis] {
            by_t[axis] -= f / (z * z) * by_j2;
            by_t.z += 2.0 * f * g.clamped[axis] / (z * z * z) * by_j2;
        } else {
            // t̃ = limit·z: J = −f·limit/z, one power of z less (INRIA keeps the factor 2).
            by_t.z += f * g.clamped[axis] / (z * z * z) * by_j2;
        }
    }
    by_t
}

/// Adds the gradients by log scales and raw quaternion, from ∂M.
fn shape_backward(g: &Geometry, by_m: DMat3, i: usize, out: &mut Gradients) {
    for k in 0..3 {
        out.params.log_scales[i][k] += g.scale[k] * g.rotation.col(k).dot(by_m.col(k));
    }
    let gr = DMat3::from_cols(by_m.x_axis * g.scale.x, by_m.y_axis * g.scale.y, by_m.z_axis * g.scale.z);
    let at = |row: usize, col: usize| gr.col(col)[row];
    let (r, x, y, z) = (g.quat.x, g.quat.y, g.quat.z, g.quat.w);
    let by_unit = 2.0
        * DVec4::new(
            x * (at(2, 1) - at(1, 2)) + y * (at(0, 2) - at(2, 0)) + z * (at(1, 0) - at(0, 1)),
            y * (at(0, 1) + at(1, 0)) + z * (at(0, 2) + at(2, 0)) + r * (at(2, 1) - at(1, 2))
                - 2.0 * x * (at(1, 1) + at(2, 2)),
            x * (at(0, 1) + at(1, 0)) + z * (at(1, 2) + at(2, 1)) + r * (at(0, 2) - at(2, 0))
                - 2.0 * y * (at(0, 0) + at(2, 2)),
            x * (at(0, 2) + at(2, 0)) + y * (at(1, 2) + at(2, 1)) + r * (at(1, 0) - at(0, 1))
                - 2.0 * z * (at(0, 0) + at(1, 1)),
        );
    out.params.quats[i] += (by_unit - g.quat * g.quat.dot(by_unit)) / g.quat_length;
}

/// Adds the gradient by the SH coefficients, from ∂RGB; returns the gradient by the mean through
/// the viewing direction, world axes.
fn colour_backward(
    params: &Params,
    i: usize,
    view: &View,
    upstream: &SplatGradient,
    out: &mut Gradients,
) -> DVec3 {
    let offset = params.means[i] - view.position();
    let distance = offset.length();
    let direction = offset / distance;
    let raw = raw_colour(params, i, view) + 0.5;
    let mut by_colour = DVec3::new(upstream.channels[0], upstream.channels[1], upstream.channels[2]);
    for k in 0..3 {
        if raw[k] < 0.0 {
            by_colour[k] = 0.0;
        }
    }
    let basis = sh::basis(direction, params.sh_degree);
    let gradient = sh::basis_gradient(direction, params.sh_degree);
    let coefficients = params.sh_of(i);
    let mut by_direction = DVec3::ZERO;
    for (k, &coefficient) in coefficients.iter().enumerate() {
        out.params.sh[i * coefficients.len() + k] += by_colour * basis[k];
        by_direction += gradient[k] * coefficient.dot(by_colour);
    }
    (by_direction - direction * direction.dot(by_direction)) / distance
}

fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// CPU reference of the gradient by raw features from that by rendered ones, both [N, d]
/// (docs/internals/method.md#feature-gauge): `∂f = (∂f̂ − f̂'(f̂'·∂f̂)·‖f‖/(‖f‖+ε)) / (‖f‖+ε)` with
/// f̂' = f/‖f‖.
pub fn features_reference(features: &[f64], upstream: &[f64], dim: usize, mode: FeatureMode) -> Vec<f64> {
    let FeatureMode::Gauge { epsilon, .. } = mode else { return upstream.to_vec() };
    let mut out = Vec::with_capacity(upstream.len());
    for (f, g) in features.chunks(mode.width(dim)).zip(upstream.chunks(mode.width(dim))) {
        let length = f.iter().map(|x| x * x).sum::<f64>().sqrt();
        let scale = length + f64::from(epsilon);
        let along: f64 = f.iter().zip(g).map(|(x, y)| x * y).sum();
        // f̂'(f̂'·g)‖f‖/(‖f‖+ε) = f (f·g) / (‖f‖(‖f‖+ε)); 0 at f = 0.
        let factor = if length > 0.0 { along / (length * scale) } else { 0.0 };
        out.extend(f.iter().zip(g).map(|(x, y)| (y - x * factor) / scale));
    }
    out
}
