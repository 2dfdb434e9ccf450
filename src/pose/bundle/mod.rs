//! Bundle adjustment: cameras, their optics and points that minimise the robust reprojection error (Levenberg–Marquardt
//! in f64, points eliminated by the Schur complement).
mod normal;

use super::numeric::{cauchy, cauchy_weight};
use crate::scene::{Lens, Pose};
use crate::{Error, Result};
use glam::{DVec2, DVec3};
use nalgebra::DVector;
use normal::Normal;

/// One sighting of a point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Observation {
    pub(crate) camera: usize,
    pub(crate) point: usize,
    /// Measured position, pixels.
    pub(crate) pixel: DVec2,
    /// One standard deviation, pixels.
    pub(crate) sigma: f64,
}

/// What the photos of one camera share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Optics {
    /// Focal length, original pixels.
    pub(crate) focal: f64,
    /// Radial distortion.
    pub(crate) lens: Lens,
    /// Principal point from the middle of the photo, original pixels.
    pub(crate) shift: DVec2,
}

/// Number of parameters of [`Optics`]: ln f, k1, k2, shift.
pub(crate) const OPTICS: usize = 5;

/// What is known of optics before the images are seen, as normal deviates. σ = 0 holds a parameter where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct OpticsPrior {
    /// ln f and its σ.
    pub(crate) log_focal: (f64, f64),
    /// σ of k1 and k2 around 0.
    pub(crate) lens: [f64; 2],
    /// σ of the shift around 0, original pixels.
    pub(crate) shift: f64,
}

impl OpticsPrior {
    /// Number of parameters that it leaves free.
    pub(crate) fn count(&self) -> usize {
        let radial = self.lens.iter().filter(|s| **s > 0.0).count();
        usize::from(self.log_focal.1 > 0.0) + radial + 2 * usize::from(self.shift > 0.0)
    }

    /// σ of every parameter, in the order of [`Outcome::sigmas`].
    pub(crate) fn sigmas(&self) -> [f64; OPTICS] {
        [self.log_focal.1, self.lens[0], self.lens[1], self.shift, self.shift]
    }

    /// Multiplies every σ.
    pub(crate) fn narrow(&mut self, scale: f64) {
        self.log_focal.1 *= scale;
        self.lens.iter_mut().for_each(|s| *s *= scale);
        self.shift *= scale;
    }

    /// (distance from the prior's mean, σ) of every parameter.
    fn deviations(&self, o: &Optics) -> [(f64, f64); OPTICS] {
        [
            (o.focal.ln() - self.log_focal.0, self.log_focal.1),
            (o.lens.k1, self.lens[0]),
            (o.lens.k2, self.lens[1]),
            (o.shift.x, self.shift),
            (o.shift.y, self.shift),
        ]
    }
}

/// Everything the adjustment changes, and what it may not.
#[derive(Clone, Debug, Default)]
pub(crate) struct Problem {
    /// World → camera; camera 0 stays fixed.
    pub(crate) poses: Vec<Pose>,
    /// Middle of each photo, pixels.
    pub(crate) centres: Vec<DVec2>,
    /// Which optics each camera uses.
    pub(crate) group: Vec<usize>,
    /// Pixels of each camera per original pixel of its optics: photos of one camera may be scaled differently.
    pub(crate) zoom: Vec<f64>,
    /// Per group.
    pub(crate) optics: Vec<Optics>,
    /// Per group.
    pub(crate) priors: Vec<OpticsPrior>,
    pub(crate) points: Vec<DVec3>,
    /// Those of one point in a row.
    pub(crate) observations: Vec<Observation>,
}

/// What an adjustment found.
#[derive(Clone, Debug)]
pub(crate) struct Outcome {
    /// Robust cost, in squared standard deviations.
    pub(crate) cost: f64,
    /// σ of ln f, k1, k2 and the shift per group, from the observations and the priors; 0 where held.
    pub(crate) sigmas: Vec<[f64; OPTICS]>,
}

impl Problem {
    /// Projection in camera frame and its pixel.
    fn project(&self, o: &Observation) -> (DVec3, DVec2) {
        let t = self.poses[o.camera].transform(self.points[o.point]);
        let (optics, zoom) = (&self.optics[self.group[o.camera]], self.zoom[o.camera]);
        let seen = optics.lens.distort(DVec2::new(t.x, t.y) / t.z);
        (t, seen * (optics.focal * zoom) + optics.shift * zoom + self.centres[o.camera])
    }

