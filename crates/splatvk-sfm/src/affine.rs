//! Affine-invariant keypoints (ASIFT, Morel and Yu 2009), for matches between views far apart in
//! angle. Corners are also detected in copies of the photo that are compressed along one direction,
//! as an oblique view compresses a planar patch.
use super::matching::Keypoints;
use super::sift;
use crate::scene::Image;
use glam::{DMat2, DVec2};
use rayon::prelude::*;

/// Tilts of the simulated views: √2, 2 and 2√2 are 45°, 60° and 69° from the normal; of two photos
/// that see a patch from both sides each bears one.
const TILTS: [f64; 3] = [std::f64::consts::SQRT_2, 2.0, 2.0 * std::f64::consts::SQRT_2];
/// Angle between the directions of a compression, degrees, times its tilt (Morel and Yu).
const TURN: f64 = 72.0;
/// Blur along the compressed direction per √(t² − 1), pixels (Morel and Yu): the average over the
/// pixels of a tilted camera.
const BLUR: f64 = 0.8;

/// Keypoints of a luma image and of its compressed copies, the strongest `limit` of each; positions
/// in pixels of the image itself.
pub(crate) fn detect(luma: &Image<f32>, valid: &Image<bool>, limit: usize) -> Keypoints {
    let mut all = sift::detect(luma, valid, limit);
    let views = TILTS.iter().flat_map(|t| {
        let directions = (180.0 * t / TURN).round();
        (0..directions as usize).map(move |k| (*t, (k as f64 * 180.0 / directions).to_radians()))
    });
    let views: Vec<(f64, f64)> = views.collect();
    let compressed =
        views.par_iter().map(|&(tilt, turn)| Compressed::new(luma, valid, tilt, turn).keypoints(limit));
    for found in compressed.collect::<Vec<_>>() {
        all.points.extend(found.points);
        all.descriptors.extend(found.descriptors);
    }
    all
}

/// A rotated and compressed copy of an image.
struct Compressed {
    luma: Image<f32>,
    valid: Image<bool>,
    /// Linear map from positions in the copy to positions in the image.
    back: DMat2,
    origin: DVec2,
}

impl Compressed {
    fn new(image: &Image<f32>, valid: &Image<bool>, tilt: f64, turn: f64) -> Compressed {
        let size = DVec2::new(image.width as f64, image.height as f64);
        let (axis, across) = (DVec2::from_angle(turn), DVec2::from_angle(turn).perp());
        let extent = |d: DVec2| (size * d.abs()).element_sum();
        // The rotated image has full resolution along its first axis, of which every `tilt`-th
        // sample stays.
        let (long, height) = (extent(axis).ceil() as usize, extent(across).ceil() as usize);
        let width = (long as f64 / tilt).floor().max(1.0) as usize;
        let to_image =
            |u: f64, v: f64| 0.5 * size + axis * (u - 0.5 * long as f64) + across * (v - 0.5 * height as f64);
        let mut turned = Image::filled(long, height, 0.0f32);
        turned.data.par_chunks_mut(long).enumerate().for_each(|(y, row)| {
            row.iter_mut().enumerate().for_each(|(x, out)| {
                *out = bilinear(image, to_image(x as f64 + 0.5, y as f64 + 0.5));
            });
        });
        let kernel = kernel(BLUR * (tilt * tilt - 1.0).sqrt());
        let mut luma = Image::filled(width, height, 0.0f32);
        let mut inside = Image::filled(width, height, false);
        for y in 0..height {
            let row = &turned.data[y * long..(y + 1) * long];
            for x in 0..width {
                let u = (x as f64 + 0.5) * tilt;
                luma.data[y * width + x] = blurred_at(row, u, &kernel);
                let p = to_image(u, y as f64 + 0.5);
                let within = p.x >= 0.0 && p.y >= 0.0 && p.x < size.x && p.y < size.y;
                inside.data[y * width + x] = within && valid.at(p.x as usize, p.y as usize);
            }
        }
        let back = DMat2::from_cols(axis * tilt, across);
        Compressed { luma, valid: inside, back, origin: to_image(0.0, 0.0) }
    }

    fn keypoints(&self, limit: usize) -> Keypoints {
        let mut found = sift::detect(&self.luma, &self.valid, limit);
        found.points.iter_mut().for_each(|p| *p = self.origin + self.back * *p);
        found
    }
}

