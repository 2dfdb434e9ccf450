//! Registration of photos to a scene with known cameras
//! (docs/internals/method.md#photos-added-later).
use super::detectors::{detect_features, keypoints};
use super::finish::{agreement, inlier_matches, sparse_points};
use super::global_ba;
use super::grow::{MIN_RESECTION, Resection, resection};
use super::model::{Model, RefinedIntrinsics, Track, TrackElement};
use super::pair::{Matches, Pair};
use super::tracks::{self, KeypointMatch};
use super::unregistered::Unregistered;
use super::verify::{MIN_INLIERS, THRESHOLD, VerifiedMatches, verify_added};
use crate::bundle::{Intrinsics, IntrinsicsPrior};
use crate::choose::Reason;
use crate::matching::Keypoints;
use crate::math::median;
use crate::numeric::{cauchy_weight, minimise_small};
use crate::photo::{Photo, cameras_by_file};
use crate::progress::Progress;
use crate::scene::{Camera, Lens, Pose};
use crate::{Error, Result};
use crate::{Fitted, SparseModel};
use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, SMatrix};

/// Cameras of a scene, whose photos are undistorted.
#[derive(Clone, Copy)]
pub struct Known<'a> {
    /// At working resolution; fx and fy are treated as equal. The world frame is that of these
    /// cameras.
    pub cameras: &'a [Camera],
    /// Estimated intrinsics and fit quality.
    pub fitted: &'a [Fitted],
}

/// σ of ln f of a photo from a camera of the scene at the same zoom: nearer focus lengthens f by
/// about a percent.
const SAME_CAMERA_SIGMA: f64 = 0.01;
/// Fewest points with observations in two other photos for a refinement on those alone: fewer leave
/// the pose to chance, and points that only one other photo observes give way to any pose.
const MIN_FIXED: usize = 30;
/// Rounds of refining the camera and triangulating the points: the second changes the pose by less
/// than its σ.
const ROUNDS: usize = 3;

/// Largest difference of ln f, in σ, between photos of one camera.
const AGREES: f64 = 3.0;

/// Registers all `photos` except for the first ones, which are `known`; `features` are one per
/// photo. Returns the cameras and points of all. The error names photos that share too little with
/// the others.
pub fn with_added(
    photos: &[Photo],
    known: Known,
    features: &[Keypoints],
    seed: u64,
    progress: &dyn Progress,
) -> Result<SparseModel, Unregistered> {
    let count = known.cameras.len();
    progress.begin("cameras", 4);
    progress.step(0, "matches");
    let mut detectors = detect_features(photos, features, progress)?;
    let mut model = start_model(photos, known.cameras, seed)?;
    let focals: Vec<f64> = (0..photos.len()).map(|v| model.focal(v)).collect();
    let VerifiedMatches { putative, pairs } = verify_added(photos, &mut detectors, &model, count, progress)?;
    progress.step(1, "poses");
    let long = photos[0].image.width.max(photos[0].image.height) as f64;
    let threshold = THRESHOLD * long;
    let old: Vec<Matches> = putative.into_iter().filter(|p| p.second < count).collect();
    let mut links: Vec<KeypointMatch> = inlier_matches(&model, &old, threshold);
    links.extend(pairs.iter().flat_map(|p| p.matches.list.iter().map(|m| m.2)));
    let keypoints: Vec<Vec<TrackElement>> = (0..photos.len()).map(|v| keypoints(&detectors, v)).collect();
    model.tracks = tracks::join(&mut links, &keypoints)
        .into_iter()
        .map(|elements| Track { position: None, elements })
        .collect();
    model.triangulate_all(2.0 * threshold);
    let mut sigmas = vec![Sigmas::default(); photos.len()];
    for _ in count..photos.len() {
        progress.check()?;
        let view = register(&mut model, photos, &pairs, threshold)?;
        for _ in 0..ROUNDS {
            model.triangulate_all(threshold);
            sigmas[view] = refine_view(&mut model, view, threshold);
        }
        model.triangulate_all(2.0 * threshold);
    }
    model.triangulate_all(threshold);
    model.prune(threshold);
    check_observations(&model, photos, count)?;
    let shares = agreement(&model, &pairs, threshold);
    let mut fitted = fitted(&model, photos, known, &pairs, &shares, &sigmas);
    if known.fitted.iter().all(|f| f.sigmas[0] > 0.0) {
        progress.step(2, "all cameras");
        share_intrinsics(&mut model, &mut fitted, &focals, count);
        let camera: Vec<usize> = fitted.iter().map(|f| f.camera).collect();
        let outcome = global_ba::adjust(&mut model, photos, count, &camera, threshold, progress)?;
        for (v, own) in fitted.iter_mut().enumerate() {
            own.sigmas[0] = outcome.sigmas[model.camera_ids[v]][0];
            own.residual = model.median_error(v);
            if v > 0 {
                own.rotation_sigma = outcome.rotation_sigmas[v];
            }
        }
    }
    progress.step(3, "points");
    let cameras = (0..photos.len()).map(|v| camera(&model, photos, known.cameras, v)).collect();
    let points = sparse_points(photos, &model);
    let out = SparseModel { cameras, points, fitted, ..SparseModel::default() };
    progress.step(4, &format!("{} points", out.points.len()));
    progress.end();
    Ok(out)
}

