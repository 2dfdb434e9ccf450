//! Incremental structure from motion: the built-in initialiser that needs no large model.
mod added;
mod crops;
mod detectors;
mod finish;
mod fit;
mod global_ba;
mod grow;
mod intrinsics;
mod known;
mod model;
mod neighbours;
mod pair;
mod patch;
mod refine;
mod scan;
mod tracks;
mod unregistered;
mod verify;

use super::SparseModel;
use super::bundle::{Intrinsics, IntrinsicsPrior};
use super::choose::Reason;
use super::matching::Keypoints;
use super::vanishing::{self, LogFocal};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::Lens;
use crate::{Error, Result};
pub use added::{Known, with_added};
use detectors::{detect_features, keypoints};
use finish::{AGREED, Evidence, agreement, finish};
use glam::DVec2;
use grow::grow;
pub use known::with_cameras;
use model::{Model, PRINCIPAL_POINT_SIGMA, RefinedIntrinsics, TrackElement};
use pair::Pair;
use tracks::KeypointMatch;
pub use unregistered::Unregistered;
use verify::{MIN_INLIERS, THRESHOLD, VerifiedMatches};

/// Prior focal length without EXIF, share of the long side: covers phones (0.8) to normal lenses
/// (1.2) within one σ.
const FOCAL_GUESS: f64 = 0.9;
/// σ of ln f without EXIF.
const FOCAL_SIGMA: f64 = 0.35;
/// σ of ln f from EXIF: values are rounded, and sensors are cropped.
const EXIF_SIGMA: f64 = 0.05;
/// σ of the radial distortion at the corner of a photo, share of the radius: below a hundredth
/// where a phone has corrected it, a twentieth for plain wide lenses.
const LENS_SIGMA: f64 = 0.05;

/// Estimates cameras and sparse points from photos and their learned features (one per photo; if
/// empty, only the built-in corner detector is used). `seed` draws the samples of RANSAC. The error
/// names photos that cannot be registered.
pub fn reconstruct(
    photos: &[Photo],
    features: &[Keypoints],
    seed: u64,
    progress: &dyn Progress,
) -> Result<SparseModel, Unregistered> {
    if photos.len() < 2 {
        return Err(Error::input("cameras need at least two photos; give two or more").into());
    }
    progress.begin("cameras", STEPS);
    progress.step(0, "corners");
    let mut detectors = detect_features(photos, features, progress)?;
    progress.step(1, "matches");
    let putative = verify::putative_matches(photos, &detectors, progress)?;
    let flat = verify::flat_photos(photos, &putative, seed);
    let empty = empty_model(photos, &flat, seed);
    let VerifiedMatches { putative, pairs } =
        verify::verify_all(photos, &mut detectors, putative, &empty, progress)?;
    progress.step(2, "poses");
    let keypoints: Vec<Vec<TrackElement>> = (0..photos.len()).map(|v| keypoints(&detectors, v)).collect();
    let model = assemble(photos, &keypoints, empty, &pairs, progress)?;
    progress.step(3, "refining");
    let mut model = finish(photos, model, &Evidence { putative, pairs, keypoints }, progress)?;
    model.flat = flat.into_iter().all(|f| f);
    check_points(photos, &model)?;
    progress.step(STEPS, &format!("{} points", model.points.len()));
    progress.end();
    Ok(model)
}

/// Returns an error that names photos with too few observations.
fn check_points(photos: &[Photo], model: &SparseModel) -> Result<(), Unregistered> {
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
    Err(Unregistered { views, error })
}

/// Steps of the progress bar: corners, matches, poses, refinement, extension.
const STEPS: u64 = 5;

/// Camera ids, numbered in any way, if photos share one only where their files name camera and
/// zoom. Differences between the intrinsics of such photos are due to image stabilisation, which
/// moves the lens from photo to photo.
fn camera_ids_by_exif(photos: &[Photo], camera_ids: &[usize]) -> Vec<usize> {
    let is_named = |p: &Photo| p.camera_model.is_some() && p.exif_focal.is_some();
    let first = |v: usize| camera_ids.iter().position(|g| *g == camera_ids[v]).unwrap_or(v);
    photos.iter().enumerate().map(|(v, p)| if is_named(p) { first(v) } else { v }).collect()
}

/// Model without poses: camera ids and priors of the intrinsics from the files, and from the edges
/// in photos that are not `flat`. Lines in one plane run in at most two orthogonal directions; a
/// third one there is spurious.
fn empty_model(photos: &[Photo], flat: &[bool], seed: u64) -> Model {
    let zoom: Vec<f64> = photos.iter().map(Photo::zoom).collect();
    let camera_ids = crate::photo::cameras_by_file(photos);
    // The first photo of each camera represents it.
    let cameras = camera_ids.iter().max().map_or(0, |g| g + 1);
    let firsts: Vec<usize> = (0..cameras).filter_map(|g| camera_ids.iter().position(|o| *o == g)).collect();
    let priors: Vec<IntrinsicsPrior> =
        firsts.iter().enumerate().map(|(g, &v)| intrinsics_prior(photos, flat, &camera_ids, g, v)).collect();
    Model {
        poses: vec![None; photos.len()],
        centres: photos
            .iter()
            .map(|p| DVec2::new(p.image.width as f64, p.image.height as f64) * 0.5)
            .collect(),
        camera_ids_by_file: camera_ids.clone(),
        camera_ids_by_exif: camera_ids_by_exif(photos, &camera_ids),
        camera_ids,
        zoom,
        intrinsics: priors
            .iter()
            .map(|p| Intrinsics {
                focal: p.log_focal.0.exp(),
                lens: Lens::NONE,
                principal_point_offset: DVec2::ZERO,
            })
            .collect(),
        priors,
        refined: RefinedIntrinsics::Focal,
        tracks: Vec::new(),
        seed,
    }
}

