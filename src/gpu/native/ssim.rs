//! `ssim_columns.comp`, `ssim_rows.comp` (or `ssim_rows_shared.comp`) and `ssim_gradient.comp`.
//! Only these passes read their scratch buffers. Here these hold a plane per quantity instead of
//! pairs, so that rows of a plane are vectors.
use super::small::sign;
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::ssim::{C1, C2, HALF, STRIP, WINDOW};
use fearless_simd::{Level, Simd, dispatch, f32x8, prelude::*};
use rayon::prelude::*;
use std::ops::Range;

const REACH: usize = HALF as usize;
const ROWS: usize = STRIP as usize;
const TAPS: usize = WINDOW.len();
const LANES: usize = 8;
/// Rows that the outputs of a strip read.
const READ: usize = ROWS + 2 * REACH;
/// Columns that are blurred together: with four planes they fit the first-level cache.
const BLOCK: usize = 64;

/// Rows of a plane that a strip reads, in a block of columns.
type Rows = [[f32; BLOCK]; READ];

/// The weighted sum of eleven vectors.
#[inline(always)]
fn blur<S: Simd>(simd: S, tap: impl Fn(usize) -> f32x8<S>) -> f32x8<S> {
    let weight = |k: usize| f32x8::simd_from(simd, WINDOW[k] as f32);
    let mut sum = tap(REACH) * weight(REACH);
    for k in 0..REACH {
        sum = (tap(k) + tap(TAPS - 1 - k)).mul_add(weight(k), sum);
    }
    sum
}

/// Reads the numbers of a block of columns, of which those beyond `from` are 0.
#[inline(always)]
fn read<S: Simd>(simd: S, from: &[f32], block: &mut [f32; BLOCK]) {
    // A whole block is copied in registers: a call of memmove takes longer.
    let Some(from) = from.first_chunk::<BLOCK>() else {
        block[..from.len()].copy_from_slice(from);
        return block[from.len()..].fill(0.0);
    };
    for (from, to) in from.chunks_exact(LANES).zip(block.chunks_exact_mut(LANES)) {
        f32x8::from_slice(simd, from).store_slice(to);
    }
}

/// Writes the numbers of a block of columns that lie in `to`.
#[inline(always)]
fn write<S: Simd>(simd: S, block: &[f32; BLOCK], to: &mut [f32]) {
    let Some(to) = to.first_chunk_mut::<BLOCK>() else {
        return to.copy_from_slice(&block[..to.len()]);
    };
    for (from, to) in block.chunks_exact(LANES).zip(to.chunks_exact_mut(LANES)) {
        f32x8::from_slice(simd, from).store_slice(to);
    }
}

/// Row `k` of the vertical blur of a plane.
#[inline(always)]
fn blur_columns<S: Simd>(simd: S, rows: &Rows, k: usize, out: &mut [f32; BLOCK]) {
    // One check of bounds instead of one per number.
    let Some(rows) = rows[k..].first_chunk::<TAPS>() else { return };
    for (block, out) in out.chunks_exact_mut(LANES).enumerate() {
        let at = block * LANES;
        blur(simd, |tap| f32x8::from_slice(simd, &rows[tap][at..at + LANES])).store_slice(out);
    }
}

/// Horizontal blur of a row that begins [`REACH`] before the first output.
#[inline(always)]
fn blur_row<S: Simd>(simd: S, row: &[f32], out: &mut [f32]) {
    for (block, out) in out.chunks_exact_mut(LANES).enumerate() {
        let Some(row) = row[block * LANES..].first_chunk::<{ LANES + TAPS - 1 }>() else { return };
        blur(simd, |tap| f32x8::from_slice(simd, &row[tap..tap + LANES])).store_slice(out);
    }
}

/// The strips of an image, and their blocks of columns.
struct Strips {
    width: usize,
    height: usize,
}

impl Strips {
    /// Places of the rows that a strip reads in a block of columns that begins at `x`; `None` for
    /// those outside of the image.
    fn rows(&self, strip: usize, x: usize) -> impl Iterator<Item = Option<Range<usize>>> {
        let (width, height) = (self.width, self.height);
        (0..READ).map(move |i| {
            let y = (strip * ROWS + i).checked_sub(REACH).filter(|y| *y < height)?;
            Some(y * width + x..y * width + (x + BLOCK).min(width))
        })
    }

    fn blocks(&self) -> impl Iterator<Item = usize> + use<> {
        (0..self.width).step_by(BLOCK)
    }
}

