//! `ssim_columns.comp`, `ssim_rows.comp` (or `ssim_rows_shared.comp`) and `ssim_gradient.comp` in
//! one sweep over the rows of an image. The last of these commands does the work of all, since only
//! they read their scratch buffers: blurred rows stay in the cache.
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::ssim::{C1, C2, HALF, STRIP, WINDOW};
use fearless_simd::{Level, Simd, dispatch, f32x8, prelude::*};
use rayon::prelude::*;
use std::ops::Range;

const REACH: usize = HALF as usize;
/// Rows and columns of one sum.
const ROWS: usize = STRIP as usize;
const TAPS: usize = WINDOW.len();
const LANES: usize = 8;
/// Rows of a step of the sweep: each row that their windows share is loaded once for all.
const STEP: usize = 4;
/// Rows that the windows of a step read.
const READ: usize = STEP + TAPS - 1;
/// Rows of a plane that are kept.
const KEPT: usize = 4 * STEP;
/// Steps after that of a row until the windows that begin with it are complete.
const LAG: usize = 3;
/// Zeros before and behind a row: the window of a pixel beside the border reads them.
const MARGIN: usize = LANES;

const _: () = assert!(TAPS == 2 * REACH + 1 && READ <= KEPT && KEPT == (LAG + 1) * STEP && REACH <= MARGIN);

/// Eight numbers, of which those beyond `from` are 0.
#[inline(always)]
fn load<S: Simd>(simd: S, from: &[f32]) -> f32x8<S> {
    let Some(whole) = from.first_chunk::<LANES>() else {
        let mut eight = [0.0; LANES];
        eight[..from.len()].copy_from_slice(from);
        return f32x8::from_slice(simd, &eight);
    };
    f32x8::from_slice(simd, whole)
}

/// Writes those of eight numbers that lie in `to`.
#[inline(always)]
fn store<S: Simd>(eight: f32x8<S>, to: &mut [f32]) {
    match to.first_chunk_mut::<LANES>() {
        Some(whole) => eight.store_array(whole),
        None => to.copy_from_slice(&eight.to_array()[..to.len()]),
    }
}

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

/// Vertical blurs of the eight columns at `at`, in the rows of a step.
#[inline(always)]
fn blur_columns<S: Simd>(simd: S, rows: &[&[f32]; READ], at: usize) -> [f32x8<S>; STEP] {
    let zero = f32x8::simd_from(simd, 0.0);
    let (mut taps, mut sums) = ([zero; READ], [zero; STEP]);
    for (tap, row) in taps.iter_mut().zip(rows) {
        *tap = f32x8::from_slice(simd, &row[at..at + LANES]);
    }
    for (k, sum) in sums.iter_mut().enumerate() {
        *sum = blur(simd, |tap| taps[k + tap]);
    }
    sums
}

