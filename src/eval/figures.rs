//! Scores of one frame: colour fit, depth, masks.
use crate::math::median;
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};
use serde::Serialize;

/// Minimum opacity of pixels whose depth is compared.
const SOLID: f32 = 0.5;

/// Applies the gain and offset per channel that bring a render closest to a photo (least squares).
pub fn colour_fit(rendered: &RgbImage, photo: &RgbImage) -> RgbImage {
    let n = rendered.data.len().max(1) as f64;
    let fits: [(f64, f64); 3] = [0, 1, 2].map(|c| {
        let (mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0);
        for (r, p) in rendered.data.iter().zip(&photo.data) {
            let (r, p) = (f64::from(r[c]), f64::from(p[c]));
            x += r;
            y += p;
            xx += r * r;
            xy += r * p;
        }
        let spread = xx - x * x / n;
        // A render of constant colour has no gain.
        let gain = if spread > 1e-9 * n { (xy - x * y / n) / spread } else { 0.0 };
        (gain, (y - gain * x) / n)
    });
    let data = rendered
        .data
        .iter()
        .map(|v| [0, 1, 2].map(|c| (fits[c].0 * f64::from(v[c]) + fits[c].1).clamp(0.0, 1.0) as f32));
    RgbImage { width: rendered.width, height: rendered.height, data: data.collect() }
}

/// Depth errors over pixels with true depth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct DepthScore {
    /// Median of |z − z_true| / z_true at the scale of the cameras.
    pub median_relative: f64,
    /// AbsRel: mean of |s z − z_true| / z_true, s = median z_true / median z of this frame.
    pub abs_rel: f64,
    /// Share of pixels with max(s z / z_true, z_true / (s z)) < 1.25.
    pub delta: f64,
}

/// Scores the depth of solid pixels; `scale` maps scene to truth, from the cameras. `None` without
/// common pixels.
pub fn depth_score(
    depth: &Image<f32>,
    alpha: &Image<f32>,
    truth: &Image<f32>,
    scale: f64,
) -> Option<DepthScore> {
    let pairs = depth.data.iter().zip(&alpha.data).zip(&truth.data);
    let solid = pairs.filter(|((z, a), t)| **z > 0.0 && **a >= SOLID && **t > 0.0);
    let pairs: Vec<(f64, f64)> = solid.map(|((z, _), t)| (f64::from(*z), f64::from(*t))).collect();
    let median_of =
        |value: &dyn Fn(&(f64, f64)) -> f64| median(&mut pairs.iter().map(value).collect::<Vec<_>>());
    let own_scale = median_of(&|p| p.1)? / median_of(&|p| p.0)?;
    let n = pairs.len() as f64;
    let is_close = |p: &&(f64, f64)| (own_scale * p.0 / p.1).max(p.1 / (own_scale * p.0)) < 1.25;
    Some(DepthScore {
        median_relative: median_of(&|(z, t)| (z * scale - t).abs() / t)?,
        abs_rel: pairs.iter().map(|(z, t)| (own_scale * z - t).abs() / t).sum::<f64>() / n,
        delta: pairs.iter().filter(is_close).count() as f64 / n,
    })
}

/// Intersection over union of a mask (resampled to the truth's size by nearest pixel) and one
/// object; 0 when both are empty.
pub fn iou(mask: &Image<bool>, objects: &Image<u32>, label: u32) -> Result<f64> {
    if mask.data.len() != mask.width * mask.height || mask.data.is_empty() {
        return Err(Error::work("eval: a mask without pixels"));
    }
    let (mut both, mut either) = (0u64, 0u64);
    for y in 0..objects.height {
        let my = ((y as f64 + 0.5) * mask.height as f64 / objects.height as f64) as usize;
        for x in 0..objects.width {
            let mx = ((x as f64 + 0.5) * mask.width as f64 / objects.width as f64) as usize;
            let (p, t) = (mask.at(mx, my), objects.at(x, y) == label);
            both += u64::from(p && t);
            either += u64::from(p || t);
        }
    }
    Ok(both as f64 / either.max(1) as f64)
}

/// Rounds an image to 8 bits, so that scores can be recomputed from the files.
pub(super) fn quantised(image: &RgbImage) -> RgbImage {
    let data = image.data.iter().map(|c| c.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() / 255.0)).collect();
    RgbImage { width: image.width, height: image.height, data }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pass::metrics::psnr;

    fn plane(data: Vec<f32>) -> Image<f32> {
        Image { width: data.len(), height: 1, data }
    }

    #[test]
    fn depth_score_counts_solid_pixels() {
        let depth = plane(vec![1.0, 2.2, 4.0, 9.0, 0.0]);
        let alpha = plane(vec![1.0, 1.0, 1.0, 0.2, 1.0]);
        let truth = plane(vec![2.0, 4.0, 4.0, 1.0, 1.0]);
        let score = depth_score(&depth, &alpha, &truth, 2.0).unwrap();
        assert!((score.median_relative - 0.1).abs() < 1e-6, "{score:?}");
        // The frame's own scale is 4 / 2.2: 1.818, 4, 7.27 against 2, 4, 4.
        let s = 4.0 / 2.2;
        let mean = ((2.0 - s) / 2.0 + (4.0 * s - 4.0) / 4.0) / 3.0;
        assert!((score.abs_rel - mean).abs() < 1e-6 && (score.delta - 2.0 / 3.0).abs() < 1e-9, "{score:?}");
        assert_eq!(depth_score(&depth, &alpha, &plane(vec![0.0; 5]), 1.0), None);
    }

    #[test]
    fn colour_fit_removes_gain_and_offset() {
        let value = |k: usize| [0, 3, 7].map(|c| 0.2 + 0.4 * ((k * 37 + c * 11) % 64) as f32 / 64.0);
        let photo = RgbImage { width: 16, height: 12, data: (0..192).map(value).collect() };
        let dimmed = |v: &[f32; 3]| [0.8 * v[0] + 0.05, 0.7 * v[1], 1.1 * v[2] - 0.02];
        let render = RgbImage { data: photo.data.iter().map(dimmed).collect(), ..photo.clone() };
        assert!(psnr(&render, &photo) < 25.0);
        assert!(psnr(&colour_fit(&render, &photo), &photo) > 100.0);
        // Turned upside down it stays wrong, and never gets worse.
        let turned = RgbImage { data: photo.data.iter().rev().copied().collect(), ..photo.clone() };
        let (before, after) = (psnr(&turned, &photo), psnr(&colour_fit(&turned, &photo), &photo));
        assert!(after >= before && after < 25.0, "{before} {after}");
        let flat = RgbImage { data: vec![[0.5; 3]; 192], ..photo.clone() };
        assert!(psnr(&colour_fit(&flat, &photo), &photo).is_finite());
    }
}
