//! Global alignment of pairwise pointmaps (docs/internals/method.md#pointmaps). The predictions of
//! networks such as MASt3R, DUSt3R and VGGT for pairs of photos become one set of cameras and depth
//! maps of one scale.
//!
//! Positions are continuous pixels of the network's input ("model pixels"); the centre of the first
//! pixel is 0.5.
mod adjust;
mod canonical;
mod dense;
mod matches;
mod normal;
mod pairs;
mod problem;
mod residual;
mod solver;
mod tree;

use super::Geometry;
use super::choose::Reason;
use super::leave_out;
use super::numeric::rotation_angle;
use crate::math::median;
use crate::progress::Progress;
use crate::scene::{ModelView, PairPointmaps, Pointmaps};
use crate::{Error, Result};
use adjust::Adjustment;
use canonical::{Canonical, Focals};
pub use matches::{PairMatches, PixelMatch, descriptor_matches, point_matches};
use pairs::Edge;
use problem::Problem;
use tree::{Registration, largest_component};

/// Aligned geometry, and the views without any.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// Geometry of the registered views, in order; its `method` names the start.
    pub geometry: Geometry,
    /// Views that no usable pair connects with the others, ascending.
    pub left_out: Vec<usize>,
}

/// Matches the pointmaps and aligns them (steps A–G); `seed` draws the samples of RANSAC. Views
/// that are not connected with most of the others are left out, with a warning each.
pub fn reconstruct(mut maps: Pointmaps, seed: u64, progress: &dyn Progress) -> Result<Reconstruction> {
    check_input(&maps)?;
    let mut matches = Vec::with_capacity(maps.pairs.len());
    for pair in &mut maps.pairs {
        progress.check()?;
        matches.push(matches::of_pair(&maps.views[pair.first], &maps.views[pair.second], pair));
        // Descriptors take most of the memory and are used only for the matches.
        pair.descriptors = None;
    }
    align(maps, matches, seed, progress)
}

/// Aligns pointmaps (steps B–G) for given matches, one list per pair.
pub fn align(
    mut maps: Pointmaps,
    mut matches: Vec<PairMatches>,
    seed: u64,
    progress: &dyn Progress,
) -> Result<Reconstruction> {
    check_input(&maps)?;
    let given = maps.views.len();
    let mut registered: Vec<usize> = (0..given).collect();
    loop {
        let used = match attempt(&maps, &matches, seed, progress)? {
            Attempt::Registered(geometry) => {
                let left_out = (0..given).filter(|v| !registered.contains(v)).collect();
                return Ok(Reconstruction { geometry: *geometry, left_out });
            }
            Attempt::Disconnected(used) => used,
        };
        let joined: Vec<[usize; 2]> =
            maps.pairs.iter().zip(&used).filter(|p| *p.1).map(|(p, _)| [p.first, p.second]).collect();
        let keep = largest_component(maps.views.len(), &joined);
        // As in structure from motion, at most half of the views do not stand for the scene.
        if 2 * keep.len() <= given {
            return Err(not_connected(&maps.views, &joined, &keep));
        }
        for v in (0..maps.views.len()).filter(|v| !keep.contains(v)) {
            progress.warn(&leave_out::message(&maps.views[v].name, &Reason::NoOverlap));
        }
        registered = keep.iter().map(|v| registered[*v]).collect();
        keep_views(&mut maps, &mut matches, &keep, &used);
    }
}

/// Geometry of all views, or true per usable pair where these do not connect all views.
enum Attempt {
    Registered(Box<Geometry>),
    Disconnected(Vec<bool>),
}

