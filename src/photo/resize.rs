//! Area averaging: every output pixel is the mean of the input area that it covers, fractions included.
use crate::scene::RgbImage;
use rayon::prelude::*;

/// Per output index: the first input index and the weights of it and its successors, which sum to 1.
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

/// Resizes an image, given as a function of (column, row), by area averaging. Sizes are (width, height) ≥ 1.
pub(super) fn area_average(
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

impl RgbImage {
    /// The image at another size by area averaging: exact for down-scaling; enlarging repeats pixels.
    pub fn resized_by_area(&self, width: usize, height: usize) -> RgbImage {
        area_average((self.width, self.height), (width, height), |x, y| self.at(x, y))
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
    fn whole_boxes_take_the_value_at_their_centre() {
        let small = ramp(36, 24).resized_by_area(9, 6);
        for y in 0..6 {
            for x in 0..9 {
                let expected = [(x as f32 + 0.5) * 4.0, (y as f32 + 0.5) * 4.0, 1.0];
                assert!((0..3).all(|k| (small.at(x, y)[k] - expected[k]).abs() < ROUNDING), "{x} {y}");
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
