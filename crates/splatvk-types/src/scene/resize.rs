//! Area averaging: every output pixel is the mean of the input area that it covers, fractions
//! included.
use crate::scene::{Image, RgbImage};
use rayon::prelude::*;

/// Per output index: the first input index and the weights from there on, which sum to 1.
fn footprints(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let step = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let (low, high) = (i as f64 * step, (i + 1) as f64 * step);
            let first = (low as usize).min(from - 1);
            let last = (high.ceil() as usize).clamp(first + 1, from);
            let weights = (first..last)
                .map(|j| ((high.min((j + 1) as f64) - low.max(j as f64)) / step).max(0.0) as f32)
                .collect();
            (first, weights)
        })
        .collect()
}

/// Resizes an image, given as a function of (column, row), by area averaging. Sizes are (width,
/// height) ≥ 1.
pub fn area_average(
    from: (usize, usize),
    to: (usize, usize),
    pixel: impl Fn(usize, usize) -> [f32; 3] + Sync,
) -> RgbImage {
    let (columns, rows) = (footprints(from.0, to.0), footprints(from.1, to.1));
    let mut data = vec![[0.0f32; 3]; to.0 * to.1];
    data.par_chunks_mut(to.0).zip(rows.par_iter()).for_each(|(line, (y0, wy))| {
        for (out, (x0, wx)) in line.iter_mut().zip(&columns) {
            for (dy, &b) in wy.iter().enumerate() {
                for (dx, &a) in wx.iter().enumerate() {
                    let c = pixel(x0 + dx, y0 + dy);
                    for k in 0..3 {
                        out[k] += a * b * c[k];
                    }
                }
            }
        }
    });
    RgbImage { width: to.0, height: to.1, data }
}

/// [`area_average`] of pixels with their used shares; also returns the [H, W] used share of every
/// output pixel. Where that is 0, the colour continues the others smoothly.
pub fn area_average_of_used(
    from: (usize, usize),
    to: (usize, usize),
    pixel: impl Fn(usize, usize) -> ([f32; 3], f32) + Sync,
) -> (RgbImage, Image<f32>) {
    let mut image = area_average(from, to, |x, y| {
        let (colour, share) = pixel(x, y);
        colour.map(|v| v * share)
    });
    let share = area_average(from, to, |x, y| [pixel(x, y).1; 3]);
    // Rounding may exceed 1 slightly.
    let share = Image { width: to.0, height: to.1, data: share.data.iter().map(|s| s[0].min(1.0)).collect() };
    for (colour, share) in image.data.iter_mut().zip(&share.data).filter(|(_, share)| **share > 0.0) {
        *colour = colour.map(|v| v / share);
    }
    image.fill_from_used(|i| share.data[i] > 0.0);
    (image, share)
}

impl Image<f32> {
    /// The map at another size by area averaging.
    pub fn resized_by_area(&self, width: usize, height: usize) -> Image<f32> {
        let out = area_average((self.width, self.height), (width, height), |x, y| [self.at(x, y); 3]);
        Image { width, height, data: out.data.iter().map(|v| v[0]).collect() }
    }
}

impl RgbImage {
    /// Resizes by area averaging: exact for down-scaling; enlarging repeats pixels.
    pub fn resized_by_area(&self, width: usize, height: usize) -> RgbImage {
        area_average((self.width, self.height), (width, height), |x, y| self.at(x, y))
    }
}

/// Resampling filter; its width grows with the reduction, as in Pillow's `resize`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Kernel {
    /// Bilinear.
    Triangle,
    /// Keys' cubic with a = −0.5.
    Cubic,
    /// Sinc windowed by a sinc, three lobes.
    Lanczos,
}

impl Kernel {
    fn reach(self) -> f64 {
        match self {
            Kernel::Triangle => 1.0,
            Kernel::Cubic => 2.0,
            Kernel::Lanczos => 3.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        let x = x.abs();
        match self {
            _ if x >= self.reach() => 0.0,
            Kernel::Triangle => 1.0 - x,
            Kernel::Cubic if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
            Kernel::Cubic => ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0,
            Kernel::Lanczos => sinc(x) * sinc(x / 3.0),
        }
    }

    /// Per output index: the first input index and the weights from there on, which sum to 1.
    fn taps(self, from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
        let step = from as f64 / to as f64;
        (0..to).map(|i| self.tap((i as f64 + 0.5) * step, step.max(1.0), from)).collect()
    }

    /// First input index and weights around `centre`, for a filter widened by `wide`.
    fn tap(self, centre: f64, wide: f64, from: usize) -> (usize, Vec<f32>) {
        let first = ((centre - self.reach() * wide + 0.5).max(0.0) as usize).min(from - 1);
        let last = ((centre + self.reach() * wide + 0.5) as usize).clamp(first + 1, from);
        let raw: Vec<f64> = (first..last).map(|j| self.weight((j as f64 + 0.5 - centre) / wide)).collect();
        let sum: f64 = raw.iter().sum();
        (first, raw.into_iter().map(|w| (w / sum) as f32).collect())
    }
}

/// `sin(πx) / (πx)`.
fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { (std::f64::consts::PI * x).sin() / (std::f64::consts::PI * x) }
}

