//! `project_backward.comp`.
use super::splat::{Camera, Geometry};
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::layout::{CAMERA_GRADIENTS, GRADIENT_FLOATS, MOMENTS};
use crate::gpu::shaders::structs::CameraView;
use crate::scene::{SH_C0, sh};
use glam::{DVec3, Mat3, Vec2, Vec3, Vec4};
use rayon::prelude::*;

const UP: usize = GRADIENT_FLOATS as usize;
const COLOUR: usize = MOMENTS as usize;
const PARTS: usize = CAMERA_GRADIENTS as usize;

/// Parameters of the splats.
struct Splats<'a> {
    means: &'a [[f32; 3]],
    log_scales: &'a [[f32; 3]],
    quats: &'a [[f32; 4]],
    opacity_logits: &'a [f32],
    /// [N, sh_stride, 3].
    sh: &'a [f32],
    sh_stride: usize,
    degree: u32,
    antialiased: bool,
}

/// Gradient by one splat; the SH coefficients have `basis × colour`.
#[derive(Default)]
struct Gradient {
    mean: Vec3,
    log_scale: Vec3,
    quat: [f32; 4],
    opacity_logit: f32,
    basis: [f64; 16],
    colour: Vec3,
}

/// Gradient by the camera: ρ, θ, fx, fy, cx, cy.
#[derive(Clone, Copy, Default)]
struct CameraGradient {
    rho: Vec3,
    theta: Vec3,
    focal: Vec2,
    centre: Vec2,
}

fn outer(a: Vec3, b: Vec3) -> Mat3 {
    Mat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// Twice the axial vector of the skew part.
fn skew(m: &Mat3) -> Vec3 {
    let [c0, c1, c2] = [m.x_axis, m.y_axis, m.z_axis];
    Vec3::new(c1.z - c2.y, c2.x - c0.z, c0.y - c1.x)
}

impl Splats<'_> {
    fn backward(
        &self,
        i: usize,
        camera: &Camera,
        up: &[f32; UP],
        by_camera: &mut CameraGradient,
    ) -> Gradient {
        let mean = Vec3::from(self.means[i]);
        let g = Geometry::of(camera, mean, self.log_scales[i].into(), Vec4::from(self.quats[i]));
        let opacity = 1.0 / (1.0 + (-self.opacity_logits[i]).min(80.0).exp());
        let mut by_b = covariance_backward(&g, Vec3::new(-0.5 * up[3], -up[4], -0.5 * up[5]));
        if self.antialiased {
            filter_backward(&g, up[0], &mut by_b);
        }
        let m = Mat3::from_cols(
            g.rotation.x_axis * g.scale.x,
            g.rotation.y_axis * g.scale.y,
            g.rotation.z_axis * g.scale.z,
        );
        let by_j = by_b.map(|b| camera.to_camera(m * b));
        let mut by_t = Vec3::new(0.0, 0.0, up[COLOUR + 3]);
        let mut own = CameraGradient::default();
        let by_centre = [-(g.conic.x * up[1] + g.conic.y * up[2]), -(g.conic.z * up[2] + g.conic.y * up[1])];
        for axis in 0..2 {
            axis_backward(axis, camera, &g, by_centre[axis], by_j[axis], &mut by_t, &mut own);
        }
        let by_m = outer(g.tj[0], by_b[0]) + outer(g.tj[1], by_b[1]);
        let log_scale = g.scale
            * Vec3::new(
                g.rotation.x_axis.dot(by_m.x_axis),
                g.rotation.y_axis.dot(by_m.y_axis),
                g.rotation.z_axis.dot(by_m.z_axis),
            );
        let by_rotation =
            Mat3::from_cols(by_m.x_axis * g.scale.x, by_m.y_axis * g.scale.y, by_m.z_axis * g.scale.z);
        let by_colour = Vec3::from_slice(&up[COLOUR..COLOUR + 3]);
        let (basis, colour, by_mean_colour) = self.colour_backward(i, mean - camera.position, by_colour);
        if g.visible {
            let turn = outer(g.j[0], by_j[0]) + outer(g.j[1], by_j[1]);
            by_camera.rho += by_t + camera.to_camera(by_mean_colour);
            by_camera.theta += g.t.cross(by_t) + skew(&turn);
            by_camera.focal += own.focal;
            by_camera.centre += own.centre;
        }
        Gradient {
            mean: camera.to_world(by_t) + by_mean_colour,
            log_scale,
            quat: quat_backward(&g, &by_rotation),
            opacity_logit: up[0] * (1.0 - opacity),
            basis,
            colour,
        }
    }

    /// Basis, gradient by the colour of the splat, and that by the mean through the direction.
    fn colour_backward(&self, i: usize, offset: Vec3, by_colour: Vec3) -> ([f64; 16], Vec3, Vec3) {
        if self.degree == 0 {
            // The colour does not depend on the direction.
            let mut basis = [0.0; 16];
            basis[0] = f64::from(SH_C0);
            let colour = 0.5 + SH_C0 * Vec3::from_slice(&self.sh[3 * i * self.sh_stride..]);
            let by_colour = Vec3::select(colour.cmplt(Vec3::ZERO), Vec3::ZERO, by_colour);
            return (basis, by_colour, Vec3::ZERO);
        }
        let distance = offset.length();
        let direction = offset / distance;
        let (basis, slopes) = (
            sh::basis(direction.as_dvec3(), self.degree),
            sh::basis_gradient(direction.as_dvec3(), self.degree),
        );
        let mut colour = Vec3::splat(0.5);
        let mut by_channel = [DVec3::ZERO; 3];
        for k in 0..((self.degree + 1) * (self.degree + 1)) as usize {
            let coefficient = Vec3::from_slice(&self.sh[3 * (i * self.sh_stride + k)..]);
            colour += basis[k] as f32 * coefficient;
            for (by, c) in by_channel.iter_mut().zip(coefficient.to_array()) {
                *by += slopes[k] * f64::from(c);
            }
        }
        let by_colour = Vec3::select(colour.cmplt(Vec3::ZERO), Vec3::ZERO, by_colour);
        let by_direction: Vec3 =
            by_channel.iter().zip(by_colour.to_array()).map(|(by, c)| by.as_vec3() * c).sum();
        (basis, by_colour, (by_direction - direction * direction.dot(by_direction)) / distance)
    }
}

