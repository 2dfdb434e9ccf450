//! Normal equations of bundle adjustment, and the elimination of the points.
use super::{INTRINSICS, Observation, Problem};
use crate::numeric::{cauchy_curvature, cauchy_weight, skew};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Normal equations: camera block (poses 1.., then intrinsics; lower triangle), and per point its
/// own block and coupling.
pub(super) struct Normal {
    pub(super) h: DMatrix<f64>,
    pub(super) g: DVector<f64>,
    pub(super) points: Vec<PointBlock>,
}

/// Block of one point: Hessian `v`, gradient `g` and coupling with the cameras.
pub(super) struct PointBlock {
    pub(super) point: usize,
    v: DMat3,
    pub(super) g: DVec3,
    pub(super) coupling: Vec<Coupling>,
}

/// Hessian block of a point and the parameters `at .. at + size`.
pub(super) struct Coupling {
    pub(super) at: usize,
    pub(super) size: usize,
    pub(super) by: [DVec3; 6],
}

impl PointBlock {
    /// Inverse of the Hessian, with damping λ on the diagonal.
    pub(super) fn inverse(&self, lambda: f64) -> DMat3 {
        let mut v = self.v;
        // The tiny absolute term keeps unobserved points from making the block singular.
        for k in 0..3 {
            v.col_mut(k)[k] += lambda * self.v.col(k)[k] + 1e-12;
        }
        v.inverse()
    }

    /// Coupling with the parameters `at .. at + size`, added where it is missing.
    fn coupling_with(&mut self, at: usize, size: usize) -> &mut Coupling {
        let known = self.coupling.iter().position(|k| k.at == at).unwrap_or_else(|| {
            self.coupling.push(Coupling { at, size, by: [DVec3::ZERO; 6] });
            self.coupling.len() - 1
        });
        &mut self.coupling[known]
    }
}

/// Curvature of the robust loss in the normal equations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Curvature {
    /// That of the weighted squares: the weights count as constants. For covariances.
    Weighted,
    /// That of the loss itself, which bends less along the residual (Triggs et al. 2000, section
    /// 4.3): steps converge quadratically. At least [`LEAST_CURVATURE`] of the weight remains.
    Robust,
}

/// Least curvature along a residual, as a share of that of the weighted squares. Beyond the scale
/// of the loss it would be negative.
const LEAST_CURVATURE: f64 = 0.1;

/// Residual of an observation in standard deviations and its derivatives. Both are multiplied by
/// the root of the weight, so that their products are the normal equations.
pub(super) struct Derivatives {
    r: DVec2,
    /// Root of the weight.
    pub(super) root: f64,
    pub(super) by_point: [DVec3; 2],
    /// By the pose, unless it is fixed, and by the intrinsics.
    pub(super) by: [Option<JacobianBlock>; 2],
}

/// Root R = √w (1 − α r̂r̂ᵀ) of the Hessian W of the loss by a residual.
#[derive(Clone, Copy)]
pub(super) struct Whitening {
    r: DVec2,
    /// √w.
    pub(super) root: f64,
    /// α over the squared length of the residual.
    out: f64,
    /// 1 − α.
    along: f64,
}

/// Root of the Hessian of the loss at residual `r`.
pub(super) fn whitening(r: DVec2, c: f64, curvature: Curvature) -> Whitening {
    let r2 = r.length_squared();
    let along = match curvature {
        Curvature::Weighted => 1.0,
        Curvature::Robust => cauchy_curvature(r2, c).max(LEAST_CURVATURE).sqrt(),
    };
    Whitening { r, root: cauchy_weight(r2, c).sqrt(), out: (1.0 - along) / r2.max(1e-300), along }
}

impl Whitening {
    /// R times the derivatives of both components of the residual.
    pub(super) fn rows<T>(&self, u: T, v: T) -> (T, T)
    where
        T: Copy + std::ops::Mul<f64, Output = T> + std::ops::Add<Output = T> + std::ops::Sub<Output = T>,
    {
        let share = (u * self.r.x + v * self.r.y) * self.out;
        ((u - share * self.r.x) * self.root, (v - share * self.r.y) * self.root)
    }

    /// R⁻¹ times the gradient of half the loss by the residual.
    pub(super) fn residual(&self, r: DVec2) -> DVec2 {
        r * (self.root / self.along)
    }
}

