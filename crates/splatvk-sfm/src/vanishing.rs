//! Focal length from vanishing points (docs/internals/method.md#vanishing-points). Man-made edges
//! mostly run in three orthogonal directions, which are orthogonal in a photo only under the right
//! focal length.
use super::segments::{self, END_SIGMA};
use crate::math::Random;
use crate::scene::RgbImage;
use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;

/// Largest |ln| of a focal length tried over the prior mean: 0.38 to 2.6 times it.
const REACH: f64 = 0.96;
/// Step of ln f: 8 %, half of the uncertainty that the sharpest photos of the tuning sets leave.
const STEP: f64 = 0.08;
/// Samples of three edges per focal length: with a tenth of the edges in each of two directions, a
/// hundred samples almost surely contain the right two.
const DRAWS: usize = 600;
/// σ of an edge's direction beside that of its ends, radians (0.6°): walls, boards and lenses are
/// not quite straight.
const EDGE_FLOOR: f64 = 0.01;
/// Share of the edges that may run in any direction.
const CLUTTER: f64 = 0.5;
/// Share of the edges that count as independent: an edge has two sides, and objects in a row share
/// their tilt.
const INDEPENDENT: f64 = 0.25;
/// Largest σ of ln f of a photo that is used. Where objects stand at any angle to each other
/// (`breakfast`, `breakfast-phone`) or a photo shows two directions only, the tuning sets have 12
/// to 43 %; where walls or a table determine it, 5 to 9 %, with errors up to 8 %.
const SHARP: f64 = 0.1;
/// σ of ln f common to all photos of a set: corners that are not quite square, an off-centre
/// principal point.
const SHARED: f64 = 0.04;

/// Estimate of ln (f / long side).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LogFocal {
    pub(super) mean: f64,
    pub(super) sigma: f64,
}

/// Most photos of a camera whose edges are used: [`SHARED`] bounds the gain of more.
const MAX_PHOTOS: usize = 8;

/// Estimates ln (f / long side) of photos of one camera, from those with a σ up to [`SHARP`];
/// `None` without any. Of many photos some are used, in even steps. `prior` is on the same
/// quantity; the result includes it.
pub(super) fn log_focal<'a>(images: impl Iterator<Item = &'a RgbImage>, prior: LogFocal) -> Option<LogFocal> {
    let all: Vec<&RgbImage> = images.collect();
    let count = all.len().min(MAX_PHOTOS);
    let images: Vec<&RgbImage> = (0..count).map(|k| all[k * all.len() / count]).collect();
    let sharp = |image: &&RgbImage| Edges::of(image).log_focal(prior).filter(|f| f.sigma <= SHARP);
    combined(&images.par_iter().filter_map(sharp).collect::<Vec<_>>())
}

/// Weighted mean; σ grows where the photos differ by more than their own σ.
fn combined(found: &[LogFocal]) -> Option<LogFocal> {
    let weight = |f: &LogFocal| f.sigma.powi(-2);
    let sum: f64 = found.iter().map(weight).sum();
    let mean = found.iter().map(|f| weight(f) * f.mean).sum::<f64>() / sum;
    let excess = found.iter().map(|f| weight(f) * (f.mean - mean).powi(2)).sum::<f64>();
    let scatter = (excess / (found.len() as f64 - 1.0).max(1.0)).max(1.0);
    (!found.is_empty()).then(|| LogFocal { mean, sigma: (scatter / sum).sqrt().hypot(SHARED) })
}

/// A straight edge; ends relative to the image centre, in units of the long side.
struct Edge {
    ends: [DVec2; 2],
    /// One standard deviation of its direction, radians.
    sigma: f64,
}

struct Edges(Vec<Edge>);

/// Plane through an edge and the camera centre.
struct EdgePlane {
    normal: DVec3,
    /// Ray of the midpoint of the edge.
    middle: DVec3,
    sigma: f64,
}

impl Edges {
    fn of(image: &RgbImage) -> Edges {
        let found = segments::detect(image);
        let half = 0.5 * DVec2::new(found.width as f64, found.height as f64);
        let long = 2.0 * half.max_element();
        let edge = |s: &segments::Segment| Edge {
            ends: [(s.from - half) / long, (s.to - half) / long],
            sigma: (END_SIGMA * std::f64::consts::SQRT_2 / s.length()).hypot(EDGE_FLOOR),
        };
        Edges(found.segments.iter().map(edge).collect())
    }

