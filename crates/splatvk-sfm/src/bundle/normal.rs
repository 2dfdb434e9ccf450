//! The normal equations of the adjustment, and the points eliminated from them.
use super::{OPTICS, Observation, Problem};
use crate::numeric::{cauchy_weight, skew};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Normal equations: camera block (poses 1.., then optics; lower triangle), and per point its own
/// block and coupling.
pub(super) struct Normal {
    pub(super) h: DMatrix<f64>,
    pub(super) g: DVector<f64>,
    pub(super) points: Vec<PointBlock>,
}

pub(super) struct PointBlock {
    pub(super) point: usize,
    v: DMat3,
    pub(super) g: DVec3,
    pub(super) coupling: Vec<Coupling>,
}

/// How a point hangs together with the parameters `at .. at + size`.
pub(super) struct Coupling {
    pub(super) at: usize,
    pub(super) size: usize,
    pub(super) by: [DVec3; 6],
}

impl PointBlock {
    /// The inverse of its own block, with damping λ on the diagonal.
    pub(super) fn inverse(&self, lambda: f64) -> DMat3 {
        let mut v = self.v;
        // The tiny absolute term keeps unobserved points from making the block singular.
        for k in 0..3 {
            v.col_mut(k)[k] += lambda * self.v.col(k)[k] + 1e-12;
        }
        v.inverse()
    }

    /// Its coupling with the parameters `at .. at + size`.
    fn with(&mut self, at: usize, size: usize) -> &mut Coupling {
        let known = self.coupling.iter().position(|k| k.at == at).unwrap_or_else(|| {
            self.coupling.push(Coupling { at, size, by: [DVec3::ZERO; 6] });
            self.coupling.len() - 1
        });
        &mut self.coupling[known]
    }
}

/// An observation's residual, in standard deviations, its weight, and the derivatives of (u, v).
pub(super) struct Derivatives {
    r: DVec2,
    pub(super) w: f64,
    pub(super) by_point: [DVec3; 2],
    /// By the pose, unless it is held, and the optics.
    pub(super) by: [Option<By>; 2],
}

/// Derivatives of (u, v) by the parameters `at .. at + size`.
pub(super) struct By {
    pub(super) at: usize,
    pub(super) size: usize,
    pub(super) rows: [[f64; 6]; 2],
}

/// Points that one thread takes at a time. Sums are over the same parts on any number of threads.
const PART: usize = 512;

impl Problem {
    /// Number of parameters of the poses, and of poses and optics.
    pub(super) fn sizes(&self) -> (usize, usize) {
        let poses = 6 * (self.poses.len() - 1);
        (poses, poses + OPTICS * self.optics.len())
    }

    pub(super) fn linearise(&self, c: f64) -> Normal {
        let (pose_size, n) = self.sizes();
        let of_points: Vec<&[Observation]> = self.observations.chunk_by(|a, b| a.point == b.point).collect();
        let parts: Vec<Normal> =
            of_points.par_chunks(PART).map(|part| self.linearise_part(part, c)).collect();
        let mut normal = Normal { h: DMatrix::zeros(n, n), g: DVector::zeros(n), points: Vec::new() };
        for part in parts {
            normal.h += part.h;
            normal.g += part.g;
            normal.points.extend(part.points);
        }
        let all = self.optics.iter().zip(&self.priors).flat_map(|(o, p)| p.deviations(o));
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

    /// The observations of some points, without the priors.
    fn linearise_part(&self, of_points: &[&[Observation]], c: f64) -> Normal {
        let (_, n) = self.sizes();
        let mut normal = Normal { h: DMatrix::zeros(n, n), g: DVector::zeros(n), points: Vec::new() };
        for seen in of_points {
            let mut block =
                PointBlock { point: seen[0].point, v: DMat3::ZERO, g: DVec3::ZERO, coupling: Vec::new() };
            for Derivatives { r, w, by_point, by } in seen.iter().filter_map(|o| self.derivatives(o, c)) {
                for (j, r) in by_point.iter().zip([r.x, r.y]) {
                    block.g += *j * (w * r);
                    block.v += DMat3::from_cols(*j * j.x, *j * j.y, *j * j.z) * w;
                }
                for (column, own) in by.iter().flatten().enumerate() {
                    let coupling = block.with(own.at, own.size);
                    let [u, v] = own.rows;
                    for k in 0..own.size {
                        coupling.by[k] += w * (by_point[0] * u[k] + by_point[1] * v[k]);
                        normal.g[own.at + k] += w * (u[k] * r.x + v[k] * r.y);
                    }
                    // The poses come before the optics, so what is filled is the lower triangle.
                    for (row, other) in by.iter().flatten().enumerate().skip(column) {
                        let [a, b] = other.rows;
                        for k in 0..own.size {
                            for i in if row == column { k } else { 0 }..other.size {
                                normal.h[(other.at + i, own.at + k)] += w * (u[k] * a[i] + v[k] * b[i]);
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

    /// `None` behind the camera.
    pub(super) fn derivatives(&self, o: &Observation, c: f64) -> Option<Derivatives> {
        let (t, p) = self.project(o);
        if t.z <= 1e-9 {
            return None;
        }
        let group = self.group[o.camera];
        let (optics, zoom) = (&self.optics[group], self.zoom[o.camera]);
        let r = (p - o.pixel) / o.sigma;
        let f = optics.focal * zoom / o.sigma;
        let x = DVec2::new(t.x, t.y) / t.z;
        let bend = optics.lens.jacobian(x);
        // Rows of ∂(u, v)/∂t, each a 3-vector: through x = (X, Y)/Z and the lens.
        let rows = [0, 1].map(|axis| {
            let by = bend.row(axis) * (f / t.z);
            DVec3::new(by.x, by.y, -by.dot(x))
        });
        let to_world = self.poses[o.camera].rotation.transpose();
        // δt = ρ − [t]× θ, so ∂/∂θ = −rowᵀ[t]× = ([t]× row)ᵀ.
        let pose = self.camera_offset(o.camera).map(|at| {
            let by = |row: DVec3| {
                let turn = skew(t) * row;
                [row.x, row.y, row.z, turn.x, turn.y, turn.z]
            };
            By { at, size: 6, rows: rows.map(by) }
        });
        let (r2, bent) = (x.length_squared(), optics.lens.distort(x));
        let free = self.priors[group].deviations(optics).map(|d| d.1 > 0.0);
        let by_optics = [0, 1].map(|axis| {
            // By ln f, which is the centred pixel itself, the lens and the shift; what is held has
            // no derivative.
            let mut by = [f * bent[axis], f * x[axis] * r2, f * x[axis] * r2 * r2, 0.0, 0.0, 0.0];
            by[3 + axis] = zoom / o.sigma;
            by.iter_mut().zip(free).filter(|(_, free)| !free).for_each(|(b, _)| *b = 0.0);
            by
        });
        let own = By { at: self.sizes().0 + OPTICS * group, size: OPTICS, rows: by_optics };
        let w = cauchy_weight(r.length_squared(), c);
        Some(Derivatives { r, w, by_point: rows.map(|row| to_world * row), by: [pose, Some(own)] })
    }

    /// The camera system after eliminating the points, with damping λ on every diagonal; the lower
    /// triangle.
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

    /// What eliminating some points takes away from a camera system of `n` parameters, and the
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
                        for i in from..row.size {
                            h[(row.at + i, column.at + k)] += va.dot(row.by[i]);
                        }
                    }
                }
            }
        }
        (h, g, inverses)
    }
}
