//! Solver of the blocked normal equations: cameras are eliminated exactly (Schur complement); depth
//! corrections follow by preconditioned conjugate gradients, with the banded Cholesky factor of
//! each view's own block as preconditioner.
use super::normal::{NormalEquations, Stencil};
use super::problem::Step;
use nalgebra::{Cholesky, DVector, Dyn};
use rayon::prelude::*;

/// Cholesky factor of a stencil: per row of the lower triangle `width` values and the diagonal.
struct Band {
    width: usize,
    rows: Vec<f64>,
}

impl Band {
    /// Factor of `A + damping · diag A`; `None` if that is not positive definite.
    fn factor(a: &Stencil, damping: f64) -> Option<Band> {
        let (width, n) = (a.lattice.columns + 1, a.values.len());
        let stride = width + 1;
        let mut rows = vec![0.0; n * stride];
        for (i, values) in a.values.iter().enumerate() {
            for (offset, value) in a.offsets().iter().zip(values).filter(|(o, _)| **o <= i) {
                rows[i * stride + width - offset] += value;
            }
            rows[i * stride + width] += damping * values[0];
            let (before, row) = rows.split_at_mut(i * stride);
            for j in i.saturating_sub(width)..i {
                // Row i holds columns i − width to i; row j overlaps in its last j − (i − width).
                let overlap = j + width - i;
                let above = &before[j * stride..(j + 1) * stride];
                let sum: f64 = row[..overlap].iter().zip(&above[width - overlap..]).map(|(p, q)| p * q).sum();
                row[overlap] = (row[overlap] - sum) / above[width];
            }
            let pivot = row[width] - row[..width].iter().map(|v| v * v).sum::<f64>();
            if pivot.is_nan() || pivot <= 0.0 {
                return None;
            }
            row[width] = pivot.sqrt();
        }
        Some(Band { width, rows })
    }

    fn row(&self, i: usize) -> &[f64] {
        &self.rows[i * (self.width + 1)..(i + 1) * (self.width + 1)]
    }

    /// Solves in place by forward and back substitution.
    fn solve(&self, x: &mut [f64]) {
        let width = self.width;
        for i in 0..x.len() {
            let (low, row) = (i.saturating_sub(width), self.row(i));
            let sum: f64 = row[width + low - i..width].iter().zip(&x[low..i]).map(|(l, v)| l * v).sum();
            x[i] = (x[i] - sum) / row[width];
        }
        for i in (0..x.len()).rev() {
            let (low, row) = (i.saturating_sub(width), self.row(i));
            x[i] /= row[width];
            let value = x[i];
            for (l, v) in row[width + low - i..width].iter().zip(&mut x[low..i]) {
                *v -= l * value;
            }
        }
    }
}

/// Most steps of conjugate gradients; a few dozen are usual.
const MAX_STEPS: usize = 1000;

/// Factorised normal equations with `A + damping · diag A`, for several right-hand sides.
pub(super) struct Factored<'a> {
    normal: &'a NormalEquations<'a>,
    damping: f64,
    cameras: Cholesky<f64, Dyn>,
    bands: Vec<Band>,
    /// First corner of each view, then the number of corners.
    starts: Vec<usize>,
}

