//! Photos as a pinhole would have taken them.
use crate::scene::{Lens, RgbImage};
use glam::DVec2;
use rayon::prelude::*;

/// Takes radial distortion out of an image: same size, focal length and principal point (pixels). Cubic interpolation
/// (Catmull–Rom); what the lens did not see continues the nearest pixels.
pub fn straighten(image: &RgbImage, lens: Lens, focal: f64, centre: DVec2) -> RgbImage {
    let (w, h) = (image.width, image.height);
    let mut data = vec![[0f32; 3]; w * h];
    data.par_chunks_mut(w).enumerate().for_each(|(y, line)| {
        for (x, out) in line.iter_mut().enumerate() {
            let ideal = (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - centre) / focal;
            *out = cubic(image, lens.distort(ideal) * focal + centre);
        }
    });
    RgbImage { width: w, height: h, data }
}

/// Catmull–Rom weights of four neighbours at a fraction between the middle two.
fn weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    ]
}

/// Colour at a continuous position; within the range of the four nearest pixels, so that edges do not ring.
fn cubic(image: &RgbImage, p: DVec2) -> [f32; 3] {
    let (w, h) = (image.width as i64, image.height as i64);
    let (u, v) = (
        (p.x - 0.5).clamp(0.0, (w - 1) as f64),
        (p.y - 0.5).clamp(0.0, (h - 1) as f64),
    );
    let (i, j) = (u as i64, v as i64);
    let (wx, wy) = (weights((u - i as f64) as f32), weights((v - j as f64) as f32));
    let at = |x: i64, y: i64| image.at(x.clamp(0, w - 1) as usize, y.clamp(0, h - 1) as usize);
    let (mut sum, mut low, mut high) = ([0f32; 3], [f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for (dy, b) in wy.iter().enumerate() {
        for (dx, a) in wx.iter().enumerate() {
            let c = at(i + dx as i64 - 1, j + dy as i64 - 1);
            for k in 0..3 {
                sum[k] += a * b * c[k];
                if (1..3).contains(&dx) && (1..3).contains(&dy) {
                    low[k] = low[k].min(c[k]);
                    high[k] = high[k].max(c[k]);
                }
            }
        }
    }
    [0, 1, 2].map(|k| sum[k].clamp(low[k], high[k]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pattern_seen_through_a_lens_comes_out_straight() {
        let (w, h, focal, lens) = (160, 120, 140.0, Lens { k1: -0.12, k2: 0.03 });
        let centre = DVec2::new(81.0, 58.5);
        // A smooth pattern of ideal positions, and the photo that the lens makes of it.
        let pattern = |x: DVec2| {
            let (u, v) = (x.x * focal, x.y * focal);
            [(0.15 * u).sin() as f32, (0.12 * v).sin() as f32, (0.08 * (u + v)).cos() as f32]
                .map(|c| 0.5 + 0.4 * c)
        };
        let position = |k: usize| (DVec2::new((k % w) as f64 + 0.5, (k / w) as f64 + 0.5) - centre) / focal;
        let data = (0..w * h).map(|k| pattern(lens.undistort(position(k)))).collect();
        let photo = RgbImage { width: w, height: h, data };
        let out = straighten(&photo, lens, focal, centre);
        let mut worst = 0f32;
        for y in 2..h - 2 {
            for x in 2..w - 2 {
                let (got, want) = (out.at(x, y), pattern(position(y * w + x)));
                worst = (0..3).map(|k| (got[k] - want[k]).abs()).fold(worst, f32::max);
            }
        }
        // The clamp to the neighbours' range costs up to a quarter of the curvature at crests: 0.15²/8 · 0.4.
        assert!(worst < 2e-3, "{worst}");
    }
}
