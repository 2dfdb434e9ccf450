//! How bright the photos show their common points.
use crate::SparseModel;
use crate::photo::Photo;
use crate::photo::light::radius2;
use crate::scene::{RgbImage, to_linear};
use glam::DVec2;
use rayon::prelude::*;

/// Half the side of the averaged patch as a fraction of the long side: 3 pixels at 640 outweigh
/// noise and misplacement.
const PATCH: f64 = 3.0 / 640.0;
/// A patch grows with the view's scale, at most to this many times its size.
const MAX_GROWTH: f64 = 3.0;
/// An sRGB value at least this high may be clipped; JPEG leaves a few grey levels of ringing.
const SATURATED: f32 = 0.98;
/// Linear light below which quantisation and black level decide: 1 % is grey level 25 of 255.
const DARK: f64 = 0.01;
/// Standard deviation of the linear mean of a patch from quantisation and black level: half a grey
/// level in the shadows.
const FLOOR: f64 = 5e-4;
/// ln error of a patch without texture: shading and noise.
const PLAIN_SIGMA: f64 = 0.02;
/// ln error per relative contrast of a patch: the views cut different pieces out of the texture.
const TEXTURE_SIGMA: f64 = 0.3;
/// Cells per side of a photo: residuals within a cell share highlight, shadow and texture, so they
/// count as one when the standard deviation is estimated.
const CELLS: f64 = 6.0;

/// One photo's sight of a point.
struct Sample {
    view: usize,
    pixel: DVec2,
    /// Mean over the channels of ln light, then red and blue against it.
    ln: [f64; 3],
    /// Variance of the first and of the others.
    variance: [f64; 2],
    /// Squared radius, half diagonals.
    r2: f64,
}

/// Two photos' sights of one point.
#[derive(Clone, Copy)]
pub(super) struct Pair {
    pub(super) views: [usize; 2],
    pub(super) difference: [f64; 3],
    pub(super) variance: [f64; 2],
    /// Differences of r² and r⁴, per photo: they may belong to different lenses.
    pub(super) r: [[f64; 2]; 2],
    /// 1 / sightings of the point: all its pairs together weigh as much as its free differences.
    pub(super) share: f64,
    /// Where each photo shows it, in cells of the photo.
    pub(super) cells: [usize; 2],
}

/// All pairs of usable sights of a point.
pub(super) fn pairs_of(photos: &[Photo], model: &SparseModel) -> Vec<Pair> {
    // Scale of every sight against the coarsest of its point: patches cover the same piece of
    // surface.
    let mut wanted: Vec<Vec<(usize, DVec2, f64)>> = vec![Vec::new(); photos.len()];
    for (k, point) in model.points.iter().enumerate() {
        let scale = |v: usize| {
            let camera = &model.cameras[v];
            camera.fx / camera.pose.transform(point.position).z.max(1e-9)
        };
        let least = point.views.iter().map(|s| scale(s.0)).fold(f64::INFINITY, f64::min);
        for (v, pixel) in &point.views {
            wanted[*v].push((k, *pixel, (scale(*v) / least).clamp(1.0, MAX_GROWTH)));
        }
    }
    let samples: Vec<Vec<(usize, Sample)>> = photos
        .par_iter()
        .zip(wanted)
        .enumerate()
        .map(|(view, (photo, wanted))| {
            let linear = Linear::of(photo);
            wanted.into_iter().filter_map(|(k, p, s)| Some((k, linear.sample(view, p, s)?))).collect()
        })
        .collect();
    let mut points: Vec<Vec<Sample>> = model.points.iter().map(|_| Vec::new()).collect();
    for (k, sample) in samples.into_iter().flatten() {
        points[k].push(sample);
    }
    points.iter().flat_map(|p| pairs_of_point(p, photos)).collect()
}

fn pairs_of_point<'a>(samples: &'a [Sample], photos: &'a [Photo]) -> impl Iterator<Item = Pair> + 'a {
    let cell = |s: &Sample| {
        let image = &photos[s.view].image;
        let at = |p: f64, size: usize| (CELLS * p / size as f64).clamp(0.0, CELLS - 1.0) as usize;
        at(s.pixel.y, image.height) * CELLS as usize + at(s.pixel.x, image.width)
    };
    let pair = move |a: &Sample, b: &Sample| Pair {
        views: [a.view, b.view],
        difference: [0, 1, 2].map(|c| a.ln[c] - b.ln[c]),
        variance: [0, 1].map(|c| a.variance[c] + b.variance[c]),
        r: [a, b].map(|s| [s.r2, s.r2 * s.r2]),
        share: 2.0 / samples.len() as f64,
        cells: [cell(a), cell(b)],
    };
    (1..samples.len())
        .flat_map(move |j| (0..j).map(move |i| (i, j)))
        .map(move |(i, j)| pair(&samples[i], &samples[j]))
}

/// A photo in linear light.
struct Linear {
    image: RgbImage,
    clipped: Vec<bool>,
    patch: f64,
}

impl Linear {
    fn of(photo: &Photo) -> Linear {
        let mut image = photo.image.clone();
        // Above 1 nothing is clipped: the file holds linear light.
        let range = image.data.iter().flatten().any(|v| *v > 1.0);
        let clipped = image.data.iter().map(|c| !range && c.iter().any(|v| *v >= SATURATED)).collect();
        image.data.iter_mut().flatten().for_each(|v| *v = to_linear(*v));
        let patch = PATCH * image.width.max(image.height) as f64;
        Linear { image, clipped, patch }
    }

    /// Mean light of the patch around a position; `None` where it leaves the photo, is clipped or
    /// too dark.
    fn sample(&self, view: usize, pixel: DVec2, growth: f64) -> Option<Sample> {
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
        Some(Sample {
            view,
            pixel,
            ln: [grey, ln[0] - grey, ln[2] - grey],
            // Texture that is cut differently changes brightness more than colour; how much, the
            // robust scale tells.
            variance: [base + TEXTURE_SIGMA * TEXTURE_SIGMA * contrast2; 2],
            r2: radius2(pixel.x, pixel.y, (w, h)),
        })
    }
}