/// Prior of camera `g` from the file of its photo `v`, and from the edges of its photos that are
/// not `flat`.
fn intrinsics_prior(
    photos: &[Photo],
    flat: &[bool],
    camera_ids: &[usize],
    g: usize,
    v: usize,
) -> IntrinsicsPrior {
    let sides = photos[v].picture_size();
    let long = f64::max(sides[0], sides[1]);
    let log_focal = match photos[v].original_focal() {
        Some(f) => (f.ln(), EXIF_SIGMA),
        None => {
            let guess = LogFocal { mean: FOCAL_GUESS.ln(), sigma: FOCAL_SIGMA };
            let deep = photos.iter().zip(flat).zip(camera_ids).filter(|((_, flat), of)| !**flat && **of == g);
            let images = deep.map(|((p, _), _)| &p.image);
            let LogFocal { mean, sigma } = vanishing::log_focal(images, guess).unwrap_or(guess);
            (mean + long.ln(), sigma)
        }
    };
    let corner = 0.5 * f64::hypot(sides[0], sides[1]) / log_focal.0.exp();
    // Portrait and landscape photos of a camera have different principal points in upright pixels.
    let mut members = photos.iter().zip(camera_ids).filter(|m| *m.1 == g).map(|m| m.0);
    let equal_sizes = members.all(|p| p.original_size == photos[v].original_size);
    IntrinsicsPrior {
        log_focal,
        lens: [LENS_SIGMA / corner.powi(2), 0.5 * LENS_SIGMA / corner.powi(4)],
        principal_point_offset: if equal_sizes {
            (PRINCIPAL_POINT_SIGMA * long).max(photos[v].off_middle())
        } else {
            0.0
        },
    }
}

/// Most seed pairs that are tried.
const SEEDS: usize = 3;

/// Grows a model of all photos from the verified pairs.
fn assemble(
    photos: &[Photo],
    points: &[Vec<TrackElement>],
    mut empty: Model,
    pairs: &[Pair],
    progress: &dyn Progress,
) -> Result<Model, Unregistered> {
    let mut links: Vec<KeypointMatch> =
        pairs.iter().flat_map(|p| p.matches.list.iter().map(|m| m.2)).collect();
    let tracks = tracks::join(&mut links, points);
    // The focal length of a camera starts at the mean of its pairs' estimates, weighted by inliers
    // and parallax.
    for g in 0..empty.intrinsics.len() {
        let (mut sum, mut weight) = (0.0, 1e-9);
        let has_camera =
            |p: &&Pair| [p.matches.first, p.matches.second].iter().any(|v| empty.camera_ids[*v] == g);
        for p in pairs.iter().filter(has_camera) {
            let w = grow::seed_score(p);
            sum += w * p.geometry.stretch.ln();
            weight += w;
        }
        empty.intrinsics[g].focal *= (sum / weight).exp();
    }
    let long = photos[0].image.width.max(photos[0].image.height) as f64;
    let threshold = THRESHOLD * long;
    let mut seeds: Vec<&Pair> = pairs.iter().collect();
    seeds.sort_by(|a, b| grow::seed_score(b).total_cmp(&grow::seed_score(a)));
    seeds.truncate(SEEDS);
    // First with shared cameras; if that contradicts the pairs, with separate intrinsics per photo.
    // Those also explain unrelated errors, so they must agree with all pairs.
    let apart = empty.with_separate_intrinsics();
    let attempts =
        std::iter::once(&empty).chain(&apart).flat_map(|start| seeds.iter().map(move |s| (start, *s)));
    let mut best: Option<(f64, Model)> = None;
    let mut stuck = Vec::new();
    for (start, seed) in attempts {
        progress.check()?;
        let model = match grow(start, &tracks, pairs, seed, threshold) {
            Ok(model) => model,
            Err(s) => {
                if stuck.is_empty() || s.unregistered.len() < stuck.len() {
                    stuck = s.unregistered;
                }
                continue;
            }
        };
        let worst = agreement(&model, pairs, threshold).into_iter().fold(1.0, f64::min);
        let shared = start.camera_ids == empty.camera_ids;
        if worst > AGREED || best.as_ref().is_none_or(|b| shared && worst > b.0) {
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
        Unregistered { views: stuck.iter().map(|v| (*v, Reason::NoOverlap)).collect(), error }
    })
}

#[cfg(test)]
mod tests;
