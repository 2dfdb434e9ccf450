//! Numbers of eight splats at once: a vector has one number of each.
use super::blend::exp2;
use fearless_simd::{Simd, f32x8, i32x8, mask32x8, prelude::*};
use std::f32::consts::LOG2_E;
use std::ops::{Add, AddAssign, Index, IndexMut, Mul, Sub};

/// Splats of a vector.
pub(super) const LANES: usize = 8;

/// Three-dimensional vectors.
#[derive(Clone, Copy)]
pub(super) struct Vec3s<S: Simd>(pub [f32x8<S>; 3]);

impl<S: Simd> Vec3s<S> {
    #[inline(always)]
    pub fn splat(simd: S, [x, y, z]: [f32; 3]) -> Vec3s<S> {
        Vec3s([f32x8::simd_from(simd, x), f32x8::simd_from(simd, y), f32x8::simd_from(simd, z)])
    }

    #[inline(always)]
    pub fn dot(self, other: Vec3s<S>) -> f32x8<S> {
        let ([x, y, z], [u, v, w]) = (self.0, other.0);
        x.mul_add(u, y.mul_add(v, z * w))
    }

    #[inline(always)]
    pub fn cross(self, other: Vec3s<S>) -> Vec3s<S> {
        let ([x, y, z], [u, v, w]) = (self.0, other.0);
        Vec3s([y * w - z * v, z * u - x * w, x * v - y * u])
    }

    /// `self` where `mask` is set, elsewhere 0.
    #[inline(always)]
    pub fn only(self, mask: mask32x8<S>) -> Vec3s<S> {
        let ([x, y, z], zero) = (self.0, f32x8::simd_from(self.0[0].token(), 0.0));
        Vec3s([mask.select(x, zero), mask.select(y, zero), mask.select(z, zero)])
    }
}

impl<S: Simd> Index<usize> for Vec3s<S> {
    type Output = f32x8<S>;
    #[inline(always)]
    fn index(&self, axis: usize) -> &f32x8<S> {
        &self.0[axis]
    }
}

impl<S: Simd> IndexMut<usize> for Vec3s<S> {
    #[inline(always)]
    fn index_mut(&mut self, axis: usize) -> &mut f32x8<S> {
        &mut self.0[axis]
    }
}

impl<S: Simd> Add for Vec3s<S> {
    type Output = Vec3s<S>;
    #[inline(always)]
    fn add(self, other: Vec3s<S>) -> Vec3s<S> {
        Vec3s([self[0] + other[0], self[1] + other[1], self[2] + other[2]])
    }
}

impl<S: Simd> AddAssign for Vec3s<S> {
    #[inline(always)]
    fn add_assign(&mut self, other: Vec3s<S>) {
        *self = *self + other;
    }
}

impl<S: Simd> Sub for Vec3s<S> {
    type Output = Vec3s<S>;
    #[inline(always)]
    fn sub(self, other: Vec3s<S>) -> Vec3s<S> {
        Vec3s([self[0] - other[0], self[1] - other[1], self[2] - other[2]])
    }
}

impl<S: Simd> Mul for Vec3s<S> {
    type Output = Vec3s<S>;
    #[inline(always)]
    fn mul(self, other: Vec3s<S>) -> Vec3s<S> {
        Vec3s([self[0] * other[0], self[1] * other[1], self[2] * other[2]])
    }
}

impl<S: Simd> Mul<f32x8<S>> for Vec3s<S> {
    type Output = Vec3s<S>;
    #[inline(always)]
    fn mul(self, factor: f32x8<S>) -> Vec3s<S> {
        Vec3s([self[0] * factor, self[1] * factor, self[2] * factor])
    }
}

/// Numbers of a splat at most.
const MOST: usize = 48;

/// Exchanges rows and columns.
#[inline(always)]
fn transposed<S: Simd>(mut rows: [f32x8<S>; LANES]) -> [f32x8<S>; LANES] {
    // Each round turns the bits (row, column) of a place by one.
    for _ in 0..3 {
        let old = rows;
        for k in 0..LANES / 2 {
            rows[2 * k] = old[k].zip_low(old[k + LANES / 2]);
            rows[2 * k + 1] = old[k].zip_high(old[k + LANES / 2]);
        }
    }
    rows
}

