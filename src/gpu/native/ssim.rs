//! `ssim_columns.comp`, `ssim_rows.comp` and `ssim_gradient.comp`.
use super::small::sign;
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::ssim::{C1, C2, HALF, STRIP, WINDOW};
use fearless_simd::{Level, Simd, dispatch, f32x8, prelude::*};
use rayon::prelude::*;

const REACH: usize = HALF as usize;
const ROWS: usize = STRIP as usize;
const TAPS: usize = WINDOW.len();
const LANES: usize = 8;
/// Rows that the outputs of a strip read.
const READ: usize = ROWS + 2 * REACH;

/// The weighted sum of eleven vectors.
#[inline(always)]
fn blur<S: Simd>(simd: S, mut tap: impl FnMut(usize) -> f32x8<S>) -> f32x8<S> {
    let mut sum = f32x8::simd_from(simd, 0.0);
    for (k, w) in WINDOW.iter().enumerate() {
        sum = tap(k).mul_add(f32x8::simd_from(simd, *w as f32), sum);
    }
    sum
}

/// Row `k` of a vertical blur of rows of `out.len()` numbers, a multiple of eight.
#[inline(always)]
fn blur_columns<S: Simd>(simd: S, rows: &[f32], k: usize, out: &mut [f32]) {
    let stride = out.len();
    for (block, out) in out.chunks_exact_mut(LANES).enumerate() {
        let at = k * stride + block * LANES;
        blur(simd, |tap| f32x8::from_slice(simd, &rows[at + tap * stride..][..LANES])).store_slice(out);
    }
}

/// Horizontal blur of a row that begins [`REACH`] before the first output.
#[inline(always)]
fn blur_row<S: Simd>(simd: S, row: &[f32], out: &mut [f32]) {
    for (block, out) in out.chunks_exact_mut(LANES).enumerate() {
        let at = block * LANES;
        blur(simd, |tap| f32x8::from_slice(simd, &row[at + tap..][..LANES])).store_slice(out);
    }
}

/// Numbers of a row in whole vectors.
fn padded(width: usize) -> usize {
    width.next_multiple_of(LANES)
}

/// The rows that a strip reads, and the row of its scratch memory that each goes to; rows outside
/// of the image are not among them.
fn rows_read(strip: usize, height: usize) -> impl Iterator<Item = (usize, usize)> {
    let row = move |i: usize| Some((i, (strip * ROWS + i).checked_sub(REACH).filter(|y| *y < height)?));
    (0..READ).filter_map(row)
}

/// Vertical blurs of (x, y) and (x² + y², xy).
pub(super) fn columns(call: &mut NativeCall) -> Result<(), String> {
    let [width, height, weighted] = call.words()?.map(|word| word as usize);
    let [rendered, target, means, moments] = call.memory([0, 1, 2, 3])?;
    let (rendered, target): (&[f32], &[f32]) = (rendered.of(), target.of());
    let plane = width * height;
    let weights = (weighted != 0).then(|| &target[3 * plane..4 * plane]);
    let means = means.of::<[f32; 2]>()[..3 * plane].par_chunks_mut(plane);
    let moments = moments.of::<[f32; 2]>()[..3 * plane].par_chunks_mut(plane);
    let (stride, level) = (padded(width), Level::new());
    means.zip(moments).enumerate().for_each(|(channel, (means, moments))| {
        let (x, y) = (&rendered[channel * plane..], &target[channel * plane..]);
        let strips = means.par_chunks_mut(ROWS * width).zip(moments.par_chunks_mut(ROWS * width));
        strips.enumerate().for_each(|(strip, (means, moments))| {
            let mut rows: [Vec<f32>; 4] = std::array::from_fn(|_| vec![0.0; READ * stride]);
            let mut out: [Vec<f32>; 4] = std::array::from_fn(|_| vec![0.0; stride]);
            for (i, row) in rows_read(strip, height) {
                let (own, at) = (i * stride..i * stride + width, row * width..(row + 1) * width);
                let [u, v, squares, products] = rows.each_mut().map(|row| &mut row[own.clone()]);
                u.copy_from_slice(&x[at.clone()]);
                v.copy_from_slice(&y[at.clone()]);
                if let Some(weights) = weights {
                    u.iter_mut().zip(&*v).zip(&weights[at]).for_each(|((u, v), w)| *u = w * (*u - v) + v);
                }
                for k in 0..width {
                    squares[k] = u[k] * u[k] + v[k] * v[k];
                    products[k] = u[k] * v[k];
                }
            }
            let strip = means.chunks_exact_mut(width).zip(moments.chunks_exact_mut(width));
            for (k, (means, moments)) in strip.enumerate() {
                dispatch!(level, simd => {
                    for (rows, out) in rows.iter().zip(&mut out) {
                        blur_columns(simd, rows, k, out);
                    }
                });
                let [u, v, squares, products] = &out;
                for x in 0..width {
                    means[x] = [u[x], v[x]];
                    moments[x] = [squares[x], products[x]];
                }
            }
        });
    });
    Ok(())
}

