//! Bundle adjustment: poses, intrinsics and points that minimise the robust reprojection error
//! (Levenberg–Marquardt in f64, points eliminated by the Schur complement), and their standard
//! deviations.
mod displacement;
mod normal;
mod points;
mod problem;
mod solve;

use super::numeric::cauchy_weight;
pub(crate) use displacement::DisplacementSigmas;
use nalgebra::{DMatrix, DVector};
use normal::{Curvature, Normal};
pub(crate) use problem::{Adjusted, INTRINSICS, Intrinsics, IntrinsicsPrior, Observation, Problem};

impl Problem {
    /// Covariance of poses and intrinsics, for residuals of the stated σ; `None` where it is not
    /// finite.
    fn covariance(&self, normal: &Normal) -> Option<DMatrix<f64>> {
        // Marginalise the points without damping; λ = 1e-9 only keeps numerical zeros positive.
        let (mut s, _, _) = Self::reduce(normal, 1e-9);
        let (pose_size, n) = self.sizes();
        // The unit of length is free: pin it along the direction that scales all translations.
        let gauge = DVector::from_fn(n, |i, _| {
            if i < pose_size && i % 6 < 3 { self.poses[1 + i / 6].translation[i % 6] } else { 0.0 }
        });
        let strength = s.trace() / n as f64 / gauge.norm_squared().max(1e-12);
        s += &gauge * gauge.transpose() * strength;
        s.cholesky().map(|f| f.inverse())
    }

    /// Weighted sum of the squared residuals, in units of their σ, and the degrees of freedom;
    /// outliers count little in both.
    pub(crate) fn squares(&self, c: f64) -> (f64, f64) {
        let (mut sum, mut freedom) = (0.0, -(self.sizes().1 as f64) - 3.0 * self.points.len() as f64);
        for o in &self.observations {
            let r2 = self.residual(o).length_squared() / (o.sigma * o.sigma);
            if r2.is_finite() {
                let w = cauchy_weight(r2, c);
                sum += w * r2;
                freedom += 2.0 * w;
            }
        }
        (sum, freedom)
    }

    /// Variance of the residuals, in units of their σ².
    fn variance(&self, c: f64) -> f64 {
        let (sum, freedom) = self.squares(c);
        sum / freedom.max(1.0)
    }

    /// σ of the intrinsics per camera and of the rotation per pose, from the inverse of the reduced
    /// system, scaled by the observed residual variance.
    fn sigmas(&self, c: f64) -> (Vec<[f64; INTRINSICS]>, Vec<f64>) {
        let inverse = self.covariance(&self.linearise(c, Curvature::Weighted));
        let (pose_size, _) = self.sizes();
        let variance = self.variance(c);
        let sigma = |camera: usize, k: usize, prior: f64| {
            let i = pose_size + INTRINSICS * camera + k;
            let estimated = inverse.as_ref().map_or(f64::INFINITY, |m| (m[(i, i)] * variance).sqrt());
            estimated.min(prior)
        };
        let camera_sigmas = |(camera, (o, p)): (usize, (&Intrinsics, &IntrinsicsPrior))| {
            let priors = p.deviations(o).map(|d| d.1);
            std::array::from_fn(|k| sigma(camera, k, priors[k]))
        };
        let intrinsics = self.intrinsics.iter().zip(&self.priors).enumerate().map(camera_sigmas).collect();
        let rotation = |pose: usize| {
            let Some(at) = pose.checked_sub(1).map(|k| 6 * k + 3) else { return 0.0 };
            let largest =
                inverse.as_ref().map(|m| m.fixed_view::<3, 3>(at, at).symmetric_eigenvalues().max());
            // π is no information at all.
            (largest.unwrap_or(f64::INFINITY) * variance).sqrt().min(std::f64::consts::PI)
        };
        (intrinsics, (0..self.poses.len()).map(rotation).collect())
    }
}

#[cfg(test)]
mod tests;