/// Planes of `count` numbers at the start of a buffer.
fn planes<const N: usize>(numbers: &mut [f32], count: usize) -> [&mut [f32]; N] {
    let mut planes = numbers.chunks_exact_mut(count);
    std::array::from_fn(|_| planes.next().unwrap_or_default())
}

/// Two images of one channel, and the weights of their pixels.
#[derive(Clone, Copy)]
struct Images<'a> {
    x: &'a [f32],
    y: &'a [f32],
    weights: Option<&'a [f32]>,
}

impl<'a> Images<'a> {
    fn of(
        rendered: &'a [f32],
        target: &'a [f32],
        plane: usize,
        channel: usize,
        weighted: bool,
    ) -> Images<'a> {
        let own = channel * plane..(channel + 1) * plane;
        let weights = weighted.then(|| &target[3 * plane..4 * plane]);
        Images { x: &rendered[own.clone()], y: &target[own], weights }
    }

    /// Values of the pixels of `at` in both; a pixel of weight 0 has that of the target.
    #[inline(always)]
    fn values<S: Simd>(&self, simd: S, at: Range<usize>, x: &mut [f32; BLOCK], y: &mut [f32; BLOCK]) {
        read(simd, &self.x[at.clone()], x);
        read(simd, &self.y[at.clone()], y);
        if let Some(weights) = self.weights {
            x.iter_mut().zip(&*y).zip(&weights[at]).for_each(|((x, y), w)| *x = w * (*x - y) + y);
        }
    }
}

/// Vertical blurs of x, y, x² + y² and xy.
pub(super) fn columns(call: &mut NativeCall) -> Result<(), String> {
    let [width, height, weighted] = call.words()?.map(|word| word as usize);
    let [rendered, target, means, moments] = call.memory([0, 1, 2, 3])?;
    let (rendered, target): (&[f32], &[f32]) = (rendered.of(), target.of());
    let (plane, level) = (width * height, Level::new());
    let [x, y] = planes(means.of(), 3 * plane);
    let [squares, products] = planes(moments.of(), 3 * plane);
    let channels = x.par_chunks_mut(plane).zip(y.par_chunks_mut(plane));
    let channels = channels.zip(squares.par_chunks_mut(plane)).zip(products.par_chunks_mut(plane));
    channels.enumerate().for_each(|(channel, (((x, y), squares), products))| {
        let images = Images::of(rendered, target, plane, channel, weighted != 0);
        let strips = x.par_chunks_mut(ROWS * width).zip(y.par_chunks_mut(ROWS * width));
        let strips = strips.zip(squares.par_chunks_mut(ROWS * width));
        let strips = strips.zip(products.par_chunks_mut(ROWS * width));
        strips.enumerate().for_each(|(strip, (((x, y), squares), products))| {
            let image = Strips { width, height };
            dispatch!(level, simd => strip_columns(simd, &image, strip, &images, [x, y, squares, products]));
        });
    });
    Ok(())
}

#[inline(always)]
fn strip_columns<S: Simd>(simd: S, image: &Strips, strip: usize, images: &Images, mut out: [&mut [f32]; 4]) {
    let mut rows = [[[0.0; BLOCK]; READ]; 4];
    for first in image.blocks() {
        let columns = BLOCK.min(image.width - first);
        for (i, at) in image.rows(strip, first).enumerate() {
            let [x, y, squares, products] = rows.each_mut().map(|rows| &mut rows[i]);
            match at {
                Some(at) => images.values(simd, at, x, y),
                None => [&mut *x, &mut *y].into_iter().for_each(|row| row.fill(0.0)),
            }
            for k in (0..BLOCK).step_by(LANES) {
                let [u, v] = [&*x, &*y].map(|row| f32x8::from_slice(simd, &row[k..k + LANES]));
                u.mul_add(u, v * v).store_slice(&mut squares[k..k + LANES]);
                (u * v).store_slice(&mut products[k..k + LANES]);
            }
        }
        for k in 0..out[0].len() / image.width {
            let at = k * image.width + first;
            for (rows, out) in rows.iter().zip(&mut out) {
                let mut blurred = [0.0; BLOCK];
                blur_columns(simd, rows, k, &mut blurred);
                write(simd, &blurred, &mut out[at..at + columns]);
            }
        }
    }
}

