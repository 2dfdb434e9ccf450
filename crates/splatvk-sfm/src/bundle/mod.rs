//! Bundle adjustment: poses, intrinsics and points that minimise the robust reprojection error
//! (Levenberg–Marquardt in f64, points eliminated by the Schur complement).
mod displacement;
mod normal;
mod problem;

use super::numeric::cauchy_weight;
use crate::scene::Pose;
use crate::{Error, Result};
pub(crate) use displacement::DisplacementSigmas;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};
use normal::{Normal, PointBlock};
use problem::MIN_LEN;
pub(crate) use problem::{Adjusted, INTRINSICS, Intrinsics, IntrinsicsPrior, Observation, Problem};
use rayon::prelude::*;

impl Problem {
    /// The problem after a damped Gauss–Newton step; `None` if the system is not positive definite.
    fn stepped(&self, normal: &Normal, lambda: f64) -> Option<Problem> {
        let (s, b, inverses) = Self::reduce(normal, lambda);
        let d = s.cholesky()?.solve(&b);
        if !d.iter().all(|v| v.is_finite()) {
            return None;
        }
        let mut next = self.clone();
        for k in 1..self.poses.len() {
            let at = |i: usize| -d[6 * (k - 1) + i];
            let step = Pose::exp(DVec3::new(at(0), at(1), at(2)), DVec3::new(at(3), at(4), at(5)));
            next.poses[k] = step.compose(&self.poses[k]).orthonormalised();
        }
        let pose_size = 6 * (self.poses.len() - 1);
        for (k, intrinsics) in next.intrinsics.iter_mut().enumerate() {
            let step = |j: usize| -d[pose_size + INTRINSICS * k + j];
            // Steps beyond half the focal length or 0.1 in the distortion are outside the linear
            // range. Where focal length and distance grow by one factor, photos of a flat scene
            // hardly change: such a step is exact in f, not in ln f.
            intrinsics.focal *= 1.0 + step(0).clamp(-0.4, 0.6);
            intrinsics.lens.k1 += step(1).clamp(-0.1, 0.1);
            intrinsics.lens.k2 += step(2).clamp(-0.1, 0.1);
            intrinsics.principal_point_offset += DVec2::new(step(3), step(4));
        }
        let step = |(p, inverse): (&PointBlock, &DMat3)| {
            let mut g = p.g;
            for coupling in &p.coupling {
                for k in 0..coupling.size {
                    g -= coupling.by[k] * d[coupling.at + k];
                }
            }
            *inverse * g
        };
        let steps: Vec<DVec3> =
            normal.points.par_iter().zip(&inverses).with_min_len(MIN_LEN).map(step).collect();
        for (p, step) in normal.points.iter().zip(steps) {
            next.points[p.point] -= step;
        }
        Some(next)
    }

    /// Minimises the robust cost with Cauchy scale `c` (standard deviations).
    pub(crate) fn solve(&mut self, c: f64, max_steps: usize) -> Result<Adjusted> {
        if self.poses.len() < 2 || self.observations.is_empty() {
            return Err(Error::work("bundle adjustment: needs two cameras with common points"));
        }
        let mut cost = self.cost(c);
        let mut lambda = 1e-4;
        for _ in 0..max_steps {
            let normal = self.linearise(c);
            let before = cost;
            for _ in 0..10 {
                if let Some(next) = self.stepped(&normal, lambda) {
                    let trial = next.cost(c);
                    if trial < cost {
                        (*self, cost) = (next, trial);
                        lambda = (lambda * 0.2).max(1e-10);
                        break;
                    }
                }
                lambda *= 8.0;
            }
            if before - cost <= 1e-8 * before {
                break;
            }
        }
        let (sigmas, rotation_sigmas) = self.sigmas(c);
        Ok(Adjusted { cost, sigmas, rotation_sigmas })
    }

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
        let inverse = self.covariance(&self.linearise(c));
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
