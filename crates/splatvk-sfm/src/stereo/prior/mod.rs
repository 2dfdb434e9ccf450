//! Fusion of depth priors (from a network or files) with matched depth.
//!
//! A prior has shape without scale: it is aligned with stereo piece by piece ([`align`]). It is
//! dropped where it contradicts confident stereo, lies in another view's free space, or is blurred
//! over a depth edge ([`edges`]). The rest is averaged with matched depth by inverse variance, and
//! replaces it where nothing was matched.
mod align;
mod edges;
mod pieces;
#[cfg(test)]
mod tests;

use super::Level;
use super::surface::{RelativePoses, Surface, Visibility, ray};
use crate::progress::Progress;
use crate::scene::{DepthPrior, PriorKind};
use glam::Vec3;

/// Confidence of a pixel with depth from the prior alone: it shapes the surface but is no
/// measurement, like a plausible match.
pub const SUGGESTED: f32 = 0.4;
/// (least confidence, σ of depth as a share of the view's tolerance): confirmed by two views, by
/// one, by none, and inferred.
const DEVIATION: [(f32, f32); 4] = [(0.9, 0.5), (0.6, 1.0), (0.45, 2.0), (0.0, 3.0)];
/// Matched depth and prior that differ by more σ are of different surfaces and are not averaged.
const SAME_SURFACE: f32 = 3.0;
/// From this confidence on matched depth beats a contradicting prior; below, the smaller σ does.
const SURE: f32 = 0.6;
/// Half of the distance for slopes of the prior, pixels: one would measure the noise of
/// half-precision files.
const SLOPE: usize = 2;
/// Share of a prior in rejected pieces from which on the user is warned.
const DOUBTFUL: f32 = 0.25;

/// `surface` (matched, smoothed) fused with the priors, one or none per view. Priors that do not
/// fit are named in a warning and skipped.
pub fn fuse_priors(
    level: &Level,
    poses: &RelativePoses,
    surface: &Surface,
    priors: &[Option<DepthPrior>],
    seed: u32,
    progress: &dyn Progress,
) -> Surface {
    let mut out = surface.clone();
    for (view, prior) in priors.iter().enumerate().take(level.references.len()) {
        let Some(prior) = prior else { continue };
        let r = &level.references[view];
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        let own = first..first + width * height;
        let confidence = &surface.confidence[own.clone()];
        let matched: Vec<f32> = own
            .clone()
            .map(|k| {
                let inverse =
                    surface.planes[k].dot(ray(level, view, (k - first) % width, (k - first) / width));
                if surface.confidence[k] > 0.0 { inverse.max(0.0) } else { 0.0 }
            })
            .collect();
        let values = resampled(prior, width, height);
        let name = &level.cameras[view].name;
        let aligned =
            align::align(&values, &matched, confidence, (width, height), level.tolerance[view], seed);
        let Some(aligned) = aligned else {
            progress.warn(&format!(
                "{name}: the depth prior explains what was matched no better than one constant depth, whatever its scale and \
                 shift; it is not used for this photo"
            ));
            continue;
        };
        if aligned.contradicted > DOUBTFUL {
            progress.warn(&format!(
                "{name}: {:.0} % of the depth prior contradicts matched depth and is not used",
                100.0 * aligned.contradicted
            ));
        }
        let fusion = PriorFusion { level, poses, surface, view, matched: &matched, aligned: &aligned };
        let (planes, confidence) = fusion.run(width, height);
        out.planes[own.clone()].copy_from_slice(&planes);
        out.confidence[own].copy_from_slice(&confidence);
    }
    out
}

/// Prior as inverse depth at the level's size, bilinear; 0 where unknown.
fn resampled(prior: &DepthPrior, width: usize, height: usize) -> Vec<f32> {
    let values = &prior.values;
    let inverse = |v: f32| match prior.kind {
        _ if !v.is_finite() || v <= 0.0 => 0.0,
        PriorKind::Depth => 1.0 / v,
        PriorKind::InverseDepth => v,
    };
    let mut out = Vec::with_capacity(width * height);
    for y in 0..height {
        let (y0, y1, fy) = bilinear_taps(y, values.height, height);
        for x in 0..width {
            let (x0, x1, fx) = bilinear_taps(x, values.width, width);
            let four = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|(x, y)| inverse(values.at(x, y)));
            // Unknown if any tap is: a mean with 0 would be a wall far away.
            let value = lerp(lerp(four[0], four[1], fx), lerp(four[2], four[3], fx), fy);
            out.push(if four.iter().all(|v| *v > 0.0) { value } else { 0.0 });
        }
    }
    out
}

