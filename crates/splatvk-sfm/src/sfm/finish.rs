//! Final stage of a reconstruction: intrinsics, observations refined to sub-pixel, further points.
use super::detectors::MARGIN;
use super::intrinsics::estimate_intrinsics;
use super::model::{Model, Track, TrackElement};
use super::pair::{self, Matches, Pair};
use super::patch::LumaGradients;
use super::refine;
use super::tracks::{self, KeypointMatch};
use super::verify::THRESHOLD;
use crate::bundle::Adjusted;
use crate::matching;
use crate::photo::{Photo, Straightening};
use crate::progress::Progress;
use crate::scene::{Camera, Image, Lens, RgbImage};
use crate::two_view::{fundamental, sampson};
use crate::{Error, Result};
use crate::{Fitted, SparseModel, SparsePoint};
use glam::DVec2;
use rayon::prelude::*;

/// Least share of a photo's inlier matches that agree with the cameras for these to be accepted
/// while growing: where they are right it is 0.97 and more on the tuning sets, below 0.8 where
/// cameras or focal lengths are wrong.
pub(super) const AGREED: f64 = 0.9;

/// Matches and pairs that the model was grown from.
pub(super) struct Evidence {
    pub(super) putative: Vec<Matches>,
    pub(super) pairs: Vec<Pair>,
    /// Per view, numbered as in [`KeypointMatch`].
    pub(super) keypoints: Vec<Vec<TrackElement>>,
}

/// Final adjustment: outliers removed, σ from the residuals, the intrinsics that the observations
/// determine, every observation refined to sub-pixel, and further points where the geometry
/// predicts them.
pub(super) fn finish(
    photos: &[Photo],
    mut model: Model,
    evidence: &Evidence,
    progress: &dyn Progress,
) -> Result<SparseModel> {
    let long = photos[0].image.width.max(photos[0].image.height) as f64;
    let threshold = THRESHOLD * long;
    model.triangulate_all(threshold);
    model.prune(threshold);
    model.adjust(f64::INFINITY, 1.5, 60)?;
    reweight_and_adjust(&mut model)?;
    estimate_intrinsics(&mut model)?;
    if corner_displacement(&model, photos) > REMATCH || model.has_crops() {
        // The pinhole model rejected matches that distortion or an off-centre axis displaces,
        // mostly near the corners: match again.
        rematch(&mut model, evidence, threshold);
        reweight_and_adjust(&mut model)?;
        estimate_intrinsics(&mut model)?;
    }
    progress.check()?;
    let undistorted: Vec<RgbImage> =
        photos.par_iter().enumerate().map(|(v, p)| undistorted_image(&model, v, &p.image)).collect();
    sub_pixel(&mut model, photos, &undistorted, threshold, progress)?;
    progress.step(4, "optics");
    if refine_on_fine_images(&mut model, photos) {
        progress.check()?;
        reweight_and_adjust(&mut model)?;
        model.prune(0.5 * threshold);
        reweight_and_adjust(&mut model)?;
    }
    let outcome = estimate_intrinsics(&mut model)?;
    model.normalise();
    let reliability = reliability(&model, &evidence.pairs, threshold);
    sparse_model(photos, &model, outcome, &reliability)
}

/// Distance up to which neighbours predict the local plane of a point, pixels of the working image.
const REACH: f64 = 80.0;

/// Refines all observations to sub-pixel on undistorted images and adds points that the geometry
/// predicts.
pub(super) fn sub_pixel(
    model: &mut Model,
    photos: &[Photo],
    undistorted: &[RgbImage],
    threshold: f64,
    progress: &dyn Progress,
) -> Result<()> {
    let images: Vec<LumaGradients> =
        undistorted.par_iter().map(|image| LumaGradients::new(&image.luma())).collect();
    let valid: Vec<Image<bool>> = photos
        .par_iter()
        .zip(undistorted)
        .map(|(p, image)| matching::valid_area(image, p.border, p.coverage.as_ref(), MARGIN))
        .collect();
    with_undistorted(model, |m| refine::refine(m, &images, refine::REFINED, REACH));
    reweight_and_adjust(model)?;
    progress.check()?;
    model.prune(0.5 * threshold);
    with_undistorted(model, |m| {
        refine::extend(m, &images, &valid);
    });
    model.prune(0.5 * threshold);
    reweight_and_adjust(model)?;
    progress.check()
}