/// Horizontal blurs of the eight columns at `at` of a row with its margin.
#[inline(always)]
fn blur_row<S: Simd>(simd: S, row: &[f32], at: usize) -> f32x8<S> {
    let row = &row[MARGIN - REACH + at..][..LANES + TAPS - 1];
    blur(simd, |tap| f32x8::from_slice(simd, &row[tap..tap + LANES]))
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

/// The last rows of a plane.
struct Ring {
    numbers: Vec<f32>,
    stride: usize,
}

impl Ring {
    fn new(stride: usize) -> Ring {
        Ring { numbers: vec![0.0; KEPT * stride], stride }
    }

    #[inline(always)]
    fn row(&mut self, row: usize) -> &mut [f32] {
        &mut self.numbers[row % KEPT * self.stride..][..self.stride]
    }

    /// The rows that the windows of step `step` read.
    #[inline(always)]
    fn window(&self, step: usize) -> [&[f32]; READ] {
        let row = |i: usize| &self.numbers[(step * STEP + i) % KEPT * self.stride..][..self.stride];
        std::array::from_fn(row)
    }
}

/// Memory of a task.
struct Scratch {
    /// x, y, x² + y² and xy.
    inputs: [Ring; 4],
    /// Their vertical blurs in the rows of a step, with margins.
    blurred: [[Vec<f32>; 4]; STEP],
    /// SSIM and its derivatives in a row, with margins.
    slopes: [Vec<f32>; 4],
    /// Horizontal blurs of the derivatives.
    derivatives: [Ring; 3],
}

impl Scratch {
    fn new(width: usize) -> Scratch {
        // Sums of SSIM are over two vectors.
        let stride = width.next_multiple_of(ROWS);
        let row = |_| vec![0.0; stride + 2 * MARGIN];
        Scratch {
            inputs: std::array::from_fn(|_| Ring::new(stride)),
            blurred: std::array::from_fn(|_| std::array::from_fn(row)),
            slopes: std::array::from_fn(row),
            derivatives: std::array::from_fn(|_| Ring::new(stride)),
        }
    }
}

/// The loss of one channel.
struct Loss<'a> {
    x: &'a [f32],
    y: &'a [f32],
    /// Weights of the pixels.
    weights: Option<&'a [f32]>,
    width: usize,
    height: usize,
    l1_weight: f32,
    dssim_weight: f32,
    with_ssim: bool,
    /// Rows with a gradient.
    rows: Range<usize>,
}

/// Results of a task: the gradient, and the sums of SSIM over strips of rows and of absolute
/// differences over strips of columns.
struct Results<'a> {
    gradient: &'a mut [f32],
    ssim: &'a mut [f32],
    l1: &'a mut [f32],
}