/// SSIM and its derivatives by (E[x], E[x²], E[xy]), from blurred x, y, x² + y² and xy.
#[inline(always)]
fn ssim_of<S: Simd>([x, y, squares, products]: [f32x8<S>; 4]) -> [f32x8<S>; 4] {
    let product = x * y;
    let sum = x.mul_add(x, y * y);
    let (a1, a2) = (product * 2.0 + C1 as f32, (products - product) * 2.0 + C2 as f32);
    let (b1, b2) = (sum + C1 as f32, (squares - sum) + C2 as f32);
    let inverse = f32x8::simd_from(x.token(), 1.0) / (b1 * b2);
    let s = a1 * a2 * inverse;
    // 1/b2 − 1/b1 = (b1 − b2) / (b1 b2).
    let by_mean = (y * (a2 - a1) + x * s * (b1 - b2)) * (inverse * 2.0);
    [by_mean, -(s * b1 * inverse), a1 * inverse * 2.0, s]
}

/// Memory of one row of [`rows`].
struct RowScratch {
    /// The four inputs, then the three derivatives, with a margin of zeros.
    wide: [Vec<f32>; 4],
    blurred: [Vec<f32>; 4],
}

impl RowScratch {
    fn new(width: usize) -> RowScratch {
        let stride = width.next_multiple_of(LANES);
        let planes = |length: usize| std::array::from_fn(|_| vec![0.0; length]);
        RowScratch { wide: planes(stride + TAPS - 1), blurred: planes(stride) }
    }

    /// Leaves the blurred derivatives in the first planes of `blurred`, and SSIM in `wide[3]`.
    #[inline(always)]
    fn compute<S: Simd>(&mut self, simd: S, width: usize) {
        for (wide, blurred) in self.wide.iter().zip(&mut self.blurred) {
            blur_row(simd, wide, blurred);
        }
        for at in (0..width).step_by(LANES) {
            let blurred = self.blurred.each_ref().map(|row| f32x8::from_slice(simd, &row[at..at + LANES]));
            for (wide, value) in self.wide.iter_mut().zip(ssim_of(blurred)) {
                value.store_slice(&mut wide[REACH + at..REACH + at + LANES]);
            }
        }
        for (wide, blurred) in self.wide.iter_mut().zip(&mut self.blurred).take(3) {
            // Columns outside of the image have no SSIM.
            wide[REACH + width..].fill(0.0);
            blur_row(simd, wide, blurred);
        }
    }
}

/// Horizontal blurs, SSIM, and the horizontal blurs of its derivatives.
pub(super) fn rows(call: &mut NativeCall) -> Result<(), String> {
    let [width, height, strips, first, end] = call.words()?.map(|word| word as usize);
    let [means, moments, slopes, cross, sums] = call.memory([0, 1, 2, 3, 4])?;
    let (rows, level) = (3 * height, Level::new());
    let count = rows * width;
    let (means, moments): (&[f32], &[f32]) = (means.of(), moments.of());
    let blurred = [&means[..count], &means[count..], &moments[..count], &moments[count..]];
    let [by_mean, by_square] = planes(slopes.of(), count);
    let by_product = cross.of::<f32>()[..count].par_chunks_mut(width);
    let out = by_mean.par_chunks_mut(width).zip(by_square.par_chunks_mut(width)).zip(by_product);
    let sums = sums.of::<f32>()[..rows * strips].par_chunks_mut(strips);
    out.zip(sums).enumerate().for_each_init(
        || RowScratch::new(width),
        |scratch, (row, (((by_mean, by_square), by_product), sums))| {
            let at = row * width..(row + 1) * width;
            for (wide, plane) in scratch.wide.iter_mut().zip(blurred) {
                wide[REACH..REACH + width].copy_from_slice(&plane[at.clone()]);
                wide[REACH + width..].fill(0.0);
            }
            dispatch!(level, simd => scratch.compute(simd, width));
            let is_counted = (first..end).contains(&(row % height));
            for (sum, own) in sums.iter_mut().zip(scratch.wide[3][REACH..REACH + width].chunks(ROWS)) {
                *sum = if is_counted { own.iter().sum() } else { 0.0 };
            }
            for (out, blurred) in [by_mean, by_square, by_product].into_iter().zip(&scratch.blurred) {
                out.copy_from_slice(&blurred[..width]);
            }
        },
    );
    Ok(())
}

/// The loss of [`gradient`], of one channel.
struct Loss<'a> {
    images: Images<'a>,
    l1_weight: f32,
    dssim_weight: f32,
    /// Blurred derivatives by (E[x], E[x²], E[xy]); empty without SSIM.
    derivatives: [&'a [f32]; 3],
    /// Rows with a gradient.
    rows: Range<usize>,
}