/// Refines all observations on the fine images of the photos; `false` if no photo has one.
fn refine_on_fine_images(model: &mut Model, photos: &[Photo]) -> bool {
    let ratios: Vec<f64> = photos
        .iter()
        .map(|p| p.fine.as_ref().map_or(1.0, |f| f.width as f64 / p.image.width as f64))
        .collect();
    let largest = ratios.iter().copied().fold(1.0, f64::max);
    if largest == 1.0 {
        return false;
    }
    let sizes: Vec<f64> = ratios.iter().map(|r| 1.0 / r).collect();
    model.rescale_images(&ratios);
    let images: Vec<LumaGradients> = photos
        .par_iter()
        .enumerate()
        .map(|(v, p)| {
            let luma = || p.image.luma();
            let plane = p.fine.as_ref().map_or_else(luma, |f| f.as_ref().clone());
            match model.lens(v) {
                lens if lens.is_none() => LumaGradients::new(&plane),
                _ => LumaGradients::new(&undistortion(model, v).plane(&plane)),
            }
        })
        .collect();
    with_undistorted(model, |m| refine::refine(m, &images, refine::FINE, REACH * largest));
    model.rescale_images(&sizes);
    true
}

/// Estimates σ from the residuals and adjusts, twice: σ and geometry depend on each other and
/// converge to a percent in two rounds.
pub(super) fn reweight_and_adjust(model: &mut Model) -> Result<Adjusted> {
    model.estimate_sigma();
    model.adjust(f64::INFINITY, 2.0, 60)?;
    model.estimate_sigma();
    model.adjust(f64::INFINITY, 2.0, 60)
}

/// Largest displacement at a corner without new matching, pixels: three times the noise of
/// keypoints.
const REMATCH: f64 = 1.0;

/// Largest displacement of a photo's corner by the distortion, pixels.
fn corner_displacement(model: &Model, photos: &[Photo]) -> f64 {
    let corner = |(v, p): (usize, &Photo)| {
        let half = DVec2::new(p.image.width as f64, p.image.height as f64) * 0.5;
        let x = half / model.focal(v);
        (model.lens(v).distort(x) - x).length() * model.focal(v)
    };
    photos.iter().enumerate().map(corner).fold(0.0, f64::max)
}

/// Links of the matches whose Sampson errors with the model's cameras are below `threshold` pixels.
pub(super) fn inlier_matches(model: &Model, matches: &[Matches], threshold: f64) -> Vec<KeypointMatch> {
    matches.par_iter().flat_map_iter(|pair| inliers_of(model, pair, threshold)).collect()
}

fn inliers_of(model: &Model, pair: &Matches, threshold: f64) -> Vec<KeypointMatch> {
    let (i, j) = (pair.first, pair.second);
    let (Some(a), Some(b)) = (model.poses[i], model.poses[j]) else { return Vec::new() };
    let f = fundamental(&b.compose(&a.inverse()), model.focal(i), model.focal(j));
    let is_inlier = |m: &&(DVec2, DVec2, KeypointMatch)| {
        sampson(&f, model.undistorted(i, m.0), model.undistorted(j, m.1)) < threshold * threshold
    };
    pair.list.iter().filter(is_inlier).map(|m| m.2).collect()
}

/// Share per view of the inliers of its pairs that agree with the model's cameras, too. The view
/// with the least share is counted first; pairs with views below [`AGREED`] do not count for the
/// others.
pub(super) fn agreement(model: &Model, pairs: &[Pair], threshold: f64) -> Vec<f64> {
    let counted = |p: &Pair| (inliers_of(model, &p.matches, threshold).len(), p.matches.list.len());
    let counts: Vec<(usize, usize)> = pairs.par_iter().map(counted).collect();
    let mut shares: Vec<Option<f64>> = vec![None; model.poses.len()];
    loop {
        let open = (0..shares.len()).filter(|v| shares[*v].is_none());
        let open = open.map(|v| (agreeing_share(v, pairs, &counts, &shares), v));
        let Some((worst, view)) = open.min_by(|a, b| a.0.total_cmp(&b.0)) else {
            break;
        };
        shares[view] = Some(worst);
    }
    shares.into_iter().flatten().collect()
}

/// Share of `counts` (agreeing, all) over the pairs of a view whose known `shares` are not below
/// [`AGREED`].
fn agreeing_share(view: usize, pairs: &[Pair], counts: &[(usize, usize)], shares: &[Option<f64>]) -> f64 {
    let own = pairs.iter().zip(counts).filter(|(p, _)| {
        let ends = [p.matches.first, p.matches.second];
        ends.contains(&view) && ends.iter().all(|v| shares[*v].is_none_or(|s| s >= AGREED))
    });
    let (agree, all) = own.fold((0, 0), |sum, (_, c)| (sum.0 + c.0, sum.1 + c.1));
    if all == 0 { 1.0 } else { agree as f64 / all as f64 }
}

/// Evidence for the poses, per view.
struct Reliability {
    agreement: Vec<f64>,
    unconfirmed: Vec<bool>,
}

