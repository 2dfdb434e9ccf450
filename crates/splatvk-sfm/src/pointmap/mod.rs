//! Pairwise pointmaps to cameras and dense points (docs/internals/method.md#pointmaps): what
//! networks such as MASt3R, DUSt3R and VGGT predict for pairs of photos is brought to one scale,
//! one set of cameras and one set of depth maps.
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
use tree::{Placement, largest_component};

/// Cameras, depth and points, and for which photos.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// Of the placed views, in order. Its method says where the adjustment started.
    pub geometry: Geometry,
    /// Views that no pair joins to the others, ascending.
    pub left_out: Vec<usize>,
}

/// Steps A–G; `seed` draws the samples of RANSAC. Views that do not hold together with most of the
/// others are left out, with a warning each.
pub fn reconstruct(mut maps: Pointmaps, seed: u64, progress: &dyn Progress) -> Result<Reconstruction> {
    check(&maps)?;
    let mut matches = Vec::with_capacity(maps.pairs.len());
    for pair in &mut maps.pairs {
        progress.check()?;
        matches.push(matches::of_pair(&maps.views[pair.first], &maps.views[pair.second], pair));
        // They take most of the memory, and have served.
        pair.descriptors = None;
    }
    align(maps, matches, seed, progress)
}

/// Steps B–G for given matches, one list per pair.
pub fn align(
    mut maps: Pointmaps,
    mut matches: Vec<PairMatches>,
    seed: u64,
    progress: &dyn Progress,
) -> Result<Reconstruction> {
    check(&maps)?;
    let given = maps.views.len();
    let mut placed: Vec<usize> = (0..given).collect();
    loop {
        let used = match attempt(&maps, &matches, seed, progress)? {
            Attempt::Placed(geometry) => {
                let left_out = (0..given).filter(|v| !placed.contains(v)).collect();
                return Ok(Reconstruction { geometry: *geometry, left_out });
            }
            Attempt::Apart(used) => used,
        };
        let joined: Vec<[usize; 2]> =
            maps.pairs.iter().zip(&used).filter(|p| *p.1).map(|(p, _)| [p.first, p.second]).collect();
        let keep = largest_component(maps.views.len(), &joined);
        // As structure from motion does: what fewer agree on says nothing about the others.
        if 2 * keep.len() <= given {
            return Err(not_connected(&maps.views, &joined, &keep));
        }
        for v in (0..maps.views.len()).filter(|v| !keep.contains(v)) {
            progress.warn(&leave_out::message(&maps.views[v].name, &Reason::NoOverlap));
        }
        placed = keep.iter().map(|v| placed[*v]).collect();
        restrict(&mut maps, &mut matches, &keep, &used);
    }
}

/// Cameras for all views, or which pairs are usable while these do not join all views.
enum Attempt {
    Placed(Box<Geometry>),
    Apart(Vec<bool>),
}

fn attempt(maps: &Pointmaps, matches: &[PairMatches], seed: u64, progress: &dyn Progress) -> Result<Attempt> {
    let (views, pairs) = (&maps.views, &maps.pairs);
    let canonical = canonical::all(views, pairs);
    let focals = canonical::focals(views, &canonical);
    let edges: Vec<Option<Edge>> = pairs
        .iter()
        .zip(matches)
        .map(|(pair, m)| pairs::edge(views, pair, &m.matches, &canonical, &focals, seed))
        .collect();
    let usable: Vec<bool> = edges.iter().map(Option::is_some).collect();
    let starts = starts(maps, &canonical, focals, &edges.into_iter().flatten().collect::<Vec<_>>());
    if starts.is_empty() {
        return Ok(Attempt::Apart(usable));
    }
    let problem = Problem::new(views, &canonical, &starts[0].focals, pairs, matches);
    let (mut adjustment, method) = best_adjustment(problem, &starts, progress)?;
    if !adjustment.problem.joins_all_views() {
        return Ok(Attempt::Apart(adjustment.problem.pairs.iter().map(|p| p.joins()).collect()));
    }
    adjustment.normalise();
    parallax(views, &adjustment)?;
    progress.check()?;
    let geometry = Geometry { method: method.into(), ..dense::output(maps, &canonical, &adjustment) };
    Ok(Attempt::Placed(Box::new(geometry)))
}