fn attempt(maps: &Pointmaps, matches: &[PairMatches], seed: u64, progress: &dyn Progress) -> Result<Attempt> {
    let (views, pairs) = (&maps.views, &maps.pairs);
    let canonical = canonical::canonical_maps(views, pairs);
    let focals = canonical::focals(views, &canonical);
    let edges: Vec<Option<Edge>> = pairs
        .iter()
        .zip(matches)
        .map(|(pair, m)| pairs::edge(views, pair, &m.matches, &canonical, &focals, seed))
        .collect();
    let usable: Vec<bool> = edges.iter().map(Option::is_some).collect();
    let starts = starts(maps, &canonical, focals, &edges.into_iter().flatten().collect::<Vec<_>>());
    if starts.is_empty() {
        return Ok(Attempt::Disconnected(usable));
    }
    let problem = Problem::new(views, &canonical, &starts[0].focals, pairs, matches);
    let (mut adjustment, method) = best_adjustment(problem, &starts, progress)?;
    if !adjustment.problem.joins_all_views() {
        return Ok(Attempt::Disconnected(adjustment.problem.pairs.iter().map(|p| p.joins()).collect()));
    }
    adjustment.normalise();
    check_parallax(views, &adjustment)?;
    progress.check()?;
    let geometry = Geometry { method: method.into(), ..dense::output(maps, &canonical, &adjustment) };
    Ok(Attempt::Registered(Box::new(geometry)))
}

/// Adjusts from every start and returns the result of the lowest match cost, with its method.
fn best_adjustment(
    problem: Problem,
    starts: &[Start],
    progress: &dyn Progress,
) -> Result<(Adjustment, &'static str)> {
    const FROM_NETWORK: &str = "pointmaps, started from the network's own cameras";
    Ok(match starts {
        [network, pairs] => {
            let a = adjusted(problem.clone(), network, progress)?;
            let b = adjusted(problem, pairs, progress)?;
            if a.total_match_cost() <= b.total_match_cost() {
                (a, FROM_NETWORK)
            } else {
                (b, "pointmaps, started from pairs: the network's own cameras explain fewer matches")
            }
        }
        [start, ..] => {
            let method = if start.origin == Origin::Network { FROM_NETWORK } else { "pointmaps" };
            (adjusted(problem, start, progress)?, method)
        }
        [] => return Err(Error::work("pointmaps without a start")),
    })
}

/// Solves from one start, and again after the removal of wrong pairs.
fn adjusted(problem: Problem, start: &Start, progress: &dyn Progress) -> Result<Adjustment> {
    let mut a = Adjustment::new(problem, &start.registration, &start.focals);
    a.solve(progress)?;
    // A pair that disagrees with all others by more than 5 px at 512 is wrong as a whole.
    if a.drop_wrong_pairs(5.0 / 512.0) && a.problem.joins_all_views() {
        a.solve(progress)?;
    }
    Ok(a)
}

/// Origin of a start.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Origin {
    Network,
    Pairs,
}

/// Initial values of the adjustment.
struct Start {
    origin: Origin,
    registration: Registration,
    focals: Focals,
}

/// Starts from the network's own cameras and from the spanning tree, where they exist; only the
/// former if both are within [`SAME_START`].
fn starts(maps: &Pointmaps, canonical: &[Canonical], focals: Focals, edges: &[Edge]) -> Vec<Start> {
    let mut out = Vec::new();
    if let Some(first) = maps.cameras.first() {
        let back = first.pose.inverse();
        let poses = maps.cameras.iter().map(|c| c.pose.compose(&back)).collect();
        // The network's cameras and its depth have the same unit.
        let registration = Registration { poses, kappa: vec![0.0; maps.views.len()] };
        let focals = focals.starting_from(&maps.cameras);
        out.push(Start { origin: Origin::Network, registration, focals });
    }
    if let Ok(registration) = tree::register(maps.views.len(), edges) {
        let pairs = Start { origin: Origin::Pairs, registration, focals };
        if out.first().is_none_or(|network| largest_difference(network, &pairs, canonical) > SAME_START) {
            out.push(pairs);
        }
    }
    out
}

/// Starts with a smaller difference count as one: 12 pixels at 512, still noise at the widest
/// Cauchy scale of the adjustment.
const SAME_START: f64 = 12.0 / 512.0;