impl Loss<'_> {
    /// The task that begins at row `first`.
    #[inline(always)]
    fn task<S: Simd>(&self, simd: S, first: usize, scratch: &mut Scratch, out: &mut Results) {
        let steps = (out.gradient.len() / self.width).div_ceil(STEP);
        out.l1.fill(0.0);
        // Blurs lag behind the rows that they read, and begin as many rows before the first one.
        for step in 0..steps + 2 * LAG {
            if self.with_ssim {
                for row in step * STEP..(step + 1) * STEP {
                    let y = (first + row).checked_sub(2 * REACH).filter(|y| *y < self.height);
                    self.read(simd, y, row, &mut scratch.inputs);
                }
                if let Some(step) = step.checked_sub(LAG) {
                    self.derive(simd, first, step, scratch, out.ssim);
                }
            }
            if let Some(step) = step.checked_sub(2 * LAG) {
                self.differentiate(simd, first, step, &scratch.derivatives, out);
            }
        }
    }

    /// Values of up to eight pixels in both images, and their weights; a pixel of weight 0 has the
    /// value of the target.
    #[inline(always)]
    fn values<S: Simd>(&self, simd: S, at: Range<usize>) -> [f32x8<S>; 3] {
        let (x, y) = (load(simd, &self.x[at.clone()]), load(simd, &self.y[at.clone()]));
        match self.weights {
            Some(weights) => {
                let weights = load(simd, &weights[at]);
                [weights.mul_add(x - y, y), y, weights]
            }
            None => [x, y, f32x8::simd_from(simd, 1.0)],
        }
    }

    /// Places of the blocks of eight columns of a row of the image, each with its first column.
    fn blocks(&self, y: usize) -> impl Iterator<Item = (usize, Range<usize>)> {
        let (first, width) = (y * self.width, self.width);
        (0..width).step_by(LANES).map(move |x| (x, first + x..first + (x + LANES).min(width)))
    }

    /// Reads row `y` of the images, or zeros outside of them, to row `row` of the rings.
    #[inline(always)]
    fn read<S: Simd>(&self, simd: S, y: Option<usize>, row: usize, rings: &mut [Ring; 4]) {
        let [xs, ys, squares, products] = rings.each_mut().map(|ring| ring.row(row));
        let Some(y) = y else {
            return [xs, ys, squares, products].into_iter().for_each(|row| row.fill(0.0));
        };
        for (column, at) in self.blocks(y) {
            let own = column..column + LANES;
            let [x, y, _] = self.values(simd, at);
            x.store_slice(&mut xs[own.clone()]);
            y.store_slice(&mut ys[own.clone()]);
            x.mul_add(x, y * y).store_slice(&mut squares[own.clone()]);
            (x * y).store_slice(&mut products[own]);
        }
    }

    /// SSIM and the blurred derivatives of the rows of a step.
    #[inline(always)]
    fn derive<S: Simd>(&self, simd: S, first: usize, step: usize, scratch: &mut Scratch, sums: &mut [f32]) {
        let Scratch { inputs, blurred, slopes, derivatives } = scratch;
        for (plane, ring) in inputs.iter().enumerate() {
            let rows = ring.window(step);
            for at in (0..self.width).step_by(LANES) {
                for (row, sum) in blurred.iter_mut().zip(blur_columns(simd, &rows, at)) {
                    sum.store_slice(&mut row[plane][MARGIN + at..MARGIN + at + LANES]);
                }
            }
        }
        let strips = self.width.div_ceil(ROWS);
        for (k, blurred) in blurred.iter_mut().enumerate() {
            let row = step * STEP + k;
            let out = derivatives.each_mut().map(|ring| ring.row(row));
            let Some(y) = (first + row).checked_sub(REACH).filter(|y| *y < self.height) else {
                out.into_iter().for_each(|row| row.fill(0.0));
                continue;
            };
            self.slopes(simd, blurred, slopes);
            for (out, slopes) in out.into_iter().zip(&*slopes) {
                for at in (0..self.width).step_by(LANES) {
                    blur_row(simd, slopes, at).store_slice(&mut out[at..at + LANES]);
                }
            }
            let own = y.checked_sub(first).and_then(|y| sums.get_mut(y * strips..(y + 1) * strips));
            for (strip, sum) in own.into_iter().flatten().enumerate() {
                let at = MARGIN + strip * ROWS;
                let half = |at: usize| f32x8::from_slice(simd, &slopes[3][at..at + LANES]);
                let sum_of_strip = (half(at) + half(at + LANES)).reduce_sum();
                *sum = if self.rows.contains(&y) { sum_of_strip } else { 0.0 };
            }
        }
    }

    /// SSIM and its derivatives in a row, from its vertical blurs; 0 in columns beyond the image.
    #[inline(always)]
    fn slopes<S: Simd>(&self, simd: S, blurred: &mut [Vec<f32>; 4], slopes: &mut [Vec<f32>; 4]) {
        blurred.iter_mut().for_each(|row| row[MARGIN + self.width..].fill(0.0));
        for at in (0..self.width).step_by(LANES) {
            let mut sums = [f32x8::simd_from(simd, 0.0); 4];
            for (sum, row) in sums.iter_mut().zip(&*blurred) {
                *sum = blur_row(simd, row, at);
            }
            for (row, value) in slopes.iter_mut().zip(ssim_of(sums)) {
                value.store_slice(&mut row[MARGIN + at..MARGIN + at + LANES]);
            }
        }
        slopes.iter_mut().for_each(|row| row[MARGIN + self.width..].fill(0.0));
    }

    /// Gradient of the rows of a step; adds their absolute differences.
    #[inline(always)]
    fn differentiate<S: Simd>(
        &self,
        simd: S,
        first: usize,
        step: usize,
        derivatives: &[Ring; 3],
        out: &mut Results,
    ) {
        let rows = derivatives.each_ref().map(|ring| ring.window(step));
        let l1 = &mut out.l1[step * STEP / ROWS * self.width..][..self.width];
        for column in (0..self.width).step_by(LANES) {
            let columns = column..(column + LANES).min(self.width);
            let mut blurred = [[f32x8::simd_from(simd, 0.0); STEP]; 3];
            for (blurred, rows) in blurred.iter_mut().zip(&rows).filter(|_| self.with_ssim) {
                *blurred = blur_columns(simd, rows, column);
            }
            let mut sum = load(simd, &l1[columns.clone()]);
            for (k, row) in (step * STEP..(step + 1) * STEP).enumerate() {
                let own = row * self.width + columns.start..row * self.width + columns.end;
                let Some(gradient) = out.gradient.get_mut(own.clone()) else { break };
                if !self.rows.contains(&(first + row)) {
                    gradient.fill(0.0);
                    continue;
                }
                let [x, y, weights] =
                    self.values(simd, first * self.width + own.start..first * self.width + own.end);
                let [a, b, c] = [blurred[0][k], blurred[1][k], blurred[2][k]];
                let (difference, zero) = (x - y, f32x8::simd_from(simd, 0.0));
                let slope = f32x8::simd_from(simd, self.l1_weight).copysign(difference);
                // The subgradient at 0 is 0.
                let slope = difference.abs().simd_gt(zero).select(slope, zero);
                let by_ssim = (x * 2.0).mul_add(b, y.mul_add(c, a));
                store((slope - by_ssim * self.dssim_weight) * weights, gradient);
                sum += difference.abs();
            }
            store(sum, &mut l1[columns]);
        }
    }
}

