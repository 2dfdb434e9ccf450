//! Effect of smooth image displacements on the result. They stand for everything that a projection
//! leaves out (a lens that is not quite radial, a rolling shutter, a sensor or a paper that is not
//! flat) and that more observations do not average out.
use super::normal::{Curvature, Normal};
use super::{INTRINSICS, Problem};
use glam::{DVec2, DVec3};
use nalgebra::DMatrix;

/// Number of displacement patterns: second-order polynomials of the image position. First-order
/// ones are rotations and zooms, which have parameters, and shears, which cameras do not have.
pub(super) const PATTERNS: usize = 6;

/// Displacements in units of their largest in the image; `at`: position from the image centre in
/// half long sides.
pub(super) fn patterns(at: DVec2) -> [DVec2; PATTERNS] {
    let squares = [at.x * at.x, at.x * at.y, at.y * at.y];
    std::array::from_fn(|k| if k < 3 { DVec2::X * squares[k] } else { DVec2::Y * squares[k - 3] })
}

/// Standard deviations of the parameters under independent displacements by every pattern in every
/// photo.
pub(crate) struct DisplacementSigmas {
    /// Of ln f, k1, k2 and the principal point offset per camera id; 0 where held.
    pub(crate) intrinsics: Vec<[f64; INTRINSICS]>,
    /// Of the rotation of every pose, over all axes, radians.
    pub(crate) rotations: Vec<f64>,
}

impl Problem {
    /// Standard deviations of the parameters under displaced photos. Per view, pixels: `half_long`
    /// is half of the long side, `by` the displacement of each pattern there. `None` where the
    /// photos leave a parameter undetermined.
    pub(crate) fn displacement_sigmas(
        &self,
        c: f64,
        half_long: &[f64],
        by: &[f64],
    ) -> Option<DisplacementSigmas> {
        let normal = self.linearise(c, Curvature::Weighted);
        let moved = self.covariance(&normal)? * self.gradients(&normal, c, half_long, by);
        let deviation = |row: usize| moved.row(row).norm();
        let (poses, _) = self.sizes();
        let intrinsics = (0..self.intrinsics.len())
            .map(|g| std::array::from_fn(|k| deviation(poses + INTRINSICS * g + k)));
        let rotation = |pose: usize| {
            let axes = pose.checked_sub(1).map(|k| (0..3).map(move |axis| 6 * k + 3 + axis));
            axes.into_iter().flatten().map(|row| deviation(row).powi(2)).sum::<f64>().sqrt()
        };
        let mut out = DisplacementSigmas {
            intrinsics: intrinsics.collect(),
            rotations: (0..self.poses.len()).map(rotation).collect(),
        };
        for (sigmas, (intrinsics, prior)) in
            out.intrinsics.iter_mut().zip(self.intrinsics.iter().zip(&self.priors))
        {
            let held = prior.deviations(intrinsics).map(|d| d.1 == 0.0);
            sigmas.iter_mut().zip(held).filter(|(_, held)| *held).for_each(|(s, _)| *s = 0.0);
        }
        Some(out)
    }

    /// Gradients of the cost in poses and intrinsics, points eliminated, by the displacements: a
    /// column per view and pattern.
    fn gradients(&self, normal: &Normal, c: f64, half_long: &[f64], by: &[f64]) -> DMatrix<f64> {
        let mut out = DMatrix::zeros(self.sizes().1, PATTERNS * self.poses.len());
        let of_points = self.observations.chunk_by(|a, b| a.point == b.point);
        for (seen, block) in of_points.zip(&normal.points) {
            let inverse = block.inverse(0.0);
            for o in seen {
                let Some(d) = self.derivatives(o, c, Curvature::Weighted) else { continue };
                let at = (o.pixel - self.centres[o.view]) / half_long[o.view];
                for (k, pattern) in patterns(at).into_iter().enumerate() {
                    let column = PATTERNS * o.view + k;
                    let r = pattern * (by[o.view] * d.root / o.sigma);
                    for own in d.by.iter().flatten() {
                        for i in 0..own.size {
                            out[(own.at + i, column)] += own.rows[0][i] * r.x + own.rows[1][i] * r.y;
                        }
                    }
                    let moved: DVec3 = inverse * (d.by_point[0] * r.x + d.by_point[1] * r.y);
                    for coupling in &block.coupling {
                        for i in 0..coupling.size {
                            out[(coupling.at + i, column)] -= coupling.by[i].dot(moved);
                        }
                    }
                }
            }
        }
        out
    }
}