/// Sets the focal length of new photos to that of their known camera where they agree, and gives
/// others a new camera id. `focals`: expected focal length per view.
fn share_intrinsics(model: &mut Model, fitted: &mut [Fitted], focals: &[f64], known: usize) {
    for view in known..fitted.len() {
        let found = model.focal(view) / focals[view];
        if found.ln().abs() < AGREES * fitted[view].sigmas[0] {
            model.intrinsics[view].focal /= found;
        } else {
            fitted[view].camera = fitted.iter().map(|f| f.camera + 1).max().unwrap_or(0);
        }
    }
}

/// Model with the known cameras; new photos get the intrinsics of their camera. The error names a
/// photo of another camera.
fn start_model(photos: &[Photo], cameras: &[Camera], seed: u64) -> Result<Model, Unregistered> {
    let known = |v: usize| cameras.get(v);
    let views = || 0..photos.len();
    let middle = |v: usize| DVec2::new(photos[v].image.width as f64, photos[v].image.height as f64) * 0.5;
    let by_view = views().map(|v| match known(v) {
        Some(c) => {
            let focal = 0.5 * (c.fx + c.fy);
            let intrinsics = Intrinsics { focal, lens: Lens::NONE, principal_point_offset: DVec2::ZERO };
            Ok((intrinsics, IntrinsicsPrior::default()))
        }
        None => shared_intrinsics(photos, cameras, v).ok_or_else(|| Unregistered {
            views: vec![(v, Reason::NoOverlap)],
            error: Error::input(format!(
                "{}: by its file taken with another camera, size or zoom than the scene's photos; photos of the same camera can be \
                 added, for others make a scene of all photos",
                photos[v].stem
            )),
        }),
    });
    let (intrinsics, priors) = by_view.collect::<Result<Vec<_>, Unregistered>>()?.into_iter().unzip();
    Ok(Model {
        poses: views().map(|v| known(v).map(|c| c.pose)).collect(),
        centres: views().map(|v| known(v).map_or(middle(v), |c| DVec2::new(c.cx, c.cy))).collect(),
        camera_ids: views().collect(),
        camera_ids_by_file: views().collect(),
        camera_ids_by_exif: views().collect(),
        zoom: views().map(|v| if known(v).is_some() { 1.0 } else { photos[v].zoom() }).collect(),
        intrinsics,
        priors,
        refined: RefinedIntrinsics::Focal,
        tracks: Vec::new(),
        seed,
    })
}

