//! Networks that take all photos in one call: the answer for a photo must not depend on its place
//! in the list.
//!
//! A graph that was traced with one list can hold its length or order as constants, and then gives
//! wrong cameras without an error. Attention over photos has no order of its own, but networks may
//! treat one photo as the reference, usually the first. So there are two strengths of check:
//!
//! - with the first photo in its place and the others in another order the same numbers must come,
//!   up to the rounding of sums, whatever the weights are;
//! - with another first photo, or a photo that occurs twice, a trained network gives nearly the
//!   same scene, and one with random weights gives anything.
use super::parallax::TwoViews;
use super::pictures::pictures;
use super::{Figure, Finding, Measured, Verdict, measured, record, refuse, rotation_degrees};
use crate::Result;
use crate::graph::{Graph, GraphFile};
use crate::installed::Installed;
use crate::math::median;
use crate::multiview::{self, Estimate};
use crate::prepare::Prepared;
use crate::scene::{Camera, Pose};

/// Numbers of photos for graphs that take any. Exports are traced with 1, 2 or 4 as a rule, so 3
/// and 6 are new to them.
const COUNTS: [usize; 4] = [2, 3, 4, 6];
/// Largest difference with all photos but the first in another order, relative to the largest
/// value. Measured: 5e-6 for Depth Anything 3 Base with random weights in float32. Float16 rounds a
/// thousand times coarser.
const EXACT: f64 = 0.02;
/// Sampling step of depth comparisons, pixels.
const STRIDE: usize = 7;

/// Differences between two estimates of one scene.
struct Gap {
    /// Largest distance of a camera's two centres, in extents of the cameras.
    centre: f64,
    /// Largest rotation between a camera's two poses, degrees.
    rotation: f64,
    /// Median relative difference of depth.
    depth: f64,
}

/// Differences up to which trained networks are in no doubt.
const NEAR: Gap = Gap { centre: 0.25, rotation: 5.0, depth: 0.1 };
/// Differences from which the answers of a trained network contradict one another. Cameras that
/// belong to places in the list move by twice their extent when the list is reversed, and the two
/// copies of a photo then lie apart by the distance of two cameras.
const FAR: Gap = Gap { centre: 1.0, rotation: 30.0, depth: 0.5 };
const FAR_COPIES: Gap = Gap { centre: 0.5, ..FAR };

/// Runs a multi-view graph on lists of built-in pictures; reports the parallax of the shortest one.
pub(super) fn check(model: &Installed, file: &GraphFile, steps: &mut Vec<Measured>) -> Result<()> {
    let _turn = file.compute.turn();
    let fixed = file.fixed("images", "N");
    let counts = fixed.map_or(COUNTS.to_vec(), |n| vec![n]);
    let prepared = multiview::same_size(file, &pictures(counts.iter().copied().max().unwrap_or_default()))?;
    let net = measured("network loaded".to_string(), steps, || file.load())?;
    let mut lists = Lists { model, file, net, prepared, steps };
    for (k, count) in counts.iter().copied().enumerate() {
        let straight: Vec<usize> = (0..count).collect();
        let plain = lists.run("", &straight).map_err(|e| match fixed {
            Some(_) => e,
            None => refuse(model, &format!("its number of photos is free, but {count} photos fail: {e}")),
        })?;
        if count == 1 {
            continue;
        }
        if k == 0 {
            lists.record(parallax(&plain, &lists.prepared[0]))?;
        }
        if count > 2 {
            lists.same_first(&plain)?;
        }
        // Each of the other two once is enough, if the number is free.
        if fixed.is_some() || count == 2 {
            lists.reversed(&plain)?;
        }
        if fixed.is_some() || count == 3 {
            lists.doubled(&plain)?;
        }
    }
    Ok(())
}

/// One loaded graph and the pictures that lists are made of.
struct Lists<'a> {
    model: &'a Installed,
    file: &'a GraphFile,
    net: Graph,
    prepared: Vec<Prepared>,
    steps: &'a mut Vec<Measured>,
}

