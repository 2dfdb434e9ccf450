//! Focal length from vanishing points: edges of most things that people build run in three
//! directions at right angles, and only the right focal length makes the directions that a photo
//! shows so (docs/internals/method.md#vanishing-points).
use super::segments::{self, END_SIGMA};
use crate::math::Random;
use crate::scene::RgbImage;
use glam::{DQuat, DVec2, DVec3};
use rayon::prelude::*;

/// Focal lengths tried, natural logarithms about the middle of the prior: 0.38 to 2.6 times it …
const REACH: f64 = 0.96;
/// … in steps of 8 %: half of what the sharpest photos of the tuning sets leave open.
const STEP: f64 = 0.08;
/// Triples of edges tried as three directions, per focal length: of edges of which a tenth runs in
/// each of two directions, with a hundred the right two are drawn almost surely.
const DRAWS: usize = 600;
/// Error of an edge's direction beside that of its ends, radians (0.6°): walls, boards and lenses
/// are not quite straight.
const EDGE_FLOOR: f64 = 0.01;
/// Share of the edges that may run in any direction.
const CLUTTER: f64 = 0.5;
/// Share of the edges that count as independent: an edge has two sides, and what stands in a row
/// leans in a row.
const INDEPENDENT: f64 = 0.25;
/// Largest σ of ln f that one photo may leave for it to count. Where things stand at any angle to
/// each other (`breakfast`, `breakfast-phone`) or a photo shows two directions only, the tuning
/// sets have 12 to 43 %; where walls or a table fix it, 5 to 9 %, with errors up to 8 %.
const SHARP: f64 = 0.1;
/// σ of ln f that all photos of a set share: corners that are not quite square, an optical axis off
/// the middle.
const SHARED: f64 = 0.04;

/// What a photo or several say of ln (f / long side).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LogFocal {
    pub(super) mean: f64,
    pub(super) sigma: f64,
}

/// ln (f / long side) of photos that one camera took, from those that show it sharply; `None` if
/// none does. `prior` is on the same quantity and counted once.
pub(super) fn log_focal<'a>(images: impl Iterator<Item = &'a RgbImage>, prior: LogFocal) -> Option<LogFocal> {
    let sharp: Vec<LogFocal> =
        images.filter_map(|image| Edges::of(image).log_focal(prior)).filter(|f| f.sigma <= SHARP).collect();
    joined(&sharp)
}

/// Weighted mean; where the photos differ by more than they state, they all know less.
fn joined(found: &[LogFocal]) -> Option<LogFocal> {
    let weight = |f: &LogFocal| f.sigma.powi(-2);
    let sum: f64 = found.iter().map(weight).sum();
    let mean = found.iter().map(|f| weight(f) * f.mean).sum::<f64>() / sum;
    let excess = found.iter().map(|f| weight(f) * (f.mean - mean).powi(2)).sum::<f64>();
    let scatter = (excess / (found.len() as f64 - 1.0).max(1.0)).max(1.0);
    (!found.is_empty()).then(|| LogFocal { mean, sigma: (scatter / sum).sqrt().hypot(SHARED) })
}

/// A straight edge, its ends from the middle of the photo in units of the long side.
struct Edge {
    ends: [DVec2; 2],
    /// One standard deviation of its direction, radians.
    sigma: f64,
}

struct Edges(Vec<Edge>);

/// The plane of an edge and the centre of the camera.
struct EdgePlane {
    normal: DVec3,
    /// Ray of the middle of the edge.
    middle: DVec3,
    sigma: f64,
}

impl Edges {
    fn of(image: &RgbImage) -> Edges {
        let found = segments::of(image);
        let half = 0.5 * DVec2::new(found.width as f64, found.height as f64);
        let long = 2.0 * half.max_element();
        let edge = |s: &segments::Segment| Edge {
            ends: [(s.from - half) / long, (s.to - half) / long],
            sigma: (END_SIGMA * std::f64::consts::SQRT_2 / s.length()).hypot(EDGE_FLOOR),
        };
        Edges(found.segments.iter().map(edge).collect())
    }

    /// Mean and deviation of the posterior over focal lengths, each with the three directions that
    /// suit it best.
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
        // A peak between two steps is no sharper than they are.
        Some(LogFocal { mean: prior.mean + mean, sigma: square.sqrt().hypot(STEP / 12f64.sqrt()) })
    }

    /// Log likelihood ratio against edges of any direction, with the best three directions at right
    /// angles. `focal` in long sides.
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
        // The same draws for every focal length: their luck is not to tell them apart.
        let mut rng = Random::new(0);
        // Long edges have small σ and say most.
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
        climb(&planes, best)
    }
}

/// Turns three directions about the coordinate axes by ever smaller angles as long as the
/// likelihood rises.
fn climb(planes: &[EdgePlane], mut best: (f64, [DVec3; 3])) -> f64 {
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

/// Σ ln (ε + (1 − ε)/3 Σ π N(θ; σ)) with θ the angle in the picture between an edge and the way to
/// a vanishing point.
fn likelihood(planes: &[EdgePlane], axes: &[DVec3; 3]) -> f64 {
    let one = |p: &EdgePlane| {
        let density = |axis: &DVec3| {
            // The plane of the edge's middle and the direction; sin θ ≈ θ where the density is not
            // 0.
            let through = p.middle.cross(*axis).normalize_or_zero();
            let sine = p.normal.cross(through).length() / p.sigma;
            (-0.5 * sine * sine).exp() / p.sigma
        };
        let near: f64 = axes.iter().map(density).sum();
        let aligned = (1.0 - CLUTTER) / 3.0 * near * (0.5 * std::f64::consts::PI).sqrt();
        (CLUTTER + aligned).ln()
    };
    planes.iter().map(one).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRIOR: LogFocal = LogFocal { mean: -0.105, sigma: 0.35 };

    /// Edges of boxes that stand in `frames`, seen from above at an angle, and edges of any
    /// direction.
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
    fn boxes_at_right_angles_tell_the_focal_length() {
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
    fn what_stands_at_any_angle_tells_nothing() {
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
    fn photos_that_contradict_each_other_know_less() {
        let one = |mean| LogFocal { mean, sigma: 0.05 };
        assert_eq!(joined(&[]), None);
        let agree = joined(&[one(0.0), one(0.02)]).unwrap();
        assert!((agree.mean - 0.01).abs() < 1e-12 && agree.sigma < 0.06, "{agree:?}");
        let differ = joined(&[one(-0.2), one(0.2)]).unwrap();
        assert!(differ.sigma > 0.15, "{differ:?}");
    }

    #[test]
    fn breakfast_leaves_it_open() {
        let truth = super::super::testing::train(&super::super::testing::folder());
        assert_eq!(log_focal(truth.photos.iter().map(|p| &p.image), PRIOR), None);
    }
}
