//! The cameras of a scene and of photos that join it, adjusted together
//! (docs/internals/method.md#photos-added-later).
use super::finish::{reweight_and_adjust, straightened, sub_pixel};
use super::model::{Freedom, Model};
use super::optics::adjust_optics;
use crate::Result;
use crate::bundle::{Adjusted, Optics, OpticsPrior};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{Lens, RgbImage};
use glam::{DVec2, DVec3};

/// σ of ln f about what the scene says of its cameras: wide, since the same sightings and more are
/// weighed again.
const FOCAL_SIGMA: f64 = 0.05;

/// Adjusts all cameras and points of a model whose first `known` views are those of a scene,
/// sightings refined to sub-pixel and further points added as for a new scene. Views of one
/// `camera`, numbered in any way, share their focal length in the ratios that they have. The world
/// frame stays: the first camera where it is, the unit that of the first `known`. The model ends as
/// one of pinholes.
pub(super) fn adjust(
    model: &mut Model,
    photos: &[Photo],
    known: usize,
    camera: &[usize],
    threshold: f64,
    progress: &dyn Progress,
) -> Result<Adjusted> {
    let centres =
        |m: &Model| -> Vec<DVec3> { m.poses[..known].iter().flatten().map(|p| p.centre()).collect() };
    let before = centres(model);
    let straight: Vec<RgbImage> =
        (0..photos.len()).map(|v| straightened(model, v, &photos[v].image)).collect();
    *model = without_lens(model).regrouped(camera);
    model.adjust(f64::INFINITY, 1.5, 60)?;
    reweight_and_adjust(model)?;
    sub_pixel(model, photos, &straight, threshold, progress)?;
    let outcome = adjust_optics(model, Freedom::Focal)?;
    rescale(model, &before, &centres(model));
    Ok(outcome)
}

/// The same model of the photos as pinholes show them, with optics of its own for each view: focal
/// length 1, all of it in the zoom.
fn without_lens(model: &Model) -> Model {
    let mut out = model.clone();
    for s in out.tracks.iter_mut().flat_map(|t| &mut t.sightings) {
        s.pixel = model.straight(s.view, s.pixel) + model.principal_point(s.view);
    }
    let views = 0..model.poses.len();
    out.centres = views.clone().map(|v| model.principal_point(v)).collect();
    out.zoom = views.clone().map(|v| model.focal(v)).collect();
    out.group = views.clone().collect();
    out.optics = vec![Optics { focal: 1.0, lens: Lens::NONE, shift: DVec2::ZERO }; views.len()];
    out.priors = vec![OpticsPrior { log_focal: (0.0, FOCAL_SIGMA), ..OpticsPrior::default() }; views.len()];
    out
}

/// Scales the world about the first of the centres so that they are, in the mean, as far from it as
/// `before`.
fn rescale(model: &mut Model, before: &[DVec3], after: &[DVec3]) {
    let Some((first, old)) = after.first().zip(before.first()) else { return };
    let pairs = || before.iter().zip(after).map(|(b, a)| (*b - *old, *a - *first));
    let (dot, norm) = pairs().fold((0.0, 0.0), |sum, (b, a)| (sum.0 + a.dot(b), sum.1 + a.length_squared()));
    if !(dot > 0.0 && norm > 0.0) {
        return;
    }
    let scaled = |x: DVec3| *old + (x - *first) * (dot / norm);
    // The first is where it was.
    for pose in model.poses.iter_mut().skip(1).flatten() {
        pose.translation = -(pose.rotation * scaled(pose.centre()));
    }
    for x in model.tracks.iter_mut().filter_map(|t| t.position.as_mut()) {
        *x = scaled(*x);
    }
}
