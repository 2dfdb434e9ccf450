//! The normal equations in blocks: cameras dense, each view's depth corrections as a stencil of
//! neighbours, and between two views only what their matches couple. Nothing grows with the square
//! of the number of corrections.
use super::problem::{GAUGE_WEIGHT, Link, PairLinks, Problem, STEP_WEIGHT, State};
use super::residual::{Lattice, Row, SLOTS, slots};
use crate::numeric::cauchy_weight;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Pairs that are summed at a time: each has its own sums until they are added up, always in one
/// order.
const AT_A_TIME: usize = 8;

/// Which corrections of two views the matches of a pair couple: a sparse matrix with a row per
/// corner of the first view.
#[derive(Clone, Debug, Default)]
pub(super) struct Pattern {
    starts: Vec<u32>,
    columns: Vec<u32>,
    /// Per match the places of its 4 × 4 values.
    places: Vec<[u32; 16]>,
}

impl Pattern {
    fn new(links: &[Link], rows: usize) -> Pattern {
        let entry = |l: &Link, k: usize| (l.ends[0].corners[k / 4] as u32, l.ends[1].corners[k % 4] as u32);
        let mut entries: Vec<(u32, u32)> =
            links.iter().flat_map(|l| (0..16).map(move |k| entry(l, k))).collect();
        entries.sort_unstable();
        entries.dedup();
        let mut starts = vec![0u32; rows + 1];
        for e in &entries {
            starts[e.0 as usize + 1] += 1;
        }
        for row in 0..rows {
            starts[row + 1] += starts[row];
        }
        let place = |l: &Link, k: usize| entries.partition_point(|e| *e < entry(l, k)) as u32;
        let places = links.iter().map(|l| std::array::from_fn(|k| place(l, k))).collect();
        Pattern { starts, columns: entries.iter().map(|e| e.1).collect(), places }
    }

    /// The patterns of all pairs.
    pub(super) fn all(problem: &Problem) -> Vec<Pattern> {
        let of = |p: &PairLinks| Pattern::new(&p.links, problem.lattices[p.views[0]].len());
        problem.pairs.par_iter().map(of).collect()
    }
}

/// Values of a [`Pattern`].
pub(super) struct Coupling<'a> {
    pub(super) views: [usize; 2],
    pattern: &'a Pattern,
    values: Vec<f64>,
}

impl Coupling<'_> {
    /// Adds to the corrections `y` of one side what those of the other, `x`, are coupled with.
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

/// Symmetric matrix over the corners of one grid, in which only neighbours meet: per corner its
/// value with itself and with the corners before it by 1, columns − 1, columns and columns + 1.
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

    /// Adds the outer product of a position's bilinear weights with themselves.
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

/// One view's depth corrections.
pub(super) struct GridBlock {
    pub(super) stencil: Stencil,
    pub(super) gradient: Vec<f64>,
    /// Camera unknowns that meet them.
    pub(super) unknowns: Vec<usize>,
    /// One row for each of those, one column per corner.
    pub(super) cameras: DMatrix<f64>,
}

/// Hessian of Gauss–Newton and gradient.
pub(super) struct Normal<'a> {
    pub(super) camera: DMatrix<f64>,
    pub(super) camera_gradient: DVector<f64>,
    pub(super) grids: Vec<GridBlock>,
    pub(super) couplings: Vec<Coupling<'a>>,
}

impl<'a> Normal<'a> {
    /// Of the robust cost with scales stretched by `c`.
    pub(super) fn new(problem: &Problem, patterns: &'a [Pattern], s: &State, c: f64) -> Normal<'a> {
        let n = problem.camera_unknowns();
        let mut normal = Normal {
            camera: DMatrix::zeros(n, n),
            camera_gradient: DVector::zeros(n),
            grids: (0..problem.lattices.len()).map(|v| empty(problem, v)).collect(),
            couplings: Vec::with_capacity(patterns.len()),
        };
        for (pairs, patterns) in problem.pairs.chunks(AT_A_TIME).zip(patterns.chunks(AT_A_TIME)) {
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
        let places = camera_places(problem, pair.views);
        for (i, p) in places.iter().enumerate() {
            let Some(p) = *p else { continue };
            self.camera_gradient[p] += sums.gradient[i];
            for (j, q) in places.iter().enumerate() {
                let Some(q) = *q else { continue };
                self.camera[(p, q)] += sums.camera[i.max(j)][i.min(j)];
            }
        }
        for (v, side) in pair.views.iter().zip(&sums.sides) {
            let block = &mut self.grids[*v];
            let rows = places.map(|p| block.unknowns.iter().position(|u| Some(*u) == p));
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
                    // The left neighbour is one corner before, the upper one a row.
                    block.stencil.values[j][if j == i + 1 { 1 } else { 3 }] -= STEP_WEIGHT;
                }
            }
        }
    }
}