/// The first passes, whose work is done by [`gradient`].
pub(super) fn nothing(_: &mut NativeCall) -> Result<(), String> {
    Ok(())
}

/// The gradient, and the sums of SSIM and absolute differences; without SSIM the last alone.
pub(super) fn gradient(call: &mut NativeCall) -> Result<(), String> {
    let words: [u32; 8] = call.words()?;
    let [width, height] = [0, 1].map(|k| words[k] as usize);
    let [l1_weight, dssim_weight] = [2, 3].map(|k| f32::from_bits(words[k]));
    let [first, end, weighted, first_sum] = [4, 5, 6, 7].map(|k| words[k] as usize);
    let (plane, level) = (width * height, Level::new());
    let with_ssim = call.variant()[0] == 1;
    let [rendered, target, gradient, sums] = call.memory([0, 1, 4, 5])?;
    let (rendered, target): (&[f32], &[f32]) = (rendered.of(), target.of());
    let (ssim, l1) = sums.of::<f32>().split_at_mut(first_sum);
    let (strips, column_strips) = (width.div_ceil(ROWS), height.div_ceil(ROWS));
    // Long tasks, since each begins with rows of another one. No result depends on their number.
    let strips_of_task = column_strips.div_ceil(rayon::current_num_threads()).max(1);
    let task_rows = ROWS * strips_of_task;
    let gradient = gradient.of::<f32>()[..3 * plane].par_chunks_mut(plane);
    let ssim = ssim[..3 * strips * height].par_chunks_mut(strips * height);
    let l1 = l1[..3 * column_strips * width].par_chunks_mut(column_strips * width);
    gradient.zip(ssim).zip(l1).enumerate().for_each(|(channel, ((gradient, ssim), l1))| {
        let own = channel * plane..(channel + 1) * plane;
        let loss = Loss {
            x: &rendered[own.clone()],
            y: &target[own],
            weights: (weighted != 0).then(|| &target[3 * plane..4 * plane]),
            width,
            height,
            l1_weight,
            dssim_weight,
            with_ssim,
            rows: first..end,
        };
        let gradient = gradient.par_chunks_mut(task_rows * width);
        let ssim = ssim.par_chunks_mut(task_rows * strips);
        let l1 = l1.par_chunks_mut(strips_of_task * width);
        gradient.zip(ssim).zip(l1).enumerate().for_each_init(
            || Scratch::new(width),
            |scratch, (task, ((gradient, ssim), l1))| {
                let mut out = Results { gradient, ssim, l1 };
                dispatch!(level, simd => loss.task(simd, task * task_rows, scratch, &mut out));
            },
        );
    });
    Ok(())
}
