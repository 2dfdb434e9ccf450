//! Straight edges of an image: connected pixels of similar gradient direction, as in LSD (Grompone
//! von Gioi et al. 2010), with a bound on their width instead of its statistical test.
use crate::scene::{Image, RgbImage};
use glam::{DVec2, IVec2};

/// Long side of the image in which edges are detected, pixels: a larger one only adds shorter
/// edges.
const SIZE: usize = 800;

/// Standard deviation of the ends of an edge, pixels.
pub(super) const END_SIGMA: f64 = 0.7;

/// A straight edge, pixel positions of its ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct Segment {
    pub from: DVec2,
    pub to: DVec2,
}

impl Segment {
    pub fn length(&self) -> f64 {
        self.from.distance(self.to)
    }
}

/// Largest angle between a gradient and the mean of its edge: 22.5°, as in LSD.
const TOLERANCE: f64 = std::f64::consts::PI / 8.0;

/// Smallest gradient, full white per pixel: at 2/255 noise of quantisation, LSD's `q / sin
/// TOLERANCE`.
const MIN_GRADIENT: f32 = 0.0205;

/// Shortest edge, share of the long side: 19 pixels at 640, where noise of half a pixel turns the
/// direction by 1.5°.
const MIN_LENGTH: f64 = 0.03;

/// Largest standard deviation of an edge's pixels across it, pixels: a sharp edge has 0.5, one
/// blurred over four pixels 1.2; an arc that bends by three pixels is beyond it.
const MAX_SPREAD: f64 = 1.5;

/// Least share of the length that pixels of the edge cover: scattered pixels are texture.
const MIN_COVER: f64 = 0.8;

/// Edges of a photo, in pixels of the reduced image in which they were detected.
pub(super) struct Found {
    pub segments: Vec<Segment>,
    pub width: usize,
    pub height: usize,
}

pub(super) fn detect(image: &RgbImage) -> Found {
    let scale = (SIZE as f64 / image.width.max(image.height) as f64).min(1.0);
    let size = |s: usize| ((s as f64 * scale).round() as usize).max(1);
    let small = image.resized_by_area(size(image.width), size(image.height));
    Found { segments: segments(&small.luma()), width: small.width, height: small.height }
}

/// Edges of an image, in the order of their strongest pixel.
fn segments(luma: &Image<f32>) -> Vec<Segment> {
    let (w, h) = (luma.width, luma.height);
    if w < 8 || h < 8 {
        return Vec::new();
    }
    let gradients = gradients(&smoothed(luma));
    let strength = |i: &u32| gradients[*i as usize].1;
    let mut order: Vec<u32> = (0..(w * h) as u32).filter(|i| strength(i) >= MIN_GRADIENT).collect();
    order.sort_unstable_by(|a, b| strength(b).total_cmp(&strength(a)).then(a.cmp(b)));
    let mut free: Vec<bool> = gradients.iter().map(|g| g.1 >= MIN_GRADIENT).collect();
    let shortest = MIN_LENGTH * w.max(h) as f64;
    let mut found = Vec::new();
    for seed in order {
        if !free[seed as usize] {
            continue;
        }
        let region = grow(seed as usize, (w, h), &gradients, &mut free);
        if region.len() as f64 >= shortest {
            found.extend(fit(&region, w, &gradients).filter(|s| s.length() >= shortest));
        }
    }
    found
}

/// Mean over 3 × 3 pixels with weights 1 2 1.
fn smoothed(luma: &Image<f32>) -> Image<f32> {
    let (w, h) = (luma.width, luma.height);
    let mut rows = luma.clone();
    for y in 0..h {
        for x in 1..w - 1 {
            rows.data[y * w + x] = 0.25 * (luma.at(x - 1, y) + 2.0 * luma.at(x, y) + luma.at(x + 1, y));
        }
    }
    let mut out = rows.clone();
    for y in 1..h - 1 {
        for x in 0..w {
            out.data[y * w + x] = 0.25 * (rows.at(x, y - 1) + 2.0 * rows.at(x, y) + rows.at(x, y + 1));
        }
    }
    out
}

