//! Normal equations in blocks: a dense one for the cameras, a stencil per view for its depth
//! corrections, and between two views only the entries that their matches couple. Nothing grows
//! with the square of the number of corrections.
use super::problem::{GAUGE_WEIGHT, Link, PairLinks, Problem, STEP_WEIGHT, State};
use super::residual::{Lattice, Row, SLOTS, slots};
use crate::numeric::cauchy_weight;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Pairs accumulated in parallel: each has its own sums, which are then added in a fixed order.
const PAIRS_PER_BATCH: usize = 8;

/// Sparsity of the block that couples the corrections of two views: a compressed matrix with a row
/// per corner of the first view.
#[derive(Clone, Debug, Default)]
pub(super) struct SparsityPattern {
    starts: Vec<u32>,
    columns: Vec<u32>,
    /// Per match the indices of its 4 × 4 values.
    indices: Vec<[u32; 16]>,
}

impl SparsityPattern {
    fn new(links: &[Link], rows: usize) -> SparsityPattern {
        let mut entries: Vec<(u32, u32)> =
            links.iter().flat_map(|l| (0..16).map(move |k| corner_pair(l, k))).collect();
        entries.sort_unstable();
        entries.dedup();
        let mut starts = vec![0u32; rows + 1];
        for e in &entries {
            starts[e.0 as usize + 1] += 1;
        }
        for row in 0..rows {
            starts[row + 1] += starts[row];
        }
        let index = |l: &Link, k: usize| entries.partition_point(|e| *e < corner_pair(l, k)) as u32;
        let indices = links.iter().map(|l| std::array::from_fn(|k| index(l, k))).collect();
        SparsityPattern { starts, columns: entries.iter().map(|e| e.1).collect(), indices }
    }

    /// Patterns of all pairs.
    pub(super) fn all(problem: &Problem) -> Vec<SparsityPattern> {
        let rows = |p: &PairLinks| problem.lattices[p.views[0]].len();
        problem.pairs.par_iter().map(|p| SparsityPattern::new(&p.links, rows(p))).collect()
    }
}

/// Corners of the first and the second view that value `k` of a match couples.
fn corner_pair(l: &Link, k: usize) -> (u32, u32) {
    (l.ends[0].corners[k / 4] as u32, l.ends[1].corners[k % 4] as u32)
}

/// Values of a [`SparsityPattern`].
pub(super) struct Coupling<'a> {
    pub(super) views: [usize; 2],
    pattern: &'a SparsityPattern,
    values: Vec<f64>,
}

impl Coupling<'_> {
    /// Adds the product with the other side's corrections `x` to those of `side`, `y`.
    pub(super) fn add_product(&self, side: usize, x: &[f64], y: &mut [f64]) {
        for (row, range) in self.pattern.starts.windows(2).enumerate() {
            let range = range[0] as usize..range[1] as usize;
            let entries = self.pattern.columns[range.clone()].iter().zip(&self.values[range]);
            if side == 0 {
                y[row] += entries.map(|(c, v)| v * x[*c as usize]).sum::<f64>();
            } else {
                entries.for_each(|(c, v)| y[*c as usize] += v * x[row]);
            }
        }
    }
}

/// Symmetric matrix over the corners of one grid that couples neighbours only: per corner the
/// values with itself and with the corners before it by 1, columns − 1, columns and columns + 1.
#[derive(Clone, Debug)]
pub(super) struct Stencil {
    pub(super) lattice: Lattice,
    pub(super) values: Vec<[f64; 5]>,
}

impl Stencil {
    fn new(lattice: Lattice) -> Stencil {
        Stencil { lattice, values: vec![[0.0; 5]; lattice.len()] }
    }

    pub(super) fn offsets(&self) -> [usize; 5] {
        let c = self.lattice.columns;
        [0, 1, c - 1, c, c + 1]
    }

    /// Adds `factor` times the outer product of a position's bilinear weights.
    fn add(&mut self, corners: [usize; 4], w: [f64; 4], factor: f64) {
        let [a, b, c, d] = corners;
        for k in 0..4 {
            self.values[corners[k]][0] += factor * w[k] * w[k];
        }
        self.values[b][1] += factor * w[1] * w[0];
        self.values[d][1] += factor * w[3] * w[2];
        self.values[c][2] += factor * w[2] * w[1];
        self.values[c][3] += factor * w[2] * w[0];
        self.values[d][3] += factor * w[3] * w[1];
        self.values[d][4] += factor * w[3] * w[0];
        debug_assert!(a + 1 == b && c + 1 == d);
    }

    /// `y = (A + damping · diag A) x`.
    pub(super) fn product(&self, damping: f64, x: &[f64], y: &mut [f64]) {
        let offsets = self.offsets();
        for (i, row) in self.values.iter().enumerate() {
            y[i] = row[0] * (1.0 + damping) * x[i];
            for (o, v) in offsets.iter().zip(row).skip(1) {
                if let Some(j) = i.checked_sub(*o) {
                    y[i] += v * x[j];
                    y[j] += v * x[i];
                }
            }
        }
    }
}

