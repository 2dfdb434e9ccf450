//! Ends of surfaces in a photo: planes fitted at its borders and at its depth edges.
use crate::math::Random;
use crate::scene::{Camera, DepthMap, RgbImage};
use glam::{DMat3, DVec2, DVec3};

/// Grid of the splats in units of the longer image side: only the mean colour is known, so finer
/// splats add no detail.
pub(super) const STEP: f64 = 0.015;
/// Least depth of a splat behind a surface, relative to the surface: above stereo noise.
pub(super) const BEHIND: f64 = 1.05;

/// Half-width of the first window of a plane fit, over the longer side; doubled up to twice where
/// depth is missing.
const WINDOW: f64 = 0.06;
/// Largest relative inverse-depth difference of an inlier of a plane: above stereo noise, below
/// object sizes.
const INLIER: f64 = 0.01;
/// Fewest samples of a plane: of a stride-3 grid, a tenth of the window at a straight border.
const SAMPLES: usize = 30;
/// Largest colour distance (L2) between a pixel and the border on one surface, including its
/// texture and shading.
const ALIKE: f32 = 0.25;

/// Number of neighbouring anchors of which the typical one continues.
const NEIGHBOURS: usize = 7;

/// Photo with camera and depth.
pub(super) struct Shown<'a> {
    pub(super) image: &'a RgbImage,
    pub(super) camera: &'a Camera,
    pub(super) depth: &'a DepthMap,
    /// Least confidence of depth that is used.
    pub(super) min_confidence: f32,
}

/// Plane at a position where it ends: inverse depth `w + slope·(pixel − at)`.
pub(super) struct Anchor {
    pub(super) at: DVec2,
    pub(super) w: f64,
    slope: DVec2,
    pub(super) colour: [f32; 3],
}

/// Pixel of known depth.
struct Sample {
    offset: DVec2,
    inverse: f64,
    weight: f64,
    colour: [f32; 3],
}

impl Anchor {
    /// Inverse depth of the plane at a pixel.
    pub(super) fn inverse(&self, p: DVec2) -> f64 {
        self.w + self.slope.dot(p - self.at)
    }

    /// Fits the plane with the most weight to samples around `at`, with its mean colour.
    fn fit(at: DVec2, samples: &[Sample], random: &mut Random) -> Option<Anchor> {
        let (w, slope) = fit_plane(samples, random)?;
        let mut colour = [0.0f64; 3];
        let mut total = 0.0;
        for s in samples {
            if ((w + slope.dot(s.offset)) / s.inverse - 1.0).abs() < 2.0 * INLIER {
                (0..3).for_each(|c| colour[c] += s.weight * f64::from(s.colour[c]));
                total += s.weight;
            }
        }
        (total > 0.0).then(|| Anchor { at, w, slope, colour: colour.map(|c| (c / total) as f32) })
    }

    /// Of the anchors nearest to the border position `at`, the one with the median depth at a pixel
    /// beyond: a plane fitted to noise does not continue.
    pub(super) fn typical(anchors: &[Anchor], at: DVec2, pixel: DVec2) -> Option<&Anchor> {
        let mut near: Vec<&Anchor> = anchors.iter().collect();
        let squared = |a: &&Anchor| a.at.distance_squared(at);
        if near.len() > NEIGHBOURS {
            near.select_nth_unstable_by(NEIGHBOURS, |a, b| squared(a).total_cmp(&squared(b)));
            near.truncate(NEIGHBOURS);
        }
        near.sort_by(|a, b| a.inverse(pixel).total_cmp(&b.inverse(pixel)));
        near.get(near.len() / 2).copied()
    }

    /// Anchor nearest to a position.
    pub(super) fn nearest<'a>(anchors: impl Iterator<Item = &'a Anchor>, to: DVec2) -> Option<&'a Anchor> {
        let squared = |a: &&Anchor| a.at.distance_squared(to);
        anchors.min_by(|a, b| squared(a).total_cmp(&squared(b)))
    }
}

/// Fits planes along the border, one per grid step, where there is enough depth.
pub(super) fn at_border(shown: &Shown, random: &mut Random) -> Vec<Anchor> {
    let (DVec2 { x: w, y: h }, step) = (shown.size(), STEP * shown.long());
    let along = |length: f64| (0..=(length / step).ceil() as i64).map(move |i| (i as f64 * step).min(length));
    let horizontal = along(w).flat_map(|x| [DVec2::new(x, 0.0), DVec2::new(x, h)]);
    let vertical = along(h).flat_map(|y| [DVec2::new(0.0, y), DVec2::new(w, y)]);
    let anchor = |at: DVec2| {
        // Where the border has no depth, the nearest depth may belong to another object.
        let own = shown.mean_colour(at, 2.0 * step);
        let alike = |c: [f32; 3]| (0..3).map(|k| (c[k] - own[k]).powi(2)).sum::<f32>() < ALIKE * ALIKE;
        Anchor::fit(at, &shown.samples(at, |s| alike(s.colour))?, random)
    };
    horizontal.chain(vertical).filter_map(anchor).collect()
}

