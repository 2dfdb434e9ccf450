//! Parameters, observations and cost of bundle adjustment.
use crate::numeric::cauchy;
use crate::scene::{Lens, Pose};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Observation of a point in one view.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Observation {
    pub(crate) view: usize,
    pub(crate) point: usize,
    /// Measured position, pixels.
    pub(crate) pixel: DVec2,
    /// One standard deviation, pixels.
    pub(crate) sigma: f64,
}

/// Intrinsics that the photos of one camera share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Intrinsics {
    /// Focal length, original pixels.
    pub(crate) focal: f64,
    /// Radial distortion.
    pub(crate) lens: Lens,
    /// Principal point relative to the image centre, original pixels.
    pub(crate) principal_point_offset: DVec2,
}

/// Fewest observations or points of a parallel task: some 50 µs.
pub(super) const MIN_LEN: usize = 512;

/// Number of parameters of [`Intrinsics`]: ln f, k1, k2, principal point offset.
pub(crate) const INTRINSICS: usize = 5;

/// Normal priors of intrinsics. σ = 0 holds a parameter where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct IntrinsicsPrior {
    /// ln f and its σ.
    pub(crate) log_focal: (f64, f64),
    /// σ of k1 and k2 around 0.
    pub(crate) lens: [f64; 2],
    /// σ of the principal point offset around 0, original pixels.
    pub(crate) principal_point_offset: f64,
}

impl IntrinsicsPrior {
    /// Number of parameters that it leaves free.
    pub(crate) fn count(&self) -> usize {
        let radial = self.lens.iter().filter(|s| **s > 0.0).count();
        usize::from(self.log_focal.1 > 0.0) + radial + 2 * usize::from(self.principal_point_offset > 0.0)
    }

    /// σ of every parameter, in the order of [`Adjusted::sigmas`].
    pub(crate) fn sigmas(&self) -> [f64; INTRINSICS] {
        [
            self.log_focal.1,
            self.lens[0],
            self.lens[1],
            self.principal_point_offset,
            self.principal_point_offset,
        ]
    }

    /// Multiplies every σ by `scale`.
    pub(crate) fn scale_sigmas(&mut self, scale: f64) {
        self.log_focal.1 *= scale;
        self.lens.iter_mut().for_each(|s| *s *= scale);
        self.principal_point_offset *= scale;
    }

    /// (distance from the prior's mean, σ) of every parameter.
    pub(super) fn deviations(&self, o: &Intrinsics) -> [(f64, f64); INTRINSICS] {
        [
            (o.focal.ln() - self.log_focal.0, self.log_focal.1),
            (o.lens.k1, self.lens[0]),
            (o.lens.k2, self.lens[1]),
            (o.principal_point_offset.x, self.principal_point_offset),
            (o.principal_point_offset.y, self.principal_point_offset),
        ]
    }
}

/// Variables, constants and observations of a bundle adjustment.
#[derive(Clone, Debug, Default)]
pub(crate) struct Problem {
    /// World → camera, one per view; view 0 stays fixed.
    pub(crate) poses: Vec<Pose>,
    /// Image centre of each view, pixels.
    pub(crate) centres: Vec<DVec2>,
    /// Camera id of each view: index into `intrinsics` and `priors`.
    pub(crate) camera_ids: Vec<usize>,
    /// Pixels of each view per original pixel of its camera: photos of one camera may be scaled
    /// differently.
    pub(crate) zoom: Vec<f64>,
    /// Per camera id.
    pub(crate) intrinsics: Vec<Intrinsics>,
    /// Per camera id.
    pub(crate) priors: Vec<IntrinsicsPrior>,
    pub(crate) points: Vec<DVec3>,
    /// Grouped by point.
    pub(crate) observations: Vec<Observation>,
}

/// Result of an adjustment.
#[derive(Clone, Debug)]
pub(crate) struct Adjusted {
    /// Robust cost, in squared standard deviations.
    pub(crate) cost: f64,
    /// Number of trial steps; tests limit it.
    #[cfg_attr(not(test), allow(dead_code))]
    pub(crate) trials: usize,
    /// σ of ln f, k1, k2 and the principal point offset per camera id, from the observations and
    /// the priors; 0 where held.
    pub(crate) sigmas: Vec<[f64; INTRINSICS]>,
    /// σ of the rotation of every pose against the first, about its least certain axis, radians.
    pub(crate) rotation_sigmas: Vec<f64>,
}

impl Problem {
    /// Point in the camera frame and its pixel.
    pub(super) fn project(&self, o: &Observation) -> (DVec3, DVec2) {
        self.project_point(o, self.points[o.point])
    }

    /// Like [`Self::project`], with the point at `x`.
    pub(super) fn project_point(&self, o: &Observation, x: DVec3) -> (DVec3, DVec2) {
        let t = self.poses[o.view].transform(x);
        let (intrinsics, zoom) = (&self.intrinsics[self.camera_ids[o.view]], self.zoom[o.view]);
        let distorted = intrinsics.lens.distort(DVec2::new(t.x, t.y) / t.z);
        let (offset, centre) = (intrinsics.principal_point_offset, self.centres[o.view]);
        (t, distorted * (intrinsics.focal * zoom) + offset * zoom + centre)
    }

    /// Reprojection residual of an observation, pixels; infinite behind the camera.
    pub(crate) fn residual(&self, o: &Observation) -> DVec2 {
        let (t, p) = self.project(o);
        if t.z > 0.0 { p - o.pixel } else { DVec2::INFINITY }
    }

    /// Robust cost; `c` is the Cauchy scale in standard deviations.
    pub(crate) fn cost(&self, c: f64) -> f64 {
        let cost = |o: &Observation| {
            let (t, p) = self.project(o);
            // A point that a step moves behind a camera has a large, but finite cost.
            if t.z > 1e-9 {
                cauchy((p - o.pixel).length_squared() / (o.sigma * o.sigma), c)
            } else {
                cauchy(1e12, c)
            }
        };
        // The order of the sum does not depend on the number of threads.
        let costs: Vec<f64> = self.observations.par_iter().with_min_len(MIN_LEN).map(cost).collect();
        costs.into_iter().sum::<f64>() + self.prior_cost()
    }

    pub(super) fn prior_cost(&self) -> f64 {
        let all = self.intrinsics.iter().zip(&self.priors).flat_map(|(o, p)| p.deviations(o));
        all.filter(|(_, sigma)| *sigma > 0.0).map(|(d, sigma)| (d / sigma).powi(2)).sum()
    }

    /// Index of the first parameter of a pose; `None` for the fixed one.
    pub(super) fn pose_offset(&self, view: usize) -> Option<usize> {
        view.checked_sub(1).map(|v| 6 * v)
    }
}
