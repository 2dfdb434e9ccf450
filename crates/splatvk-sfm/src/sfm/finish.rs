//! From a grown model to the final one: what the lens does, sightings refined to sub-pixel, further
//! points.
use super::families::MARGIN;
use super::model::{Model, Sighting, Track};
use super::optics::learn_optics;
use super::pair::{self, Matches, Pair};
use super::patch::Shades;
use super::refine;
use super::relate::THRESHOLD;
use super::tracks::{self, KeypointMatch};
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

/// Share of a photo's matches that agree with the cameras, from which on they are taken for right
/// while growing: where they are it is 0.97 and more on the tuning sets, below 0.8 where cameras or
/// focal lengths are wrong.
pub(super) const AGREED: f64 = 0.9;

/// What the model was grown from.
pub(super) struct Evidence {
    pub(super) putative: Vec<Matches>,
    pub(super) pairs: Vec<Pair>,
    /// Per view, numbered as the links number them.
    pub(super) keypoints: Vec<Vec<Sighting>>,
}

/// Final adjustment: outliers out, weights from the residuals, the optics that the sightings
/// determine, every sighting refined to sub-pixel and further points added where the geometry
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
    learn_optics(&mut model)?;
    if bend(&model, photos) > REMATCH || model.has_crops() {
        // The pinhole took what the lens displaces for outliers, above all near the corners: match
        // again. So it did where the axis is not in the middle.
        rematch(&mut model, evidence, threshold);
        reweight_and_adjust(&mut model)?;
        learn_optics(&mut model)?;
    }
    progress.check()?;
    let straight: Vec<RgbImage> =
        (0..photos.len()).map(|v| straightened(&model, v, &photos[v].image)).collect();
    sub_pixel(&mut model, photos, &straight, threshold, progress)?;
    progress.step(4, "optics");
    let mut outcome = learn_optics(&mut model)?;
    if sharpen(&mut model, photos) {
        progress.check()?;
        reweight_and_adjust(&mut model)?;
        model.prune(0.5 * threshold);
        reweight_and_adjust(&mut model)?;
        outcome = learn_optics(&mut model)?;
    }
    model.normalise();
    let trust = trust(&model, &evidence.pairs, threshold);
    sparse_model(photos, &model, outcome, &trust)
}

/// Pixels of the working image within which the neighbours of a point lie on one plane with it.
const REACH: f64 = 80.0;

/// Refines all sightings to sub-pixel on the `straight` images, those of pinholes, and adds points
/// that the geometry predicts.
pub(super) fn sub_pixel(
    model: &mut Model,
    photos: &[Photo],
    straight: &[RgbImage],
    threshold: f64,
    progress: &dyn Progress,
) -> Result<()> {
    let shades: Vec<Shades> = straight.par_iter().map(|image| Shades::new(&image.luma())).collect();
    let valid = |p: &Photo, image| matching::valid_area(image, p.border, p.coverage.as_ref(), MARGIN);
    let valid: Vec<Image<bool>> = photos.iter().zip(straight).map(|(p, image)| valid(p, image)).collect();
    on_straight(model, |m| refine::refine(m, &shades, refine::REFINED, REACH));
    reweight_and_adjust(model)?;
    progress.check()?;
    model.prune(0.5 * threshold);
    on_straight(model, |m| {
        refine::extend(m, &shades, &valid);
    });
    model.prune(0.5 * threshold);
    reweight_and_adjust(model)?;
    progress.check()
}

/// Refines all sightings on the larger images of the photos; false where no photo has one.
fn sharpen(model: &mut Model, photos: &[Photo]) -> bool {
    let ratios: Vec<f64> = photos
        .iter()
        .map(|p| p.fine.as_ref().map_or(1.0, |f| f.width as f64 / p.image.width as f64))
        .collect();
    let largest = ratios.iter().copied().fold(1.0, f64::max);
    if largest == 1.0 {
        return false;
    }
    let sizes: Vec<f64> = ratios.iter().map(|r| 1.0 / r).collect();
    model.magnify(&ratios);
    let shades: Vec<Shades> = photos
        .par_iter()
        .enumerate()
        .map(|(v, p)| {
            let luma = || p.image.luma();
            let plane = p.fine.as_ref().map_or_else(luma, |f| f.as_ref().clone());
            match model.lens(v) {
                lens if lens.is_none() => Shades::new(&plane),
                _ => Shades::new(&straightening(model, v).plane(&plane)),
            }
        })
        .collect();
    on_straight(model, |m| refine::refine(m, &shades, refine::FINE, REACH * largest));
    model.magnify(&sizes);
    true
}

