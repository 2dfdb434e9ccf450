//! Cameras of photos that join photos whose cameras are known (docs/method.md#photos-added-later).
use super::families::{corner_families, keypoints};
use super::finish::{agreement, inlier_matches};
use super::grow::{MIN_RESECTION, Resection, resection};
use super::model::{Freedom, Model, Sighting, Track};
use super::prior::{empty_model, separable};
use super::relate::{MIN_INLIERS, Matches, Pair, Related, THRESHOLD, related_to};
use super::tracks::{self, KeypointMatch};
use super::unplaced::Unplaced;
use crate::math::median;
use crate::photo::Photo;
use crate::pose::bundle::{Optics, OpticsPrior};
use crate::pose::choose::Reason;
use crate::pose::matching::Keypoints;
use crate::pose::numeric::{cauchy_weight, minimise_small};
use crate::pose::{Fitted, SparseModel, SparsePoint};
use crate::progress::Progress;
use crate::scene::{Camera, Lens, Pose};
use crate::{Error, Result};
use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, SMatrix};

/// The photos of a scene. Their images are those of pinholes: without lens.
#[derive(Clone, Copy)]
pub struct Known<'a> {
    /// At working resolution; fx and fy are taken for equal. They stay as they are, and so does the world frame.
    pub cameras: &'a [Camera],
    /// What is known of how they were found.
    pub fitted: &'a [Fitted],
}

/// σ of ln f of a photo that comes from a camera of the scene at the same zoom: focusing nearer lengthens a lens by about a percent.
const SAME_CAMERA_SIGMA: f64 = 0.01;
/// Fewest points seen by two photos besides the one that is refined: fewer leave its pose to chance, and points that only one
/// other photo sees give way to wherever it is.
const MIN_FIXED: usize = 30;
/// Rounds of refining the camera and triangulating the points anew: the second changes the pose by less than its σ.
const ROUNDS: usize = 3;

/// Cameras and points for all `photos`, the first of which are `known`; the others need no cameras, `features` are one per photo.
/// A photo that shares too little with the others is an error that names it.
pub fn with_added(
    photos: &[Photo],
    known: Known,
    features: &[Keypoints],
    seed: u64,
    progress: &dyn Progress,
) -> Result<SparseModel, Unplaced> {
    let count = known.cameras.len();
    progress.begin("cameras", 3);
    progress.step(0, "matches");
    let mut families = corner_families(photos, features, progress)?;
    let mut model = start_model(photos, known.cameras, seed);
    let Related { putative, pairs } = related_to(photos, &mut families, &model, count, progress)?;
    progress.step(1, "poses");
    let long = photos[0].image.width.max(photos[0].image.height) as f64;
    let threshold = THRESHOLD * long;
    let old: Vec<Matches> = putative.into_iter().filter(|p| p.second < count).collect();
    let mut links: Vec<KeypointMatch> = inlier_matches(&model, &old, threshold);
    links.extend(pairs.iter().flat_map(|p| p.matches.list.iter().map(|m| m.2)));
    let keypoints: Vec<Vec<Sighting>> = (0..photos.len()).map(|v| keypoints(&families, v)).collect();
    model.tracks = tracks::join(&mut links, &keypoints)
        .into_iter()
        .map(|sightings| Track { position: None, sightings })
        .collect();
    model.triangulate_all(2.0 * threshold);
    let mut sigmas = vec![Sigmas::default(); photos.len()];
    for _ in count..photos.len() {
        progress.check()?;
        let (view, prior) = register(&mut model, photos, known.cameras, &pairs, threshold)?;
        for _ in 0..ROUNDS {
            model.triangulate_all(threshold);
            sigmas[view] = refine(&mut model, view, &prior, threshold);
        }
        model.triangulate_all(2.0 * threshold);
    }
    progress.step(2, "points");
    model.triangulate_all(threshold);
    model.prune(threshold);
    let shares = agreement(&model, &pairs, threshold);
    check_sightings(&model, photos, count)?;
    let out = sparse_model(&model, photos, known, &shares, &sigmas);
    progress.step(3, &format!("{} points", out.points.len()));
    progress.end();
    Ok(out)
}