/// Intrinsics of a scene photo whose file states the same camera as the new one, and their prior
/// for this one.
fn shared_intrinsics(
    photos: &[Photo],
    cameras: &[Camera],
    view: usize,
) -> Option<(Intrinsics, IntrinsicsPrior)> {
    let by_file = cameras_by_file(photos);
    let same_camera = (0..cameras.len()).find(|o| by_file[*o] == by_file[view])?;
    let (taken, photo) = (photos[same_camera].original_camera(&cameras[same_camera]), &photos[same_camera]);
    let middle = DVec2::new(f64::from(photo.original_size.0), f64::from(photo.original_size.1)) * 0.5;
    let focal = 0.5 * (taken.fx + taken.fy);
    // Portrait and landscape photos of a camera have different principal points in upright pixels.
    let principal_point_offset = match photo.original_size == photos[view].original_size {
        true => DVec2::new(taken.cx, taken.cy) - middle,
        false => DVec2::ZERO,
    };
    let prior = IntrinsicsPrior {
        log_focal: (focal.ln(), SAME_CAMERA_SIGMA),
        lens: [0.0; 2],
        principal_point_offset: 0.0,
    };
    Some((Intrinsics { focal, lens: photo.lens(), principal_point_offset }, prior))
}

/// Registers the view with the most inliers and returns it. The error names all unregistered views
/// if none has enough.
fn register(
    model: &mut Model,
    photos: &[Photo],
    pairs: &[Pair],
    threshold: f64,
) -> Result<usize, Unregistered> {
    let remaining: Vec<usize> = (0..photos.len()).filter(|v| model.poses[*v].is_none()).collect();
    let found = remaining.iter().filter_map(|v| Some((*v, resection(model, *v, threshold)?)));
    let best: Option<(usize, Resection)> = found.max_by_key(|(v, r)| (r.count, std::cmp::Reverse(*v)));
    match best.filter(|b| b.1.count >= MIN_RESECTION) {
        Some((view, found)) => {
            model.poses[view] = Some(found.pose);
            model.intrinsics[view].focal *= found.stretch;
            Ok(view)
        }
        None => Err(unregistered(photos, &remaining, pairs)),
    }
}

fn unregistered(photos: &[Photo], remaining: &[usize], pairs: &[Pair]) -> Unregistered {
    let matches = |view: usize| {
        let own = pairs.iter().filter(|p| [p.matches.first, p.matches.second].contains(&view));
        own.map(|p| p.matches.list.len()).max().unwrap_or(0)
    };
    let names: Vec<String> = remaining
        .iter()
        .map(|&v| match matches(v) {
            0 => format!("{} (no photo of the scene shows the same)", photos[v].stem),
            n => format!("{} ({n} matches with the nearest photo)", photos[v].stem),
        })
        .collect();
    Unregistered {
        views: remaining.iter().map(|v| (*v, Reason::NoOverlap)).collect(),
        error: Error::input(format!(
            "no place found in the scene for {}; it shows too little of what the scene's photos show: add a photo from between first",
            names.join(", ")
        )),
    }
}

/// Returns an error that names the new photos with too few observations.
fn check_observations(model: &Model, photos: &[Photo], known: usize) -> Result<(), Unregistered> {
    let shown = |v: usize| model.tracks.iter().filter(|t| t.elements.iter().any(|s| s.view == v)).count();
    let few: Vec<usize> = (known..photos.len()).filter(|v| shown(*v) < MIN_INLIERS).collect();
    if few.is_empty() { Ok(()) } else { Err(unregistered(photos, &few, &[])) }
}

/// Standard deviations of a registered view.
#[derive(Clone, Copy, Default)]
struct Sigmas {
    log_focal: f64,
    /// Radians.
    rotation: f64,
}