    /// Posterior mean and σ over focal lengths, each with its best three orthogonal directions.
    fn log_focal(&self, prior: LogFocal) -> Option<LogFocal> {
        if self.0.len() < 3 {
            return None;
        }
        let steps = (REACH / STEP).round() as i32;
        let offsets: Vec<f64> = (-steps..=steps).map(|k| k as f64 * STEP).collect();
        let score = |x: &f64| {
            INDEPENDENT * self.best_likelihood((prior.mean + x).exp()) - 0.5 * (x / prior.sigma).powi(2)
        };
        let scores: Vec<f64> = offsets.par_iter().map(score).collect();
        let top = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = scores.iter().map(|s| (s - top).exp()).collect();
        let sum: f64 = weights.iter().sum();
        let mean = weights.iter().zip(&offsets).map(|(w, x)| w * x).sum::<f64>() / sum;
        let square = weights.iter().zip(&offsets).map(|(w, x)| w * (x - mean).powi(2)).sum::<f64>() / sum;
        // σ includes the quantisation by steps.
        Some(LogFocal { mean: prior.mean + mean, sigma: square.sqrt().hypot(STEP / 12f64.sqrt()) })
    }

    /// Log likelihood ratio of the best three orthogonal directions, against edges of any
    /// direction. `focal` in long sides.
    fn best_likelihood(&self, focal: f64) -> f64 {
        let ray = |p: DVec2| p.extend(focal).normalize();
        let planes: Vec<EdgePlane> = self
            .0
            .iter()
            .map(|Edge { ends: [a, b], sigma }| EdgePlane {
                normal: ray(*a).cross(ray(*b)).normalize_or_zero(),
                middle: ray(0.5 * (*a + *b)),
                sigma: *sigma,
            })
            .collect();
        // Equal draws for every focal length, so that their luck does not distinguish them.
        let mut rng = Random::new(0);
        // The longer of two edges, which has the smaller σ.
        let mut draw = || {
            let (a, b) = (rng.below(planes.len()), rng.below(planes.len()));
            if planes[a].sigma < planes[b].sigma { a } else { b }
        };
        let mut best = (f64::NEG_INFINITY, [DVec3::X, DVec3::Y, DVec3::Z]);
        for _ in 0..DRAWS {
            let [a, b, c] = [draw(), draw(), draw()].map(|k| planes[k].normal);
            let first = a.cross(b).normalize_or_zero();
            let second = first.cross(c).normalize_or_zero();
            if first == DVec3::ZERO || second == DVec3::ZERO {
                continue;
            }
            let axes = [first, second, first.cross(second)];
            let value = likelihood(&planes, &axes);
            if value > best.0 {
                best = (value, axes);
            }
        }
        climb_likelihood(&planes, best)
    }
}

/// Rotates three directions about the coordinate axes by ever smaller angles as long as the
/// likelihood rises; returns the likelihood.
fn climb_likelihood(planes: &[EdgePlane], mut best: (f64, [DVec3; 3])) -> f64 {
    // From the error of a drawn direction to a twentieth of that of an edge.
    let mut angle = 0.03;
    while angle > 0.0005 {
        let before = best.0;
        for turn in [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z] {
            let rotation = DQuat::from_scaled_axis(turn * angle);
            let axes = best.1.map(|d| rotation * d);
            let value = likelihood(planes, &axes);
            if value > best.0 {
                best = (value, axes);
            }
        }
        if best.0 == before {
            angle *= 0.5;
        }
    }
    best.0
}

/// Σ ln (ε + (1 − ε)/3 Σ π N(θ; σ)) with θ the angle in the image between an edge and the direction
/// to a vanishing point.
fn likelihood(planes: &[EdgePlane], axes: &[DVec3; 3]) -> f64 {
    planes.iter().map(|p| log_likelihood(p, axes)).sum()
}

