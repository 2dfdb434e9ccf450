//! What an adjustment changes, and what it costs.
use crate::numeric::cauchy;
use crate::scene::{Lens, Pose};
use glam::{DVec2, DVec3};

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

/// What is known of optics before the images are seen, as normal deviates. σ = 0 holds a parameter
/// where it is.
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

    /// σ of every parameter, in the order of [`Adjusted::sigmas`].
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
    pub(super) fn deviations(&self, o: &Optics) -> [(f64, f64); OPTICS] {
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
    /// Pixels of each camera per original pixel of its optics: photos of one camera may be scaled
    /// differently.
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
pub(crate) struct Adjusted {
    /// Robust cost, in squared standard deviations.
    pub(crate) cost: f64,
    /// σ of ln f, k1, k2 and the shift per group, from the observations and the priors; 0 where
    /// held.
    pub(crate) sigmas: Vec<[f64; OPTICS]>,
    /// σ of the rotation of every pose against the first, about its least certain axis, radians.
    pub(crate) rotation_sigmas: Vec<f64>,
}

impl Problem {
    /// Projection in camera frame and its pixel.
    pub(super) fn project(&self, o: &Observation) -> (DVec3, DVec2) {
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

    pub(super) fn camera_offset(&self, camera: usize) -> Option<usize> {
        camera.checked_sub(1).map(|c| 6 * c)
    }
}