/// Columns of eight rows of `stride` numbers.
#[inline(always)]
fn gather_whole<S: Simd>(simd: S, rows: &[f32], stride: usize, columns: &mut [f32x8<S>]) {
    let (rows, count) = (rows[..LANES * stride].chunks_exact(stride), columns.len());
    if count < LANES {
        for (k, column) in columns.iter_mut().enumerate() {
            let mut numbers = [0.0; LANES];
            numbers.iter_mut().zip(rows.clone()).for_each(|(number, row)| *number = row[k]);
            *column = f32x8::simd_from(simd, numbers);
        }
        return;
    }
    for first in (0..count).step_by(LANES) {
        // The last eight columns overlap those before them.
        let first = first.min(count - LANES);
        let mut eight = [f32x8::simd_from(simd, 0.0); LANES];
        for (eight, row) in eight.iter_mut().zip(rows.clone()) {
            *eight = f32x8::from_slice(simd, &row[first..first + LANES]);
        }
        columns[first..first + LANES].copy_from_slice(&transposed(eight));
    }
}

/// Columns of up to eight rows of `stride` numbers; 0 in lanes beyond the last row.
#[inline(always)]
pub(super) fn gather_rows<S: Simd>(simd: S, rows: &[f32], stride: usize, columns: &mut [f32x8<S>]) {
    if rows.len() >= LANES * stride {
        gather_whole(simd, rows, stride, columns);
    } else {
        let mut padded = [0.0; LANES * MOST];
        padded[..rows.len()].copy_from_slice(rows);
        gather_whole(simd, &padded, stride, columns);
    }
}

/// Writes up to eight rows of `stride` numbers from their first columns.
#[inline(always)]
pub(super) fn scatter_rows<S: Simd>(columns: &[f32x8<S>], rows: &mut [f32], stride: usize) {
    let count = columns.len();
    if count < LANES {
        for (k, column) in columns.iter().enumerate() {
            let numbers = column.to_array();
            rows.chunks_exact_mut(stride).zip(numbers).for_each(|(row, number)| row[k] = number);
        }
        return;
    }
    for first in (0..count).step_by(LANES) {
        let first = first.min(count - LANES);
        let mut eight = [columns[0]; LANES];
        eight.copy_from_slice(&columns[first..first + LANES]);
        for (row, eight) in rows.chunks_exact_mut(stride).zip(transposed(eight)) {
            eight.store_slice(&mut row[first..first + LANES]);
        }
    }
}

/// [`gather_rows`] of all columns.
#[inline(always)]
pub(super) fn gather<S: Simd, const N: usize>(simd: S, rows: &[[f32; N]]) -> [f32x8<S>; N] {
    let mut columns = [f32x8::simd_from(simd, 0.0); N];
    gather_rows(simd, rows.as_flattened(), N, &mut columns);
    columns
}

/// [`scatter_rows`] of all columns.
#[inline(always)]
pub(super) fn scatter<S: Simd, const N: usize>(columns: &[f32x8<S>; N], rows: &mut [[f32; N]]) {
    scatter_rows(columns, rows.as_flattened_mut(), N);
}

/// Powers of e, between 2⁻¹²⁶ and 2¹²⁶.
#[inline(always)]
pub(super) fn exp<S: Simd>(x: f32x8<S>) -> f32x8<S> {
    let (x, limit) = (x * LOG2_E, f32x8::simd_from(x.token(), 126.0));
    // Comparisons leave a NaN as it is.
    let x = x.simd_gt(limit).select(limit, x);
    exp2(x.simd_lt(-limit).select(-limit, x))
}

/// Logarithms to base 2 of positive numbers that are not subnormal.
#[inline(always)]
pub(super) fn log2<S: Simd>(x: f32x8<S>) -> f32x8<S> {
    let number = |value: f32| f32x8::simd_from(x.token(), value);
    // x = 2^exponent · m, with m between √½ and √2.
    let bits: i32x8<S> = x.bitcast();
    let exponent = (bits - std::f32::consts::FRAC_1_SQRT_2.to_bits() as i32) >> 23;
    let m: f32x8<S> = (bits - (exponent << 23)).bitcast();
    // ln m = 2 artanh((m − 1) / (m + 1)).
    let z = (m - 1.0) / (m + 1.0);
    let zz = z * z;
    let series = zz.mul_add(number(2.0 / 9.0), number(2.0 / 7.0));
    let series = series.mul_add(zz, number(2.0 / 5.0));
    let series = series.mul_add(zz, number(2.0 / 3.0));
    let series = series.mul_add(zz, number(2.0));
    let log2 = (z * series).mul_add(number(LOG2_E), f32x8::float_from(exponent));
    // The exponent of a NaN is a number.
    x.simd_eq(x).select(log2, x)
}