/// Block of one view's depth corrections.
pub(super) struct GridBlock {
    pub(super) stencil: Stencil,
    pub(super) gradient: Vec<f64>,
    /// Camera unknowns coupled with the corrections.
    pub(super) unknowns: Vec<usize>,
    /// Coupling with the cameras: one row per entry of `unknowns`, one column per corner.
    pub(super) cameras: DMatrix<f64>,
}

/// Gauss–Newton Hessian and gradient.
pub(super) struct NormalEquations<'a> {
    pub(super) camera: DMatrix<f64>,
    pub(super) camera_gradient: DVector<f64>,
    pub(super) grids: Vec<GridBlock>,
    pub(super) couplings: Vec<Coupling<'a>>,
}

impl<'a> NormalEquations<'a> {
    /// Normal equations of the robust cost, with Cauchy scales stretched by `c`.
    pub(super) fn new(
        problem: &Problem,
        patterns: &'a [SparsityPattern],
        s: &State,
        c: f64,
    ) -> NormalEquations<'a> {
        let n = problem.camera_unknowns();
        let mut normal = NormalEquations {
            camera: DMatrix::zeros(n, n),
            camera_gradient: DVector::zeros(n),
            grids: (0..problem.lattices.len()).map(|v| zero_block(problem, v)).collect(),
            couplings: Vec::with_capacity(patterns.len()),
        };
        for (pairs, patterns) in problem.pairs.chunks(PAIRS_PER_BATCH).zip(patterns.chunks(PAIRS_PER_BATCH)) {
            let sums: Vec<PairSums> = pairs
                .par_iter()
                .zip(patterns)
                .map(|(pair, pattern)| PairSums::new(problem, s, pair, pattern, c))
                .collect();
            for ((pair, pattern), sums) in pairs.iter().zip(patterns).zip(sums) {
                normal.add(problem, pair, &sums);
                normal.couplings.push(Coupling { views: pair.views, pattern, values: sums.coupling });
            }
        }
        normal.add_priors(problem, s);
        normal
    }

    fn add(&mut self, problem: &Problem, pair: &PairLinks, sums: &PairSums) {
        let indices = camera_indices(problem, pair.views);
        for (i, p) in indices.iter().enumerate() {
            let Some(p) = *p else { continue };
            self.camera_gradient[p] += sums.gradient[i];
            for (j, q) in indices.iter().enumerate() {
                let Some(q) = *q else { continue };
                self.camera[(p, q)] += sums.camera[i.max(j)][i.min(j)];
            }
        }
        for (v, side) in pair.views.iter().zip(&sums.sides) {
            let block = &mut self.grids[*v];
            let rows = indices.map(|p| block.unknowns.iter().position(|u| Some(*u) == p));
            for (k, values) in side.cameras.iter().enumerate() {
                for (row, value) in rows.iter().zip(values) {
                    if let Some(row) = row {
                        block.cameras[(*row, k)] += value;
                    }
                }
            }
            for (sum, value) in block.gradient.iter_mut().zip(&side.gradient) {
                *sum += value;
            }
            for (sum, value) in block.stencil.values.iter_mut().zip(&side.stencil.values) {
                (0..5).for_each(|o| sum[o] += value[o]);
            }
        }
    }

    fn add_priors(&mut self, problem: &Problem, s: &State) {
        for (g, (mean, sigma)) in problem.focal_priors.iter().enumerate() {
            let i = problem.focal(g);
            self.camera[(i, i)] += sigma.powi(-2);
            self.camera_gradient[i] += (s.log_focals[g] - mean) * sigma.powi(-2);
        }
        let views = problem.lattices.len();
        let gauge = problem.gauge(s) * GAUGE_WEIGHT;
        for i in (0..views).map(|v| problem.kappa(v)) {
            self.camera_gradient[i] += gauge;
            for j in (0..views).map(|v| problem.kappa(v)) {
                self.camera[(i, j)] += GAUGE_WEIGHT;
            }
        }
        for (v, block) in self.grids.iter_mut().enumerate() {
            let (grid, lattice) = (&s.grid[v], problem.lattices[v]);
            for i in 0..grid.len() {
                let weight = problem.size_weights[v][i];
                block.stencil.values[i][0] += weight;
                block.gradient[i] += weight * grid[i];
                for j in lattice.later_neighbours(i) {
                    let step = (grid[i] - grid[j]) * STEP_WEIGHT;
                    block.gradient[i] += step;
                    block.gradient[j] -= step;
                    block.stencil.values[i][0] += STEP_WEIGHT;
                    block.stencil.values[j][0] += STEP_WEIGHT;
                    // The left neighbour is one corner before, the upper one a row of corners.
                    block.stencil.values[j][if j == i + 1 { 1 } else { 3 }] -= STEP_WEIGHT;
                }
            }
        }
    }
}

