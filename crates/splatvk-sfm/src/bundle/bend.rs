//! What smooth displacements do to the result: of all that a projection leaves out (a lens that is
//! not quite radial, a rolling shutter, a sensor or a paper that is not flat), and that more
//! sightings do not average away.
use super::normal::Normal;
use super::{OPTICS, Problem};
use glam::{DVec2, DVec3};
use nalgebra::DMatrix;

/// Displacements of a photo by second-order polynomials of the place in it: those of first order
/// are turns and zooms, which have parameters, and shears, which cameras do not have.
pub(super) const PATTERNS: usize = 6;

/// Displacements in units of their largest in the picture; `at`: the place from the middle in half
/// long sides.
pub(super) fn patterns(at: DVec2) -> [DVec2; PATTERNS] {
    let squares = [at.x * at.x, at.x * at.y, at.y * at.y];
    std::array::from_fn(|k| if k < 3 { DVec2::X * squares[k] } else { DVec2::Y * squares[k - 3] })
}

/// Deviations of the parameters that independent displacements by every pattern in every photo
/// bring.
pub(crate) struct Bent {
    /// Of ln f, k1, k2 and the shift per group; 0 where held.
    pub(crate) optics: Vec<[f64; OPTICS]>,
    /// Of the rotation of every pose, over all axes, radians.
    pub(crate) rotations: Vec<f64>,
}

impl Problem {
    /// What displaced photos do; per camera, in pixels, half of the long side and by how much each
    /// pattern displaces its ends. `None` where the photos leave a parameter open altogether.
    pub(crate) fn bent(&self, c: f64, half_long: &[f64], by: &[f64]) -> Option<Bent> {
        let normal = self.linearise(c);
        let moved = self.covariance(&normal)? * self.gradients(&normal, c, half_long, by);
        let deviation = |row: usize| moved.row(row).norm();
        let (poses, _) = self.sizes();
        let optics =
            (0..self.optics.len()).map(|g| std::array::from_fn(|k| deviation(poses + OPTICS * g + k)));
        let rotation = |pose: usize| {
            let axes = pose.checked_sub(1).map(|k| (0..3).map(move |axis| 6 * k + 3 + axis));
            axes.into_iter().flatten().map(|row| deviation(row).powi(2)).sum::<f64>().sqrt()
        };
        let mut bent =
            Bent { optics: optics.collect(), rotations: (0..self.poses.len()).map(rotation).collect() };
        for (sigmas, (optics, prior)) in bent.optics.iter_mut().zip(self.optics.iter().zip(&self.priors)) {
            let held = prior.deviations(optics).map(|d| d.1 == 0.0);
            sigmas.iter_mut().zip(held).filter(|(_, held)| *held).for_each(|(s, _)| *s = 0.0);
        }
        Some(bent)
    }

    /// Gradients of the cost in the cameras' parameters, points eliminated, by the displacements: a
    /// column per camera and pattern.
    fn gradients(&self, normal: &Normal, c: f64, half_long: &[f64], by: &[f64]) -> DMatrix<f64> {
        let mut out = DMatrix::zeros(self.sizes().1, PATTERNS * self.poses.len());
        let of_points = self.observations.chunk_by(|a, b| a.point == b.point);
        for (seen, block) in of_points.zip(&normal.points) {
            let inverse = block.inverse(0.0);
            for o in seen {
                let Some(d) = self.derivatives(o, c) else { continue };
                let at = (o.pixel - self.centres[o.camera]) / half_long[o.camera];
                for (k, pattern) in patterns(at).into_iter().enumerate() {
                    let column = PATTERNS * o.camera + k;
                    let r = pattern * (by[o.camera] * d.w / o.sigma);
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
