//! Spherical harmonics of eight directions in f32, as `glsl/shared/sh.glsl`, for the native passes.
use super::lanes::{Vec3s, gather_rows, scatter_rows};
use crate::scene::sh::{C0, C1, C2, C3};
use fearless_simd::{Simd, f32x8, prelude::*};
use std::ops::Range;

/// Calls `$run::<N>` for a pass whose first variant is the SH degree; N are its coefficients.
macro_rules! with_count {
    ($run:ident, $call:expr) => {
        match $call.variant()[0] {
            0 => $run::<1>($call),
            1 => $run::<4>($call),
            2 => $run::<9>($call),
            _ => $run::<16>($call),
        }
    };
}
pub(super) use with_count;

/// Coefficients of splats.
pub(super) struct Coefficients<'a> {
    numbers: &'a [f32],
    /// Numbers of a splat.
    stride: usize,
}

impl<'a> Coefficients<'a> {
    pub fn new(numbers: &'a [f32], stride: usize) -> Coefficients<'a> {
        Coefficients { numbers, stride: 3 * stride }
    }

    /// The first `N` RGB coefficients of up to eight splats.
    #[inline(always)]
    pub fn of<S: Simd, const N: usize>(&self, simd: S, own: &Range<usize>) -> [[f32x8<S>; 3]; N] {
        let mut columns = [[f32x8::simd_from(simd, 0.0); 3]; N];
        let rows = &self.numbers[own.start * self.stride..own.end * self.stride];
        gather_rows(simd, rows, self.stride, columns.as_flattened_mut());
        columns
    }
}

/// The first `N` basis functions, those of whole degrees, at unit directions.
#[inline(always)]
pub(super) fn basis<S: Simd, const N: usize>(simd: S, d: Vec3s<S>) -> [f32x8<S>; N] {
    let [x, y, z] = d.0;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let mut b = [f32x8::simd_from(simd, 0.0); N];
    b[0] = f32x8::simd_from(simd, C0 as f32);
    if N >= 4 {
        b[1] = y * -C1 as f32;
        b[2] = z * C1 as f32;
        b[3] = x * -C1 as f32;
    }
    if N >= 9 {
        b[4] = x * y * C2[0] as f32;
        b[5] = y * z * C2[1] as f32;
        b[6] = (zz * 2.0 - xx - yy) * C2[2] as f32;
        b[7] = x * z * C2[3] as f32;
        b[8] = (xx - yy) * C2[4] as f32;
    }
    if N >= 16 {
        b[9] = y * (xx * 3.0 - yy) * C3[0] as f32;
        b[10] = x * y * z * C3[1] as f32;
        b[11] = y * (zz * 4.0 - xx - yy) * C3[2] as f32;
        b[12] = z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * C3[3] as f32;
        b[13] = x * (zz * 4.0 - xx - yy) * C3[4] as f32;
        b[14] = z * (xx - yy) * C3[5] as f32;
        b[15] = x * (xx - yy * 3.0) * C3[6] as f32;
    }
    b
}

/// Derivatives of [`basis`] by the direction, with its components as free variables.
#[inline(always)]
pub(super) fn basis_gradient<S: Simd, const N: usize>(simd: S, d: Vec3s<S>) -> [Vec3s<S>; N] {
    let [x, y, z] = d.0;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let number = |value: f64| f32x8::simd_from(simd, value as f32);
    let zero = number(0.0);
    let mut g = [Vec3s([zero; 3]); N];
    if N >= 4 {
        g[1] = Vec3s([zero, number(-C1), zero]);
        g[2] = Vec3s([zero, zero, number(C1)]);
        g[3] = Vec3s([number(-C1), zero, zero]);
    }
    if N >= 9 {
        g[4] = Vec3s([y, x, zero]) * number(C2[0]);
        g[5] = Vec3s([zero, z, y]) * number(C2[1]);
        g[6] = Vec3s([x * -2.0, y * -2.0, z * 4.0]) * number(C2[2]);
        g[7] = Vec3s([z, zero, x]) * number(C2[3]);
        g[8] = Vec3s([x * 2.0, y * -2.0, zero]) * number(C2[4]);
    }
    if N >= 16 {
        g[9] = Vec3s([x * y * 6.0, (xx - yy) * 3.0, zero]) * number(C3[0]);
        g[10] = Vec3s([y * z, x * z, x * y]) * number(C3[1]);
        g[11] = Vec3s([x * y * -2.0, zz * 4.0 - xx - yy * 3.0, y * z * 8.0]) * number(C3[2]);
        g[12] = Vec3s([x * z * -6.0, y * z * -6.0, zz * 6.0 - xx * 3.0 - yy * 3.0]) * number(C3[3]);
        g[13] = Vec3s([zz * 4.0 - xx * 3.0 - yy, x * y * -2.0, x * z * 8.0]) * number(C3[4]);
        g[14] = Vec3s([x * z * 2.0, y * z * -2.0, xx - yy]) * number(C3[5]);
        g[15] = Vec3s([(xx - yy) * 3.0, x * y * -6.0, zero]) * number(C3[6]);
    }
    g
}

/// Writes the gradients by the coefficients of `count` splats, `basis` × `by_colour`; 0 for higher
/// degrees.
#[inline(always)]
pub(super) fn scatter<S: Simd, const N: usize>(
    basis: &[f32x8<S>; N],
    by_colour: Vec3s<S>,
    out: &mut [f32],
    count: usize,
) {
    let stride = out.len() / count;
    if stride > 3 * N {
        out.fill(0.0);
    }
    let mut columns = [by_colour.0; N];
    for (rgb, basis) in columns.iter_mut().zip(basis) {
        *rgb = (by_colour * *basis).0;
    }
    scatter_rows(columns.as_flattened(), out, stride);
}
