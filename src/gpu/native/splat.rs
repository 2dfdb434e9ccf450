//! Screen-space geometry of eight splats in f32, as `glsl/shared/splat.glsl`.
use super::lanes::{Vec3s, exp, gather};
use super::sh::Coefficients;
use crate::gpu::shaders::shared::layout::TILE;
use crate::gpu::shaders::shared::splat::{DILATION, SMALLEST_AREA};
use crate::gpu::shaders::structs::CameraView;
use fearless_simd::{Simd, f32x8, mask32x8, prelude::*};
use std::ops::Range;

/// Parameters of splats.
pub(super) struct Splats<'a> {
    pub means: &'a [[f32; 3]],
    pub log_scales: &'a [[f32; 3]],
    pub quats: &'a [[f32; 4]],
    pub opacity_logits: &'a [f32],
    pub sh: Coefficients<'a>,
    pub antialiased: bool,
}

impl Splats<'_> {
    /// Means of up to eight splats, and their geometry.
    #[inline(always)]
    pub fn geometry<S: Simd>(
        &self,
        simd: S,
        camera: &Camera<S>,
        own: &Range<usize>,
    ) -> (Vec3s<S>, Geometry<S>) {
        let mean = Vec3s(gather(simd, &self.means[own.clone()]));
        let log_scale = Vec3s(gather(simd, &self.log_scales[own.clone()]));
        let quat = gather(simd, &self.quats[own.clone()]);
        (mean, Geometry::of(simd, camera, mean, log_scale, quat))
    }

    /// 1 / opacity of up to eight splats: 1 + exp(−logit), which is at most that of 80.
    #[inline(always)]
    pub fn inverse_opacities<S: Simd>(&self, simd: S, own: &Range<usize>) -> f32x8<S> {
        let (logits, _) = self.opacity_logits[own.clone()].as_chunks();
        let [logits] = gather(simd, logits);
        // exp(80) is finite, so an extreme logit gives a tiny opacity and not a NaN.
        let limit = f32x8::simd_from(simd, 80.0);
        exp((-logits).simd_lt(limit).select(-logits, limit)) + 1.0
    }
}

/// Camera, with each number in all lanes.
pub(super) struct Camera<S: Simd> {
    /// Rows of R.
    rows: [Vec3s<S>; 3],
    pub translation: Vec3s<S>,
    pub position: Vec3s<S>,
    pub focal: [f32x8<S>; 2],
    pub centre: [f32x8<S>; 2],
    /// Slopes beyond which the Jacobian is that of the limit.
    low: [f32x8<S>; 2],
    high: [f32x8<S>; 2],
    /// Index of the last pixel of the last tile.
    pub far: [f32x8<S>; 2],
    near: f32x8<S>,
}

impl<S: Simd> Camera<S> {
    #[inline(always)]
    pub fn new(simd: S, view: &CameraView) -> Camera<S> {
        let [r0, r1, r2] = view.world_to_camera;
        let row = |[x, y, z, _]: [f32; 4]| Vec3s::splat(simd, [x, y, z]);
        let pair = |of: [f32; 2]| [f32x8::simd_from(simd, of[0]), f32x8::simd_from(simd, of[1])];
        let limit = |axis: usize, edge: f32| (edge - view.centre[axis]) / view.focal[axis];
        let margin = [0.15 * view.size[0], 0.15 * view.size[1]];
        let mut camera = Camera {
            rows: [row(r0), row(r1), row(r2)],
            translation: Vec3s::splat(simd, [r0[3], r1[3], r2[3]]),
            position: Vec3s::splat(simd, [0.0; 3]),
            focal: pair(view.focal),
            centre: pair(view.centre),
            low: pair([limit(0, -margin[0]), limit(1, -margin[1])]),
            high: pair([limit(0, view.size[0] + margin[0]), limit(1, view.size[1] + margin[1])]),
            far: pair(view.size.map(|size| (size / TILE as f32).ceil() * TILE as f32 - 1.0)),
            near: f32x8::simd_from(simd, view.near),
        };
        camera.position = camera.position - camera.to_world(camera.translation);
        camera
    }

    #[inline(always)]
    pub fn to_camera(&self, v: Vec3s<S>) -> Vec3s<S> {
        Vec3s([self.rows[0].dot(v), self.rows[1].dot(v), self.rows[2].dot(v)])
    }