/// Direction and magnitude of the gradient per pixel, by central differences; zero at the border.
fn gradients(luma: &Image<f32>) -> Vec<(DVec2, f32)> {
    let (w, h) = (luma.width, luma.height);
    let at = |x: usize, y: usize| f64::from(luma.at(x, y));
    let mut out = vec![(DVec2::ZERO, 0.0); w * h];
    for y in 2..h - 2 {
        for x in 2..w - 2 {
            let g = 0.5 * DVec2::new(at(x + 1, y) - at(x - 1, y), at(x, y + 1) - at(x, y - 1));
            out[y * w + x] = (g.normalize_or_zero(), g.length() as f32);
        }
    }
    out
}

/// Region of pixels connected to the seed whose gradients agree with its mean direction; they are
/// removed from `free`.
fn grow(seed: usize, (w, h): (usize, usize), gradients: &[(DVec2, f32)], free: &mut [bool]) -> Vec<usize> {
    let least = TOLERANCE.cos();
    let mut region = vec![seed];
    let mut mean = gradients[seed].0;
    free[seed] = false;
    let mut next = 0;
    while next < region.len() {
        let at = IVec2::new((region[next] % w) as i32, (region[next] / w) as i32);
        next += 1;
        for (dx, dy) in [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)] {
            let p = at + IVec2::new(dx, dy);
            if p.x < 0 || p.y < 0 || p.x >= w as i32 || p.y >= h as i32 {
                continue;
            }
            let k = p.y as usize * w + p.x as usize;
            if free[k] && gradients[k].0.dot(mean) >= least * mean.length() {
                free[k] = false;
                region.push(k);
                mean += gradients[k].0;
            }
        }
    }
    region
}

/// Gradient-weighted line through a region; `None` if the region is bent, broad or scattered.
fn fit(region: &[usize], width: usize, gradients: &[(DVec2, f32)]) -> Option<Segment> {
    let centre = |k: usize| DVec2::new((k % width) as f64 + 0.5, (k / width) as f64 + 0.5);
    let weighted = || region.iter().map(|k| (centre(*k), f64::from(gradients[*k].1)));
    let total: f64 = weighted().map(|p| p.1).sum();
    let middle = weighted().fold(DVec2::ZERO, |sum, (p, g)| sum + p * g) / total;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for (p, g) in weighted() {
        let d = p - middle;
        xx += g * d.x * d.x;
        xy += g * d.x * d.y;
        yy += g * d.y * d.y;
    }
    // The larger principal axis of the moments.
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let along = DVec2::from_angle(angle);
    let across = 0.5 * (xx + yy) - 0.5 * (xx - yy).hypot(2.0 * xy);
    if (across.max(0.0) / total).sqrt() > MAX_SPREAD {
        return None;
    }
    let offset_along = |k: &usize| (centre(*k) - middle).dot(along);
    let (low, high) =
        region.iter().map(offset_along).fold((0.0, 0.0), |(a, b): (f64, f64), t| (a.min(t), b.max(t)));
    let mut covered = vec![false; (high - low) as usize + 1];
    region.iter().for_each(|k| covered[(offset_along(k) - low) as usize] = true);
    let share = covered.iter().filter(|c| **c).count() as f64 / covered.len() as f64;
    (share >= MIN_COVER).then(|| Segment { from: middle + low * along, to: middle + high * along })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_of_bar_but_not_disc() {
        let turn = DVec2::from_angle(0.3);
        // Soft edges, as a lens makes them.
        let step = |d: f64| (0.5 - d).clamp(0.0, 1.0) as f32;
        let value = |k: usize| {
            let p = DVec2::new((k % 160) as f64 + 0.5, (k / 160) as f64 + 0.5);
            let bar = p - DVec2::new(50.0, 60.0);
            let along = bar.dot(turn.perp()).abs() - 40.0;
            let bar = step(along.max(bar.dot(turn).abs() - 8.0));
            let disc = step(p.distance(DVec2::new(115.0, 60.0)) - 25.0);
            0.2 + 0.6 * bar.max(disc)
        };
        let luma = Image { width: 160, height: 120, data: (0..160 * 120).map(value).collect() };
        let found = segments(&luma);
        let long: Vec<_> = found.iter().filter(|s| s.length() > 60.0).collect();
        assert_eq!(long.len(), 2, "{found:?}");
        for s in long {
            let off = (s.to - s.from).normalize().dot(turn).abs().asin();
            // Measured: 0.1°.
            assert!(off.to_degrees() < 0.5, "{s:?}: {}", off.to_degrees());
        }
        let disc = found.iter().filter(|s| s.from.x > 85.0);
        assert!(disc.clone().all(|s| s.length() < 30.0), "{:?}", disc.collect::<Vec<_>>());
    }
}