fn reliability(model: &Model, pairs: &[Pair], threshold: f64) -> Reliability {
    let agrees = |p: &Pair| {
        inliers_of(model, &p.matches, threshold).len() as f64 >= AGREED * p.matches.list.len() as f64
    };
    let agrees: Vec<bool> = pairs.par_iter().map(agrees).collect();
    Reliability {
        agreement: agreement(model, pairs, threshold),
        unconfirmed: pair::unconfirmed(model.poses.len(), pairs, &agrees),
    }
}

/// Replaces the tracks by those of all matches that agree with the cameras.
fn rematch(model: &mut Model, evidence: &Evidence, threshold: f64) {
    let mut links = inlier_matches(model, &evidence.putative, threshold);
    model.tracks = tracks::join(&mut links, &evidence.keypoints)
        .into_iter()
        .map(|elements| Track { position: None, elements })
        .collect();
    model.triangulate_all(threshold);
    model.prune(threshold);
}

fn undistortion(model: &Model, view: usize) -> Straightening {
    let (focal, centre) = (model.focal(view), model.principal_point(view));
    Straightening { lens: model.lens(view), focal, aspect: 1.0, centre }
}

/// Image of a view without distortion.
pub(super) fn undistorted_image(model: &Model, view: usize, image: &RgbImage) -> RgbImage {
    match model.lens(view) {
        lens if lens.is_none() => image.clone(),
        _ => undistortion(model, view).image(image),
    }
}

/// Runs `step` on the model with undistorted observations and no distortion, then restores both.
fn with_undistorted(model: &mut Model, step: impl FnOnce(&mut Model)) {
    let intrinsics = model.intrinsics.clone();
    let original = model.clone_without_tracks();
    for s in model.tracks.iter_mut().flat_map(|t| &mut t.elements) {
        s.pixel = original.undistorted(s.view, s.pixel) + original.principal_point(s.view);
    }
    model.intrinsics.iter_mut().for_each(|o| o.lens = Lens::NONE);
    step(model);
    model.intrinsics = intrinsics;
    for s in model.tracks.iter_mut().flat_map(|t| &mut t.elements) {
        let f = original.focal(s.view);
        let x = (s.pixel - original.principal_point(s.view)) / f;
        s.pixel = original.lens(s.view).distort(x) * f + original.principal_point(s.view);
    }
}

/// Triangulated tracks with undistorted observations, in the colour of their first one.
pub(super) fn sparse_points(photos: &[Photo], model: &Model) -> Vec<SparsePoint> {
    model.tracks.iter().filter_map(|t| sparse_point(photos, model, t)).collect()
}

fn sparse_point(photos: &[Photo], model: &Model, t: &Track) -> Option<SparsePoint> {
    let views: Vec<(usize, DVec2)> = t
        .elements
        .iter()
        .map(|s| (s.view, model.undistorted(s.view, s.pixel) + model.principal_point(s.view)))
        .collect();
    let s = t.elements.first()?;
    Some(SparsePoint { position: t.position?, colour: photos[s.view].image.nearest(s.pixel), views })
}

fn sparse_model(
    photos: &[Photo],
    model: &Model,
    outcome: Adjusted,
    reliability: &Reliability,
) -> Result<SparseModel> {
    let cameras = cameras_of(photos, model)?;
    let points = sparse_points(photos, model);
    // The first rotation is as certain as that against the next view.
    let others = outcome.rotation_sigmas.iter().skip(1).copied().fold(f64::INFINITY, f64::min);
    let fit_of = |v: usize| Fitted {
        lens: model.lens(v),
        sigmas: outcome.sigmas[model.camera_ids[v]],
        residual: model.median_error(v),
        agreement: reliability.agreement[v],
        unconfirmed: reliability.unconfirmed[v],
        rotation_sigma: if v == 0 { others } else { outcome.rotation_sigmas[v] },
        camera: model.camera_ids[v],
    };
    Ok(SparseModel {
        cameras,
        points,
        focal_log_sigma: outcome.sigmas.iter().map(|s| s[0]).max_by(f64::total_cmp),
        fitted: (0..photos.len()).map(fit_of).collect(),
        flat: false,
    })
}

fn cameras_of(photos: &[Photo], model: &Model) -> Result<Vec<Camera>> {
    photos
        .iter()
        .enumerate()
        .map(|(v, p)| {
            let pose = model.poses[v]
                .ok_or_else(|| Error::work(format!("no camera position found for {}", p.stem)))?;
            Ok(Camera {
                name: p.path.file_name().map_or_else(|| p.stem.clone(), |n| n.to_string_lossy().into()),
                width: p.image.width as u32,
                height: p.image.height as u32,
                fx: model.focal(v),
                fy: model.focal(v),
                cx: model.principal_point(v).x,
                cy: model.principal_point(v).y,
                pose,
            })
        })
        .collect()
}