/// Gradient through the conic by the rows of B.
fn covariance_backward(g: &Geometry, by_conic: Vec3) -> [Vec3; 2] {
    let (a, b, c) = (g.conic.x, g.conic.y, g.conic.z);
    let (p, q, r) = (by_conic.x, 0.5 * by_conic.y, by_conic.z);
    // −Q G Q of symmetric 2 × 2 matrices.
    let (qg00, qg01, qg10, qg11) = (a * p + b * q, a * q + b * r, b * p + c * q, b * q + c * r);
    let (s00, s01, s11) = (-(qg00 * a + qg01 * b), -(qg00 * b + qg01 * c), -(qg10 * b + qg11 * c));
    [2.0 * (g.b[0] * s00 + g.b[1] * s01), 2.0 * (g.b[0] * s01 + g.b[1] * s11)]
}

/// Gradient through the opacity of antialiased splats.
fn filter_backward(g: &Geometry, by_log_opacity: f32, by_b: &mut [Vec3; 2]) {
    let inverse = 1.0 / g.squared_area();
    let [xx, yy, xy] = [g.b[0].length_squared(), g.b[1].length_squared(), g.b[0].dot(g.b[1])];
    let own = Vec3::new(yy * inverse, -xy * inverse, xx * inverse) - g.conic;
    by_b[0] += by_log_opacity * (own.x * g.b[0] + own.y * g.b[1]);
    by_b[1] += by_log_opacity * (own.y * g.b[0] + own.z * g.b[1]);
}

/// Gradient through one coordinate of the centre and one row of the Jacobian.
fn axis_backward(
    axis: usize,
    camera: &Camera,
    g: &Geometry,
    by_centre: f32,
    by_j: Vec3,
    by_t: &mut Vec3,
    by_intrinsics: &mut CameraGradient,
) {
    let (f, inverse) = (camera.focal[axis], 1.0 / g.t.z);
    let ratio = g.clamped[axis] * inverse;
    by_t[axis] += f * inverse * by_centre;
    by_t.z -= f * inverse * inverse * (g.t[axis] * by_centre + by_j[axis]);
    by_intrinsics.focal[axis] += g.t[axis] * inverse * by_centre + inverse * (by_j[axis] - ratio * by_j.z);
    by_intrinsics.centre[axis] += by_centre;
    let by_ratio = -f * inverse * by_j.z;
    by_t.z -= by_ratio * inverse * ratio;
    if g.inside[axis] {
        by_t[axis] += by_ratio * inverse;
        by_t.z -= by_ratio * inverse * ratio;
    } else {
        // The limit itself depends on the intrinsics.
        by_intrinsics.focal[axis] -= by_ratio * ratio / f;
        by_intrinsics.centre[axis] -= by_ratio / f;
    }
}