/// SSIM and its derivatives by (E[x], E[x²], E[xy]) from blurred (x, y) and (x² + y², xy): planes
/// of `blurred` to those of `out`.
#[inline(always)]
fn ssim_of(blurred: &[Vec<f32>; 4], out: &mut [Vec<f32>; 4]) {
    let [x, y, squares, products] = blurred;
    let [by_mean, by_square, by_product, ssim] = out;
    let (c1, c2) = (C1 as f32, C2 as f32);
    for k in 0..ssim.len() {
        let product = x[k] * y[k];
        let sum = x[k] * x[k] + y[k] * y[k];
        let (a1, a2) = (2.0 * product + c1, 2.0 * (products[k] - product) + c2);
        let (b1, b2) = (sum + c1, (squares[k] - sum) + c2);
        let inverse = 1.0 / (b1 * b2);
        let s = a1 * a2 * inverse;
        by_mean[k] = 2.0 * y[k] * (a2 - a1) * inverse - 2.0 * x[k] * s / b1 + 2.0 * x[k] * s / b2;
        by_square[k] = -s / b2;
        by_product[k] = 2.0 * a1 * inverse;
        ssim[k] = s;
    }
}

/// Memory of one row of [`rows`].
struct RowScratch {
    /// The four inputs, then the three derivatives, with a margin of zeros.
    wide: [Vec<f32>; 4],
    blurred: [Vec<f32>; 4],
    derivatives: [Vec<f32>; 4],
}

impl RowScratch {
    fn new(width: usize) -> RowScratch {
        let stride = padded(width);
        let planes = |length: usize| std::array::from_fn(|_| vec![0.0; length]);
        RowScratch { wide: planes(stride + TAPS - 1), blurred: planes(stride), derivatives: planes(stride) }
    }

    #[inline(always)]
    fn compute<S: Simd>(&mut self, simd: S, width: usize) {
        for (wide, blurred) in self.wide.iter().zip(&mut self.blurred) {
            blur_row(simd, wide, blurred);
        }
        ssim_of(&self.blurred, &mut self.derivatives);
        for k in 0..3 {
            self.wide[k][REACH..REACH + width].copy_from_slice(&self.derivatives[k][..width]);
            blur_row(simd, &self.wide[k], &mut self.blurred[k]);
        }
    }
}

/// Horizontal blurs, SSIM, and the horizontal blurs of its derivatives.
pub(super) fn rows(call: &mut NativeCall) -> Result<(), String> {
    let [width, height, strips, first, end] = call.words()?.map(|word| word as usize);
    let [means, moments, slopes, cross, sums] = call.memory([0, 1, 2, 3, 4])?;
    let (means, moments): (&[[f32; 2]], &[[f32; 2]]) = (means.of(), moments.of());
    let rows = 3 * height;
    let slopes = slopes.of::<[f32; 2]>()[..rows * width].par_chunks_mut(width);
    let cross = cross.of::<f32>()[..rows * width].par_chunks_mut(width);
    let sums = sums.of::<f32>()[..rows * strips].par_chunks_mut(strips);
    let level = Level::new();
    slopes.zip(cross).zip(sums).enumerate().for_each_init(
        || RowScratch::new(width),
        |scratch, (row, ((slopes, cross), sums))| {
            let at = row * width..(row + 1) * width;
            for (k, (mean, moment)) in means[at.clone()].iter().zip(&moments[at]).enumerate() {
                [scratch.wide[0][k + REACH], scratch.wide[1][k + REACH]] = *mean;
                [scratch.wide[2][k + REACH], scratch.wide[3][k + REACH]] = *moment;
            }
            dispatch!(level, simd => scratch.compute(simd, width));
            let is_counted = (first..end).contains(&(row % height));
            for (sum, own) in sums.iter_mut().zip(scratch.derivatives[3][..width].chunks(ROWS)) {
                *sum = if is_counted { own.iter().sum() } else { 0.0 };
            }
            for x in 0..width {
                slopes[x] = [scratch.blurred[0][x], scratch.blurred[1][x]];
                cross[x] = scratch.blurred[2][x];
            }
        },
    );
    Ok(())
}

