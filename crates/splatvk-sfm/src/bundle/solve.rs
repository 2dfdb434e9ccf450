//! Steps of the adjustment (docs/internals/method.md#bundle-adjustment).
use super::normal::{Curvature, Normal, PointBlock};
use super::problem::{Adjusted, INTRINSICS, Intrinsics, MIN_LEN, Problem};
use crate::scene::Pose;
use crate::{Error, Result};
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Relative decrease of the cost at which the steps end. Near the optimum they converge
/// quadratically, so that less than this remains: 0.1 squared standard deviations of 100,000
/// observations, which moves a parameter by a thirtieth of its stated σ.
const TOLERANCE: f64 = 1e-6;
/// Relative decrease of the cost from which on the steps use [`Curvature::Robust`]. Larger steps
/// move observations in and out of the flat part of the loss.
const NEAR: f64 = 1e-3;
/// Relative decrease of the cost up to which points move to their optimum after each step.
const FAR: f64 = 0.03;
/// Damping of the first step.
const DAMPING: f64 = 1e-4;
/// Least damping.
const LEAST_DAMPING: f64 = 1e-10;
/// Most trials of a step, each with more damping.
const TRIALS: usize = 10;

/// Damping and curvature of the next step.
struct Descent {
    /// Scale of the loss, standard deviations.
    c: f64,
    cost: f64,
    lambda: f64,
    curvature: Curvature,
    /// Whether the cameras are so far off that points at their optimum would follow their errors.
    far: bool,
    /// Number of trial steps so far.
    trials: usize,
}

impl Problem {
    /// Minimises the robust cost with Cauchy scale `c` (standard deviations).
    pub(crate) fn solve(&mut self, c: f64, max_steps: usize) -> Result<Adjusted> {
        if self.poses.len() < 2 || self.observations.is_empty() {
            return Err(Error::work("bundle adjustment: needs two cameras with common points"));
        }
        let cost = self.cost(c);
        let mut descent =
            Descent { c, cost, lambda: DAMPING, curvature: Curvature::Weighted, far: true, trials: 0 };
        for _ in 0..max_steps {
            let before = descent.cost;
            self.descend(&mut descent);
            let gain = (before - descent.cost) / before;
            descent.far = gain > FAR;
            // Where the loss bends the other way, only steps by the weights lead down.
            let failed = gain <= 0.0 && descent.curvature == Curvature::Robust;
            if gain <= TOLERANCE && !failed {
                break;
            }
            descent.curvature = if gain < NEAR && !failed { Curvature::Robust } else { Curvature::Weighted };
        }
        let (sigmas, rotation_sigmas) = self.sigmas(c);
        Ok(Adjusted { cost: descent.cost, trials: descent.trials, sigmas, rotation_sigmas })
    }

    /// Takes one step if a trial lowers the cost. Steps with [`Curvature::Robust`] are tried once.
    fn descend(&mut self, descent: &mut Descent) {
        let normal = self.linearise(descent.c, descent.curvature);
        let trials = if descent.curvature == Curvature::Robust { 1 } else { TRIALS };
        let (poses, intrinsics, points) = (self.poses.clone(), self.intrinsics.clone(), self.points.clone());
        for _ in 0..trials {
            descent.trials += 1;
            if self.step(&normal, descent.lambda) {
                let cost = match descent.far {
                    true => self.cost(descent.c),
                    false => self.relax_points(&points, descent.c, descent.curvature),
                };
                if cost < descent.cost {
                    descent.cost = cost;
                    descent.lambda = (descent.lambda * 0.2).max(LEAST_DAMPING);
                    return;
                }
                self.poses.clone_from(&poses);
                self.intrinsics.clone_from(&intrinsics);
                self.points.clone_from(&points);
            }
            descent.lambda *= 8.0;
        }
    }

    /// Takes a damped Gauss–Newton step; `false` and none if the system is not positive definite.
    pub(super) fn step(&mut self, normal: &Normal, lambda: f64) -> bool {
        let (s, b, inverses) = Self::reduce(normal, lambda);
        let Some(d) = s.cholesky().map(|f| f.solve(&b)).filter(|d| d.iter().all(|v| v.is_finite())) else {
            return false;
        };
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
            self.points[p.point] -= step;
        }
        let (pose_size, _) = self.sizes();
        for (pose, d) in self.poses.iter_mut().skip(1).zip(d.as_slice().chunks_exact(6)) {
            let step = Pose::exp(-DVec3::from_slice(d), -DVec3::from_slice(&d[3..]));
            *pose = step.compose(pose).orthonormalised();
        }
        let of_cameras = d.as_slice()[pose_size..].chunks_exact(INTRINSICS);
        self.intrinsics.iter_mut().zip(of_cameras).for_each(|(o, d)| o.step(d));
        true
    }
}

impl Intrinsics {
    /// Subtracts a step, in the order of [`Adjusted::sigmas`].
    fn step(&mut self, d: &[f64]) {
        // Steps beyond half the focal length or 0.1 in the distortion are outside the linear range.
        // Where focal length and distance grow by one factor, photos of a flat scene hardly change:
        // such a step is exact in f, not in ln f.
        self.focal *= 1.0 - d[0].clamp(-0.6, 0.4);
        self.lens.k1 -= d[1].clamp(-0.1, 0.1);
        self.lens.k2 -= d[2].clamp(-0.1, 0.1);
        self.principal_point_offset -= DVec2::new(d[3], d[4]);
    }
}