/// The known cameras, and for the other photos what their files say.
fn start_model(photos: &[Photo], cameras: &[Camera], seed: u64) -> Model {
    let by_file = empty_model(photos, seed);
    let known = |v: usize| cameras.get(v);
    let views = || 0..photos.len();
    let optics = views().map(|v| match known(v) {
        Some(c) => Optics { focal: 0.5 * (c.fx + c.fy), lens: Lens::NONE, shift: DVec2::ZERO },
        None => candidates(photos, cameras, v)[0].0,
    });
    let priors = views().map(|v| match known(v) {
        Some(_) => OpticsPrior::default(),
        None => candidates(photos, cameras, v)[0].1,
    });
    Model {
        poses: views().map(|v| known(v).map(|c| c.pose)).collect(),
        centres: views().map(|v| known(v).map_or(by_file.centres[v], |c| DVec2::new(c.cx, c.cy))).collect(),
        group: views().collect(),
        alike: views().collect(),
        separable: views().collect(),
        zoom: views().map(|v| if known(v).is_some() { 1.0 } else { by_file.zoom[v] }).collect(),
        optics: optics.collect(),
        priors: priors.collect(),
        freedom: Freedom::Focal,
        tracks: Vec::new(),
        seed,
    }
}

/// Optics that a new photo may have, each with the σ of what may differ from them: those of a photo of the scene that was taken with
/// the same camera by their files, and what its own file says.
fn candidates(photos: &[Photo], cameras: &[Camera], view: usize) -> Vec<(Optics, OpticsPrior)> {
    let by_file = empty_model(photos, 0);
    let alike = (0..cameras.len()).find(|o| by_file.group[*o] == by_file.group[view]);
    let shared = alike.map(|o| {
        let (taken, photo) = (photos[o].original_camera(&cameras[o]), &photos[o]);
        let middle = DVec2::new(f64::from(photo.original_size.0), f64::from(photo.original_size.1)) * 0.5;
        let focal = 0.5 * (taken.fx + taken.fy);
        // Upright photos of a camera that was turned hold its principal point in another place.
        let shift = match photo.original_size == photos[view].original_size {
            true => DVec2::new(taken.cx, taken.cy) - middle,
            false => DVec2::ZERO,
        };
        let prior = OpticsPrior { log_focal: (focal.ln(), SAME_CAMERA_SIGMA), lens: [0.0; 2], shift: 0.0 };
        (Optics { focal, lens: photo.lens(), shift }, prior)
    });
    let own = by_file.priors[by_file.group[view]];
    let own = (
        Optics { focal: own.log_focal.0.exp(), lens: Lens::NONE, shift: DVec2::ZERO },
        OpticsPrior { lens: [own.lens[0], 0.0], shift: 0.0, ..own },
    );
    // Files that name camera and zoom leave no doubt that it is the same.
    let parts = separable(photos, &by_file.group);
    let sure = alike.is_some_and(|o| parts[o] == parts[view]);
    shared.into_iter().chain((!sure).then_some(own)).collect()
}

/// Places the photo that shows most of the points, with the optics that explain most of them. An error that names all that are
/// left when none shows enough.
fn register(
    model: &mut Model,
    photos: &[Photo],
    cameras: &[Camera],
    pairs: &[Pair],
    threshold: f64,
) -> Result<(usize, OpticsPrior), Unplaced> {
    let left: Vec<usize> = (0..photos.len()).filter(|v| model.poses[*v].is_none()).collect();
    let mut best: Option<(usize, Resection, Optics, OpticsPrior)> = None;
    for &view in &left {
        for (optics, prior) in candidates(photos, cameras, view) {
            (model.optics[view], model.priors[view]) = (optics, prior);
            let Some(found) = resection(model, view, threshold) else { continue };
            // The camera of the scene comes first; another one must explain clearly more.
            let ahead = |b: &Resection| found.count as f64 > CLEARLY * b.count as f64;
            if best.as_ref().is_none_or(|b| ahead(&b.1)) {
                best = Some((view, found, optics, prior));
            }
        }
    }
    match best.filter(|b| b.1.count >= MIN_RESECTION) {
        Some((view, found, optics, prior)) => {
            model.poses[view] = Some(found.pose);
            model.optics[view] = Optics { focal: optics.focal * found.stretch, ..optics };
            model.priors[view] = prior;
            Ok((view, prior))
        }
        None => Err(unplaced(photos, &left, pairs)),
    }
}