    #[inline(always)]
    pub fn to_world(&self, v: Vec3s<S>) -> Vec3s<S> {
        self.rows[0] * v[0] + self.rows[1] * v[1] + self.rows[2] * v[2]
    }
}

/// Geometry of splats on the screen; names as in the shader.
pub(super) struct Geometry<S: Simd> {
    pub visible: mask32x8<S>,
    pub t: Vec3s<S>,
    pub inverse_z: f32x8<S>,
    /// Unit quaternion (w, x, y, z).
    pub quat: [f32x8<S>; 4],
    pub quat_length: f32x8<S>,
    /// Columns.
    pub rotation: [Vec3s<S>; 3],
    pub scale: Vec3s<S>,
    pub clamped: [f32x8<S>; 2],
    pub inside: [mask32x8<S>; 2],
    pub j: [Vec3s<S>; 2],
    pub tj: [Vec3s<S>; 2],
    pub b: [Vec3s<S>; 2],
    pub conic: Vec3s<S>,
    pub conic_det: f32x8<S>,
    pub area: Vec3s<S>,
}

/// Columns of the rotation by a unit quaternion.
#[inline(always)]
fn rotation_of<S: Simd>([r, x, y, z]: [f32x8<S>; 4]) -> [Vec3s<S>; 3] {
    let one = f32x8::simd_from(r.token(), 1.0);
    [
        Vec3s([one - (y * y + z * z) * 2.0, (x * y + r * z) * 2.0, (x * z - r * y) * 2.0]),
        Vec3s([(x * y - r * z) * 2.0, one - (x * x + z * z) * 2.0, (y * z + r * x) * 2.0]),
        Vec3s([(x * z + r * y) * 2.0, (y * z - r * x) * 2.0, one - (x * x + y * y) * 2.0]),
    ]
}

impl<S: Simd> Geometry<S> {
    #[inline(always)]
    pub fn of(
        simd: S,
        camera: &Camera<S>,
        mean: Vec3s<S>,
        log_scale: Vec3s<S>,
        raw: [f32x8<S>; 4],
    ) -> Geometry<S> {
        let (zero, one) = (f32x8::simd_from(simd, 0.0), f32x8::simd_from(simd, 1.0));
        let mut t = camera.to_camera(mean) + camera.translation;
        let visible = t[2].simd_gt(camera.near);
        t[2] = visible.select(t[2], one);
        let length = (raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3]).sqrt();
        let inverse_length = one / length;
        let quat = [
            raw[0] * inverse_length,
            raw[1] * inverse_length,
            raw[2] * inverse_length,
            raw[3] * inverse_length,
        ];
        let rotation = rotation_of(quat);
        let scale = Vec3s([exp(log_scale[0]), exp(log_scale[1]), exp(log_scale[2])]);
        let inverse_z = one / t[2];
        let (mut j, mut tj, mut b) = ([t; 2], [t; 2], [t; 2]);
        let (mut clamped, mut inside) = ([zero; 2], [visible; 2]);
        for axis in 0..2 {
            let slope = t[axis] * inverse_z;
            let limited = slope.max(camera.low[axis]).min(camera.high[axis]);
            let step = camera.focal[axis] * inverse_z;
            j[axis] = Vec3s([zero, zero, -step * limited]);
            j[axis][axis] = step;
            tj[axis] = camera.to_world(j[axis]);
            let along = [tj[axis].dot(rotation[0]), tj[axis].dot(rotation[1]), tj[axis].dot(rotation[2])];
            b[axis] = Vec3s(along) * scale;
            clamped[axis] = limited * t[2];
            inside[axis] = slope.simd_eq(limited);
        }
        let area = b[0].cross(b[1]);
        let (xx, yy, xy) = (b[0].dot(b[0]), b[1].dot(b[1]), b[0].dot(b[1]));
        let dilation = DILATION as f32;
        let conic_det = one / (area.dot(area) + (xx + yy) * dilation + dilation * dilation);
        Geometry {
            visible,
            t,
            inverse_z,
            quat,
            quat_length: length,
            rotation,
            scale,
            clamped,
            inside,
            j,
            tj,
            b,
            conic: Vec3s([yy + dilation, -xy, xx + dilation]) * conic_det,
            conic_det,
            area,
        }
    }

    /// Square of the area, at least the smallest that counts.
    #[inline(always)]
    pub fn squared_area(&self) -> f32x8<S> {
        self.area.dot(self.area).max(SMALLEST_AREA as f32)
    }
}