/// Refines pose and focal length of a view; the points stay fixed.
fn refine_view(model: &mut Model, view: usize, threshold: f64) -> Sigmas {
    let prior = model.priors[view];
    let Some(pose) = model.poses[view] else { return Sigmas::default() };
    let element = |t: &Track| {
        let (x, s) = (t.position?, *t.elements.iter().find(|s| s.view == view)?);
        (model.reprojection_error(&s, x) < 2.0 * threshold).then_some((x, s.pixel, t.elements.len() > 2))
    };
    let mut seen: Vec<(DVec3, DVec2, bool)> = model.tracks.iter().filter_map(element).collect();
    if seen.iter().filter(|s| s.2).count() >= MIN_FIXED {
        seen.retain(|s| s.2);
    }
    let (intrinsics, zoom, centre) = (model.intrinsics[view], model.zoom[view], model.principal_point(view));
    let project = |x: &[f64; 7], world: DVec3| -> DVec2 {
        let size = pose.translation.length().max(1e-3);
        let step = Pose::exp(DVec3::new(x[0], x[1], x[2]) * size, DVec3::new(x[3], x[4], x[5]));
        let t = step.compose(&pose).transform(world);
        intrinsics.lens.distort(DVec2::new(t.x, t.y) / t.z.max(1e-9)) * (intrinsics.focal * x[6].exp() * zoom)
            + centre
    };
    let mut squares: Vec<f64> =
        seen.iter().map(|s| (project(&[0.0; 7], s.0) - s.1).length_squared()).collect();
    let Some(middle) = median(&mut squares) else { return Sigmas::default() };
    // The median of the squared length of a 2-D normal deviate is 2 ln 2 σ²; below 0.05 px the lens
    // limits.
    let sigma = (middle / (2.0 * std::f64::consts::LN_2)).sqrt().max(0.05);
    // Errors of neighbours are correlated: observations count as their effective number against the
    // priors.
    let weight = (model.effective_observations(2 * seen.len()) / (2 * seen.len()).max(1) as f64).sqrt();
    let log_focal = intrinsics.focal.ln();
    let residuals = |x: &[f64; 7], out: &mut Vec<f64>| {
        out.clear();
        for (world, pixel, _) in &seen {
            let r = (project(x, *world) - *pixel) / sigma;
            // sqrt of the Cauchy loss along the residual, scale 2 σ: its square sums to the loss.
            let r2 = r.length_squared();
            let w = if r2 > 1e-12 { (4.0 * (r2 / 4.0).ln_1p() / r2).sqrt() } else { cauchy_weight(r2, 2.0) };
            out.extend([weight * w * r.x, weight * w * r.y]);
        }
        out.push((log_focal + x[6] - prior.log_focal.0) / prior.log_focal.1);
    };
    let steps = [1e-7; 7];
    let (x, _) = minimise_small([0.0; 7], steps, 30, residuals);
    let mut optimum = Vec::new();
    residuals(&x, &mut optimum);
    let jacobian_column = |k: usize| {
        let (mut y, mut moved) = (x, Vec::new());
        y[k] += steps[k];
        residuals(&y, &mut moved);
        moved.iter().zip(&optimum).map(|(a, b)| (a - b) / steps[k]).collect::<Vec<f64>>()
    };
    let columns: Vec<Vec<f64>> = (0..7).map(jacobian_column).collect();
    let h: DMatrix<f64> =
        DMatrix::from_fn(7, 7, |i, j| columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum());
    let size = pose.translation.length().max(1e-3);
    let step = Pose::exp(DVec3::new(x[0], x[1], x[2]) * size, DVec3::new(x[3], x[4], x[5]));
    model.poses[view] = Some(step.compose(&pose).orthonormalised());
    model.intrinsics[view].focal *= x[6].exp();
    let unknown = std::f64::consts::PI;
    let Some(inverse) = h.cholesky().map(|f| f.inverse()) else {
        return Sigmas { log_focal: prior.log_focal.1, rotation: unknown };
    };
    let turn: SMatrix<f64, 3, 3> = inverse.fixed_view::<3, 3>(3, 3).into();
    Sigmas {
        log_focal: inverse[(6, 6)].sqrt(),
        rotation: turn.symmetric_eigenvalues().max().max(0.0).sqrt().min(unknown),
    }
}

