//! Global bundle adjustment of a scene with added photos
//! (docs/internals/method.md#photos-added-later).
use super::finish::{reweight_and_adjust, sub_pixel, undistorted_image};
use super::intrinsics::adjust_intrinsics;
use super::model::{Model, RefinedIntrinsics};
use crate::Result;
use crate::bundle::{Adjusted, Intrinsics, IntrinsicsPrior};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{Lens, RgbImage};
use glam::{DVec2, DVec3};

/// σ of ln f about the focal lengths of the scene: wide, since its observations are used again.
const FOCAL_SIGMA: f64 = 0.05;

/// Adjusts all cameras and points of a model whose first `known` views are those of a scene, and
/// refines and adds points as for a new scene. Views of one id in `camera` share their focal length
/// in the ratios that they have. The first camera stays fixed, and the known cameras keep their
/// scale. The resulting model has no distortion.
pub(super) fn adjust(
    model: &mut Model,
    photos: &[Photo],
    known: usize,
    camera: &[usize],
    threshold: f64,
    progress: &dyn Progress,
) -> Result<Adjusted> {
    let before = camera_centres(model, known);
    let undistorted: Vec<RgbImage> =
        (0..photos.len()).map(|v| undistorted_image(model, v, &photos[v].image)).collect();
    *model = without_lens(model).with_camera_ids(camera);
    model.adjust(f64::INFINITY, 1.5, 60)?;
    reweight_and_adjust(model)?;
    sub_pixel(model, photos, &undistorted, threshold, progress)?;
    let outcome = adjust_intrinsics(model, RefinedIntrinsics::Focal)?;
    rescale(model, &before, &camera_centres(model, known));
    Ok(outcome)
}

fn camera_centres(model: &Model, count: usize) -> Vec<DVec3> {
    model.poses[..count].iter().flatten().map(|p| p.centre()).collect()
}

/// The model of the undistorted photos, with separate intrinsics per view: focal length 1, scaled
/// by `zoom`.
fn without_lens(model: &Model) -> Model {
    let mut out = model.clone();
    for s in out.tracks.iter_mut().flat_map(|t| &mut t.elements) {
        s.pixel = model.undistorted(s.view, s.pixel) + model.principal_point(s.view);
    }
    let views = 0..model.poses.len();
    out.centres = views.clone().map(|v| model.principal_point(v)).collect();
    out.zoom = views.clone().map(|v| model.focal(v)).collect();
    out.camera_ids = views.clone().collect();
    out.intrinsics =
        vec![Intrinsics { focal: 1.0, lens: Lens::NONE, principal_point_offset: DVec2::ZERO }; views.len()];
    out.priors =
        vec![IntrinsicsPrior { log_focal: (0.0, FOCAL_SIGMA), ..IntrinsicsPrior::default() }; views.len()];
    out
}

/// Scales the world about the first centre so that the distances from it fit those of `before`.
fn rescale(model: &mut Model, before: &[DVec3], after: &[DVec3]) {
    let Some((first, old)) = after.first().zip(before.first()) else { return };
    let pairs = || before.iter().zip(after).map(|(b, a)| (*b - *old, *a - *first));
    let (dot, norm) = pairs().fold((0.0, 0.0), |sum, (b, a)| (sum.0 + a.dot(b), sum.1 + a.length_squared()));
    if !(dot > 0.0 && norm > 0.0) {
        return;
    }
    let scaled = |x: DVec3| *old + (x - *first) * (dot / norm);
    // The first camera keeps its pose.
    for pose in model.poses.iter_mut().skip(1).flatten() {
        pose.translation = -(pose.rotation * scaled(pose.centre()));
    }
    for x in model.tracks.iter_mut().filter_map(|t| t.position.as_mut()) {
        *x = scaled(*x);
    }
}
