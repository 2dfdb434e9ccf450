//! Structure from motion: the built-in initialiser that needs no large model.
mod added;
mod crops;
mod families;
mod finish;
mod fit;
mod grow;
mod known;
mod model;
mod optics;
mod pair;
mod patch;
mod refine;
mod relate;
mod together;
mod tracks;
mod unplaced;

use super::SparseModel;
use super::bundle::{Optics, OpticsPrior};
use super::choose::Reason;
use super::matching::Keypoints;
use super::vanishing::{self, LogFocal};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::Lens;
use crate::{Error, Result};
pub use added::{Known, with_added};
use families::{corner_families, keypoints};
use finish::{AGREED, Evidence, agreement, finish};
use glam::DVec2;
use grow::grow;
pub use known::with_cameras;
use model::{Freedom, Model, SHIFT_SIGMA, Sighting};
use pair::Pair;
use relate::{MIN_INLIERS, Related, THRESHOLD};
use tracks::KeypointMatch;
pub use unplaced::Unplaced;

/// ln f of a photo without EXIF: 0.9 × the long side covers phones (0.8) to normal lenses (1.2)
/// within one σ.
const FOCAL_GUESS: f64 = 0.9;
const FOCAL_SIGMA: f64 = 0.35;
/// EXIF focal lengths are rounded and sensors are cropped.
const EXIF_SIGMA: f64 = 0.05;
/// Radial distortion at the corner of a photo, as a share of the radius: below a hundredth where a
/// phone has corrected it, a twentieth for plain wide lenses.
const LENS_SIGMA: f64 = 0.05;
/// Cameras and sparse points from photos and their learned features (one per photo; may be empty,
/// then only the built-in corner detector is used). `seed` draws the samples of RANSAC.
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
    let putative = relate::putative_matches(photos, &families, progress)?;
    let flat = relate::flat_photos(photos, &putative, seed);
    let empty = empty_model(photos, &flat, seed);
    let Related { putative, pairs } = relate::related(photos, &mut families, putative, &empty, progress)?;
    progress.step(2, "poses");
    let keypoints: Vec<Vec<Sighting>> = (0..photos.len()).map(|v| keypoints(&families, v)).collect();
    let model = assemble(photos, &keypoints, empty, &pairs, progress)?;
    progress.step(3, "refining");
    let mut model = finish(photos, model, &Evidence { putative, pairs, keypoints }, progress)?;
    model.flat = flat.into_iter().all(|f| f);
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

/// Cameras, numbered in any way, if photos share one only where their files name it and its zoom.
/// What such photos say against it is then image stabilisation, which moves the lens from photo to
/// photo, and no other camera.
fn separable(photos: &[Photo], group: &[usize]) -> Vec<usize> {
    let named = |p: &Photo| p.camera_model.is_some() && p.exif_focal.is_some();
    let first = |v: usize| group.iter().position(|g| *g == group[v]).unwrap_or(v);
    photos.iter().enumerate().map(|(v, p)| if named(p) { first(v) } else { v }).collect()
}

/// Groups and priors of the optics from the files, and from the edges in photos that are not
/// `flat`: lines in one plane run in two directions at right angles at most, and what looks like a
/// third has another reason.
fn empty_model(photos: &[Photo], flat: &[bool], seed: u64) -> Model {
    let zoom: Vec<f64> = photos.iter().map(Photo::zoom).collect();
    let sides = |v: usize| photos[v].picture_size();
    let long = |v: usize| f64::max(sides(v)[0], sides(v)[1]);
    let group = crate::photo::cameras_by_file(photos);
    // The first photo of each group stands for it.
    let cameras = group.iter().max().map_or(0, |g| g + 1);
    let firsts: Vec<usize> = (0..cameras).filter_map(|g| group.iter().position(|o| *o == g)).collect();
    let priors: Vec<OpticsPrior> = firsts
        .iter()
        .enumerate()
        .map(|(g, &v)| {
            let members = || photos.iter().zip(&group).filter(|m| *m.1 == g).map(|m| m.0);
            let log_focal = match photos[v].original_focal() {
                Some(f) => (f.ln(), EXIF_SIGMA),
                None => {
                    let guess = LogFocal { mean: FOCAL_GUESS.ln(), sigma: FOCAL_SIGMA };
                    let deep =
                        photos.iter().zip(flat).zip(&group).filter(|((_, flat), of)| !**flat && **of == g);
                    let images = deep.map(|((p, _), _)| &p.image);
                    let LogFocal { mean, sigma } = vanishing::log_focal(images, guess).unwrap_or(guess);
                    (mean + long(v).ln(), sigma)
                }
            };
            let corner = 0.5 * f64::hypot(sides(v)[0], sides(v)[1]) / log_focal.0.exp();
            // Upright photos of a camera that was turned hold its principal point in other places.
            let one_way = members().all(|p| p.original_size == photos[v].original_size);
            OpticsPrior {
                log_focal,
                lens: [LENS_SIGMA / corner.powi(2), 0.5 * LENS_SIGMA / corner.powi(4)],
                shift: if one_way { (SHIFT_SIGMA * long(v)).max(photos[v].off_middle()) } else { 0.0 },
            }
        })
        .collect();
    Model {
        poses: vec![None; photos.len()],
        centres: photos
            .iter()
            .map(|p| DVec2::new(p.image.width as f64, p.image.height as f64) * 0.5)
            .collect(),
        alike: group.clone(),
        separable: separable(photos, &group),
        group,
        zoom,
        optics: priors
            .iter()
            .map(|p| Optics { focal: p.log_focal.0.exp(), lens: Lens::NONE, shift: DVec2::ZERO })
            .collect(),
        priors,
        freedom: Freedom::Focal,
        tracks: Vec::new(),
        seed,
    }
}

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
    // Photos of one camera first; where that contradicts the pairs, every photo with its own focal
    // length. That explains much that is wrong for other reasons, so it must settle the matter.
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