/// Points more by which optics of its own must explain a photo: a free focal length explains some by chance.
const CLEARLY: f64 = 1.1;

fn unplaced(photos: &[Photo], left: &[usize], pairs: &[Pair]) -> Unplaced {
    let matches = |view: usize| {
        let own = pairs.iter().filter(|p| [p.matches.first, p.matches.second].contains(&view));
        own.map(|p| p.matches.list.len()).max().unwrap_or(0)
    };
    let names: Vec<String> = left
        .iter()
        .map(|&v| match matches(v) {
            0 => format!("{} (no photo of the scene shows the same)", photos[v].stem),
            n => format!("{} ({n} matches with the nearest photo)", photos[v].stem),
        })
        .collect();
    Unplaced {
        views: left.iter().map(|v| (*v, Reason::NoOverlap)).collect(),
        error: Error::input(format!(
            "no place found in the scene for {}; it shows too little of what the scene's photos show: add a photo from between first",
            names.join(", ")
        )),
    }
}

/// An error that names the new photos whose place rests on too few points.
fn check_sightings(model: &Model, photos: &[Photo], known: usize) -> Result<(), Unplaced> {
    let shown = |v: usize| model.tracks.iter().filter(|t| t.sightings.iter().any(|s| s.view == v)).count();
    let few: Vec<usize> = (known..photos.len()).filter(|v| shown(*v) < MIN_INLIERS).collect();
    if few.is_empty() { Ok(()) } else { Err(unplaced(photos, &few, &[])) }
}

/// One standard deviation each; 0 = held.
#[derive(Clone, Copy, Default)]
struct Sigmas {
    log_focal: f64,
    k1: f64,
    /// Radians.
    rotation: f64,
}

/// Pose, focal length and k1 of a view that explain where it shows the points, which stay where they are.
fn refine(model: &mut Model, view: usize, prior: &OpticsPrior, threshold: f64) -> Sigmas {
    let Some(pose) = model.poses[view] else { return Sigmas::default() };
    let sighting = |t: &Track| {
        let (x, s) = (t.position?, *t.sightings.iter().find(|s| s.view == view)?);
        (model.error(&s, x) < 2.0 * threshold).then_some((x, s.pixel, t.sightings.len() > 2))
    };
    let mut seen: Vec<(DVec3, DVec2, bool)> = model.tracks.iter().filter_map(sighting).collect();
    if seen.iter().filter(|s| s.2).count() >= MIN_FIXED {
        seen.retain(|s| s.2);
    }
    let (optics, zoom, centre) = (model.optics[view], model.zoom[view], model.principal_point(view));
    let project = |x: &[f64; 8], world: DVec3| -> DVec2 {
        let size = pose.translation.length().max(1e-3);
        let step = Pose::exp(DVec3::new(x[0], x[1], x[2]) * size, DVec3::new(x[3], x[4], x[5]));
        let t = step.compose(&pose).transform(world);
        let lens = Lens { k1: optics.lens.k1 + x[7], ..optics.lens };
        lens.distort(DVec2::new(t.x, t.y) / t.z.max(1e-9)) * (optics.focal * x[6].exp() * zoom) + centre
    };
    let mut squares: Vec<f64> =
        seen.iter().map(|s| (project(&[0.0; 8], s.0) - s.1).length_squared()).collect();
    let Some(middle) = median(&mut squares) else { return Sigmas::default() };
    // The median of the squared length of a 2-D normal deviate is 2 ln 2 σ²; below 0.05 px the lens limits.
    let sigma = (middle / (2.0 * std::f64::consts::LN_2)).sqrt().max(0.05);
    // Neighbours err alike: sightings count as fewer independent ones, against which the priors are weighed.
    let worth = (model.independent(2 * seen.len()) / (2 * seen.len()).max(1) as f64).sqrt();
    // What is held has a σ that nothing moves against, where zero cannot be divided by.
    let held = |s: f64| if s > 0.0 { s } else { 1e-9 };
    let log_focal = optics.focal.ln();
    let residuals = |x: &[f64; 8], out: &mut Vec<f64>| {
        out.clear();
        for (world, pixel, _) in &seen {
            let r = (project(x, *world) - *pixel) / sigma;
            // sqrt of the Cauchy loss along the residual, scale 2 σ: its square sums to the loss.
            let r2 = r.length_squared();
            let w = if r2 > 1e-12 { (4.0 * (r2 / 4.0).ln_1p() / r2).sqrt() } else { cauchy_weight(r2, 2.0) };
            out.extend([worth * w * r.x, worth * w * r.y]);
        }
        out.push((log_focal + x[6] - prior.log_focal.0) / held(prior.log_focal.1));
        let k1 = if prior.lens[0] > 0.0 { optics.lens.k1 + x[7] } else { x[7] };
        out.push(k1 / held(prior.lens[0]));
    };
    let steps = [1e-7; 8];
    let (x, _) = minimise_small([0.0; 8], steps, 30, residuals);
    let mut at = Vec::new();
    residuals(&x, &mut at);
    let column = |k: usize| {
        let (mut y, mut moved) = (x, Vec::new());
        y[k] += steps[k];
        residuals(&y, &mut moved);
        moved.iter().zip(&at).map(|(a, b)| (a - b) / steps[k]).collect::<Vec<f64>>()
    };
    let columns: Vec<Vec<f64>> = (0..8).map(column).collect();
    let h = DMatrix::from_fn(8, 8, |i, j| columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum());
    let size = pose.translation.length().max(1e-3);
    let step = Pose::exp(DVec3::new(x[0], x[1], x[2]) * size, DVec3::new(x[3], x[4], x[5]));
    model.poses[view] = Some(step.compose(&pose).orthonormalised());
    let own = &mut model.optics[view];
    own.focal *= x[6].exp();
    own.lens.k1 += x[7];
    let unknown = std::f64::consts::PI;
    let Some(inverse) = h.cholesky().map(|f| f.inverse()) else {
        return Sigmas { log_focal: prior.log_focal.1, k1: prior.lens[0], rotation: unknown };
    };
    let turn: SMatrix<f64, 3, 3> = inverse.fixed_view::<3, 3>(3, 3).into();
    Sigmas {
        log_focal: inverse[(6, 6)].sqrt(),
        k1: if prior.lens[0] > 0.0 { inverse[(7, 7)].sqrt() } else { 0.0 },
        rotation: turn.symmetric_eigenvalues().max().max(0.0).sqrt().min(unknown),
    }
}