impl<'a> Factored<'a> {
    /// Factors the equations; `None` if the matrix is not positive definite.
    pub(super) fn new(normal: &'a NormalEquations<'a>, damping: f64) -> Option<Factored<'a>> {
        let mut cameras = normal.camera.clone();
        for i in 0..cameras.nrows() {
            cameras[(i, i)] *= 1.0 + damping;
        }
        let bands: Option<Vec<Band>> =
            normal.grids.par_iter().map(|g| Band::factor(&g.stencil, damping)).collect();
        let mut starts = vec![0];
        for g in &normal.grids {
            starts.push(starts[starts.len() - 1] + g.gradient.len());
        }
        Some(Factored { normal, damping, cameras: cameras.cholesky()?, bands: bands?, starts })
    }

    /// Solution for the gradient: the Gauss–Newton step.
    pub(super) fn step(&self, tolerance: f64) -> Option<Step> {
        let grid = self.normal.grids.iter().flat_map(|g| g.gradient.iter().copied()).collect();
        self.solve(&Step { camera: self.normal.camera_gradient.clone(), grid }, tolerance)
    }

    /// Solves for `b` to a preconditioned residual of `tolerance` times the first one.
    pub(super) fn solve(&self, b: &Step, tolerance: f64) -> Option<Step> {
        let mut camera = self.cameras.solve(&b.camera);
        let mut r = b.grid.clone();
        self.subtract_cameras(&camera, &mut r);
        let mut x = vec![0.0; r.len()];
        let mut z = self.preconditioned(&r);
        let mut p = z.clone();
        let first = dot(&r, &z);
        let mut size = first;
        for _ in 0..MAX_STEPS {
            if size <= tolerance * tolerance * first {
                break;
            }
            let q = self.reduced_product(&p);
            let curvature = dot(&p, &q);
            if curvature.is_nan() || curvature <= 0.0 {
                return None;
            }
            let length = size / curvature;
            for k in 0..x.len() {
                x[k] += length * p[k];
                r[k] -= length * q[k];
            }
            z = self.preconditioned(&r);
            let next = dot(&r, &z);
            let beta = next / size;
            p.iter_mut().zip(&z).for_each(|(p, z)| *p = z + beta * *p);
            size = next;
        }
        camera -= self.cameras.solve(&self.camera_product(&x));
        Some(Step { camera, grid: x })
    }

    fn view_part<'v>(&self, view: usize, x: &'v [f64]) -> &'v [f64] {
        &x[self.starts[view]..self.starts[view + 1]]
    }

    /// Runs `job` in parallel on each view's part of a vector.
    fn for_each_view(&self, y: &mut [f64], job: impl Fn(usize, &mut [f64]) + Sync) {
        let mut parts = Vec::with_capacity(self.bands.len());
        let mut rest = y;
        for v in 0..self.bands.len() {
            let (part, tail) = rest.split_at_mut(self.starts[v + 1] - self.starts[v]);
            parts.push(part);
            rest = tail;
        }
        parts.into_par_iter().enumerate().for_each(|(v, part)| job(v, part));
    }

    fn preconditioned(&self, r: &[f64]) -> Vec<f64> {
        let mut z = r.to_vec();
        self.for_each_view(&mut z, |v, part| self.bands[v].solve(part));
        z
    }

    /// Product of the camera–correction blocks with corrections.
    fn camera_product(&self, x: &[f64]) -> DVector<f64> {
        let products: Vec<DVector<f64>> = (self.normal.grids.par_iter().enumerate())
            .map(|(v, g)| {
                &g.cameras * nalgebra::DVectorView::from_slice(self.view_part(v, x), g.cameras.ncols())
            })
            .collect();
        let mut sum = DVector::zeros(self.normal.camera.nrows());
        for (g, product) in self.normal.grids.iter().zip(&products) {
            g.unknowns.iter().zip(product.iter()).for_each(|(u, p)| sum[*u] += p);
        }
        sum
    }

    /// Subtracts the product of the transposed camera–correction blocks with the cameras `t`.
    fn subtract_cameras(&self, t: &DVector<f64>, y: &mut [f64]) {
        self.for_each_view(y, |v, part| {
            let g = &self.normal.grids[v];
            let own = DVector::from_iterator(g.unknowns.len(), g.unknowns.iter().map(|u| t[*u]));
            nalgebra::DVectorViewMut::from_slice(part, g.cameras.ncols())
                .gemv_tr(-1.0, &g.cameras, &own, 1.0);
        });
    }

    /// Product of `x` with the Schur complement of the cameras.
    fn reduced_product(&self, x: &[f64]) -> Vec<f64> {
        let mut y = vec![0.0; x.len()];
        self.for_each_view(&mut y, |v, part| {
            self.normal.grids[v].stencil.product(self.damping, self.view_part(v, x), part);
            for c in &self.normal.couplings {
                for side in (0..2).filter(|side| c.views[*side] == v) {
                    c.add_product(side, self.view_part(c.views[1 - side], x), part);
                }
            }
        });
        self.subtract_cameras(&self.cameras.solve(&self.camera_product(x)), &mut y);
        y
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}