/// Zero block of one view, with the camera unknowns of its pairs.
fn zero_block(problem: &Problem, view: usize) -> GridBlock {
    let mut unknowns: Vec<usize> = problem
        .pairs
        .iter()
        .filter(|p| p.views.contains(&view) && !p.links.is_empty())
        .flat_map(|p| camera_indices(problem, p.views))
        .flatten()
        .collect();
    unknowns.sort_unstable();
    unknowns.dedup();
    let lattice = problem.lattices[view];
    GridBlock {
        stencil: Stencil::new(lattice),
        gradient: vec![0.0; lattice.len()],
        cameras: DMatrix::zeros(unknowns.len(), lattice.len()),
        unknowns,
    }
}

/// Indices of a pair's camera unknowns by slot; the first camera has no pose unknowns, and two
/// views may share a focal length.
pub(super) fn camera_indices(problem: &Problem, views: [usize; 2]) -> [Option<usize>; SLOTS] {
    let mut indices = [None; SLOTS];
    for (side, view) in views.into_iter().enumerate() {
        let (pose, focal, kappa) = slots(side);
        for k in 0..6 {
            indices[pose + k] = problem.pose(view).map(|p| p + k);
        }
        indices[focal] = Some(problem.focal(problem.group[view]));
        indices[kappa] = Some(problem.kappa(view));
    }
    indices
}

/// Contribution of one pair to the normal equations.
struct PairSums {
    /// Lower triangle.
    camera: [[f64; SLOTS]; SLOTS],
    gradient: [f64; SLOTS],
    sides: [SideSums; 2],
    coupling: Vec<f64>,
}

struct SideSums {
    cameras: Vec<[f64; SLOTS]>,
    gradient: Vec<f64>,
    stencil: Stencil,
}

impl SideSums {
    fn zeros(lattice: Lattice) -> SideSums {
        let n = lattice.len();
        SideSums { cameras: vec![[0.0; SLOTS]; n], gradient: vec![0.0; n], stencil: Stencil::new(lattice) }
    }
}

impl PairSums {
    fn new(problem: &Problem, s: &State, pair: &PairLinks, pattern: &SparsityPattern, c: f64) -> PairSums {
        let mut sums = PairSums {
            camera: [[0.0; SLOTS]; SLOTS],
            gradient: [0.0; SLOTS],
            sides: pair.views.map(|v| SideSums::zeros(problem.lattices[v])),
            coupling: vec![0.0; pattern.columns.len()],
        };
        let directions = [0, 1].map(|side| problem.direction(s, pair, side));
        for (link, coupled) in pair.links.iter().zip(&pattern.indices) {
            let d = problem.depths(s, pair, link);
            for (k, direction) in directions.iter().enumerate() {
                let row = direction.row(&link.ends[k], &link.ends[1 - k], [d[k], d[1 - k]]);
                if let Some(row) = row {
                    sums.add(&row, link, k, coupled, c);
                }
            }
        }
        sums
    }

    fn add(&mut self, row: &Row, link: &Link, side: usize, coupled: &[u32; 16], c: f64) {
        let Row { r, camera, by_point_depth: point, by_pixel_depth: pixel } = row;
        let wp = link.weight * cauchy_weight(r[0] * r[0] + r[1] * r[1], c);
        let w = [wp, wp, link.weight * cauchy_weight(r[2] * r[2], c)];
        let (mut cross_point, mut cross_pixel) = ([0.0; SLOTS], [0.0; SLOTS]);
        for i in 0..SLOTS {
            let d: [f64; 3] = std::array::from_fn(|k| w[k] * camera[k][i]);
            self.gradient[i] += d[0] * r[0] + d[1] * r[1] + d[2] * r[2];
            for j in 0..=i {
                self.camera[i][j] += d[0] * camera[0][j] + d[1] * camera[1][j] + d[2] * camera[2][j];
            }
            cross_point[i] = d[0] * point[0] + d[1] * point[1] + d[2] * point[2];
            cross_pixel[i] = d[2] * pixel;
        }
        let point_product = |f: [f64; 3]| (0..3).map(|k| w[k] * f[k] * point[k]).sum::<f64>();
        let ends = [
            (side, cross_point, point_product(*r), point_product(*point)),
            (1 - side, cross_pixel, w[2] * pixel * r[2], w[2] * pixel * pixel),
        ];
        for (side, cross, gradient, square) in ends {
            let (end, sums) = (&link.ends[side], &mut self.sides[side]);
            for (corner, weight) in end.corners.iter().zip(end.weights) {
                sums.gradient[*corner] += weight * gradient;
                for (sum, value) in sums.cameras[*corner].iter_mut().zip(&cross) {
                    *sum += weight * value;
                }
            }
            sums.stencil.add(end.corners, end.weights, square);
        }
        let both = w[2] * point[2] * pixel;
        for (k, index) in coupled.iter().enumerate() {
            self.coupling[*index as usize] +=
                both * link.ends[0].weights[k / 4] * link.ends[1].weights[k % 4];
        }
    }
}
