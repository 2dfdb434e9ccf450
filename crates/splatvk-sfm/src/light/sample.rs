//! Brightness of common points in the photos.
use crate::SparseModel;
use crate::photo::Photo;
use crate::photo::light::radius2;
use crate::scene::{RgbImage, to_linear};
use glam::DVec2;
use rayon::prelude::*;

/// Half the side of the averaged patch as a share of the long side: 3 pixels at 640 outweigh noise
/// and misplacement.
const PATCH: f64 = 3.0 / 640.0;
/// Largest factor by which a patch grows with the view's scale.
const MAX_GROWTH: f64 = 3.0;
/// Least sRGB value that may be clipped; JPEG leaves a few grey levels of ringing.
const SATURATED: f32 = 0.98;
/// Linear light below which quantisation and black level dominate: 1 % is grey level 25 of 255.
const DARK: f64 = 0.01;
/// σ of a patch's linear mean from quantisation and black level: half a grey level in shadows.
const FLOOR: f64 = 5e-4;
/// σ of ln brightness of a patch without texture: shading and noise.
const PLAIN_SIGMA: f64 = 0.02;
/// σ of ln brightness per relative contrast of a patch: views sample texture differently.
const TEXTURE_SIGMA: f64 = 0.3;
/// Cells per side of a photo: residuals within a cell share highlight, shadow and texture, and
/// count as one in the standard deviation.
const CELLS: f64 = 6.0;

/// Observation of a point in one photo.
struct Observation {
    view: usize,
    pixel: DVec2,
    /// Mean of ln light over the channels, then ln red and ln blue minus that mean.
    ln: [f64; 3],
    /// Variance of the first entry of `ln`, and of the others.
    variance: [f64; 2],
    /// Squared distance from the image centre, in half diagonals.
    r2: f64,
}

/// Observations of one point in two photos.
#[derive(Clone, Copy)]
pub(super) struct Pair {
    pub(super) views: [usize; 2],
    pub(super) difference: [f64; 3],
    pub(super) variance: [f64; 2],
    /// r² and r⁴ in each photo: their lenses may differ.
    pub(super) r: [[f64; 2]; 2],
    /// 2 / observations of the point: its pairs weigh as much as its independent differences.
    pub(super) share: f64,
    /// Cell of the point in each photo.
    pub(super) cells: [usize; 2],
}

/// All pairs of usable observations of every point.
pub(super) fn pairs_of(photos: &[Photo], model: &SparseModel) -> Vec<Pair> {
    // Patches grow with scale relative to the coarsest: they cover the same surface.
    let mut patches: Vec<Vec<(usize, DVec2, f64)>> = vec![Vec::new(); photos.len()];
    for (k, point) in model.points.iter().enumerate() {
        let scale = |v: usize| {
            let camera = &model.cameras[v];
            camera.fx / camera.pose.transform(point.position).z.max(1e-9)
        };
        let least = point.views.iter().map(|s| scale(s.0)).fold(f64::INFINITY, f64::min);
        for (v, pixel) in &point.views {
            patches[*v].push((k, *pixel, (scale(*v) / least).clamp(1.0, MAX_GROWTH)));
        }
    }
    let samples: Vec<Vec<(usize, Observation)>> = photos
        .par_iter()
        .zip(patches)
        .enumerate()
        .map(|(view, (photo, patches))| {
            let linear = LinearPhoto::of(photo);
            patches.into_iter().filter_map(|(k, p, s)| Some((k, linear.sample(view, p, s)?))).collect()
        })
        .collect();
    let mut points: Vec<Vec<Observation>> = model.points.iter().map(|_| Vec::new()).collect();
    for (k, sample) in samples.into_iter().flatten() {
        points[k].push(sample);
    }
    points.iter().flat_map(|p| pairs_of_point(p, photos)).collect()
}

