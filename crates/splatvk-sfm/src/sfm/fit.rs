//! Fits with selected intrinsics, and their standard deviations.
use super::model::{Model, RefinedIntrinsics};
use crate::Result;
use crate::bundle::Adjusted;

/// Most steps from any start.
pub(super) const STEPS: usize = 60;

/// Largest cost with separate intrinsics, as a share of that with shared ones and a principal point
/// per photo. Unmodelled effects, as of a rolling shutter, and the held focal length and distortion
/// gave 0.98 on photos of one iPhone; two generated cameras, 0.5 % apart in focal length and 2 % in
/// k1, gave 0.92.
pub(super) const MAX_COST_SHARE: f64 = 0.95;

/// Fit of a model with selected intrinsics and camera ids.
pub(super) struct IntrinsicsFit {
    /// Bayesian information criterion with unknown noise: less is better.
    pub(super) bic: f64,
    pub(super) model: Model,
    pub(super) outcome: Adjusted,
}

/// Adjusts a copy of `model` with `refined` intrinsics.
pub(super) fn fit_intrinsics(
    model: &Model,
    refined: RefinedIntrinsics,
    steps: usize,
) -> Result<IntrinsicsFit> {
    let mut model = Model { refined, ..model.clone() };
    let outcome = model.adjust(f64::INFINITY, 2.0, steps)?;
    let n = model.effective_observations(model.residual_components());
    let bic = n * outcome.cost.max(1e-9).ln() + model.intrinsics_parameters() as f64 * n.ln();
    Ok(IntrinsicsFit { bic, model, outcome })
}

/// Unmodelled displacement of observations at the border of a photo, pixels of a working image up
/// to [`LONG`]. It grows in proportion with larger images: a lens displaces all sizes alike.
const DISPLACEMENT: f64 = 0.03;
/// Long side from which the displacement grows, pixels: corners are detected on working images.
const LONG: f64 = 640.0;

impl IntrinsicsFit {
    /// Widens every σ to that of the effective number of observations
    /// ([`Model::effective_observations`]), and by the effect of [`DISPLACEMENT`].
    pub(super) fn widen_sigmas(&mut self) {
        let components = self.model.residual_components();
        let wider = (components as f64 / self.model.effective_observations(components)).sqrt();
        let displaced = self.model.displacement_sigmas(|long| DISPLACEMENT * (long / LONG).max(1.0));
        let outcome = &mut self.outcome;
        for (camera, prior) in self.model.priors.iter().enumerate() {
            let displaced = displaced.as_ref().map_or(prior.sigmas(), |b| b.intrinsics[camera]);
            for ((sigma, most), displaced) in
                outcome.sigmas[camera].iter_mut().zip(prior.sigmas()).zip(displaced)
            {
                *sigma = (*sigma * wider).hypot(displaced).min(most);
            }
        }
        for (view, sigma) in outcome.rotation_sigmas.iter_mut().enumerate() {
            let displaced = displaced.as_ref().map_or(std::f64::consts::PI, |b| b.rotations[view]);
            *sigma = (*sigma * wider).hypot(displaced).min(std::f64::consts::PI);
        }
    }
}
