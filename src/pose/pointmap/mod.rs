//! Pairwise pointmaps to cameras and dense points (docs/method.md#pointmaps): what networks such as MASt3R, DUSt3R and
//! VGGT predict for pairs of photos is brought to one scale, one set of cameras and one set of depth maps.
//!
//! Positions are continuous pixels of the network's input ("model pixels"); the centre of the first pixel is 0.5.
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
use crate::progress::Progress;
use crate::scene::{ModelView, PairPointmaps};
use crate::{Error, Result};
use adjust::Adjustment;
pub use matches::{PairMatches, PixelMatch, descriptor_matches, point_matches};
use pairs::Edge;

/// Steps A–G; `seed` draws the samples of RANSAC.
pub fn reconstruct(
    views: &[ModelView],
    pairs: &[PairPointmaps],
    seed: u64,
    progress: &dyn Progress,
) -> Result<Geometry> {
    check(views, pairs)?;
    let mut matches = Vec::with_capacity(pairs.len());
    for pair in pairs {
        progress.check()?;
        matches.push(matches::of_pair(&views[pair.first], &views[pair.second], pair));
    }
    align(views, pairs, &matches, seed, progress)
}

/// Steps B–G for given matches, one list per pair.
pub fn align(
    views: &[ModelView],
    pairs: &[PairPointmaps],
    matches: &[PairMatches],
    seed: u64,
    progress: &dyn Progress,
) -> Result<Geometry> {
    check(views, pairs)?;
    let canonical = canonical::all(views, pairs);
    let focals = canonical::focals(views, &canonical);
    let edges: Vec<Edge> = pairs
        .iter()
        .zip(matches)
        .filter_map(|(pair, m)| pairs::edge(views, pair, &m.matches, &canonical, &focals, seed))
        .collect();
    let start = tree::place(views.len(), &edges).map_err(|left| not_connected(views, &edges, &left))?;
    progress.check()?;
    let mut adjustment = Adjustment::new(views, &canonical, &focals, &start, pairs, matches);
    adjustment.solve(progress)?;
    // A pair that disagrees with all others by more than 5 px at 512 is wrong as a whole.
    if adjustment.drop_wrong_pairs(5.0 / 512.0) {
        adjustment.solve(progress)?;
    }
    adjustment.normalise();
    parallax(views, &adjustment)?;
    progress.check()?;
    Ok(dense::output(views, &canonical, &adjustment))
}

fn check(views: &[ModelView], pairs: &[PairPointmaps]) -> Result<()> {
    if views.len() < 2 {
        return Err(Error::input("pointmaps need at least two photos"));
    }
    for p in pairs {
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

/// Names the pairs that hold the views together, and those that are missing.
fn not_connected(views: &[ModelView], edges: &[Edge], left: &[usize]) -> Error {
    let bad: Vec<String> = left
        .iter()
        .flat_map(|l| (0..views.len()).filter(move |v| !left.contains(v)).map(move |v| (*l, v)))
        .filter(|(a, b)| {
            !edges.iter().any(|e| [e.first, e.second] == [*a, *b] || [e.second, e.first] == [*a, *b])
        })
        .map(|(a, b)| format!("{}–{}", views[b].name, views[a].name))
        .collect();
    Error::input(format!(
        "photos do not overlap enough: no consistent geometry for {}; take photos that share at least half of what they show",
        bad.join(", ")
    ))
}

/// Below 0.5 % of the depth the baseline is within the error of the pointmaps: the camera only turned.
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