/// Fits the farther planes at depth edges, at most one per cell of `step` pixels.
pub(super) fn at_edges(shown: &Shown, step: f64, random: &mut Random) -> Vec<Anchor> {
    let anchor = |at: DVec2| {
        // At least 4 × 4 pixels, so that a tenth is one of them.
        let pixels = shown.window(at, step.max(2.0), 1);
        let mut known: Vec<f64> = pixels.filter_map(|(x, y)| shown.depth_at(x, y)).collect();
        // A tenth of the pixels on each side is an edge rather than noise.
        let tenth = known.len() / 10;
        if tenth == 0 {
            return None;
        }
        known.sort_by(f64::total_cmp);
        let (near, far) = (known[tenth], known[known.len() - 1 - tenth]);
        if far < BEHIND * near {
            return None;
        }
        let between = 1.0 / (near * far).sqrt();
        Anchor::fit(at, &shown.samples(at, |s| s.inverse < between)?, random)
    };
    shown.cells(step, 0.0).filter_map(anchor).collect()
}

impl Shown<'_> {
    /// Width and height, pixels.
    pub(super) fn size(&self) -> DVec2 {
        DVec2::new(self.image.width as f64, self.image.height as f64)
    }

    /// Longer side, pixels.
    pub(super) fn long(&self) -> f64 {
        self.size().max_element()
    }

    /// Depth of a pixel where its confidence suffices.
    pub(super) fn depth_at(&self, x: usize, y: usize) -> Option<f64> {
        let z = self.depth.depth.at(x, y);
        let known = z > 0.0 && z.is_finite() && self.depth.confidence.at(x, y) >= self.min_confidence;
        known.then_some(f64::from(z))
    }

    /// Centres of square cells of `step` pixels that cover the photo and `reach` pixels around it.
    pub(super) fn cells(&self, step: f64, reach: f64) -> impl Iterator<Item = DVec2> + use<> {
        let rings = (reach / step).ceil() as i64;
        let [columns, rows] = [self.size().x, self.size().y].map(|s| (s / step).ceil() as i64);
        (-rings..rows + rings).flat_map(move |row| {
            (-rings..columns + rings)
                .map(move |column| DVec2::new(column as f64 + 0.5, row as f64 + 0.5) * step)
        })
    }

    /// Mean colour of the pixels within `half` of a position.
    fn mean_colour(&self, at: DVec2, half: f64) -> [f32; 3] {
        let (mut sum, mut count) = ([0f32; 3], 0);
        for (x, y) in self.window(at, half, 1) {
            let c = self.image.at(x, y);
            (0..3).for_each(|k| sum[k] += c[k]);
            count += 1;
        }
        sum.map(|s| s / count.max(1) as f32)
    }

    /// Pixels of every `stride`-th row and column within `half` of a position.
    fn window(&self, at: DVec2, half: f64, stride: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let range = |centre: f64, length: usize| {
            ((centre - half).max(0.0) as usize, ((centre + half).max(0.0) as usize).min(length))
        };
        let ((x0, x1), (y0, y1)) = (range(at.x, self.image.width), range(at.y, self.image.height));
        (y0..y1).step_by(stride).flat_map(move |y| (x0..x1).step_by(stride).map(move |x| (x, y)))
    }

    /// Pixels of known depth in the first window around `at` that has [`SAMPLES`] of those that
    /// `belongs` accepts, weighted towards `at`.
    fn samples(&self, at: DVec2, belongs: impl Fn(&Sample) -> bool) -> Option<Vec<Sample>> {
        let within = |half: f64| -> Vec<Sample> {
            // At most about 400 samples for any size of photo.
            let stride = (half / 10.0).ceil().max(1.0) as usize;
            let sample = |(x, y): (usize, usize)| {
                let offset = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - at;
                let weight = (-2.0 * offset.length_squared() / (half * half)).exp();
                let inverse = 1.0 / self.depth_at(x, y)?;
                Some(Sample { offset, inverse, weight, colour: self.image.at(x, y) })
            };
            self.window(at, half, stride).filter_map(sample).filter(&belongs).collect()
        };
        let half = WINDOW * self.long();
        [1.0, 2.0, 4.0].into_iter().map(|grow| within(half * grow)).find(|s| s.len() >= SAMPLES)
    }
}

/// Fits the plane with the most weight by RANSAC: the best of 60 triples (99 % sure to find a plane
/// with half of the samples, with a margin for noise), then least squares over its inliers.
fn fit_plane(samples: &[Sample], random: &mut Random) -> Option<(f64, DVec2)> {
    let agrees =
        |s: &Sample, p: DVec3| ((p.x + p.y * s.offset.x + p.z * s.offset.y) / s.inverse - 1.0).abs() < INLIER;
    let row = |s: &Sample| DVec3::new(1.0, s.offset.x, s.offset.y);
    let mut best = (0.0, None);
    for _ in 0..60 {
        let pick = [0; 3].map(|_| &samples[random.below(samples.len())]);
        let matrix = DMat3::from_cols(row(pick[0]), row(pick[1]), row(pick[2])).transpose();
        if matrix.determinant().abs() < 1e-6 {
            continue;
        }
        let plane = matrix.inverse() * DVec3::new(pick[0].inverse, pick[1].inverse, pick[2].inverse);
        let score: f64 = samples.iter().filter(|s| agrees(s, plane)).map(|s| s.weight).sum();
        if score > best.0 {
            best = (score, Some(plane));
        }
    }
    let plane = best.1?;
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for s in samples.iter().filter(|s| agrees(s, plane)) {
        let r = row(s);
        normal += DMat3::from_cols(r * r.x, r * r.y, r * r.z) * s.weight;
        right += r * (s.weight * s.inverse);
    }
    let refined = if normal.determinant() > 1e-9 { normal.inverse() * right } else { plane };
    (refined.x > 0.0 && refined.is_finite()).then(|| (refined.x, DVec2::new(refined.y, refined.z)))
}
