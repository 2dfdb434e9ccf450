//! `project_backward.comp`.
use super::lanes::{LANES, Vec3s, gather, scatter};
use super::sh::{self, Coefficients};
use super::splat::{Camera, Geometry, Splats};
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::layout::{CAMERA_GRADIENTS, GRADIENT_FLOATS, MOMENTS};
use crate::gpu::shaders::structs::CameraView;
use fearless_simd::{Level, Simd, dispatch, f32x8, prelude::*};
use rayon::prelude::*;
use std::ops::Range;

const UP: usize = GRADIENT_FLOATS as usize;
const COLOUR: usize = MOMENTS as usize;
const PARTS: usize = CAMERA_GRADIENTS as usize;

/// Gradients of splats, one after the other.
struct Gradients<'a> {
    means: &'a mut [[f32; 3]],
    log_scales: &'a mut [[f32; 3]],
    quats: &'a mut [[f32; 4]],
    opacity_logits: &'a mut [f32],
    sh: &'a mut [f32],
}

impl Gradients<'_> {
    /// Those of splats `own`; `stride` numbers of SH each.
    fn part(&mut self, own: Range<usize>, stride: usize) -> Gradients<'_> {
        Gradients {
            means: &mut self.means[own.clone()],
            log_scales: &mut self.log_scales[own.clone()],
            quats: &mut self.quats[own.clone()],
            opacity_logits: &mut self.opacity_logits[own.clone()],
            sh: &mut self.sh[own.start * stride..own.end * stride],
        }
    }

    fn clear(&mut self) {
        self.means.fill([0.0; 3]);
        self.log_scales.fill([0.0; 3]);
        self.quats.fill([0.0; 4]);
        self.opacity_logits.fill(0.0);
        self.sh.fill(0.0);
    }
}

/// Gradient by the camera: ρ, θ, (fx, fy), (cx, cy).
#[derive(Clone, Copy)]
struct CameraGradient<S: Simd> {
    rho: Vec3s<S>,
    theta: Vec3s<S>,
    focal: [f32x8<S>; 2],
    centre: [f32x8<S>; 2],
}

impl<S: Simd> CameraGradient<S> {
    #[inline(always)]
    fn zero(simd: S) -> CameraGradient<S> {
        let (zeros, zero) = (Vec3s::splat(simd, [0.0; 3]), f32x8::simd_from(simd, 0.0));
        CameraGradient { rho: zeros, theta: zeros, focal: [zero; 2], centre: [zero; 2] }
    }

    #[inline(always)]
    fn sums(&self) -> [f32; PARTS] {
        let ([r0, r1, r2], [t0, t1, t2]) = (self.rho.0, self.theta.0);
        let ([f0, f1], [c0, c1]) = (self.focal, self.centre);
        let mut sums = [0.0; PARTS];
        for (sum, by) in sums.iter_mut().zip([r0, r1, r2, t0, t1, t2, f0, f1, c0, c1]) {
            *sum = by.reduce_sum();
        }
        sums
    }
}

/// Columns of the product of a column and a row.
#[inline(always)]
fn outer<S: Simd>(a: Vec3s<S>, b: Vec3s<S>) -> [Vec3s<S>; 3] {
    [a * b[0], a * b[1], a * b[2]]
}

/// Product of a matrix of columns and a vector.
#[inline(always)]
fn product<S: Simd>(m: [Vec3s<S>; 3], v: Vec3s<S>) -> Vec3s<S> {
    m[0] * v[0] + m[1] * v[1] + m[2] * v[2]
}