/// Largest difference between two starts: rotation angles, distances between centres in median
/// depths of the first view, ln f.
fn largest_difference(a: &Start, b: &Start, canonical: &[Canonical]) -> f64 {
    let mut depths: Vec<f64> = canonical[0].points.iter().map(|p| p.z).filter(|z| *z > 0.0).collect();
    let depth = median(&mut depths).unwrap_or(1.0);
    let focals = a.focals.values.iter().zip(&b.focals.values).map(|(f, g)| (f / g).ln().abs());
    let poses = a.registration.poses.iter().zip(&b.registration.poses).map(|(p, q)| {
        let angle = rotation_angle(&(p.rotation * q.rotation.transpose()));
        angle.max((p.centre() - q.centre()).length() / depth)
    });
    focals.chain(poses).fold(0.0, f64::max)
}

/// Keeps the views `keep` and those `used` pairs that lie between them.
fn keep_views(maps: &mut Pointmaps, matches: &mut Vec<PairMatches>, keep: &[usize], used: &[bool]) {
    let new_index = |v: usize| keep.iter().position(|k| *k == v);
    let pairs = std::mem::take(&mut maps.pairs);
    for ((pair, m), used) in pairs.into_iter().zip(std::mem::take(matches)).zip(used) {
        if let (true, Some(first), Some(second)) = (*used, new_index(pair.first), new_index(pair.second)) {
            maps.pairs.push(PairPointmaps { first, second, ..pair });
            matches.push(m);
        }
    }
    let kept = |k: usize| keep.contains(&k);
    let mut indices = 0..;
    maps.views.retain(|_| indices.next().is_some_and(kept));
    let mut indices = 0..;
    maps.cameras.retain(|_| indices.next().is_some_and(kept));
}

fn check_input(maps: &Pointmaps) -> Result<()> {
    let views = &maps.views;
    if views.len() < 2 {
        return Err(Error::input("pointmaps need at least two photos"));
    }
    if !maps.cameras.is_empty() && maps.cameras.len() != views.len() {
        return Err(Error::input(format!(
            "{} cameras for {} photos: wrong model output",
            maps.cameras.len(),
            views.len()
        )));
    }
    for p in &maps.pairs {
        if p.first == p.second || p.first.max(p.second) >= views.len() {
            return Err(Error::input(format!(
                "pointmaps of views {} and {}: no such pair",
                p.first, p.second
            )));
        }
        for (map, view) in [(&p.x11, p.first), (&p.x21, p.second), (&p.x22, p.second), (&p.x12, p.first)] {
            let size = views[view].width * views[view].height;
            if map.points.len() != size || map.confidence.len() != size {
                return Err(Error::input(format!(
                    "pointmap of {} has {} points, its input has {} × {} pixels: wrong model output",
                    views[view].name,
                    map.points.len(),
                    views[view].width,
                    views[view].height
                )));
            }
        }
    }
    Ok(())
}

/// Error that names the pairs missing between the kept views and the others.
fn not_connected(views: &[ModelView], joined: &[[usize; 2]], keep: &[usize]) -> Error {
    let left_out = (0..views.len()).filter(|v| !keep.contains(v));
    let missing: Vec<String> = left_out
        .flat_map(|l| keep.iter().map(move |v| (l, *v)))
        .filter(|(a, b)| !joined.contains(&[*a, *b]) && !joined.contains(&[*b, *a]))
        .map(|(a, b)| format!("{}–{}", views[b].name, views[a].name))
        .collect();
    Error::input(format!(
        "photos do not overlap enough: no consistent geometry for {}; take photos that share at least half of what they show",
        missing.join(", ")
    ))
}

/// Below 0.5 % of the depth the baseline is within the error of the pointmaps: the camera only
/// rotated.
const MIN_BASELINE: f64 = 0.005;

fn check_parallax(views: &[ModelView], adjustment: &Adjustment) -> Result<()> {
    let poses = &adjustment.state.poses;
    let mut widest = 0.0f64;
    for i in 0..poses.len() {
        for j in 0..i {
            widest = widest.max((poses[i].centre() - poses[j].centre()).length());
        }
    }
    // The median depth is 1 after normalisation.
    if widest < MIN_BASELINE {
        let names: Vec<&str> = views.iter().map(|v| v.name.as_str()).collect();
        return Err(Error::input(format!(
            "no parallax between {}: the camera only turned or the photos are identical; take them from different positions",
            names.join(", ")
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests;