fn sparse_model(
    model: &Model,
    photos: &[Photo],
    known: Known,
    shares: &[f64],
    sigmas: &[Sigmas],
) -> SparseModel {
    let by_file = empty_model(photos, 0).group;
    let highest = known.fitted.iter().map(|f| f.camera + 1).max().unwrap_or(0);
    let count = known.cameras.len();
    let camera = |v: usize| match known.cameras.get(v) {
        Some(c) => c.clone(),
        None => {
            let p = &photos[v];
            Camera {
                name: p.path.file_name().map_or_else(|| p.stem.clone(), |n| n.to_string_lossy().into()),
                width: p.image.width as u32,
                height: p.image.height as u32,
                fx: model.focal(v),
                fy: model.focal(v),
                cx: model.principal_point(v).x,
                cy: model.principal_point(v).y,
                // Registered: `register` gave every view one or failed.
                pose: model.poses[v].unwrap_or(Pose::IDENTITY),
            }
        }
    };
    let fitted = |v: usize| match known.fitted.get(v) {
        Some(f) => *f,
        None => {
            let alike = (0..count).find(|o| by_file[*o] == by_file[v]);
            Fitted {
                lens: model.lens(v),
                sigmas: [sigmas[v].log_focal, sigmas[v].k1, 0.0, 0.0, 0.0],
                residual: model.residual(v),
                agreement: shares[v],
                rotation_sigma: sigmas[v].rotation,
                camera: alike.map_or(highest + by_file[v], |o| known.fitted[o].camera),
            }
        }
    };
    let point = |t: &Track| {
        let views: Vec<(usize, DVec2)> = t
            .sightings
            .iter()
            .map(|s| (s.view, model.straight(s.view, s.pixel) + model.principal_point(s.view)))
            .collect();
        let s = t.sightings.first()?;
        Some(SparsePoint { position: t.position?, colour: photos[s.view].image.nearest(s.pixel), views })
    };
    SparseModel {
        cameras: (0..photos.len()).map(camera).collect(),
        points: model.tracks.iter().filter_map(point).collect(),
        focal_log_sigma: None,
        fitted: (0..photos.len()).map(fitted).collect(),
    }
}
