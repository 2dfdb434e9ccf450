//! `ssim_columns.comp`, `ssim_rows.comp` and `ssim_gradient.comp`.
use super::small::sign;
use super::vectorised;
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::ssim::{C1, C2, HALF, STRIP, WINDOW};
use rayon::prelude::*;

const REACH: usize = HALF as usize;
const ROWS: usize = STRIP as usize;
const TAPS: usize = WINDOW.len();
/// Rows that the outputs of a strip read.
const READ: usize = ROWS + 2 * REACH;

vectorised! {
/// `out[x] += w · row[x]`.
fn add_scaled(out: &mut [f32], row: &[f32], w: f32) {
    for (o, v) in out.iter_mut().zip(row) {
        *o += w * v;
    }
}
}

/// Rows that a strip reads, beginning at `first`; `None` outside the image.
fn rows_read(first: usize, height: usize) -> impl Iterator<Item = Option<usize>> {
    (0..READ).map(move |i| (first + i).checked_sub(REACH).filter(|y| *y < height))
}

/// Blurred columns of a strip from the rows that it reads, each [width]; rows outside are `None`.
fn blur_columns(rows: &[Option<Vec<f32>>], out: &mut [Vec<f32>]) {
    for (k, out) in out.iter_mut().enumerate() {
        for (tap, w) in WINDOW.iter().enumerate() {
            if let Some(row) = &rows[k + tap] {
                add_scaled(out, row, *w as f32);
            }
        }
    }
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
    means.zip(moments).enumerate().for_each(|(channel, (means, moments))| {
        let (x, y) = (&rendered[channel * plane..], &target[channel * plane..]);
        let strips = means.par_chunks_mut(ROWS * width).zip(moments.par_chunks_mut(ROWS * width));
        strips.enumerate().for_each(|(strip, (means, moments))| {
            let mut rows: [Vec<Option<Vec<f32>>>; 4] = Default::default();
            for row in rows_read(strip * ROWS, height) {
                let Some(row) = row else {
                    rows.iter_mut().for_each(|r| r.push(None));
                    continue;
                };
                let at = row * width..(row + 1) * width;
                let (mut u, v) = (x[at.clone()].to_vec(), y[at.clone()].to_vec());
                if let Some(weights) = weights {
                    u.iter_mut().zip(&v).zip(&weights[at]).for_each(|((u, v), w)| *u = w * (*u - v) + v);
                }
                let squares = u.iter().zip(&v).map(|(u, v)| u * u + v * v).collect();
                let products = u.iter().zip(&v).map(|(u, v)| u * v).collect();
                rows.iter_mut().zip([u, v, squares, products]).for_each(|(r, own)| r.push(Some(own)));
            }
            let count = means.len() / width;
            let blurred = rows.map(|rows| {
                let mut out = vec![vec![0.0; width]; count];
                blur_columns(&rows, &mut out);
                out
            });
            let [u, v, squares, products] = &blurred;
            for k in 0..count {
                for x in 0..width {
                    means[k * width + x] = [u[k][x], v[k][x]];
                    moments[k * width + x] = [squares[k][x], products[k][x]];
                }
            }
        });
    });
    Ok(())
}

/// Four padded rows, blurred horizontally.
fn blur_row(padded: &[f32], out: &mut [f32]) {
    out.fill(0.0);
    for (tap, w) in WINDOW.iter().enumerate() {
        add_scaled(out, &padded[tap..], *w as f32);
    }
}

vectorised! {
/// SSIM and its derivatives by (E[x], E[x²], E[xy]) from blurred (x, y) and (x² + y², xy): planes
/// of `blurred` to those of `out`.
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
        by_mean[k] =
            2.0 * y[k] * (a2 - a1) * inverse - 2.0 * x[k] * s / b1 + 2.0 * x[k] * s / b2;
        by_square[k] = -s / b2;
        by_product[k] = 2.0 * a1 * inverse;
        ssim[k] = s;
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
    let padded = || vec![0.0f32; width + 2 * REACH];
    let scratch = || (std::array::from_fn(|_| padded()), Default::default(), Default::default());
    slopes.zip(cross).zip(sums).enumerate().for_each_init(
        scratch,
        |(wide, blurred, derivatives): &mut ([Vec<f32>; 4], [Vec<f32>; 4], [Vec<f32>; 4]), (row, out)| {
            let ((slopes, cross), sums) = out;
            let at = row * width..(row + 1) * width;
            for (k, (mean, moment)) in means[at.clone()].iter().zip(&moments[at]).enumerate() {
                [wide[0][k + REACH], wide[1][k + REACH]] = *mean;
                [wide[2][k + REACH], wide[3][k + REACH]] = *moment;
            }
            for (wide, blurred) in wide.iter().zip(blurred.iter_mut()) {
                blurred.resize(width, 0.0);
                blur_row(wide, blurred);
            }
            derivatives.iter_mut().for_each(|d| d.resize(width, 0.0));
            ssim_of(blurred, derivatives);
            let is_counted = (first..end).contains(&(row % height));
            for (sum, own) in sums.iter_mut().zip(derivatives[3].chunks(ROWS)) {
                *sum = if is_counted { own.iter().sum() } else { 0.0 };
            }
            for k in 0..3 {
                wide[k][REACH..REACH + width].copy_from_slice(&derivatives[k]);
                blur_row(&wide[k], &mut blurred[k]);
            }
            for x in 0..width {
                slopes[x] = [blurred[0][x], blurred[1][x]];
                cross[x] = blurred[2][x];
            }
        },
    );
    Ok(())
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
    gradient.zip(sums).enumerate().for_each(|(channel, (gradient, sums))| {
        let base = channel * plane;
        let strips = gradient.par_chunks_mut(ROWS * width).zip(sums.par_chunks_mut(width));
        strips.enumerate().for_each(|(strip, (gradient, sums))| {
            let count = gradient.len() / width;
            let mut blurred: [Vec<Vec<f32>>; 3] = Default::default();
            if with_ssim {
                let row_of = |row: usize, k: usize| -> Vec<f32> {
                    let at = base + row * width..base + (row + 1) * width;
                    match k {
                        2 => cross[at].to_vec(),
                        k => slopes[at].iter().map(|s| s[k]).collect(),
                    }
                };
                for (k, out) in blurred.iter_mut().enumerate() {
                    let rows: Vec<_> =
                        rows_read(strip * ROWS, height).map(|row| row.map(|row| row_of(row, k))).collect();
                    *out = vec![vec![0.0; width]; count];
                    blur_columns(&rows, out);
                }
            }
            sums.fill(0.0);
            for k in 0..count {
                let row = strip * ROWS + k;
                let counts = (first..end).contains(&row);
                for x in 0..width {
                    let pixel = row * width + x;
                    let (mut u, v) = (rendered[base + pixel], target[base + pixel]);
                    let share = weights.map_or(1.0, |w| w[pixel]);
                    if weights.is_some() {
                        u = share * (u - v) + v;
                    }
                    let difference = u - v;
                    let mut slope = l1_weight * sign(difference);
                    if with_ssim {
                        let [a, b, c] = [&blurred[0][k], &blurred[1][k], &blurred[2][k]];
                        slope -= dssim_weight * (a[x] + 2.0 * u * b[x] + v * c[x]);
                    }
                    gradient[k * width + x] = if counts { share * slope } else { 0.0 };
                    sums[x] += if counts { difference.abs() } else { 0.0 };
                }
            }
        });
    });
    Ok(())
}

const _: () = assert!(TAPS == 2 * REACH + 1);