#[inline(always)]
fn sum<S: Simd>(a: [Vec3s<S>; 3], b: [Vec3s<S>; 3]) -> [Vec3s<S>; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// Twice the axial vector of the skew part of a matrix of columns.
#[inline(always)]
fn skew<S: Simd>([c0, c1, c2]: [Vec3s<S>; 3]) -> Vec3s<S> {
    Vec3s([c1[2] - c2[1], c2[0] - c0[2], c0[1] - c1[0]])
}

impl Splats<'_> {
    /// Gradients of up to eight splats with `N` SH coefficients; adds to that of the camera.
    #[inline(always)]
    fn backward<S: Simd, const N: usize>(
        &self,
        simd: S,
        camera: &Camera<S>,
        own: &Range<usize>,
        up: &[[f32; UP]],
        by_camera: &mut CameraGradient<S>,
        out: &mut Gradients,
    ) {
        let zero = f32x8::simd_from(simd, 0.0);
        let up: [f32x8<S>; UP] = gather(simd, up);
        let mut shown = up[0].simd_ne(zero);
        for by in &up[1..] {
            shown |= by.simd_ne(zero);
        }
        // A splat beside the image has no gradient.
        if !shown.any_true() {
            return out.clear();
        }
        let (mean, g) = self.geometry(simd, camera, own);
        let half = f32x8::simd_from(simd, 0.5);
        let mut by_b = covariance_backward(&g, Vec3s([-up[3] * half, -up[4], -up[5] * half]));
        if self.antialiased {
            filter_backward(&g, up[0], &mut by_b);
        }
        let m = [g.rotation[0] * g.scale[0], g.rotation[1] * g.scale[1], g.rotation[2] * g.scale[2]];
        let by_j = [camera.to_camera(product(m, by_b[0])), camera.to_camera(product(m, by_b[1]))];
        let by_centre =
            [-(g.conic[0] * up[1] + g.conic[1] * up[2]), -(g.conic[2] * up[2] + g.conic[1] * up[1])];
        let mut by_t = Vec3s([zero, zero, up[COLOUR + 3]]);
        let mut intrinsics = CameraGradient::zero(simd);
        for axis in 0..2 {
            axis_backward(axis, camera, &g, by_centre[axis], by_j[axis], &mut by_t, &mut intrinsics);
        }
        let by_m = sum(outer(g.tj[0], by_b[0]), outer(g.tj[1], by_b[1]));
        let by_scale =
            Vec3s([g.rotation[0].dot(by_m[0]), g.rotation[1].dot(by_m[1]), g.rotation[2].dot(by_m[2])]);
        let by_rotation = [by_m[0] * g.scale[0], by_m[1] * g.scale[1], by_m[2] * g.scale[2]];
        let by_colour = Vec3s([up[COLOUR], up[COLOUR + 1], up[COLOUR + 2]]).only(shown);
        let by_offset = self.colour_backward::<S, N>(simd, own, mean - camera.position, by_colour, out.sh);
        let counts = shown & g.visible;
        let turn = sum(outer(g.j[0], by_j[0]), outer(g.j[1], by_j[1]));
        by_camera.rho += (by_t + camera.to_camera(by_offset)).only(counts);
        by_camera.theta += (g.t.cross(by_t) + skew(turn)).only(counts);
        for axis in 0..2 {
            by_camera.focal[axis] += counts.select(intrinsics.focal[axis], zero);
            by_camera.centre[axis] += counts.select(intrinsics.centre[axis], zero);
        }
        scatter(&(camera.to_world(by_t) + by_offset).only(shown).0, out.means);
        scatter(&(by_scale * g.scale).only(shown).0, out.log_scales);
        let mut by_quat = quat_backward(&g, by_rotation);
        for by in &mut by_quat {
            *by = shown.select(*by, zero);
        }
        scatter(&by_quat, out.quats);
        let opacity = f32x8::simd_from(simd, 1.0) / self.inverse_opacities(simd, own);
        let by_logit = shown.select(up[0] * (-opacity + 1.0), zero);
        scatter(&[by_logit], out.opacity_logits.as_chunks_mut().0);
    }

    /// Writes the gradients of the SH coefficients and returns that by the mean through the
    /// direction.
    #[inline(always)]
    fn colour_backward<S: Simd, const N: usize>(
        &self,
        simd: S,
        own: &Range<usize>,
        offset: Vec3s<S>,
        by_colour: Vec3s<S>,
        by_sh: &mut [f32],
    ) -> Vec3s<S> {
        let inverse_distance = f32x8::simd_from(simd, 1.0) / offset.dot(offset).sqrt();
        let direction = offset * inverse_distance;
        let basis: [f32x8<S>; N] = sh::basis(simd, direction);
        let slopes: [Vec3s<S>; N] = sh::basis_gradient(simd, direction);
        let (coefficients, zeros): ([_; N], _) = (self.sh.of(simd, own), Vec3s::splat(simd, [0.0; 3]));
        let (mut colour, mut by_channel) = (Vec3s::splat(simd, [0.5; 3]), [zeros; 3]);
        for k in 0..N {
            let coefficient = Vec3s(coefficients[k]);
            colour += coefficient * basis[k];
            for (channel, by) in by_channel.iter_mut().enumerate() {
                *by += slopes[k] * coefficient[channel];
            }
        }
        let (mut by_direction, mut by_clamped) = (zeros, zeros);
        for channel in 0..3 {
            // A negative colour is shown as 0.
            let by = colour[channel].simd_lt(0.0).select(zeros[0], by_colour[channel]);
            by_clamped[channel] = by;
            by_direction += by_channel[channel] * by;
        }
        sh::scatter(&basis, by_clamped, by_sh, own.len());
        (by_direction - direction * direction.dot(by_direction)) * inverse_distance
    }
}