impl Lists<'_> {
    /// Runs the graph on the pictures `list` and returns the answers in this order.
    fn run(&mut self, note: &str, list: &[usize]) -> Result<Estimate> {
        let prepared: Vec<Prepared> = list.iter().map(|k| self.prepared[*k].clone()).collect();
        let step = format!("geometry of {} photos{note}", list.len());
        let net = &mut self.net;
        let values = measured(step, self.steps, || multiview::forward(net, &prepared))?;
        multiview::estimate(self.file, &prepared, &values)
    }

    /// Runs the graph on the pictures `list`, each of which occurs once, and returns the answers in
    /// the order of the pictures.
    fn run_sorted(&mut self, note: &str, list: &[usize]) -> Result<Estimate> {
        let given = self.run(note, list)?;
        let mut places: Vec<usize> = (0..list.len()).collect();
        places.sort_by_key(|k| list[*k]);
        Ok(Estimate {
            cameras: places.iter().map(|k| given.cameras[*k].clone()).collect(),
            depth: places.iter().flat_map(|k| given.depth_of(*k)).copied().collect(),
            confidence: Vec::new(),
        })
    }

    fn record(&mut self, finding: Finding) -> Result<()> {
        record(self.model, self.steps, finding)
    }

    /// All photos but the first in another order.
    fn same_first(&mut self, plain: &Estimate) -> Result<()> {
        let count = plain.cameras.len();
        let list: Vec<usize> = std::iter::once(0).chain((1..count).rev()).collect();
        let other = self.run_sorted(", reversed but the first", &list)?;
        let worst = largest_difference(plain, &other);
        if let Some(last) = self.steps.last_mut() {
            last.error = Some(worst as f32);
        }
        // Comparisons with NaN are false.
        if worst <= EXACT {
            return Ok(());
        }
        let text = format!(
            "cameras or depth depend on a photo's place in the list: with all of {count} photos but the first reversed they differ \
             by {worst:.1e} of the largest value (at most {EXACT})"
        );
        Err(refuse(self.model, &text))
    }

    /// The whole list reversed, so that another photo is the first.
    fn reversed(&mut self, plain: &Estimate) -> Result<()> {
        let list: Vec<usize> = (0..plain.cameras.len()).rev().collect();
        let other = self.run_sorted(" reversed", &list)?;
        let gap = gap(plain, &other);
        self.record(gap.judge(&FAR, "reversing the list moves cameras or depth: they belong to places in it"))
    }

    /// The last but one photo also takes the place of the last.
    fn doubled(&mut self, plain: &Estimate) -> Result<()> {
        let count = plain.cameras.len();
        let list: Vec<usize> = (0..count - 1).chain([count - 2]).collect();
        let other = self.run(", the last one doubled", &list)?;
        let [a, b] = [count - 2, count - 1];
        let (one, two) = (&other.cameras[a], &other.cameras[b]);
        // Two copies have no extent of their own.
        let extent = extent(plain) / typical_depth(plain) * typical_depth(&other);
        let gap = Gap {
            centre: (one.pose.centre() - two.pose.centre()).length() / extent,
            rotation: rotation_degrees(&one.pose.rotation, &two.pose.rotation),
            depth: depth_difference(other.depth_of(a), other.depth_of(b), 1.0),
        };
        self.record(gap.judge(&FAR_COPIES, "two copies of a photo get different cameras or depth"))
    }
}

impl Gap {
    fn judge(&self, far: &Gap, fault: &str) -> Finding {
        let figures = vec![
            Figure::new("centres", self.centre, "extents"),
            Figure::new("rotation", self.rotation, "°"),
            Figure::new("depth", 100.0 * self.depth, "%"),
        ];
        let text = |limit: &Gap| {
            format!(
                "centres by {:.2} of their extent (at most {}), rotation {:.1}° ({}°), depth {:.0} % ({} %)",
                self.centre,
                limit.centre,
                self.rotation,
                limit.rotation,
                100.0 * self.depth,
                100.0 * limit.depth
            )
        };
        let verdict = match (self.within(&NEAR), self.within(far)) {
            (true, _) => Verdict::Sound,
            (_, true) => Verdict::Doubt(format!("its answers vary with the list of photos: {}", text(&NEAR))),
            _ => Verdict::Fault(format!("{fault}: {}", text(far))),
        };
        Finding { figures, verdict }
    }

