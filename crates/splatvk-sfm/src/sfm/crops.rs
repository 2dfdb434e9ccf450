//! Photos that are cut out of larger ones: their optical axis is not in the middle, and their focal
//! length is another share of their side than that of whole photos.
use super::fit::{MAX_COST_SHARE, OpticsFit, STEPS, fit_optics};
use super::model::{Freedom, Model};
use crate::Result;
use crate::bundle::{Adjusted, OpticsPrior};

/// σ of the principal point of a photo that is cut out of a larger one, as a share of its long
/// side: half of what is cut away.
const CROP_SIGMA: f64 = 0.2;
/// σ of its ln f: what the file states is of the whole photo, which may be twice as large.
const FOCAL_SIGMA: f64 = 0.35;

/// Least offset of the axis of such a photo, as a share of its long side: image stabilisation moves
/// it by up to 0.02.
const OFF_CENTRE: f64 = 0.05;

/// Which photos are taken for whole.
#[derive(Clone)]
struct Guess {
    /// Optics by view, numbered in any way.
    group: Vec<usize>,
    /// By view.
    priors: Vec<OpticsPrior>,
    whole: Vec<bool>,
}

impl Guess {
    /// The model with these photos sharing optics.
    fn of(&self, model: &Model) -> Model {
        let mut out = model.regrouped(&(0..self.group.len()).collect::<Vec<_>>());
        out.priors.clone_from(&self.priors);
        out.regrouped(&self.group)
    }

    /// The view taken for whole, with the focal length of another whole photo of its kind or with
    /// its own.
    fn with_whole(&self, model: &Model, view: usize, prior: OpticsPrior) -> Vec<Guess> {
        let alike = |v: &usize| self.whole[*v] && model.alike[*v] == model.alike[view];
        let shared = (0..self.group.len()).find(alike).map(|v| self.group[v]);
        let one = |group: usize| {
            let mut guess = self.clone();
            (guess.group[view], guess.priors[view], guess.whole[view]) = (group, prior, true);
            guess
        };
        shared.into_iter().chain([view]).map(one).collect()
    }
}

/// The same fit, or one in which some photos are cut out of larger ones, if that explains the
/// sightings better by as much as several cameras have to: each of them has optics of its own and a
/// principal point anywhere.
pub(super) fn explained(best: OpticsFit) -> Result<OpticsFit> {
    let views = best.model.poses.len();
    // Two photos do not tell which of them is whole.
    if views < 3 || best.model.has_crops() {
        return Ok(best);
    }
    let n = best.model.independent(best.model.observations());
    let bound = best.value + n * MAX_COST_SHARE.ln();
    let freedom = match best.model.freedom {
        Freedom::Focal | Freedom::Centre => Freedom::Centre,
        Freedom::Radial | Freedom::Full => Freedom::Full,
    };
    let usual: Vec<OpticsPrior> = (0..views).map(|v| best.model.priors[best.model.group[v]]).collect();
    let cut = |(v, p): (usize, &OpticsPrior)| OpticsPrior {
        log_focal: (p.log_focal.0, p.log_focal.1.max(FOCAL_SIGMA)),
        shift: CROP_SIGMA * best.model.long_side(v),
        ..*p
    };
    let mut guess = Guess {
        group: (0..views).collect(),
        priors: usual.iter().enumerate().map(cut).collect(),
        whole: vec![false; views],
    };
    let mut found = fit_optics(&guess.of(&best.model), freedom, STEPS)?;
    if found.value >= bound {
        return Ok(best);
    }
    // Those that seem least off their middle first: most photos are whole.
    let off = |v: usize| found.model.optics[v].shift.length() / found.model.long_side(v);
    let mut order: Vec<(f64, usize)> = (0..views).map(|v| (off(v), v)).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    for (_, view) in order {
        for trial in guess.with_whole(&found.model, view, usual[view]) {
            let fit = fit_optics(&trial.of(&found.model), freedom, STEPS)?;
            if fit.value < found.value {
                (found, guess) = (fit, trial);
                break;
            }
        }
    }
    let off = |v: usize| found.model.optics[found.model.group[v]].shift.length() / found.model.long_side(v);
    let cut = (0..views).filter(|v| !guess.whole[*v]);
    if found.value >= bound || guess.whole.iter().all(|w| *w) || cut.map(off).any(|o| o < OFF_CENTRE) {
        return Ok(best);
    }
    let of_all = fit_optics(&found.model, Freedom::Full, STEPS)?.outcome;
    found.outcome = Adjusted { cost: found.outcome.cost, ..of_all };
    Ok(found)
}