fn log_likelihood(p: &EdgePlane, axes: &[DVec3; 3]) -> f64 {
    let density = |axis: &DVec3| {
        // Plane through the midpoint and the direction; sin θ ≈ θ where the density is not 0.
        let through = p.middle.cross(*axis).normalize_or_zero();
        let sine = p.normal.cross(through).length() / p.sigma;
        (-0.5 * sine * sine).exp() / p.sigma
    };
    let near: f64 = axes.iter().map(density).sum();
    let aligned = (1.0 - CLUTTER) / 3.0 * near * (0.5 * std::f64::consts::PI).sqrt();
    (CLUTTER + aligned).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRIOR: LogFocal = LogFocal { mean: -0.105, sigma: 0.35 };

    /// Edges of boxes rotated by `frames` about the vertical, seen obliquely from above, and edges
    /// of any direction.
    fn scene(focal: f64, frames: &[f64], boxes: usize, clutter: usize, seed: u64) -> Edges {
        let mut rng = Random::new(seed);
        let view = DQuat::from_rotation_x(0.5) * DQuat::from_rotation_y(0.6);
        let mut edges = Vec::new();
        let mut add = |from: DVec3, to: DVec3, rng: &mut Random| {
            let noise = |rng: &mut Random| DVec2::new(rng.normal(), rng.normal()) * (0.7 / 800.0);
            let [a, b] = [from, to].map(|p| focal * DVec2::new(p.x, p.y) / p.z);
            let length = 800.0 * a.distance(b);
            if length > 24.0 && a.abs().max(b.abs()).max_element() < 0.5 {
                let sigma = (1.0 / length).hypot(EDGE_FLOOR);
                edges.push(Edge { ends: [a + noise(rng), b + noise(rng)], sigma });
            }
        };
        for k in 0..boxes {
            let place = DVec3::new(rng.normal(), 0.3 * rng.normal(), 4.0 + rng.normal().abs());
            let turn = DQuat::from_rotation_y(frames[k % frames.len()]);
            for axis in DVec3::AXES {
                add(place, place + view * (turn * axis) * (0.3 + 0.5 * rng.uniform()), &mut rng);
            }
        }
        for _ in 0..clutter {
            let place = DVec3::new(rng.normal(), 0.6 * rng.normal(), 4.0);
            let way = DVec3::new(rng.normal(), rng.normal(), rng.normal()) * 0.3;
            add(place, place + way, &mut rng);
        }
        Edges(edges)
    }

    #[test]
    fn log_focal_of_boxes_is_sharp() {
        for (k, focal) in [0.7, 0.9, 1.2].into_iter().enumerate() {
            let found = scene(focal, &[0.0], 40, 40, k as u64).log_focal(PRIOR).unwrap();
            let error = found.mean - focal.ln();
            println!("{focal}: {error:.3} ± {:.3}", found.sigma);
            assert!(
                found.sigma < SHARP && error.abs() < 2.0 * found.sigma.hypot(SHARED),
                "{error} {found:?}"
            );
        }
    }

    #[test]
    fn log_focal_of_clutter_is_uncertain() {
        let all = [0.0, 0.3, 0.55, 0.9, 1.2];
        for seed in 0..2 {
            let loose = scene(0.9, &all, 40, 40, seed).log_focal(PRIOR).unwrap();
            let clutter = scene(0.9, &[0.0], 0, 80, seed).log_focal(PRIOR).unwrap();
            println!("{loose:?} {clutter:?}");
            for found in [loose, clutter] {
                let error = (found.mean - 0.9f64.ln()).abs();
                assert!(found.sigma > SHARP || error < 2.0 * found.sigma, "{found:?}");
            }
            assert!(clutter.sigma > SHARP);
        }
        assert_eq!(Edges(Vec::new()).log_focal(PRIOR), None);
    }

    #[test]
    fn combined_contradicting_photos_widen_sigma() {
        let one = |mean| LogFocal { mean, sigma: 0.05 };
        assert_eq!(combined(&[]), None);
        let agree = combined(&[one(0.0), one(0.02)]).unwrap();
        assert!((agree.mean - 0.01).abs() < 1e-12 && agree.sigma < 0.06, "{agree:?}");
        let differ = combined(&[one(-0.2), one(0.2)]).unwrap();
        assert!(differ.sigma > 0.15, "{differ:?}");
    }

    #[test]
    fn log_focal_of_breakfast_is_none() {
        let truth = super::super::testing::train(&super::super::testing::folder());
        assert_eq!(log_focal(truth.photos.iter().map(|p| &p.image), PRIOR), None);
    }
}