/// Gradient through the conic by the rows of B.
#[inline(always)]
fn covariance_backward<S: Simd>(g: &Geometry<S>, by_conic: Vec3s<S>) -> [Vec3s<S>; 2] {
    let ([a, b, c], [p, q, r]) = (g.conic.0, by_conic.0);
    let q = q * 0.5;
    // −2 Q G Q of symmetric 2 × 2 matrices.
    let (qg00, qg01, qg10, qg11) = (a * p + b * q, a * q + b * r, b * p + c * q, b * q + c * r);
    let s00 = (qg00 * a + qg01 * b) * -2.0;
    let s01 = (qg00 * b + qg01 * c) * -2.0;
    let s11 = (qg10 * b + qg11 * c) * -2.0;
    [g.b[0] * s00 + g.b[1] * s01, g.b[0] * s01 + g.b[1] * s11]
}

/// Gradient through the opacity of antialiased splats.
#[inline(always)]
fn filter_backward<S: Simd>(g: &Geometry<S>, by_log_opacity: f32x8<S>, by_b: &mut [Vec3s<S>; 2]) {
    let inverse = f32x8::simd_from(by_log_opacity.token(), 1.0) / g.squared_area();
    let (xx, yy, xy) = (g.b[0].dot(g.b[0]), g.b[1].dot(g.b[1]), g.b[0].dot(g.b[1]));
    let own = (Vec3s([yy, -xy, xx]) * inverse - g.conic) * by_log_opacity;
    by_b[0] += g.b[0] * own[0] + g.b[1] * own[1];
    by_b[1] += g.b[0] * own[1] + g.b[1] * own[2];
}

/// Gradient through one coordinate of the centre and one row of the Jacobian.
#[inline(always)]
fn axis_backward<S: Simd>(
    axis: usize,
    camera: &Camera<S>,
    g: &Geometry<S>,
    by_centre: f32x8<S>,
    by_j: Vec3s<S>,
    by_t: &mut Vec3s<S>,
    by_camera: &mut CameraGradient<S>,
) {
    let (inside, inverse) = (g.inside[axis], g.inverse_z);
    let zero = f32x8::simd_from(inverse.token(), 0.0);
    let step = camera.focal[axis] * inverse;
    let ratio = g.clamped[axis] * inverse;
    let by_ratio = -step * by_j[2];
    // Outside of the limits the ratio is that of the limit, which the intrinsics set.
    let by_slope = inside.select(by_ratio * inverse, zero);
    by_t[axis] += step * by_centre + by_slope;
    by_t[2] -= step * inverse * (g.t[axis] * by_centre + by_j[axis]);
    by_t[2] -= (by_ratio * inverse + by_slope) * ratio;
    let by_limit = inside.select(zero, by_ratio / camera.focal[axis]);
    by_camera.focal[axis] +=
        inverse * (g.t[axis] * by_centre + by_j[axis] - ratio * by_j[2]) - by_limit * ratio;
    by_camera.centre[axis] += by_centre - by_limit;
}

