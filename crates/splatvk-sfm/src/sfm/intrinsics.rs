//! Selection of the intrinsics that the observations determine, and of the photos that share a
//! camera.
use super::crops;
use super::fit::{IntrinsicsFit, MAX_COST_SHARE, STEPS, fit_intrinsics};
use super::model::{Model, RefinedIntrinsics};
use crate::Result;
use crate::bundle::Adjusted;
use rayon::prelude::*;

/// Most steps from an optimum of the same observations with one camera more: the cost that remains
/// after them does not decide.
const STEPS_JOINED: usize = 12;

/// Adjusts with `refined` intrinsics; standard deviations as from [`estimate_intrinsics`].
pub(super) fn adjust_intrinsics(model: &mut Model, refined: RefinedIntrinsics) -> Result<Adjusted> {
    let mut found = fit_intrinsics(model, refined, STEPS)?;
    found.widen_sigmas();
    *model = found.model;
    Ok(found.outcome)
}

/// Most tracks of a fit that is only compared with others. They have at least twice the
/// independent observations of [`Model::effective_observations`].
const COMPARED: usize = 3000;

/// Best fit over `choices`.
fn best_fit(model: &Model, choices: &[RefinedIntrinsics]) -> Result<IntrinsicsFit> {
    let fit = |refined: &RefinedIntrinsics| fit_intrinsics(model, *refined, STEPS);
    let mut all = choices.par_iter().map(fit).collect::<Vec<_>>().into_iter().collect::<Result<Vec<_>>>()?;
    all.sort_by(|a, b| a.bic.total_cmp(&b.bic));
    Ok(all.swap_remove(0))
}

/// Merges cameras of photos that may share one, as long as the criterion falls.
fn merge_cameras(mut best: IntrinsicsFit) -> Result<IntrinsicsFit> {
    for view in 1..best.model.camera_ids.len() {
        let mut tried = Vec::new();
        for other in 0..view {
            let target = best.model.camera_ids[other];
            if best.model.camera_ids_by_file[other] != best.model.camera_ids_by_file[view]
                || tried.contains(&target)
            {
                continue;
            }
            tried.push(target);
            let mut camera_ids = best.model.camera_ids.clone();
            camera_ids[view] = target;
            let trial =
                fit_intrinsics(&best.model.with_camera_ids(&camera_ids), best.model.refined, STEPS_JOINED)?;
            if trial.bic < best.bic {
                best = trial;
                break;
            }
        }
    }
    Ok(best)
}

/// Selects the intrinsics to refine and the photos that share a camera, and adjusts. The standard
/// deviations are those of a fit of all intrinsics, since parameters that the criterion drops may
/// still be present.
pub(super) fn estimate_intrinsics(model: &mut Model) -> Result<Adjusted> {
    let tracks = model.thin(COMPARED);
    let chosen = select_intrinsics(model)?;
    *model = Model { tracks, ..chosen };
    let mut found = fit_intrinsics(model, model.refined, STEPS)?;
    if model.refined != RefinedIntrinsics::Full {
        let of_all = fit_intrinsics(&found.model, RefinedIntrinsics::Full, STEPS)?.outcome;
        found.outcome = Adjusted { cost: found.outcome.cost, ..of_all };
    }
    found.widen_sigmas();
    *model = found.model;
    Ok(found.outcome)
}

/// The model with the intrinsics to refine and the camera ids of the best criterion.
fn select_intrinsics(model: &Model) -> Result<Model> {
    let apart = model.with_separate_intrinsics();
    // Shared cameras are decided only once.
    let merged = model.camera_ids != model.camera_ids_by_file
        && apart.as_ref().is_some_and(|a| a.camera_ids != model.camera_ids);
    let decided = model.has_crops() || merged;
    let start = if decided { model.clone() } else { model.with_camera_ids(&model.camera_ids_by_file) };
    let (found, apart) = rayon::join(
        || best_fit(&start, &RefinedIntrinsics::ALL),
        || {
            let few = [RefinedIntrinsics::Focal, RefinedIntrinsics::Radial];
            apart.filter(|_| !decided).map(|apart| best_fit(&apart, &few))
        },
    );
    let mut found = found?;
    if let Some(apart) = apart.transpose()?
        && apart.bic < found.bic
    {
        let several = best_fit(&merge_cameras(apart)?.model, &RefinedIntrinsics::ALL)?;
        if several.bic < shared_camera_criterion(&found)? {
            found = several;
        }
    }
    Ok(crops::with_crops(found)?.model)
}

/// Bound of the criterion for several cameras: its value if photos that may share a camera do so
/// and only its principal point moves from photo to photo, as by image stabilisation, with
/// [`MAX_COST_SHARE`] of the cost. Separate intrinsics would turn such movement into wrong focal
/// lengths.
fn shared_camera_criterion(shared: &IntrinsicsFit) -> Result<f64> {
    let mut model = shared.model.with_camera_ids(&shared.model.camera_ids_by_exif);
    for (prior, intrinsics) in model.priors.iter_mut().zip(&model.intrinsics) {
        prior.log_focal = (intrinsics.focal.ln(), 0.0);
        prior.lens = [0.0; 2];
    }
    let moved = fit_intrinsics(&model, RefinedIntrinsics::Full, STEPS)?;
    let n = model.effective_observations(model.residual_components());
    Ok(moved.bic + shared.model.intrinsics_parameters() as f64 * n.ln() + n * MAX_COST_SHARE.ln())
}