/// Normalised Gaussian kernel of radius 3 σ.
fn kernel(sigma: f64) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as i64;
    let values: Vec<f64> =
        (-radius..=radius).map(|k| (-((k * k) as f64) / (2.0 * sigma * sigma)).exp()).collect();
    let sum: f64 = values.iter().sum();
    values.iter().map(|v| (v / sum) as f32).collect()
}

/// Blurred value of a row at position `u`, linear between samples; ends are repeated.
fn blurred_at(row: &[f32], u: f64, kernel: &[f32]) -> f32 {
    let at = u - 0.5;
    let (low, share) = (at.floor() as i64, at.fract() as f32);
    let radius = kernel.len() as i64 / 2;
    let value = |i: i64| row[i.clamp(0, row.len() as i64 - 1) as usize];
    let blurred = |i: i64| kernel.iter().zip(i - radius..).map(|(k, j)| k * value(j)).sum::<f32>();
    blurred(low) * (1.0 - share) + blurred(low + 1) * share
}

/// Bilinear value of the image; edges are repeated.
fn bilinear(image: &Image<f32>, p: DVec2) -> f32 {
    let last = DVec2::new(image.width as f64 - 1.0, image.height as f64 - 1.0);
    let q = (p - 0.5).clamp(DVec2::ZERO, last);
    let (x, y) = (q.x as usize, q.y as usize);
    let (x1, y1) = ((x + 1).min(image.width - 1), (y + 1).min(image.height - 1));
    let (fx, fy) = (q.x.fract() as f32, q.y.fract() as f32);
    let row = |y: usize| image.at(x, y) * (1.0 - fx) + image.at(x1, y) * fx;
    row(y) * (1.0 - fy) + row(y1) * fy
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::mutual_matches;
    use crate::math::Random;

    /// Smooth noise with structure of a few pixels.
    fn texture(width: usize, height: usize) -> Image<f32> {
        let mut random = Random::new(1004);
        let noise =
            Image { width, height, data: (0..width * height).map(|_| random.uniform() as f32).collect() };
        let mut soft = sift::blurred(&noise, 2.0);
        soft.data.iter_mut().for_each(|v| *v = 0.5 + 4.0 * (*v - 0.5));
        soft
    }

    #[test]
    #[ignore = "takes long: tools/test-long"]
    fn detect_matches_patch_at_70_degrees() {
        let image = texture(360, 300);
        let middle = DVec2::new(180.0, 150.0);
        // A view rotated by 25° and tilted by 70°.
        let (axis, across) = (DVec2::from_angle(0.44), DVec2::from_angle(0.44).perp());
        let to = |p: DVec2| {
            let q = p - middle;
            DVec2::new(q.dot(axis) / 3.0, q.dot(across)) + middle
        };
        let from = |p: DVec2| {
            let q = p - middle;
            axis * (3.0 * q.x) + across * q.y + middle
        };
        let mut tilted = Image::filled(360, 300, 0.5f32);
        let mut valid = Image::filled(360, 300, false);
        for i in 0..360 * 300 {
            let p = DVec2::new((i % 360) as f64 + 0.5, (i / 360) as f64 + 0.5);
            let inside = |q: DVec2| q.x > 4.0 && q.y > 4.0 && q.x < 356.0 && q.y < 296.0;
            // The mean over the three pixels that become one.
            let parts = [-1.0, 0.0, 1.0].map(|k| from(p) + axis * k);
            if parts.iter().all(|q| inside(*q)) {
                tilted.data[i] = parts.map(|q| bilinear(&image, q)).iter().sum::<f32>() / 3.0;
                valid.data[i] = true;
            }
        }
        let everywhere = Image::filled(360, 300, true);
        let right = |a: &Keypoints, b: &Keypoints| {
            let matches = mutual_matches(a, b, 0.85);
            let good = matches.iter().filter(|m| to(a.points[m.first]).distance(b.points[m.second]) < 2.0);
            (good.count(), matches.len())
        };
        let plain = right(&sift::detect(&image, &everywhere, 1000), &sift::detect(&tilted, &valid, 1000));
        let affine = right(&detect(&image, &everywhere, 1000), &detect(&tilted, &valid, 1000));
        assert!(affine.0 > 5 * plain.0.max(10), "{affine:?} {plain:?}");
        assert!(2 * affine.0 > affine.1, "{affine:?}");
    }
}