    /// Reprojection residual of an observation, pixels; infinite behind the camera.
    pub(crate) fn residual(&self, o: &Observation) -> DVec2 {
        let (t, p) = self.project(o);
        if t.z > 0.0 { p - o.pixel } else { DVec2::INFINITY }
    }

    /// Robust cost; `c` is the Cauchy scale in standard deviations.
    pub(crate) fn cost(&self, c: f64) -> f64 {
        let data: f64 = self
            .observations
            .iter()
            .map(|o| {
                let (t, p) = self.project(o);
                // A point that a step pushes behind a camera must look expensive, but finite.
                if t.z > 1e-9 {
                    cauchy((p - o.pixel).length_squared() / (o.sigma * o.sigma), c)
                } else {
                    cauchy(1e12, c)
                }
            })
            .sum();
        data + self.prior_cost()
    }

    fn prior_cost(&self) -> f64 {
        let all = self.optics.iter().zip(&self.priors).flat_map(|(o, p)| p.deviations(o));
        all.filter(|(_, sigma)| *sigma > 0.0).map(|(d, sigma)| (d / sigma).powi(2)).sum()
    }

    fn camera_offset(&self, camera: usize) -> Option<usize> {
        camera.checked_sub(1).map(|c| 6 * c)
    }

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
        for (k, optics) in next.optics.iter_mut().enumerate() {
            let step = |j: usize| -d[pose_size + OPTICS * k + j];
            // Steps beyond e^0.5 in focal length or 0.1 in the lens are outside the linear range.
            optics.focal *= step(0).clamp(-0.5, 0.5).exp();
            optics.lens.k1 += step(1).clamp(-0.1, 0.1);
            optics.lens.k2 += step(2).clamp(-0.1, 0.1);
            optics.shift += DVec2::new(step(3), step(4));
        }
        for (p, inverse) in normal.points.iter().zip(&inverses) {
            let mut g = p.g;
            for coupling in &p.coupling {
                for k in 0..coupling.size {
                    g -= coupling.by[k] * d[coupling.at + k];
                }
            }
            next.points[p.point] -= *inverse * g;
        }
        Some(next)
    }

    /// Minimises the robust cost with Cauchy scale `c` (standard deviations).
    pub(crate) fn solve(&mut self, c: f64, max_steps: usize) -> Result<Outcome> {
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
        Ok(Outcome { cost, sigmas: self.sigmas(c) })
    }

    /// σ of the optics from the inverse of the reduced system, scaled by the observed residual variance.
    fn sigmas(&self, c: f64) -> Vec<[f64; OPTICS]> {
        let normal = self.linearise(c);
        // Marginalise the points without damping; λ = 1e-9 only keeps numerical zeros positive.
        let (mut s, _, _) = Self::reduce(&normal, 1e-9);
        let pose_size = 6 * (self.poses.len() - 1);
        let n = s.nrows();
        // The unit of length is free: pin it along the direction that scales all translations.
        let gauge = DVector::from_fn(n, |i, _| {
            if i < pose_size && i % 6 < 3 { self.poses[1 + i / 6].translation[i % 6] } else { 0.0 }
        });
        let strength = s.trace() / n as f64 / gauge.norm_squared().max(1e-12);
        s += &gauge * gauge.transpose() * strength;
        let (mut sum, mut freedom) = (0.0, -(n as f64) - 3.0 * self.points.len() as f64);
        for o in &self.observations {
            let r2 = self.residual(o).length_squared() / (o.sigma * o.sigma);
            if r2.is_finite() {
                let w = cauchy_weight(r2, c);
                sum += w * r2;
                freedom += 2.0 * w;
            }
        }
        let variance = sum / freedom.max(1.0);
        let inverse = s.cholesky().map(|f| f.inverse());
        let sigma = |group: usize, k: usize, prior: f64| {
            let i = pose_size + OPTICS * group + k;
            let seen = inverse.as_ref().map_or(f64::INFINITY, |m| (m[(i, i)] * variance).sqrt());
            seen.min(prior)
        };
        let of = |(group, (o, p)): (usize, (&Optics, &OpticsPrior))| {
            let priors = p.deviations(o).map(|d| d.1);
            std::array::from_fn(|k| sigma(group, k, priors[k]))
        };
        self.optics.iter().zip(&self.priors).enumerate().map(of).collect()
    }
}

#[cfg(test)]
mod tests;