/// Adjusts with weights from the residuals. Weights and geometry depend on each other; they
/// converge to a percent in two rounds.
pub(super) fn reweight_and_adjust(model: &mut Model) -> Result<Adjusted> {
    model.weigh();
    model.adjust(f64::INFINITY, 2.0, 60)?;
    model.weigh();
    model.adjust(f64::INFINITY, 2.0, 60)
}

/// Displacement at a corner above which matching starts anew, pixels: three times the noise of
/// keypoints.
const REMATCH: f64 = 1.0;

/// Largest displacement by the lens at a corner of a photo, pixels.
fn bend(model: &Model, photos: &[Photo]) -> f64 {
    let corner = |(v, p): (usize, &Photo)| {
        let half = DVec2::new(p.image.width as f64, p.image.height as f64) * 0.5;
        let x = half / model.focal(v);
        (model.lens(v).distort(x) - x).length() * model.focal(v)
    };
    photos.iter().enumerate().map(corner).fold(0.0, f64::max)
}

/// Links of the matches that agree with the model's cameras within `threshold` pixels.
pub(super) fn inlier_matches(model: &Model, matches: &[Matches], threshold: f64) -> Vec<KeypointMatch> {
    matches.par_iter().flat_map_iter(|pair| inliers_of(model, pair, threshold)).collect()
}

fn inliers_of(model: &Model, pair: &Matches, threshold: f64) -> Vec<KeypointMatch> {
    let (i, j) = (pair.first, pair.second);
    let (Some(a), Some(b)) = (model.poses[i], model.poses[j]) else { return Vec::new() };
    let f = fundamental(&b.compose(&a.inverse()), model.focal(i), model.focal(j));
    let close = |m: &&(DVec2, DVec2, KeypointMatch)| {
        sampson(&f, model.straight(i, m.0), model.straight(j, m.1)) < threshold * threshold
    };
    pair.list.iter().filter(close).map(|m| m.2).collect()
}

/// Per view the share of its matches that agree with the model's cameras, of those on which its
/// pairs with other views agree by themselves. The view that agrees least is counted first and its
/// pairs then left out: the others are not to suffer for it.
pub(super) fn agreement(model: &Model, pairs: &[Pair], threshold: f64) -> Vec<f64> {
    let counted = |p: &Pair| (inliers_of(model, &p.matches, threshold).len(), p.matches.list.len());
    let counts: Vec<(usize, usize)> = pairs.par_iter().map(counted).collect();
    let mut shares: Vec<Option<f64>> = vec![None; model.poses.len()];
    loop {
        let share = |view: usize| {
            let own = pairs.iter().zip(&counts).filter(|(p, _)| {
                let ends = [p.matches.first, p.matches.second];
                ends.contains(&view) && ends.iter().all(|v| shares[*v].is_none_or(|s| s >= AGREED))
            });
            let (agree, all) = own.fold((0, 0), |sum, (_, c)| (sum.0 + c.0, sum.1 + c.1));
            if all == 0 { 1.0 } else { agree as f64 / all as f64 }
        };
        let left = (0..shares.len()).filter(|v| shares[*v].is_none());
        let Some((worst, view)) = left.map(|v| (share(v), v)).min_by(|a, b| a.0.total_cmp(&b.0)) else {
            break;
        };
        shares[view] = Some(worst);
    }
    shares.into_iter().flatten().collect()
}

/// What speaks for the places of the cameras, per view.
struct Trust {
    agreement: Vec<f64>,
    unconfirmed: Vec<bool>,
}