/// Camera of a view; known cameras keep everything that the model does not contain.
fn camera(model: &Model, photos: &[Photo], known: &[Camera], v: usize) -> Camera {
    let p = &photos[v];
    let (focal, centre) = (model.focal(v), model.principal_point(v));
    // Every view has a pose, or `register` has failed.
    let pose = model.poses[v].unwrap_or(Pose::IDENTITY);
    match known.get(v) {
        Some(camera) => {
            // The ratio of fx and fy is kept.
            let ratio = focal / (0.5 * (camera.fx + camera.fy));
            Camera { fx: camera.fx * ratio, fy: camera.fy * ratio, pose, ..camera.clone() }
        }
        None => Camera {
            name: p.path.file_name().map_or_else(|| p.stem.clone(), |n| n.to_string_lossy().into()),
            width: p.image.width as u32,
            height: p.image.height as u32,
            fx: focal,
            fy: focal,
            cx: centre.x,
            cy: centre.y,
            pose,
        },
    }
}

/// Fit results: of the scene's photos as known, of new ones from their registration.
fn fitted(
    model: &Model,
    photos: &[Photo],
    known: Known,
    pairs: &[Pair],
    shares: &[f64],
    sigmas: &[Sigmas],
) -> Vec<Fitted> {
    let by_file = cameras_by_file(photos);
    let highest = known.fitted.iter().map(|f| f.camera + 1).max().unwrap_or(0);
    let count = known.cameras.len();
    let own = |v: usize| pairs.iter().filter(move |p| [p.matches.first, p.matches.second].contains(&v));
    let fit_of = |v: usize| match known.fitted.get(v) {
        Some(f) => *f,
        None => {
            let same_camera = (0..count).find(|o| by_file[*o] == by_file[v]);
            Fitted {
                lens: model.lens(v),
                sigmas: [sigmas[v].log_focal, 0.0, 0.0, 0.0, 0.0],
                residual: model.median_error(v),
                agreement: shares[v],
                // A single pair whose inliers are few or a minority is no confirmation.
                unconfirmed: own(v).count() < 2 && !own(v).any(|p| p.sure),
                rotation_sigma: sigmas[v].rotation,
                camera: same_camera.map_or(highest + by_file[v], |o| known.fitted[o].camera),
            }
        }
    };
    (0..photos.len()).map(fit_of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::pose_errors;
    use crate::progress::Silent;
    use crate::testing::{self, Truth};

    /// Adds `new` to the first three photos of breakfast with their true cameras.
    fn add_photo(truth: &Truth, new: Photo) -> Result<SparseModel, Unregistered> {
        let known: Vec<Camera> = truth.cameras[..3].to_vec();
        let fitted = [Fitted { agreement: 1.0, ..Fitted::default() }; 3];
        let mut photos = truth.photos[..3].to_vec();
        photos.push(new);
        let known = Known { cameras: &known, fitted: &fitted };
        with_added(&photos, known, &[], 0, &Silent)
    }

    fn check(truth: &Truth, new: Photo, focal: f64) -> SparseModel {
        let model = add_photo(truth, new).unwrap();
        assert_eq!(model.cameras[..3], truth.cameras[..3], "known cameras stay");
        let (is, was) = (&model.cameras[3], &truth.cameras[3]);
        let e = pose_errors(&model.cameras, &truth.cameras, truth.mean_depth);
        let own = model.fitted[3];
        println!(
            "rotation {:.3}° centre {:.3} % focal {:.2} % ± {:.2} %, agreement {:.3}, rotation ± {:.3}°, k1 {:.4}",
            e.rotation_degrees[3],
            100.0 * (is.pose.centre() - was.pose.centre()).length() / truth.mean_depth,
            100.0 * (is.fx / focal - 1.0),
            100.0 * own.sigmas[0],
            own.agreement,
            own.rotation_sigma.to_degrees(),
            own.lens.k1,
        );
        // Limits of a whole reconstruction: 0.2°, 0.3 % of the depth, 1 %.
        assert!(e.rotation_degrees[3] < 0.2, "{:?}", e.rotation_degrees);
        assert!((is.pose.centre() - was.pose.centre()).length() < 0.003 * truth.mean_depth);
        assert!((is.fx / focal - 1.0).abs() < 0.01, "{} {focal}", is.fx);
        assert_eq!(own.confidence(), crate::Confidence::High);
        model
    }

    #[test]
    fn with_added_registers_same_camera() {
        let truth = testing::train(&testing::folder());
        let model = check(&truth, truth.photos[3].clone(), truth.cameras[3].fx);
        assert!(model.fitted[3].lens.is_none(), "the scene's lens is none");
        assert_eq!(model.fitted[3].camera, 0);
    }

    #[test]
    fn with_added_improves_estimated_cameras() {
        let truth = testing::train(&testing::folder());
        let mut known = truth.cameras[..3].to_vec();
        for (camera, turn) in known.iter_mut().zip([0.0, 2e-3, -2e-3]) {
            camera.pose = Pose::exp(DVec3::ZERO, DVec3::new(turn, 0.5 * turn, 0.0)).compose(&camera.pose);
            (camera.fx, camera.fy) = (camera.fx * 1.003, camera.fy * 1.003);
        }
        let sigmas = [0.003, 0.0, 0.0, 0.0, 0.0];
        let fitted = [Fitted { agreement: 1.0, sigmas, ..Fitted::default() }; 3];
        let model =
            with_added(&truth.photos, Known { cameras: &known, fitted: &fitted }, &[], 0, &Silent).unwrap();
        let errors = |cameras: &[Camera]| pose_errors(cameras, &truth.cameras, truth.mean_depth);
        let (was, is) = (errors(&known), errors(&model.cameras));
        println!("rotation {:?}° of {:?}°", is.rotation_degrees, was.rotation_degrees);
        println!("centre {:?} focal {:?}", is.centre, is.focal);
        let worst = |v: &[f64]| v.iter().copied().fold(0.0, f64::max);
        // Half of the limits of a whole reconstruction.
        assert!(worst(&is.rotation_degrees) < 0.1 && worst(&was.rotation_degrees) > 0.1, "{is:?} {was:?}");
        assert!(worst(&is.centre) < 0.003 && worst(&is.focal) < 0.003, "{is:?}");
        // The world frame stays.
        assert_eq!(model.cameras[0].pose, known[0].pose);
        let size = |cameras: &[Camera]| {
            let from_first = |c: &Camera| (c.pose.centre() - cameras[0].pose.centre()).length();
            cameras[..3].iter().map(from_first).sum::<f64>()
        };
        assert!((size(&model.cameras) / size(&known) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn with_added_refuses_other_camera() {
        let truth = testing::train(&testing::folder());
        let small = truth.photos[3].image.resized_by_area(480, 360);
        let new = crate::photo::from_pixels("other.png".as_ref(), &small, None, 480).unwrap();
        let error = add_photo(&truth, new).err().unwrap().error.to_string();
        assert!(error.starts_with("other: by its file taken with another camera"), "{error}");
    }

    #[test]
    fn with_added_refuses_unrelated_and_duplicate() {
        let truth = testing::small_train();
        let mut sky = truth.photos[3].clone();
        sky.stem = "sky".into();
        sky.image.data.iter_mut().enumerate().for_each(|(i, c)| *c = [0.4, 0.6, 0.5 + 1e-7 * i as f32]);
        let error = add_photo(&truth, sky).err().unwrap();
        assert_eq!(error.views, [(3, Reason::NoOverlap)]);
        assert!(
            error.error.to_string().contains("sky (no photo of the scene shows the same)"),
            "{}",
            error.error
        );
        let again = Photo { stem: "again".into(), ..truth.photos[1].clone() };
        let error = add_photo(&truth, again).err().unwrap();
        assert!(error.error.to_string().contains("again: the same picture as train_01"), "{}", error.error);
    }
}