/// Of the adjustments from all starts the one that explains the matches best, and where it started.
fn best_adjustment(
    problem: Problem,
    starts: &[Start],
    progress: &dyn Progress,
) -> Result<(Adjustment, &'static str)> {
    let solved = |problem: Problem, start: &Start| -> Result<Adjustment> {
        let mut a = Adjustment::new(problem, &start.placement, &start.focals);
        a.solve(progress)?;
        // A pair that disagrees with all others by more than 5 px at 512 is wrong as a whole.
        if a.drop_wrong_pairs(5.0 / 512.0) && a.problem.joins_all_views() {
            a.solve(progress)?;
        }
        Ok(a)
    };
    const FROM_NETWORK: &str = "pointmaps, started from the network's own cameras";
    Ok(match starts {
        [network, pairs] => {
            let (a, b) = (solved(problem.clone(), network)?, solved(problem, pairs)?);
            if a.disagreement() <= b.disagreement() {
                (a, FROM_NETWORK)
            } else {
                (b, "pointmaps, started from pairs: the network's own cameras explain fewer matches")
            }
        }
        [start, ..] => {
            let method = if start.origin == Origin::Network { FROM_NETWORK } else { "pointmaps" };
            (solved(problem, start)?, method)
        }
        [] => return Err(Error::work("pointmaps without a start")),
    })
}

/// Where a start comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Origin {
    Network,
    Pairs,
}

/// Where the adjustment may start.
struct Start {
    origin: Origin,
    placement: Placement,
    focals: Focals,
}

/// The network's own cameras and those of the spanning tree, as far as there are any; where both
/// are much the same, only the former.
fn starts(maps: &Pointmaps, canonical: &[Canonical], focals: Focals, edges: &[Edge]) -> Vec<Start> {
    let mut out = Vec::new();
    if let Some(first) = maps.cameras.first() {
        let back = first.pose.inverse();
        let poses = maps.cameras.iter().map(|c| c.pose.compose(&back)).collect();
        // Cameras and depth have one unit.
        let placement = Placement { poses, kappa: vec![0.0; maps.views.len()] };
        out.push(Start { origin: Origin::Network, placement, focals: focals.started(&maps.cameras) });
    }
    if let Ok(placement) = tree::place(maps.views.len(), edges) {
        let pairs = Start { origin: Origin::Pairs, placement, focals };
        if out.first().is_none_or(|network| apart(network, &pairs, canonical) > ALIKE) {
            out.push(pairs);
        }
    }
    out
}

/// Starts this near are one: 12 pixels at 512, which the widest Cauchy scale of the adjustment
/// still takes for noise.
const ALIKE: f64 = 12.0 / 512.0;

/// Largest difference of two starts: angles, distances between centres in depths of the first view,
/// ln f.
fn apart(a: &Start, b: &Start, canonical: &[Canonical]) -> f64 {
    let mut depths: Vec<f64> = canonical[0].points.iter().map(|p| p.z).filter(|z| *z > 0.0).collect();
    let depth = median(&mut depths).unwrap_or(1.0);
    let focals = a.focals.values.iter().zip(&b.focals.values).map(|(f, g)| (f / g).ln().abs());
    let poses = a.placement.poses.iter().zip(&b.placement.poses).map(|(p, q)| {
        let turn = rotation_angle(&(p.rotation * q.rotation.transpose()));
        turn.max((p.centre() - q.centre()).length() / depth)
    });
    focals.chain(poses).fold(0.0, f64::max)
}

/// Keeps the views `keep` and of the pairs between them those that are `used`.
fn restrict(maps: &mut Pointmaps, matches: &mut Vec<PairMatches>, keep: &[usize], used: &[bool]) {
    let place = |v: usize| keep.iter().position(|k| *k == v);
    let pairs = std::mem::take(&mut maps.pairs);
    for ((pair, m), used) in pairs.into_iter().zip(std::mem::take(matches)).zip(used) {
        if let (true, Some(first), Some(second)) = (*used, place(pair.first), place(pair.second)) {
            maps.pairs.push(PairPointmaps { first, second, ..pair });
            matches.push(m);
        }
    }
    let kept = |k: usize| keep.contains(&k);
    let mut at = 0..;
    maps.views.retain(|_| at.next().is_some_and(kept));
    let mut at = 0..;
    maps.cameras.retain(|_| at.next().is_some_and(kept));
}

fn check(maps: &Pointmaps) -> Result<()> {
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

/// Names the pairs that are missing between the views that hold together and the others.
fn not_connected(views: &[ModelView], joined: &[[usize; 2]], keep: &[usize]) -> Error {
    let left = (0..views.len()).filter(|v| !keep.contains(v));
    let bad: Vec<String> = left
        .flat_map(|l| keep.iter().map(move |v| (l, *v)))
        .filter(|(a, b)| !joined.contains(&[*a, *b]) && !joined.contains(&[*b, *a]))
        .map(|(a, b)| format!("{}–{}", views[b].name, views[a].name))
        .collect();
    Error::input(format!(
        "photos do not overlap enough: no consistent geometry for {}; take photos that share at least half of what they show",
        bad.join(", ")
    ))
}

/// Below 0.5 % of the depth the baseline is within the error of the pointmaps: the camera only
/// turned.
const MIN_BASELINE: f64 = 0.005;

fn parallax(views: &[ModelView], adjustment: &Adjustment) -> Result<()> {
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