fn trust(model: &Model, pairs: &[Pair], threshold: f64) -> Trust {
    let agrees = |p: &Pair| {
        inliers_of(model, &p.matches, threshold).len() as f64 >= AGREED * p.matches.list.len() as f64
    };
    let agrees: Vec<bool> = pairs.par_iter().map(agrees).collect();
    Trust {
        agreement: agreement(model, pairs, threshold),
        unconfirmed: pair::unconfirmed(model.poses.len(), pairs, &agrees),
    }
}

/// New tracks from all matches that agree with the cameras.
fn rematch(model: &mut Model, evidence: &Evidence, threshold: f64) {
    let mut links = inlier_matches(model, &evidence.putative, threshold);
    model.tracks = tracks::join(&mut links, &evidence.keypoints)
        .into_iter()
        .map(|sightings| Track { position: None, sightings })
        .collect();
    model.triangulate_all(threshold);
    model.prune(threshold);
}

fn straightening(model: &Model, view: usize) -> Straightening {
    let (focal, centre) = (model.focal(view), model.principal_point(view));
    Straightening { lens: model.lens(view), focal, aspect: 1.0, centre }
}

/// A view's image as a pinhole would show it.
pub(super) fn straightened(model: &Model, view: usize, image: &RgbImage) -> RgbImage {
    match model.lens(view) {
        lens if lens.is_none() => image.clone(),
        _ => straightening(model, view).image(image),
    }
}

/// Runs a step for pinholes on the model with its sightings moved to where a pinhole would show
/// them.
fn on_straight(model: &mut Model, step: impl FnOnce(&mut Model)) {
    let optics = model.optics.clone();
    let lensed = model.clone_optics();
    for s in model.tracks.iter_mut().flat_map(|t| &mut t.sightings) {
        s.pixel = lensed.straight(s.view, s.pixel) + lensed.principal_point(s.view);
    }
    model.optics.iter_mut().for_each(|o| o.lens = Lens::NONE);
    step(model);
    model.optics = optics;
    for s in model.tracks.iter_mut().flat_map(|t| &mut t.sightings) {
        let f = lensed.focal(s.view);
        let x = (s.pixel - lensed.principal_point(s.view)) / f;
        s.pixel = lensed.lens(s.view).distort(x) * f + lensed.principal_point(s.view);
    }
}

/// The triangulated tracks, with the colour that the first of their photos has there, as pinholes
/// show them.
pub(super) fn sparse_points(photos: &[Photo], model: &Model) -> Vec<SparsePoint> {
    let point = |t: &Track| {
        let views: Vec<(usize, DVec2)> = t
            .sightings
            .iter()
            .map(|s| (s.view, model.straight(s.view, s.pixel) + model.principal_point(s.view)))
            .collect();
        let s = t.sightings.first()?;
        Some(SparsePoint { position: t.position?, colour: photos[s.view].image.nearest(s.pixel), views })
    };
    model.tracks.iter().filter_map(point).collect()
}

fn sparse_model(photos: &[Photo], model: &Model, outcome: Adjusted, trust: &Trust) -> Result<SparseModel> {
    let cameras = cameras_of(photos, model)?;
    let points = sparse_points(photos, model);
    // Of the first photo's camera no more is known than of the angle to the next.
    let others = outcome.rotation_sigmas.iter().skip(1).copied().fold(f64::INFINITY, f64::min);
    let fitted = |v: usize| Fitted {
        lens: model.lens(v),
        sigmas: outcome.sigmas[model.group[v]],
        residual: model.residual(v),
        agreement: trust.agreement[v],
        unconfirmed: trust.unconfirmed[v],
        rotation_sigma: if v == 0 { others } else { outcome.rotation_sigmas[v] },
        camera: model.group[v],
    };
    Ok(SparseModel {
        cameras,
        points,
        focal_log_sigma: outcome.sigmas.iter().map(|s| s[0]).max_by(f64::total_cmp),
        fitted: (0..photos.len()).map(fitted).collect(),
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