/// Derivatives of (u, v) by the parameters `at .. at + size`.
pub(super) struct JacobianBlock {
    pub(super) at: usize,
    pub(super) size: usize,
    pub(super) rows: [[f64; 6]; 2],
}

/// Points per parallel part. The parts, and with them the order of sums, do not depend on the
/// number of threads.
const PART: usize = 512;

impl Problem {
    /// Number of parameters of the poses, and of poses and intrinsics.
    pub(super) fn sizes(&self) -> (usize, usize) {
        let poses = 6 * (self.poses.len() - 1);
        (poses, poses + INTRINSICS * self.intrinsics.len())
    }

    /// Normal equations at the current estimate, with the priors.
    pub(super) fn linearise(&self, c: f64, curvature: Curvature) -> Normal {
        let (pose_size, n) = self.sizes();
        let of_points: Vec<&[Observation]> = self.observations.chunk_by(|a, b| a.point == b.point).collect();
        let parts: Vec<Normal> =
            of_points.par_chunks(PART).map(|part| self.linearise_part(part, c, curvature)).collect();
        let mut normal = Normal { h: DMatrix::zeros(n, n), g: DVector::zeros(n), points: Vec::new() };
        for part in parts {
            normal.h += part.h;
            normal.g += part.g;
            normal.points.extend(part.points);
        }
        let all = self.intrinsics.iter().zip(&self.priors).flat_map(|(o, p)| p.deviations(o));
        for (k, (distance, sigma)) in all.enumerate() {
            let i = pose_size + k;
            if sigma > 0.0 {
                normal.h[(i, i)] += 1.0 / (sigma * sigma);
                normal.g[i] += distance / (sigma * sigma);
            } else {
                normal.h[(i, i)] += 1.0;
            }
        }
        normal
    }

    /// Normal equations of the observations of some points, without the priors.
    fn linearise_part(&self, of_points: &[&[Observation]], c: f64, curvature: Curvature) -> Normal {
        let (_, n) = self.sizes();
        let points = Vec::with_capacity(of_points.len());
        let mut normal = Normal { h: DMatrix::zeros(n, n), g: DVector::zeros(n), points };
        for seen in of_points {
            // One coupling per view, and one per camera.
            let coupling = Vec::with_capacity(2 * seen.len());
            let mut block = PointBlock { point: seen[0].point, v: DMat3::ZERO, g: DVec3::ZERO, coupling };
            for Derivatives { r, by_point, by, .. } in
                seen.iter().filter_map(|o| self.derivatives(o, c, curvature))
            {
                for (j, r) in by_point.iter().zip([r.x, r.y]) {
                    block.g += *j * r;
                    block.v += DMat3::from_cols(*j * j.x, *j * j.y, *j * j.z);
                }
                for (column, own) in by.iter().flatten().enumerate() {
                    let coupling = block.coupling_with(own.at, own.size);
                    let [u, v] = own.rows;
                    for k in 0..own.size {
                        coupling.by[k] += by_point[0] * u[k] + by_point[1] * v[k];
                        normal.g[own.at + k] += u[k] * r.x + v[k] * r.y;
                    }
                    // Poses come before intrinsics, so this fills the lower triangle.
                    for (row, other) in by.iter().flatten().enumerate().skip(column) {
                        let [a, b] = other.rows;
                        for k in 0..own.size {
                            let at = (own.at + k) * n + other.at;
                            let out = &mut normal.h.as_mut_slice()[at..at + other.size];
                            for i in if row == column { k } else { 0 }..other.size {
                                out[i] += u[k] * a[i] + v[k] * b[i];
                            }
                        }
                    }
                }
            }
            block.coupling.sort_unstable_by_key(|k| k.at);
            normal.points.push(block);
        }
        normal
    }