fn pairs_of_point<'a>(samples: &'a [Observation], photos: &'a [Photo]) -> impl Iterator<Item = Pair> + 'a {
    let share = 2.0 / samples.len() as f64;
    (1..samples.len())
        .flat_map(move |j| (0..j).map(move |i| (i, j)))
        .map(move |(i, j)| pair(&samples[i], &samples[j], photos, share))
}

fn pair(a: &Observation, b: &Observation, photos: &[Photo], share: f64) -> Pair {
    Pair {
        views: [a.view, b.view],
        difference: [0, 1, 2].map(|c| a.ln[c] - b.ln[c]),
        variance: [0, 1].map(|c| a.variance[c] + b.variance[c]),
        r: [a, b].map(|s| [s.r2, s.r2 * s.r2]),
        share,
        cells: [a, b].map(|s| cell(s, &photos[s.view].image)),
    }
}

/// Cell of an observation in its photo.
fn cell(s: &Observation, image: &RgbImage) -> usize {
    let index = |p: f64, size: usize| (CELLS * p / size as f64).clamp(0.0, CELLS - 1.0) as usize;
    index(s.pixel.y, image.height) * CELLS as usize + index(s.pixel.x, image.width)
}

/// A photo in linear light.
struct LinearPhoto {
    image: RgbImage,
    clipped: Vec<bool>,
    patch: f64,
}

impl LinearPhoto {
    fn of(photo: &Photo) -> LinearPhoto {
        let mut image = photo.image.clone();
        // Values above 1 are from a file of linear light, which is not clipped.
        let range = image.data.iter().flatten().any(|v| *v > 1.0);
        let clipped = image.data.iter().map(|c| !range && c.iter().any(|v| *v >= SATURATED)).collect();
        image.data.iter_mut().flatten().for_each(|v| *v = to_linear(*v));
        let patch = PATCH * image.width.max(image.height) as f64;
        LinearPhoto { image, clipped, patch }
    }

    /// Mean light of the patch around a position; `None` if outside, clipped or too dark.
    fn sample(&self, view: usize, pixel: DVec2, growth: f64) -> Option<Observation> {
        let (w, h) = (self.image.width, self.image.height);
        let half = (self.patch * growth).round().max(1.0);
        let (x, y) = (pixel.x.floor(), pixel.y.floor());
        if !(x >= half && y >= half && x + half < w as f64 && y + half < h as f64) {
            return None;
        }
        let (columns, rows) =
            ((x - half) as usize..=(x + half) as usize, (y - half) as usize..=(y + half) as usize);
        let (mut sum, mut squares, mut count) = ([0.0f64; 3], 0.0, 0.0);
        for k in rows.flat_map(|r| columns.clone().map(move |c| r * w + c)) {
            if self.clipped[k] {
                return None;
            }
            let colour = self.image.data[k].map(f64::from);
            (0..3).for_each(|c| sum[c] += colour[c]);
            squares += (colour[0] + colour[1] + colour[2]).powi(2);
            count += 1.0;
        }
        let mean = sum.map(|s| s / count);
        if mean.iter().any(|m| *m < DARK) {
            return None;
        }
        let total = mean[0] + mean[1] + mean[2];
        let contrast2 = (squares / count / (total * total) - 1.0).max(0.0);
        let ln = mean.map(f64::ln);
        let grey = (ln[0] + ln[1] + ln[2]) / 3.0;
        let noise = mean.iter().map(|m| (FLOOR / m).powi(2)).fold(0.0, f64::max);
        let base = PLAIN_SIGMA * PLAIN_SIGMA + noise;
        Some(Observation {
            view,
            pixel,
            ln: [grey, ln[0] - grey, ln[2] - grey],
            // Differently sampled texture changes brightness more than colour; the scale adapts.
            variance: [base + TEXTURE_SIGMA * TEXTURE_SIGMA * contrast2; 2],
            r2: radius2(pixel.x, pixel.y, (w, h)),
        })
    }
}