impl RgbImage {
    /// Resizes with a filter; positions keep their share of the width and height.
    pub fn resized(&self, width: usize, height: usize, kernel: Kernel) -> RgbImage {
        let (columns, rows) = (kernel.taps(self.width, width), kernel.taps(self.height, height));
        let mut narrow = vec![[0f32; 3]; width * self.height];
        narrow.par_chunks_mut(width).enumerate().for_each(|(y, line)| {
            let source = &self.data[y * self.width..(y + 1) * self.width];
            for (out, (first, weights)) in line.iter_mut().zip(&columns) {
                for (w, c) in weights.iter().zip(&source[*first..]) {
                    (0..3).for_each(|k| out[k] += w * c[k]);
                }
            }
        });
        let mut data = vec![[0f32; 3]; width * height];
        data.par_chunks_mut(width).zip(&rows).for_each(|(line, (first, weights))| {
            for (j, w) in weights.iter().enumerate() {
                let source = &narrow[(first + j) * width..(first + j + 1) * width];
                for (out, c) in line.iter_mut().zip(source) {
                    (0..3).for_each(|k| out[k] += w * c[k]);
                }
            }
        });
        // Pillow clamps too; the cubic and Lanczos kernels overshoot.
        data.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
        RgbImage { width, height, data }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(w: usize, h: usize) -> RgbImage {
        let data = (0..w * h).map(|i| [(i % w) as f32 + 0.5, (i / w) as f32 + 0.5, 1.0]).collect();
        RgbImage { width: w, height: h, data }
    }

    // f32 sums of at most 16 terms below 40: 1e-4 is several times their rounding.
    const ROUNDING: f32 = 1e-4;

    #[test]
    fn area_average_of_ramp_is_centre() {
        let small = ramp(36, 24).resized_by_area(9, 6);
        for y in 0..6 {
            for x in 0..9 {
                let expected = [(x as f32 + 0.5) * 4.0, (y as f32 + 0.5) * 4.0, 1.0];
                assert!((0..3).all(|k| (small.at(x, y)[k] - expected[k]).abs() < ROUNDING), "{x} {y}");
            }
        }
    }

    const PILLOW: [(Kernel, [usize; 2], [f32; 6]); 6] = [
        (Kernel::Triangle, [9, 5], [0.51277, 0.45022, 0.47385, 0.49696, 0.52488, 0.51619]),
        (Kernel::Triangle, [31, 22], [0.0, 0.20464, 0.48690, 0.36932, 0.34806, 0.37326]),
        (Kernel::Cubic, [9, 5], [0.51684, 0.46077, 0.45342, 0.49654, 0.53136, 0.53114]),
        (Kernel::Cubic, [31, 22], [0.0, 0.13982, 0.51380, 0.35467, 0.29784, 0.32860]),
        (Kernel::Lanczos, [9, 5], [0.51938, 0.47217, 0.44634, 0.49565, 0.53508, 0.53843]),
        (Kernel::Lanczos, [31, 22], [0.0, 0.09865, 0.58307, 0.36706, 0.24082, 0.31433]),
    ];

    #[test]
    fn kernels_agree_with_pillow() {
        // Pillow 12, ((7 x + 13 y) % 17) / 16 in mode F, resized; rows of the top left 3 × 2
        // corner.
        let data = (0..20 * 14).map(|i| [((7 * (i % 20) + 13 * (i / 20)) % 17) as f32 / 16.0; 3]).collect();
        let image = RgbImage { width: 20, height: 14, data };
        for (kernel, size, want) in PILLOW {
            let out = image.resized(size[0], size[1], kernel);
            for (k, w) in want.into_iter().enumerate() {
                let got = out.at(k % 3, k / 3)[0];
                // Pillow works in f32 or f64 by mode; 1e-4 is a fortieth of an 8-bit step.
                assert!((got - w).abs() < 1e-4, "{kernel:?} {size:?} {k}: {got} {w}");
            }
        }
    }

    #[test]
    fn split_pixels_keep_the_mean() {
        let small = ramp(37, 23).resized_by_area(11, 7);
        let mean = |k: usize| small.data.iter().map(|c| c[k]).sum::<f32>() / small.data.len() as f32;
        assert!((mean(0) - 18.5).abs() < ROUNDING && (mean(1) - 11.5).abs() < ROUNDING);
        assert!(small.data.iter().all(|c| (c[2] - 1.0).abs() < ROUNDING), "a constant stays constant");
        // By hand: the first box spans 37/11 pixels, whole columns 0–2 and 4/11 of column 3.
        let first = (0.5 + 1.5 + 2.5 + 3.5 * 4.0 / 11.0) * 11.0 / 37.0;
        assert!((small.at(0, 0)[0] - first).abs() < ROUNDING);
    }
}