fn quat_backward(g: &Geometry, m: &Mat3) -> [f32; 4] {
    let [x, y, z, r] = g.quat.to_array();
    let [c0, c1, c2] = [m.x_axis, m.y_axis, m.z_axis];
    let skew = skew(m);
    let symmetric = Vec3::new(c2.y + c1.z, c0.z + c2.x, c1.x + c0.y);
    let by_unit = 2.0
        * Vec4::new(
            Vec3::new(x, y, z).dot(skew),
            y * symmetric.z + z * symmetric.y + r * skew.x - 2.0 * x * (c1.y + c2.z),
            x * symmetric.z + z * symmetric.x + r * skew.y - 2.0 * y * (c0.x + c2.z),
            x * symmetric.y + y * symmetric.x + r * skew.z - 2.0 * z * (c0.x + c1.y),
        );
    let unit = Vec4::new(r, x, y, z);
    ((by_unit - unit * unit.dot(by_unit)) / g.quat_length).to_array()
}

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    let [count, sh_stride, antialiased] = call.words()?.map(|word| word as usize);
    let (degree, groups) = (call.variant()[0], call.groups()[0] as usize);
    let memory = call.memory([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12])?;
    let [
        camera,
        means,
        log_scales,
        quats,
        logits,
        sh,
        up,
        by_means,
        by_scales,
        by_quats,
        by_logits,
        by_sh,
        parts,
    ] = memory;
    let camera = Camera::new(&camera.of::<CameraView>()[0]);
    let splats = Splats {
        means: means.of(),
        log_scales: log_scales.of(),
        quats: quats.of(),
        opacity_logits: logits.of(),
        sh: sh.of(),
        sh_stride,
        degree,
        antialiased: antialiased != 0,
    };
    let up: &[[f32; UP]] = up.of();
    // One partial camera gradient per workgroup, as the shader leaves.
    let chunk = count.div_ceil(groups.max(1)).max(1);
    let by_means = by_means.of::<[f32; 3]>()[..count].par_chunks_mut(chunk);
    let by_scales = by_scales.of::<[f32; 3]>()[..count].par_chunks_mut(chunk);
    let by_quats = by_quats.of::<[f32; 4]>()[..count].par_chunks_mut(chunk);
    let by_logits = by_logits.of::<f32>()[..count].par_chunks_mut(chunk);
    let by_sh = by_sh.of::<f32>()[..3 * sh_stride * count].par_chunks_mut(3 * sh_stride * chunk);
    let by_camera: Vec<CameraGradient> = by_means
        .zip(by_scales)
        .zip(by_quats)
        .zip(by_logits)
        .zip(by_sh)
        .enumerate()
        .map(|(part, ((((by_means, by_scales), by_quats), by_logits), by_sh))| {
            let mut sum = CameraGradient::default();
            for k in 0..by_means.len() {
                let i = part * chunk + k;
                // A splat beside the image has no gradient.
                let g = match up[i].iter().all(|by| *by == 0.0) {
                    true => Gradient::default(),
                    false => splats.backward(i, &camera, &up[i], &mut sum),
                };
                by_means[k] = g.mean.to_array();
                by_scales[k] = g.log_scale.to_array();
                by_quats[k] = g.quat;
                by_logits[k] = g.opacity_logit;
                let own = &mut by_sh[3 * sh_stride * k..3 * sh_stride * (k + 1)];
                for (by, basis) in own.chunks_exact_mut(3).zip(g.basis) {
                    by.copy_from_slice(&(basis as f32 * g.colour).to_array());
                }
            }
            sum
        })
        .collect();
    let parts = &mut parts.of::<f32>()[..PARTS * groups];
    parts.fill(0.0);
    for (part, g) in by_camera.iter().enumerate() {
        let values = [
            g.rho.x, g.rho.y, g.rho.z, g.theta.x, g.theta.y, g.theta.z, g.focal.x, g.focal.y, g.centre.x,
            g.centre.y,
        ];
        for (k, value) in values.into_iter().enumerate() {
            parts[k * groups + part] = value;
        }
    }
    Ok(())
}
