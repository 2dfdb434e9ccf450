//! What the sightings determine of the optics, and which of them share a camera.
use super::crops;
use super::fit::{MAX_COST_SHARE, OpticsFit, STEPS, fit_optics};
use super::model::{Freedom, Model};
use crate::Result;
use crate::bundle::Adjusted;

/// Steps from an optimum of the same sightings with one camera more: what is left of the cost after
/// them decides nothing.
const STEPS_JOINED: usize = 12;

/// Adjusts with `freedom`; standard deviations as [`learn_optics`] states them.
pub(super) fn adjust_optics(model: &mut Model, freedom: Freedom) -> Result<Adjusted> {
    let mut found = fit_optics(model, freedom, STEPS)?;
    found.widen();
    *model = found.model;
    Ok(found.outcome)
}

/// The best of `freedoms`, with the standard deviations of the last of them.
fn best_of(model: &Model, freedoms: &[Freedom]) -> Result<OpticsFit> {
    let mut all = freedoms.iter().map(|f| fit_optics(model, *f, STEPS)).collect::<Result<Vec<_>>>()?;
    let of_all = all.last().map(|e| e.outcome.clone());
    all.sort_by(|a, b| a.value.total_cmp(&b.value));
    let mut best = all.swap_remove(0);
    if let Some(Adjusted { sigmas, rotation_sigmas, .. }) = of_all {
        best.outcome = Adjusted { sigmas, rotation_sigmas, ..best.outcome };
    }
    Ok(best)
}

/// Photos that agree on their optics share them again, as long as the criterion falls.
fn joined(mut best: OpticsFit) -> Result<OpticsFit> {
    for view in 1..best.model.group.len() {
        let mut tried = Vec::new();
        for other in 0..view {
            let target = best.model.group[other];
            if best.model.alike[other] != best.model.alike[view] || tried.contains(&target) {
                continue;
            }
            tried.push(target);
            let mut group = best.model.group.clone();
            group[view] = target;
            let trial = fit_optics(&best.model.regrouped(&group), best.model.freedom, STEPS_JOINED)?;
            if trial.value < best.value {
                best = trial;
                break;
            }
        }
    }
    Ok(best)
}

/// Decides which of the optics the photos determine and whether photos that look alike by their
/// files share a camera, and adjusts with it. The standard deviations are those of all optics
/// together: what the criterion leaves out may be there all the same.
pub(super) fn learn_optics(model: &mut Model) -> Result<Adjusted> {
    let apart = model.with_separate_optics();
    // Which of the photos that look alike share a camera is decided once.
    let regrouped = model.group != model.alike && apart.as_ref().is_some_and(|a| a.group != model.group);
    let decided = model.has_crops() || regrouped;
    let start = if decided { model.clone() } else { model.regrouped(&model.alike) };
    let mut found = best_of(&start, &Freedom::ALL)?;
    if let Some(apart) = apart.filter(|_| !decided) {
        let apart = best_of(&apart, &[Freedom::Focal, Freedom::Radial])?;
        if apart.value < found.value {
            let several = best_of(&joined(apart)?.model, &Freedom::ALL)?;
            if several.value < shared_camera_criterion(&found)? {
                found = several;
            }
        }
    }
    found = crops::explained(found)?;
    found.widen();
    *model = found.model;
    Ok(found.outcome)
}

/// What the criterion must be below for several cameras: its value if one camera took the photos
/// that look alike and only its principal point moved from photo to photo, as image stabilisation
/// moves it, times [`MAX_COST_SHARE`] in cost. Optics of their own would turn such movement into
/// wrong focal lengths.
fn shared_camera_criterion(shared: &OpticsFit) -> Result<f64> {
    let mut model = shared.model.regrouped(&shared.model.separable);
    for (prior, optics) in model.priors.iter_mut().zip(&model.optics) {
        prior.log_focal = (optics.focal.ln(), 0.0);
        prior.lens = [0.0; 2];
    }
    let moved = fit_optics(&model, Freedom::Full, STEPS)?;
    let n = model.independent(model.observations());
    Ok(moved.value + shared.model.parameters() as f64 * n.ln() + n * MAX_COST_SHARE.ln())
}