/// Zeros for one view, with the camera unknowns of its pairs.
fn empty(problem: &Problem, view: usize) -> GridBlock {
    let mut unknowns: Vec<usize> = problem
        .pairs
        .iter()
        .filter(|p| p.views.contains(&view) && !p.links.is_empty())
        .flat_map(|p| camera_places(problem, p.views))
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

/// Indices of a pair's camera unknowns by slot; the first camera has no pose among them, and two
/// views may share a focal length.
pub(super) fn camera_places(problem: &Problem, views: [usize; 2]) -> [Option<usize>; SLOTS] {
    let mut places = [None; SLOTS];
    for (side, view) in views.into_iter().enumerate() {
        let (pose, focal, kappa) = slots(side);
        for k in 0..6 {
            places[pose + k] = problem.pose(view).map(|p| p + k);
        }
        places[focal] = Some(problem.focal(problem.group[view]));
        places[kappa] = Some(problem.kappa(view));
    }
    places
}

/// What the matches of one pair add.
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

impl PairSums {
    fn new(problem: &Problem, s: &State, pair: &PairLinks, pattern: &Pattern, c: f64) -> PairSums {
        let side = |k: usize| {
            let lattice = problem.lattices[pair.views[k]];
            let n = lattice.len();
            SideSums {
                cameras: vec![[0.0; SLOTS]; n],
                gradient: vec![0.0; n],
                stencil: Stencil::new(lattice),
            }
        };
        let mut sums = PairSums {
            camera: [[0.0; SLOTS]; SLOTS],
            gradient: [0.0; SLOTS],
            sides: [side(0), side(1)],
            coupling: vec![0.0; pattern.columns.len()],
        };
        let directions = [0, 1].map(|side| problem.direction(s, pair, side));
        for (link, places) in pair.links.iter().zip(&pattern.places) {
            let d = problem.depths(s, pair, link);
            for (k, direction) in directions.iter().enumerate() {
                let row = direction.row(&link.ends[k], &link.ends[1 - k], [d[k], d[1 - k]]);
                if let Some(row) = row {
                    sums.add(&row, link, k, places, c);
                }
            }
        }
        sums
    }

    fn add(&mut self, row: &Row, link: &Link, side: usize, places: &[u32; 16], c: f64) {
        let Row { r, camera, along, away } = row;
        let wp = link.weight * cauchy_weight(r[0] * r[0] + r[1] * r[1], c);
        let w = [wp, wp, link.weight * cauchy_weight(r[2] * r[2], c)];
        let (mut by_along, mut by_away) = ([0.0; SLOTS], [0.0; SLOTS]);
        for i in 0..SLOTS {
            let d: [f64; 3] = std::array::from_fn(|k| w[k] * camera[k][i]);
            self.gradient[i] += d[0] * r[0] + d[1] * r[1] + d[2] * r[2];
            for j in 0..=i {
                self.camera[i][j] += d[0] * camera[0][j] + d[1] * camera[1][j] + d[2] * camera[2][j];
            }
            by_along[i] = d[0] * along[0] + d[1] * along[1] + d[2] * along[2];
            by_away[i] = d[2] * away;
        }
        let sum = |f: [f64; 3]| (0..3).map(|k| w[k] * f[k] * along[k]).sum::<f64>();
        let ends = [
            (side, by_along, sum(*r), sum(*along)),
            (1 - side, by_away, w[2] * away * r[2], w[2] * away * away),
        ];
        for (side, by, gradient, square) in ends {
            let (end, sums) = (&link.ends[side], &mut self.sides[side]);
            for (corner, weight) in end.corners.iter().zip(end.weights) {
                sums.gradient[*corner] += weight * gradient;
                for (sum, value) in sums.cameras[*corner].iter_mut().zip(&by) {
                    *sum += weight * value;
                }
            }
            sums.stencil.add(end.corners, end.weights, square);
        }
        let both = w[2] * along[2] * away;
        for (k, place) in places.iter().enumerate() {
            self.coupling[*place as usize] +=
                both * link.ends[0].weights[k / 4] * link.ends[1].weights[k % 4];
        }
    }
}
