//! Solves the blocked normal equations: cameras are eliminated exactly, the depth corrections by
//! conjugate gradients with each view's own block, factored as a band matrix, as preconditioner.
use super::normal::{Normal, Stencil};
use super::problem::Step;
use nalgebra::{Cholesky, DVector, Dyn};
use rayon::prelude::*;

/// Cholesky factor of a stencil's matrix: rows of the lower triangle, from `width` before the
/// diagonal up to it.
struct Band {
    width: usize,
    rows: Vec<f64>,
}

impl Band {
    /// Of `A + damping · diag A`; `None` when it is not positive definite.
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
                // Row i holds columns i − width to i; of row j the last j − (i − width) before its
                // diagonal overlap.
                let overlap = j + width - i;
                let above = &before[j * stride..(j + 1) * stride];
                let sum: f64 = row[..overlap].iter().zip(&above[width - overlap..]).map(|(p, q)| p * q).sum();
                row[overlap] = (row[overlap] - sum) / above[width];
            }
            let rest = row[width] - row[..width].iter().map(|v| v * v).sum::<f64>();
            if rest.is_nan() || rest <= 0.0 {
                return None;
            }
            row[width] = rest.sqrt();
        }
        Some(Band { width, rows })
    }

    fn solve(&self, x: &mut [f64]) {
        let width = self.width;
        let row = |i: usize| &self.rows[i * (width + 1)..(i + 1) * (width + 1)];
        for i in 0..x.len() {
            let (low, row) = (i.saturating_sub(width), row(i));
            let sum: f64 = row[width + low - i..width].iter().zip(&x[low..i]).map(|(l, v)| l * v).sum();
            x[i] = (x[i] - sum) / row[width];
        }
        for i in (0..x.len()).rev() {
            let (low, row) = (i.saturating_sub(width), row(i));
            x[i] /= row[width];
            let value = x[i];
            for (l, v) in row[width + low - i..width].iter().zip(&mut x[low..i]) {
                *v -= l * value;
            }
        }
    }
}

/// Steps of the conjugate gradients at most; a few dozen are usual.
const MOST_STEPS: usize = 1000;

/// The equations with `A + damping · diag A`, ready to be solved for several right-hand sides.
pub(super) struct Factored<'a> {
    normal: &'a Normal<'a>,
    damping: f64,
    cameras: Cholesky<f64, Dyn>,
    bands: Vec<Band>,
    /// First corner of each view, and their number.
    starts: Vec<usize>,
}

impl<'a> Factored<'a> {
    /// `None` when the matrix is not positive definite.
    pub(super) fn new(normal: &'a Normal<'a>, damping: f64) -> Option<Factored<'a>> {
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

    /// The step along the gradient.
    pub(super) fn step(&self, tolerance: f64) -> Option<Step> {
        let grid = self.normal.grids.iter().flat_map(|g| g.gradient.iter().copied()).collect();
        self.solve(&Step { camera: self.normal.camera_gradient.clone(), grid }, tolerance)
    }

    /// `tolerance` is that of the preconditioned residual against the first one.
    pub(super) fn solve(&self, b: &Step, tolerance: f64) -> Option<Step> {
        let mut camera = self.cameras.solve(&b.camera);
        let mut r = b.grid.clone();
        self.subtract_cameras(&camera, &mut r);
        let mut x = vec![0.0; r.len()];
        let mut z = self.preconditioned(&r);
        let mut p = z.clone();
        let first = dot(&r, &z);
        let mut size = first;
        for _ in 0..MOST_STEPS {
            if size <= tolerance * tolerance * first {
                break;
            }
            let q = self.reduced(&p);
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
            let turn = next / size;
            p.iter_mut().zip(&z).for_each(|(p, z)| *p = z + turn * *p);
            size = next;
        }
        camera -= self.cameras.solve(&self.camera_product(&x));
        Some(Step { camera, grid: x })
    }

    fn of<'v>(&self, view: usize, x: &'v [f64]) -> &'v [f64] {
        &x[self.starts[view]..self.starts[view + 1]]
    }

    /// All views' parts of a vector, one job each.
    fn each(&self, y: &mut [f64], job: impl Fn(usize, &mut [f64]) + Sync) {
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
        self.each(&mut z, |v, part| self.bands[v].solve(part));
        z
    }

    /// Rows of the cameras times corrections.
    fn camera_product(&self, x: &[f64]) -> DVector<f64> {
        let products: Vec<DVector<f64>> = (self.normal.grids.par_iter().enumerate())
            .map(|(v, g)| &g.cameras * nalgebra::DVectorView::from_slice(self.of(v, x), g.cameras.ncols()))
            .collect();
        let mut sum = DVector::zeros(self.normal.camera.nrows());
        for (g, product) in self.normal.grids.iter().zip(&products) {
            g.unknowns.iter().zip(product.iter()).for_each(|(u, p)| sum[*u] += p);
        }
        sum
    }

    /// Takes from every correction what the cameras `t` are coupled with.
    fn subtract_cameras(&self, t: &DVector<f64>, y: &mut [f64]) {
        self.each(y, |v, part| {
            let g = &self.normal.grids[v];
            let own = DVector::from_iterator(g.unknowns.len(), g.unknowns.iter().map(|u| t[*u]));
            nalgebra::DVectorViewMut::from_slice(part, g.cameras.ncols())
                .gemv_tr(-1.0, &g.cameras, &own, 1.0);
        });
    }

    /// The matrix of the corrections after the cameras are eliminated, times `x`.
    fn reduced(&self, x: &[f64]) -> Vec<f64> {
        let mut y = vec![0.0; x.len()];
        self.each(&mut y, |v, part| {
            self.normal.grids[v].stencil.product(self.damping, self.of(v, x), part);
            for c in &self.normal.couplings {
                for side in (0..2).filter(|side| c.views[*side] == v) {
                    c.add_product(side, self.of(c.views[1 - side], x), part);
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