/// The loss of [`gradient`], and the images of one channel.
struct Loss<'a> {
    x: &'a [f32],
    y: &'a [f32],
    weights: Option<&'a [f32]>,
    l1_weight: f32,
    dssim_weight: f32,
}

impl Loss<'_> {
    /// The gradient of pixels `at`, from the blurred derivatives; adds the absolute differences.
    #[inline(always)]
    fn differentiate(
        &self,
        at: std::ops::Range<usize>,
        blurred: &[Vec<f32>; 3],
        gradient: &mut [f32],
        sums: &mut [f32],
    ) {
        let (x, y) = (&self.x[at.clone()], &self.y[at.clone()]);
        let weights = self.weights.map(|weights| &weights[at]);
        let [a, b, c] = blurred.each_ref().map(|plane| &plane[..gradient.len()]);
        for k in 0..gradient.len() {
            let share = weights.map_or(1.0, |w| w[k]);
            let v = y[k];
            let u = if weights.is_some() { share * (x[k] - v) + v } else { x[k] };
            let slope = self.l1_weight * sign(u - v);
            gradient[k] = share * (slope - self.dssim_weight * (a[k] + 2.0 * u * b[k] + v * c[k]));
            sums[k] += (u - v).abs();
        }
    }
}

/// Vertical blurs of the derivatives, the gradient, and the sums of absolute differences; without
/// SSIM the last two alone.
pub(super) fn gradient(call: &mut NativeCall) -> Result<(), String> {
    let words: [u32; 7] = call.words()?;
    let [width, height] = [0, 1].map(|k| words[k] as usize);
    let [l1_weight, dssim_weight] = [2, 3].map(|k| f32::from_bits(words[k]));
    let [first, end, weighted] = [4, 5, 6].map(|k| words[k] as usize);
    let (plane, strips) = (width * height, height.div_ceil(ROWS));
    let with_ssim = call.variant()[0] == 1;
    // Without SSIM there are no derivatives.
    let [rendered, target, slopes, cross, gradient, sums] = call.optional([0, 1, 2, 3, 4, 5]);
    let (rendered, target): (&[f32], &[f32]) = (rendered.of(), target.of());
    let (slopes, cross): (&[[f32; 2]], &[f32]) = (slopes.of(), cross.of());
    let gradient = gradient.of::<f32>()[..3 * plane].par_chunks_mut(plane);
    let sums = sums.of::<f32>()[..3 * strips * width].par_chunks_mut(strips * width);
    let weights = (weighted != 0).then(|| &target[3 * plane..4 * plane]);
    let (stride, level) = (padded(width), Level::new());
    gradient.zip(sums).enumerate().for_each(|(channel, (gradient, sums))| {
        let base = channel * plane;
        let (x, y) = (&rendered[base..base + plane], &target[base..base + plane]);
        let loss = Loss { x, y, weights, l1_weight, dssim_weight };
        let strips = gradient.par_chunks_mut(ROWS * width).zip(sums.par_chunks_mut(width));
        strips.enumerate().for_each(|(strip, (gradient, sums))| {
            let length = if with_ssim { READ * stride } else { 0 };
            let mut rows: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; length]);
            let mut blurred: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; stride]);
            for (i, row) in rows_read(strip, height).filter(|_| with_ssim) {
                let at = base + row * width..base + (row + 1) * width;
                for (k, (slope, cross)) in slopes[at.clone()].iter().zip(&cross[at]).enumerate() {
                    rows[0][i * stride + k] = slope[0];
                    rows[1][i * stride + k] = slope[1];
                    rows[2][i * stride + k] = *cross;
                }
            }
            sums.fill(0.0);
            for (k, gradient) in gradient.chunks_exact_mut(width).enumerate() {
                let row = strip * ROWS + k;
                if !(first..end).contains(&row) {
                    gradient.fill(0.0);
                    continue;
                }
                dispatch!(level, simd => {
                    for (rows, blurred) in rows.iter().zip(&mut blurred).filter(|_| with_ssim) {
                        blur_columns(simd, rows, k, blurred);
                    }
                    loss.differentiate(row * width..(row + 1) * width, &blurred, gradient, sums);
                });
            }
        });
    });
    Ok(())
}

const _: () = assert!(TAPS == 2 * REACH + 1);