    /// Residual and derivatives of an observation; `None` behind the camera.
    pub(super) fn derivatives(&self, o: &Observation, c: f64, curvature: Curvature) -> Option<Derivatives> {
        let (t, p) = self.project(o);
        if t.z <= 1e-9 {
            return None;
        }
        let camera = self.camera_ids[o.view];
        let (intrinsics, zoom) = (&self.intrinsics[camera], self.zoom[o.view]);
        let r = (p - o.pixel) / o.sigma;
        let f = intrinsics.focal * zoom / o.sigma;
        let x = DVec2::new(t.x, t.y) / t.z;
        let jacobian = intrinsics.lens.jacobian(x);
        // Rows of ∂(u, v)/∂t, each a 3-vector: through x = (X, Y)/Z and the distortion.
        let rows = [0, 1].map(|axis| {
            let by = jacobian.row(axis) * (f / t.z);
            DVec3::new(by.x, by.y, -by.dot(x))
        });
        let to_world = self.poses[o.view].rotation.transpose();
        // δt = ρ − [t]× θ, so ∂/∂θ = −rowᵀ[t]× = ([t]× row)ᵀ.
        let pose = self.pose_offset(o.view).map(|at| {
            let by = |row: DVec3| {
                let turn = skew(t) * row;
                [row.x, row.y, row.z, turn.x, turn.y, turn.z]
            };
            JacobianBlock { at, size: 6, rows: rows.map(by) }
        });
        let (r2, distorted) = (x.length_squared(), intrinsics.lens.distort(x));
        let free = self.priors[camera].deviations(intrinsics).map(|d| d.1 > 0.0);
        let by_intrinsics = [0, 1].map(|axis| {
            // By ln f (the centred pixel itself), distortion and principal point; parameters that
            // are held have no derivative.
            let mut by = [f * distorted[axis], f * x[axis] * r2, f * x[axis] * r2 * r2, 0.0, 0.0, 0.0];
            by[3 + axis] = zoom / o.sigma;
            by.iter_mut().zip(free).filter(|(_, free)| !free).for_each(|(b, _)| *b = 0.0);
            by
        });
        let own =
            JacobianBlock { at: self.sizes().0 + INTRINSICS * camera, size: INTRINSICS, rows: by_intrinsics };
        let white = whitening(r, c, curvature);
        let (u, v) = white.rows(rows[0], rows[1]);
        let by = [pose, Some(own)].map(|block| {
            block.map(|mut block| {
                let [u, v] = &mut block.rows;
                for (u, v) in u.iter_mut().zip(v).take(block.size) {
                    (*u, *v) = white.rows(*u, *v);
                }
                block
            })
        });
        Some(Derivatives {
            r: white.residual(r),
            root: white.root,
            by_point: [to_world * u, to_world * v],
            by,
        })
    }

    /// Camera system after eliminating the points, with damping λ on every diagonal (lower
    /// triangle), and the inverses of the point blocks.
    pub(super) fn reduce(normal: &Normal, lambda: f64) -> (DMatrix<f64>, DVector<f64>, Vec<DMat3>) {
        let (mut s, mut b) = (normal.h.clone(), normal.g.clone());
        for i in 0..b.len() {
            s[(i, i)] *= 1.0 + lambda;
        }
        let parts: Vec<_> =
            normal.points.par_chunks(PART).map(|p| Self::eliminate(p, b.len(), lambda)).collect();
        let mut inverses = Vec::with_capacity(normal.points.len());
        for (h, g, inverse) in parts {
            s -= h;
            b -= g;
            inverses.extend(inverse);
        }
        (s, b, inverses)
    }

    /// Contribution of some points to the Schur complement of `n` camera parameters, and the
    /// inverses of their blocks.
    fn eliminate(points: &[PointBlock], n: usize, lambda: f64) -> (DMatrix<f64>, DVector<f64>, Vec<DMat3>) {
        let (mut h, mut g) = (DMatrix::zeros(n, n), DVector::zeros(n));
        let inverses: Vec<DMat3> = points.iter().map(|p| p.inverse(lambda)).collect();
        for (p, inverse) in points.iter().zip(&inverses) {
            let vg = *inverse * p.g;
            for (first, column) in p.coupling.iter().enumerate() {
                for k in 0..column.size {
                    g[column.at + k] += column.by[k].dot(vg);
                    let va = *inverse * column.by[k];
                    for row in &p.coupling[first..] {
                        let from = if row.at == column.at { k } else { 0 };
                        let at = (column.at + k) * n + row.at;
                        let out = &mut h.as_mut_slice()[at..at + row.size];
                        for i in from..row.size {
                            out[i] += va.dot(row.by[i]);
                        }
                    }
                }
            }
        }
        (h, g, inverses)
    }
}