impl Loss<'_> {
    /// Gradient of a strip, and the sums of the absolute differences of its columns.
    #[inline(always)]
    fn strip<S: Simd>(&self, simd: S, image: &Strips, strip: usize, gradient: &mut [f32], sums: &mut [f32]) {
        let with_ssim = !self.derivatives[0].is_empty();
        let mut rows = [[[0.0; BLOCK]; READ]; 3];
        let mut blurred = [[0.0; BLOCK]; 3];
        sums.fill(0.0);
        for first in image.blocks() {
            let columns = BLOCK.min(image.width - first);
            for (i, at) in image.rows(strip, first).enumerate().filter(|_| with_ssim) {
                for (rows, plane) in rows.iter_mut().zip(self.derivatives) {
                    match &at {
                        Some(at) => read(simd, &plane[at.clone()], &mut rows[i]),
                        None => rows[i].fill(0.0),
                    }
                }
            }
            for (k, gradient) in gradient.chunks_exact_mut(image.width).enumerate() {
                let row = strip * ROWS + k;
                let gradient = &mut gradient[first..first + columns];
                if !self.rows.contains(&row) {
                    gradient.fill(0.0);
                    continue;
                }
                for (rows, blurred) in rows.iter().zip(&mut blurred).filter(|_| with_ssim) {
                    blur_columns(simd, rows, k, blurred);
                }
                let at = row * image.width + first..row * image.width + first + columns;
                self.differentiate(simd, at, &blurred, gradient, &mut sums[first..first + columns]);
            }
        }
    }

    /// The gradient of pixels `at`; adds the absolute differences.
    #[inline(always)]
    fn differentiate<S: Simd>(
        &self,
        simd: S,
        at: Range<usize>,
        [a, b, c]: &[[f32; BLOCK]; 3],
        gradient: &mut [f32],
        sums: &mut [f32],
    ) {
        let [mut x, mut y, mut out] = [[0.0; BLOCK]; 3];
        self.images.values(simd, at.clone(), &mut x, &mut y);
        for k in 0..BLOCK {
            let slope = self.l1_weight * sign(x[k] - y[k]);
            out[k] = slope - self.dssim_weight * (a[k] + 2.0 * x[k] * b[k] + y[k] * c[k]);
        }
        if let Some(weights) = self.images.weights {
            out.iter_mut().zip(&weights[at]).for_each(|(out, weight)| *out *= weight);
        }
        write(simd, &out, gradient);
        sums.iter_mut().zip(x.iter().zip(&y)).for_each(|(sum, (x, y))| *sum += (x - y).abs());
    }
}

/// Vertical blurs of the derivatives, the gradient, and the sums of absolute differences; without
/// SSIM the last two alone.
pub(super) fn gradient(call: &mut NativeCall) -> Result<(), String> {
    let words: [u32; 8] = call.words()?;
    let [width, height] = [0, 1].map(|k| words[k] as usize);
    let [l1_weight, dssim_weight] = [2, 3].map(|k| f32::from_bits(words[k]));
    let [first, end, weighted, first_sum] = [4, 5, 6, 7].map(|k| words[k] as usize);
    let (plane, strips, level) = (width * height, height.div_ceil(ROWS), Level::new());
    let with_ssim = call.variant()[0] == 1;
    // Without SSIM there are no derivatives.
    let [rendered, target, slopes, cross, gradient, sums] = call.optional([0, 1, 2, 3, 4, 5]);
    let (rendered, target): (&[f32], &[f32]) = (rendered.of(), target.of());
    let (slopes, cross): (&[f32], &[f32]) = (slopes.of(), cross.of());
    let gradient = gradient.of::<f32>()[..3 * plane].par_chunks_mut(plane);
    let sums = sums.of::<f32>()[first_sum..][..3 * strips * width].par_chunks_mut(strips * width);
    gradient.zip(sums).enumerate().for_each(|(channel, (gradient, sums))| {
        let own = channel * plane..(channel + 1) * plane;
        let loss = Loss {
            images: Images::of(rendered, target, plane, channel, weighted != 0),
            l1_weight,
            dssim_weight,
            derivatives: match with_ssim {
                true => [&slopes[own.clone()], &slopes[3 * plane..][own.clone()], &cross[own]],
                false => [&[]; 3],
            },
            rows: first..end,
        };
        let strips = gradient.par_chunks_mut(ROWS * width).zip(sums.par_chunks_mut(width));
        strips.enumerate().for_each(|(strip, (gradient, sums))| {
            let image = Strips { width, height };
            dispatch!(level, simd => loss.strip(simd, &image, strip, gradient, sums));
        });
    });
    Ok(())
}

const _: () = assert!(TAPS == 2 * REACH + 1);