#[inline(always)]
fn quat_backward<S: Simd>(g: &Geometry<S>, m: [Vec3s<S>; 3]) -> [f32x8<S>; 4] {
    let ([r, x, y, z], [c0, c1, c2]) = (g.quat, m);
    let skew = skew(m);
    let (yz, xz, xy) = (c2[1] + c1[2], c0[2] + c2[0], c1[0] + c0[1]);
    let by_unit = [
        Vec3s([x, y, z]).dot(skew),
        y * xy + z * xz + r * skew[0] - x * 2.0 * (c1[1] + c2[2]),
        x * xy + z * yz + r * skew[1] - y * 2.0 * (c0[0] + c2[2]),
        x * xz + y * yz + r * skew[2] - z * 2.0 * (c0[0] + c1[1]),
    ];
    let along = r * by_unit[0] + x * by_unit[1] + y * by_unit[2] + z * by_unit[3];
    let factor = f32x8::simd_from(r.token(), 2.0) / g.quat_length;
    let mut by_quat = by_unit;
    for (by, own) in by_quat.iter_mut().zip(g.quat) {
        *by = (*by - own * along) * factor;
    }
    by_quat
}

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    sh::with_count!(run_with, call)
}

fn run_with<const N: usize>(call: &mut NativeCall) -> Result<(), String> {
    let [count, sh_stride, antialiased] = call.words()?.map(|word| word as usize);
    let (groups, level) = (call.groups()[0] as usize, Level::new());
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
    let view = camera.of::<CameraView>()[0];
    let splats = Splats {
        means: means.of(),
        log_scales: log_scales.of(),
        quats: quats.of(),
        opacity_logits: logits.of(),
        sh: Coefficients::new(sh.of(), sh_stride),
        antialiased: antialiased != 0,
    };
    let up: &[[f32; UP]] = &up.of()[..count];
    // One partial camera gradient per workgroup, as the shader leaves.
    let chunk = count.div_ceil(groups.max(1)).next_multiple_of(LANES).max(LANES);
    let by_means = by_means.of::<[f32; 3]>()[..count].par_chunks_mut(chunk);
    let by_scales = by_scales.of::<[f32; 3]>()[..count].par_chunks_mut(chunk);
    let by_quats = by_quats.of::<[f32; 4]>()[..count].par_chunks_mut(chunk);
    let by_logits = by_logits.of::<f32>()[..count].par_chunks_mut(chunk);
    let by_sh = by_sh.of::<f32>()[..3 * sh_stride * count].par_chunks_mut(3 * sh_stride * chunk);
    let by_camera: Vec<[f32; PARTS]> = by_means
        .zip(by_scales)
        .zip(by_quats)
        .zip(by_logits)
        .zip(by_sh)
        .zip(up.par_chunks(chunk))
        .enumerate()
        .map(|(part, (((((means, log_scales), quats), opacity_logits), sh), up))| {
            let out = Gradients { means, log_scales, quats, opacity_logits, sh };
            dispatch!(level, simd => backward::<_, N>(simd, &splats, &view, part * chunk, up, out))
        })
        .collect();
    let parts = &mut parts.of::<f32>()[..PARTS * groups];
    parts.fill(0.0);
    for (part, sums) in by_camera.iter().enumerate() {
        for (k, sum) in sums.iter().enumerate() {
            parts[k * groups + part] = *sum;
        }
    }
    Ok(())
}

/// Gradients of splats from `first` on; returns that of the camera.
#[inline(always)]
fn backward<S: Simd, const N: usize>(
    simd: S,
    splats: &Splats,
    view: &CameraView,
    first: usize,
    up: &[[f32; UP]],
    mut out: Gradients,
) -> [f32; PARTS] {
    let (camera, mut by_camera) = (Camera::new(simd, view), CameraGradient::zero(simd));
    let stride = out.sh.len() / up.len();
    for (eight, up) in up.chunks(LANES).enumerate() {
        let place = eight * LANES..eight * LANES + up.len();
        let own = first + place.start..first + place.end;
        splats.backward::<S, N>(simd, &camera, &own, up, &mut by_camera, &mut out.part(place, stride));
    }
    by_camera.sums()
}