    /// NaN is not within any limit.
    fn within(&self, limit: &Gap) -> bool {
        self.centre <= limit.centre && self.rotation <= limit.rotation && self.depth <= limit.depth
    }
}

fn parallax(found: &Estimate, first: &Prepared) -> Finding {
    let [one, two] = [&found.cameras[0].pose, &found.cameras[1].pose];
    let depth = found.depth_of(0);
    let size = [first.width, first.height];
    TwoViews::new(two.compose(&one.inverse()), &first.from_photo, size, |k| f64::from(depth[k])).judge()
}

/// Largest difference of depth, rotations, centres and focal lengths, each relative to its largest
/// value. Poses are compared relative to the first camera.
fn largest_difference(a: &Estimate, b: &Estimate) -> f64 {
    let largest = a.depth.iter().fold(f32::MIN_POSITIVE, |m, z| m.max(z.abs()));
    let depth = a.depth.iter().zip(&b.depth).fold(0f32, |m, (x, y)| m.max((x - y).abs())) / largest;
    let extent = extent(a);
    let camera = |k: usize| {
        let [p, q] = [a, b].map(|e| relative(e, k));
        let turned = rotation_degrees(&p.rotation, &q.rotation).to_radians();
        let moved = (p.centre() - q.centre()).length() / extent;
        let focal = (b.cameras[k].fx / a.cameras[k].fx - 1.0).abs();
        [turned, moved, focal].into_iter().fold(0.0, larger)
    };
    (0..a.cameras.len()).map(camera).fold(f64::from(depth), larger)
}

/// Differences of two answers for the same photos in the same order, up to scale.
fn gap(a: &Estimate, b: &Estimate) -> Gap {
    let mut ratios: Vec<f64> = ratios(&a.depth, &b.depth).collect();
    let scale = median(&mut ratios).unwrap_or(f64::NAN);
    let extent = extent(a);
    let cameras = || (0..a.cameras.len()).map(|k| (relative(a, k), relative(b, k)));
    Gap {
        centre: cameras().map(|(p, q)| (p.centre() - scale * q.centre()).length() / extent).fold(0.0, larger),
        rotation: cameras().map(|(p, q)| rotation_degrees(&p.rotation, &q.rotation)).fold(0.0, larger),
        depth: depth_difference(&a.depth, &b.depth, scale),
    }
}

/// Keeps NaN, which `f64::max` drops.
fn larger(a: f64, b: f64) -> f64 {
    if b > a || b.is_nan() { b } else { a }
}

/// First camera → camera `k`.
fn relative(e: &Estimate, k: usize) -> Pose {
    e.cameras[k].pose.compose(&e.cameras[0].pose.inverse())
}

/// Largest distance of a camera from the first; of cameras at one place a thousandth of the depth.
fn extent(e: &Estimate) -> f64 {
    let centre = |c: &Camera| c.pose.centre();
    let from_first = |c: &Camera| (centre(c) - centre(&e.cameras[0])).length();
    e.cameras.iter().map(from_first).fold(1e-3 * typical_depth(e), f64::max)
}

fn typical_depth(e: &Estimate) -> f64 {
    let mut values: Vec<f64> = e.depth.iter().step_by(STRIDE).map(|z| f64::from(z.abs())).collect();
    median(&mut values).unwrap_or_default().max(f64::MIN_POSITIVE)
}

/// a / b where both are positive.
fn ratios<'a>(a: &'a [f32], b: &'a [f32]) -> impl Iterator<Item = f64> + 'a {
    let both = a.iter().zip(b).step_by(STRIDE).filter(|(x, y)| **x > 0.0 && **y > 0.0);
    both.map(|(x, y)| f64::from(*x) / f64::from(*y))
}

/// Median of |scale · b / a − 1|; NaN if depth is nowhere positive.
fn depth_difference(a: &[f32], b: &[f32], scale: f64) -> f64 {
    let mut off: Vec<f64> = ratios(a, b).map(|r| (scale / r - 1.0).abs()).collect();
    median(&mut off).unwrap_or(f64::NAN)
}
