//! Optics fitted with a choice of free parameters, and how far they are to be trusted.
use super::model::{Freedom, Model};
use crate::Result;
use crate::bundle::Adjusted;

/// Steps that any start needs at most.
pub(super) const STEPS: usize = 60;

/// Share of the cost that optics of their own may leave, of that with a principal point of its own
/// for every photo. What is not modelled, as a rolling shutter, and what the held focal length and
/// lens cost, gave 0.98 on photos of one iPhone; two generated cameras, 0.5 % apart in focal length
/// and 2 % in k1, 0.92.
pub(super) const MAX_COST_SHARE: f64 = 0.95;

/// Optics fitted with a choice of free parameters and groups of photos.
pub(super) struct OpticsFit {
    /// Bayesian information criterion with unknown noise: less is better.
    pub(super) value: f64,
    pub(super) model: Model,
    pub(super) outcome: Adjusted,
}

pub(super) fn fit_optics(model: &Model, freedom: Freedom, steps: usize) -> Result<OpticsFit> {
    let mut model = Model { freedom, ..model.clone() };
    let outcome = model.adjust(f64::INFINITY, 2.0, steps)?;
    let n = model.independent(model.observations());
    let value = n * outcome.cost.max(1e-9).ln() + model.parameters() as f64 * n.ln();
    Ok(OpticsFit { value, model, outcome })
}

/// Displacement of sightings at the border of a photo that no parameter describes, pixels of a
/// working image of [`LONG`] and less …
const BEND: f64 = 0.03;
/// … and in proportion of a larger one, pixels of the long side: a lens bends all sizes alike, and
/// corners are found on working images.
const LONG: f64 = 640.0;

impl OpticsFit {
    /// Widens every σ to what it is with [`Model::independent`] observations taken for independent,
    /// and by what displacements of [`BEND`] bring.
    pub(super) fn widen(&mut self) {
        let observations = self.model.observations();
        let wider = (observations as f64 / self.model.independent(observations)).sqrt();
        let bent = self.model.bent(|long| BEND * (long / LONG).max(1.0));
        let outcome = &mut self.outcome;
        for (group, prior) in self.model.priors.iter().enumerate() {
            let bent = bent.as_ref().map_or(prior.sigmas(), |b| b.optics[group]);
            for ((sigma, most), bent) in outcome.sigmas[group].iter_mut().zip(prior.sigmas()).zip(bent) {
                *sigma = (*sigma * wider).hypot(bent).min(most);
            }
        }
        for (view, sigma) in outcome.rotation_sigmas.iter_mut().enumerate() {
            let bent = bent.as_ref().map_or(std::f64::consts::PI, |b| b.rotations[view]);
            *sigma = (*sigma * wider).hypot(bent).min(std::f64::consts::PI);
        }
    }
}
