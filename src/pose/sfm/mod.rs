//! Structure from motion: the built-in initialiser that needs no large model.
mod added;
mod families;
mod finish;
mod grow;
mod known;
mod model;
mod optics;
mod pair;
mod patch;
mod prior;
mod refine;
mod relate;
mod tracks;
mod unplaced;

use super::SparseModel;
use super::choose::Reason;
use super::matching::Keypoints;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::{Error, Result};
pub use added::{Known, with_added};
use families::{corner_families, keypoints};
use finish::{AGREED, Evidence, agreement, finish};
use grow::grow;
pub use known::with_cameras;
use model::{Model, Sighting};
use pair::Pair;
use prior::empty_model;
use relate::{MIN_INLIERS, Related, THRESHOLD};
use tracks::KeypointMatch;
pub use unplaced::Unplaced;

/// Cameras and sparse points from photos and their learned features (one per photo; may be empty, then only the
/// built-in corner detector is used). `seed` draws the samples of RANSAC.
pub fn reconstruct(
    photos: &[Photo],
    features: &[Keypoints],
    seed: u64,
    progress: &dyn Progress,
) -> Result<SparseModel, Unplaced> {
    if photos.len() < 2 {
        return Err(Error::input("cameras need at least two photos; give two or more").into());
    }
    progress.begin("cameras", STEPS);
    progress.step(0, "corners");
    let mut families = corner_families(photos, features, progress)?;
    progress.step(1, "matches");
    let empty = empty_model(photos, seed);
    let Related { putative, pairs } = relate::related(photos, &mut families, &empty, progress)?;
    progress.step(2, "poses");
    let keypoints: Vec<Vec<Sighting>> = (0..photos.len()).map(|v| keypoints(&families, v)).collect();
    let model = assemble(photos, &keypoints, empty, &pairs, progress)?;
    progress.step(3, "refining");
    let model = finish(photos, model, &Evidence { putative, pairs, keypoints }, progress)?;
    check_points(photos, &model)?;
    progress.step(STEPS, &format!("{} points", model.points.len()));
    progress.end();
    Ok(model)
}

/// An error that names the photos whose place rests on too few points.
fn check_points(photos: &[Photo], model: &SparseModel) -> Result<(), Unplaced> {
    let mut counts = vec![0; photos.len()];
    model.points.iter().flat_map(|p| &p.views).for_each(|(view, _)| counts[*view] += 1);
    let views: Vec<_> =
        (0..photos.len()).filter(|v| counts[*v] < MIN_INLIERS).map(|v| (v, Reason::NoOverlap)).collect();
    if views.is_empty() {
        return Ok(());
    }
    let names: Vec<String> =
        views.iter().map(|(v, _)| format!("{} ({})", photos[*v].stem, counts[*v])).collect();
    let error = Error::input(format!(
        "too few points that the photos agree on to place {}; replace them or add photos in between",
        names.join(", ")
    ));
    Err(Unplaced { views, error })
}

/// Steps of the progress bar: corners, matches, poses, refinement, extension.
const STEPS: u64 = 5;

/// Seeds that a reconstruction may grow from.
const SEEDS: usize = 3;

/// Cameras and triangulated tracks of all photos from the pairs that agree.
fn assemble(
    photos: &[Photo],
    points: &[Vec<Sighting>],
    mut empty: Model,
    pairs: &[Pair],
    progress: &dyn Progress,
) -> Result<Model, Unplaced> {
    let mut links: Vec<KeypointMatch> =
        pairs.iter().flat_map(|p| p.matches.list.iter().map(|m| m.2)).collect();
    let tracks = tracks::join(&mut links, points);
    // The pair estimates vote on the focal stretch, weighted by matches and parallax.
    for g in 0..empty.optics.len() {
        let (mut sum, mut weight) = (0.0, 1e-9);
        let of_group = |p: &&Pair| [p.matches.first, p.matches.second].iter().any(|v| empty.group[*v] == g);
        for p in pairs.iter().filter(of_group) {
            let w = grow::seed_score(p);
            sum += w * p.geometry.stretch.ln();
            weight += w;
        }
        empty.optics[g].focal *= (sum / weight).exp();
    }
    let long = photos[0].image.width.max(photos[0].image.height) as f64;
    let threshold = THRESHOLD * long;
    let mut seeds: Vec<&Pair> = pairs.iter().collect();
    seeds.sort_by(|a, b| grow::seed_score(b).total_cmp(&grow::seed_score(a)));
    seeds.truncate(SEEDS);
    // Photos of one camera first; where that contradicts the pairs, every photo with its own focal length. That explains much
    // that is wrong for other reasons, so it must settle the matter.
    let apart = empty.with_separate_optics();
    let attempts =
        std::iter::once(&empty).chain(&apart).flat_map(|start| seeds.iter().map(move |s| (start, *s)));
    let mut best: Option<(f64, Model)> = None;
    let mut stuck = Vec::new();
    for (start, seed) in attempts {
        progress.check()?;
        let model = match grow(start, &tracks, pairs, seed, threshold) {
            Ok(model) => model,
            Err(s) => {
                if stuck.is_empty() || s.left.len() < stuck.len() {
                    stuck = s.left;
                }
                continue;
            }
        };
        let worst = agreement(&model, pairs, threshold).into_iter().fold(1.0, f64::min);
        let together = start.group == empty.group;
        if worst > AGREED || best.as_ref().is_none_or(|b| together && worst > b.0) {
            best = Some((worst, model));
        }
        if worst > AGREED {
            break;
        }
    }
    let names = || stuck.iter().map(|v| photos[*v].stem.as_str()).collect::<Vec<_>>().join(", ");
    best.map(|b| b.1).ok_or_else(|| {
        let error = Error::input(format!(
            "no camera position found for {}; these photos share too little with the others: replace them or add photos in between",
            names()
        ));
        Unplaced { views: stuck.iter().map(|v| (*v, Reason::NoOverlap)).collect(), error }
    })
}

#[cfg(test)]
mod tests;