/// Both taps of sample `k` of `to` among `from` values, and the weight of the second.
fn bilinear_taps(k: usize, from: usize, to: usize) -> (usize, usize, f32) {
    let position = ((k as f32 + 0.5) * from as f32 / to as f32 - 0.5).clamp(0.0, (from - 1) as f32);
    (position as usize, (position as usize + 1).min(from - 1), position.fract())
}

fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + t * (b - a)
}

/// Matched depth and aligned prior of one view.
struct PriorFusion<'a> {
    level: &'a Level,
    poses: &'a RelativePoses,
    surface: &'a Surface,
    view: usize,
    /// Inverse depth, 0 = unmatched.
    matched: &'a [f32],
    aligned: &'a align::Aligned,
}

impl PriorFusion<'_> {
    fn run(&self, width: usize, height: usize) -> (Vec<Vec3>, Vec<f32>) {
        let first = self.level.references[self.view].first as usize;
        let flat = edges::flat(&self.aligned.inverse, width, height);
        let mut planes = self.surface.planes[first..first + width * height].to_vec();
        let mut confidence = self.surface.confidence[first..first + width * height].to_vec();
        for k in 0..width * height {
            let prior = self.aligned.inverse[k];
            if prior <= 0.0 || !flat[k] {
                continue;
            }
            let (x, y) = (k % width, k / width);
            let plane = self.plane(x, y, width, height);
            if confidence[k] > 0.0 {
                let (matched, deviation) = (self.matched[k], self.deviation(confidence[k]) * self.matched[k]);
                let other = self.aligned.deviation[k] * prior;
                let differ = (matched - prior).abs() > SAME_SURFACE * deviation.hypot(other);
                if !differ {
                    let (a, b) = (deviation.powi(-2), other.powi(-2));
                    planes[k] = (planes[k] * a + plane * b) / (a + b);
                    continue;
                }
                if confidence[k] >= SURE || deviation / matched < other / prior {
                    continue;
                }
            }
            if !self.in_free_space(x, y, prior) {
                planes[k] = plane;
                confidence[k] = SUGGESTED;
            }
        }
        (planes, confidence)
    }

    fn deviation(&self, confidence: f32) -> f32 {
        let entry = DEVIATION.iter().find(|(least, _)| confidence >= *least);
        entry.map_or(1.0, |(_, share)| *share) * self.level.tolerance[self.view]
    }

    /// Tangent plane `π` of the aligned prior.
    fn plane(&self, x: usize, y: usize, width: usize, height: usize) -> Vec3 {
        let inverse = &self.aligned.inverse;
        let here = inverse[y * width + x];
        let slope = |low: usize, high: usize, at: &dyn Fn(usize) -> usize| {
            let (a, b) = (inverse[at(low)], inverse[at(high)]);
            if a > 0.0 && b > 0.0 && high > low { (b - a) / (high - low) as f32 } else { 0.0 }
        };
        let dx = slope(x.saturating_sub(SLOPE), (x + SLOPE).min(width - 1), &|x| y * width + x);
        let dy = slope(y.saturating_sub(SLOPE), (y + SLOPE).min(height - 1), &|y| y * width + x);
        let [fx, fy, cx, cy] = self.level.references[self.view].intrinsics;
        // π·((u − cx)/fx, (v − cy)/fy, 1) = here + dx (u − x) + dy (v − y)
        let (u, v) = (x as f32 + 0.5 - cx, y as f32 + 0.5 - cy);
        Vec3::new(dx * fx, dy * fy, here - dx * u - dy * v)
    }

    /// True if a surface at this inverse depth would lie in the free space of another view.
    fn in_free_space(&self, x: usize, y: usize, inverse: f32) -> bool {
        let point = ray(self.level, self.view, x, y) / inverse;
        let pixel = [x as f32 + 0.5, y as f32 + 0.5];
        self.level.neighbours(self.view).any(|other| {
            let seen = self.poses.visibility(self.level, self.surface, self.view, other, pixel, point);
            seen == Visibility::FreeSpace
        })
    }
}
