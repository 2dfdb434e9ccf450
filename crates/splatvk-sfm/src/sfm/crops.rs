//! Detection of cropped photos: their principal point is off-centre, and their focal length is
//! another share of the long side than that of whole photos.
use super::fit::{IntrinsicsFit, MAX_COST_SHARE, STEPS, fit_intrinsics};
use super::model::{Model, RefinedIntrinsics};
use crate::Result;
use crate::bundle::IntrinsicsPrior;
use rayon::prelude::*;

/// σ of the principal point offset of a cropped photo, share of its long side: half of the part cut
/// away.
const CROP_SIGMA: f64 = 0.2;
/// σ of ln f of a cropped photo: the file states that of the whole photo, which may be twice as
/// large.
const FOCAL_SIGMA: f64 = 0.35;

/// Least principal point offset of a cropped photo, share of its long side: image stabilisation
/// moves it by up to 0.02.
const OFF_CENTRE: f64 = 0.05;

/// Photos of which any two are tried as whole ones: 15 fits.
const PAIRED: usize = 6;

/// Hypothesis about which photos are whole.
#[derive(Clone)]
struct Hypothesis {
    /// Camera id by view, numbered in any way.
    camera_ids: Vec<usize>,
    priors: Vec<IntrinsicsPrior>,
    whole: Vec<bool>,
}

impl Hypothesis {
    /// The model under this hypothesis.
    fn apply_to(&self, model: &Model) -> Model {
        let mut out = model.with_camera_ids(&(0..self.camera_ids.len()).collect::<Vec<_>>());
        out.priors.clone_from(&self.priors);
        out.with_camera_ids(&self.camera_ids)
    }

    /// Hypotheses with one more whole view: with the camera of another whole photo that it may
    /// share, and with its own.
    fn with_whole(&self, model: &Model, view: usize, prior: IntrinsicsPrior) -> Vec<Hypothesis> {
        let may_share =
            |v: &usize| self.whole[*v] && model.camera_ids_by_file[*v] == model.camera_ids_by_file[view];
        let shared = (0..self.camera_ids.len()).find(may_share).map(|v| self.camera_ids[v]);
        let with_camera = |camera: usize| {
            let mut hypothesis = self.clone();
            (hypothesis.camera_ids[view], hypothesis.priors[view], hypothesis.whole[view]) =
                (camera, prior, true);
            hypothesis
        };
        shared.into_iter().chain([view]).map(with_camera).collect()
    }

    /// Hypotheses with two whole views of one camera, among the first [`PAIRED`] of `order`.
    fn with_two_whole(&self, model: &Model, order: &[usize], usual: &[IntrinsicsPrior]) -> Vec<Hypothesis> {
        let likely = &order[..order.len().min(PAIRED)];
        let pairs =
            likely.iter().enumerate().flat_map(|(k, a)| likely[k + 1..].iter().map(move |b| (*a, *b)));
        let ids = &model.camera_ids_by_file;
        pairs
            .filter(|(a, b)| ids[*a] == ids[*b])
            .map(|(a, b)| {
                let mut hypothesis = self.clone();
                for view in [a, b] {
                    (hypothesis.camera_ids[view], hypothesis.priors[view]) = (a, usual[view]);
                    hypothesis.whole[view] = true;
                }
                hypothesis
            })
            .collect()
    }
}

/// The fit, or one with cropped photos if that lowers the cost as much as several cameras must
/// ([`MAX_COST_SHARE`]). Each cropped photo has separate intrinsics and a free principal point.
pub(super) fn with_crops(best: IntrinsicsFit) -> Result<IntrinsicsFit> {
    let views = best.model.poses.len();
    // Two photos do not determine which of them is whole.
    if views < 3 || best.model.has_crops() {
        return Ok(best);
    }
    let n = best.model.effective_observations(best.model.residual_components());
    let bound = best.bic + n * MAX_COST_SHARE.ln();
    let refined = match best.model.refined {
        RefinedIntrinsics::Focal | RefinedIntrinsics::PrincipalPoint => RefinedIntrinsics::PrincipalPoint,
        RefinedIntrinsics::Radial | RefinedIntrinsics::Full => RefinedIntrinsics::Full,
    };
    let usual: Vec<IntrinsicsPrior> =
        (0..views).map(|v| best.model.priors[best.model.camera_ids[v]]).collect();
    let cut = |(v, p): (usize, &IntrinsicsPrior)| IntrinsicsPrior {
        log_focal: (p.log_focal.0, p.log_focal.1.max(FOCAL_SIGMA)),
        principal_point_offset: CROP_SIGMA * best.model.long_side(v),
        ..*p
    };
    let mut hypothesis = Hypothesis {
        camera_ids: (0..views).collect(),
        priors: usual.iter().enumerate().map(cut).collect(),
        whole: vec![false; views],
    };
    let fit = |start: &Model, tried: &Hypothesis| fit_intrinsics(&tried.apply_to(start), refined, STEPS);
    let mut found = fit(&best.model, &hypothesis)?;
    if found.bic >= bound {
        return Ok(best);
    }
    // Smallest offsets first: most photos are whole.
    let off = |v: usize| found.model.intrinsics[v].principal_point_offset.length() / found.model.long_side(v);
    let mut order: Vec<usize> = (0..views).collect();
    order.sort_by(|a, b| off(*a).total_cmp(&off(*b)));
    // Four free principal points fit many scenes, so that these offsets may mislead. Two whole
    // photos with one camera fit the true one only.
    let pairs = hypothesis.with_two_whole(&found.model, &order, &usual);
    let pairs: Vec<(IntrinsicsFit, Hypothesis)> =
        pairs.into_par_iter().map(|tried| Ok((fit(&found.model, &tried)?, tried))).collect::<Result<_>>()?;
    if let Some((pair, tried)) = pairs.into_iter().min_by(|a, b| a.0.bic.total_cmp(&b.0.bic))
        && pair.bic < found.bic
    {
        (found, hypothesis) = (pair, tried);
    }
    for view in order {
        if hypothesis.whole[view] {
            continue;
        }
        for trial in hypothesis.with_whole(&found.model, view, usual[view]) {
            let fit = fit(&found.model, &trial)?;
            if fit.bic < found.bic {
                (found, hypothesis) = (fit, trial);
                break;
            }
        }
    }
    let off = |v: usize| {
        found.model.intrinsics[found.model.camera_ids[v]].principal_point_offset.length()
            / found.model.long_side(v)
    };
    let cut = (0..views).filter(|v| !hypothesis.whole[*v]);
    if found.bic >= bound || hypothesis.whole.iter().all(|w| *w) || cut.map(off).any(|o| o < OFF_CENTRE) {
        return Ok(best);
    }
    Ok(found)
}
