//! Windows of the plane sweep on the host, warped into a source view: eight taps are a vector.
use crate::gpu::shaders::shared::plane_sweep as shared;
use fearless_simd::{Simd, f32x4, f32x8, f64x2, i32x8, prelude::*};
use glam::Vec3;

const TAPS: usize = shared::TAPS as usize;
/// Taps of a window besides the middle one, a multiple of [`LANES`].
pub(super) const OUTER: usize = TAPS * TAPS - 1;
const LANES: usize = 8;

/// Luma of a pixel and of those to the right, below and diagonally below.
pub(super) type Quad = [f32; 4];

/// Matching window of one reference pixel. The weights of all taps sum to 1. The middle tap is left
/// out: in every source, values are relative to its value.
pub(super) struct Window {
    /// Weight per outer tap.
    pub weights: [f32; OUTER],
    /// Weight × (luma − weighted mean).
    pub centred: [f32; OUTER],
    /// Weighted variance.
    pub variance: f32,
}

/// Offsets of the outer taps from the middle, row by row, pixels.
pub(super) const OFFSETS: [[f32; OUTER]; 2] = {
    let mut offsets = [[0.0; OUTER]; 2];
    let mut k = 0;
    while k < OUTER {
        let tap = if k < OUTER / 2 { k } else { k + 1 };
        let middle = (TAPS - 1) / 2;
        offsets[0][k] = (tap % TAPS) as f32 - middle as f32;
        offsets[1][k] = (tap / TAPS) as f32 - middle as f32;
        offsets[0][k] *= shared::TAP_STEP as f32;
        offsets[1][k] *= shared::TAP_STEP as f32;
        k += 1;
    }
    offsets
};

/// A window in a source view: homogeneous pixel of its middle, and its change per pixel along x and
/// y of the reference.
pub(super) struct Warp {
    pub middle: Vec3,
    pub along_x: Vec3,
    pub along_y: Vec3,
}

/// Σ w v, Σ w v² and Σ c v over the outer taps of a warped window, with v the luma of a source
/// relative to `base`, that at the middle tap.
#[inline(always)]
pub(super) fn moments<S: Simd>(
    simd: S,
    quads: &[Quad],
    width: usize,
    limit: [f32; 2],
    base: f32,
    warp: &Warp,
    window: &Window,
) -> [f32; 3] {
    let Warp { middle, along_x, along_y } = *warp;
    let number = |value: f32| f32x8::simd_from(simd, value);
    let mut sums = [number(0.0); 3];
    for first in (0..OUTER).step_by(LANES) {
        let of = |values: &[f32; OUTER]| f32x8::from_slice(simd, &values[first..first + LANES]);
        let (dx, dy) = (of(&OFFSETS[0]), of(&OFFSETS[1]));
        let along = |middle: f32, x: f32, y: f32| number(middle) + dx * x + dy * y;
        let inverse = number(1.0) / along(middle.z, along_x.z, along_y.z).max(1e-6);
        let x = along(middle.x, along_x.x, along_y.x) * inverse - 0.5;
        let y = along(middle.y, along_x.y, along_y.y) * inverse - 0.5;
        let (x, y) = (x.max(0.0).min(limit[0]), y.max(0.0).min(limit[1]));
        let (ix, iy): (i32x8<S>, i32x8<S>) = (x.to_int(), y.to_int());
        let (fx, fy) = (x - ix.to_float::<f32x8<S>>(), y - iy.to_float::<f32x8<S>>());
        let places = (iy * width as i32 + ix).to_array();
        let [top, right, below, diagonal] = corners(simd, quads, &places);
        let left = top + fy * (below - top);
        let right = right + fy * (diagonal - right);
        let value = left + fx * (right - left) - base;
        let (weights, centred) = (of(&window.weights), of(&window.centred));
        sums[0] += weights * value;
        sums[1] += weights * value * value;
        sums[2] += centred * value;
    }
    [sums[0].reduce_sum(), sums[1].reduce_sum(), sums[2].reduce_sum()]
}

/// The four numbers of eight quads, as four vectors.
#[inline(always)]
fn corners<S: Simd>(simd: S, quads: &[Quad], places: &[i32; LANES]) -> [f32x8<S>; 4] {
    let [a, b, c, d] = transposed(simd, quads, [places[0], places[1], places[2], places[3]]);
    let [e, f, g, h] = transposed(simd, quads, [places[4], places[5], places[6], places[7]]);
    [a.combine(e), b.combine(f), c.combine(g), d.combine(h)]
}

#[inline(always)]
fn transposed<S: Simd>(simd: S, quads: &[Quad], places: [i32; 4]) -> [f32x4<S>; 4] {
    let quad = |k: usize| f32x4::simd_from(simd, quads[places[k] as usize]);
    let (a, b, c, d) = (quad(0), quad(1), quad(2), quad(3));
    let (ab, cd): (f64x2<S>, f64x2<S>) = (a.zip_low(b).bitcast(), c.zip_low(d).bitcast());
    let (ab_high, cd_high): (f64x2<S>, f64x2<S>) = (a.zip_high(b).bitcast(), c.zip_high(d).bitcast());
    [
        ab.zip_low(cd).bitcast(),
        ab.zip_high(cd).bitcast(),
        ab_high.zip_low(cd_high).bitcast(),
        ab_high.zip_high(cd_high).bitcast(),
    ]
}

const _: () = assert!(OUTER.is_multiple_of(LANES));
