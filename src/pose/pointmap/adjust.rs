//! Step F: cameras, focal lengths, view scales and a smooth depth correction per view, adjusted together to the matches
//! (Levenberg–Marquardt in f64, dense Cholesky).
use super::canonical::{Canonical, Focals};
use super::cholesky;
use super::matches::PairMatches;
use super::tree::Placement;
use crate::Result;
use crate::math::median;
use crate::pose::numeric::{cauchy, cauchy_weight, skew};
use crate::progress::Progress;
use crate::scene::{ModelView, PairPointmaps, Pose};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};

/// Pitch of the depth-correction grid, model pixels.
const PITCH: f64 = 16.0;
/// Cauchy scales: reprojection as a fraction of the long side (1.5 px at 512), and relative depth.
const PIXEL_SCALE: f64 = 1.5 / 512.0;
const DEPTH_SCALE: f64 = 0.02;
/// Priors: size of a correction at a pixel the pairs agree on, and difference between neighbours.
const SIZE_SIGMA: f64 = 0.05;
const STEP_SIGMA: f64 = 0.02;
/// The mean log scale is the gauge; any stiff value holds it.
const GAUGE_SIGMA: f64 = 1e-3;
/// Unknowns one residual touches: two poses, two focals, two scales, two grid cells of four corners.
const MAX_ENTRIES: usize = 24;

/// What is adjusted.
#[derive(Clone, Debug)]
pub(super) struct State {
    /// World → camera; camera 0 fixed.
    pub(super) poses: Vec<Pose>,
    pub(super) log_focals: Vec<f64>,
    /// ln(global depth / canonical depth) per view.
    pub(super) kappa: Vec<f64>,
    /// ln depth correction at the grid corners per view, row-major.
    pub(super) grid: Vec<Vec<f64>>,
}

/// Grid of one view.
#[derive(Clone, Copy, Debug)]
struct Lattice {
    columns: usize,
    rows: usize,
}

impl Lattice {
    fn new(view: &ModelView) -> Lattice {
        let count = |n: usize| (n as f64 / PITCH).ceil() as usize + 1;
        Lattice { columns: count(view.width), rows: count(view.height) }
    }
    /// Corner indices and bilinear weights at a position.
    fn corners(&self, p: DVec2) -> ([usize; 4], [f64; 4]) {
        let u = (p / PITCH).max(DVec2::ZERO);
        let x = (u.x as usize).min(self.columns - 2);
        let y = (u.y as usize).min(self.rows - 2);
        let (fx, fy) = (u.x - x as f64, u.y - y as f64);
        let i = y * self.columns + x;
        let w = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        ([i, i + 1, i + self.columns, i + self.columns + 1], w)
    }
}

/// One end of a match.
#[derive(Clone, Copy, Debug)]
struct End {
    view: usize,
    /// Relative to the principal point.
    pixel: DVec2,
    /// Canonical depth.
    depth: f64,
    corners: [usize; 4],
    weights: [f64; 4],
}

#[derive(Clone, Copy, Debug)]
struct MatchResidual {
    ends: [End; 2],
    weight: f64,
    pair: usize,
}

/// Residuals (u, v in Cauchy scales; relative depth in Cauchy scales) with derivatives by unknown.
struct JacobianRow {
    r: [f64; 3],
    entries: [(usize, [f64; 3]); MAX_ENTRIES],
    count: usize,
}

impl JacobianRow {
    fn push(&mut self, index: usize, d: [f64; 3]) {
        // The two views of a pair may share a focal length.
        if let Some(e) = self.entries[..self.count].iter_mut().find(|e| e.0 == index) {
            (0..3).for_each(|k| e.1[k] += d[k]);
        } else {
            self.entries[self.count] = (index, d);
            self.count += 1;
        }
    }
}

/// The problem and its current solution.
pub(super) struct Adjustment {
    pub(super) state: State,
    group: Vec<usize>,
    priors: Vec<(f64, f64)>,
    lattices: Vec<Lattice>,
    /// Disagreement of the pairs at each grid corner.
    spread: Vec<Vec<f64>>,
    start_kappa: f64,
    links: Vec<MatchResidual>,
    /// Cauchy scale of reprojections, pixels.
    pixel_scale: f64,
    long: f64,
    pub(super) focal_log_sigma: f64,
}

impl Adjustment {
    pub(super) fn new(
        views: &[ModelView],
        canonical: &[Canonical],
        focals: &Focals,
        start: &Placement,
        pairs: &[PairPointmaps],
        matches: &[PairMatches],
    ) -> Adjustment {
        let lattices: Vec<Lattice> = views.iter().map(Lattice::new).collect();
        let long = views.iter().map(|v| v.width.max(v.height)).max().unwrap_or(1) as f64;
        let end = |view: usize, p: DVec2| -> Option<End> {
            let v = &views[view];
            let (x, y) =
                ((p.x.max(0.0) as usize).min(v.width - 1), (p.y.max(0.0) as usize).min(v.height - 1));
            let depth = canonical[view].points[y * v.width + x].z;
            let (corners, weights) = lattices[view].corners(p);
            (depth > 0.0).then_some(End { view, pixel: p - v.centre(), depth, corners, weights })
        };
        let mut links = Vec::new();
        for (k, (pair, m)) in pairs.iter().zip(matches).enumerate() {
            let mean = m.matches.iter().map(|x| x.weight).sum::<f64>() / m.matches.len().max(1) as f64;
            for x in &m.matches {
                if let (Some(a), Some(b)) = (end(pair.first, x.a), end(pair.second, x.b)) {
                    links.push(MatchResidual { ends: [a, b], weight: x.weight / mean, pair: k });
                }
            }
        }
        let spread = views
            .iter()
            .zip(canonical)
            .zip(&lattices)
            .map(|((v, c), l)| {
                let at = |i: usize| {
                    let x = ((i % l.columns) as f64 * PITCH) as usize;
                    let y = ((i / l.columns) as f64 * PITCH) as usize;
                    c.spread[y.min(v.height - 1) * v.width + x.min(v.width - 1)]
                };
                (0..l.columns * l.rows).map(at).collect()
            })
            .collect();
        Adjustment {
            state: State {
                poses: start.poses.clone(),
                log_focals: focals.values.iter().map(|f| f.ln()).collect(),
                kappa: start.kappa.clone(),
                grid: lattices.iter().map(|l| vec![0.0; l.columns * l.rows]).collect(),
            },
            group: focals.group.clone(),
            priors: focals.priors.clone(),
            start_kappa: start.kappa.iter().sum(),
            lattices,
            spread,
            links,
            pixel_scale: PIXEL_SCALE * long,
            long,
            focal_log_sigma: 0.0,
        }
    }

    pub(super) fn focal(&self, view: usize) -> f64 {
        self.state.log_focals[self.group[view]].exp()
    }

    /// ln(global depth / canonical depth) at a position of a view.
    pub(super) fn log_correction(&self, view: usize, p: DVec2) -> f64 {
        let (corners, weights) = self.lattices[view].corners(p);
        self.state.kappa[view]
            + corners.iter().zip(weights).map(|(c, w)| w * self.state.grid[view][*c]).sum::<f64>()
    }

    fn depth(&self, state: &State, e: &End) -> f64 {
        let a: f64 = e.corners.iter().zip(e.weights).map(|(c, w)| w * state.grid[e.view][*c]).sum();
        e.depth * (state.kappa[e.view] + a).exp()
    }

    fn focal_offset(&self) -> usize {
        6 * (self.state.poses.len() - 1)
    }
    fn kappa_offset(&self) -> usize {
        self.focal_offset() + self.state.log_focals.len()
    }
    fn grid_offset(&self, view: usize) -> usize {
        let before: usize = self.lattices[..view].iter().map(|l| l.columns * l.rows).sum();
        self.kappa_offset() + self.state.kappa.len() + before
    }
    fn unknowns(&self) -> usize {
        self.grid_offset(self.lattices.len())
    }

    /// Residuals of projecting end `a` into the view of end `b`; `None` behind the camera.
    fn residual(&self, s: &State, a: &End, b: &End) -> Option<([f64; 3], DVec3, DVec3)> {
        let y = DVec3::new(
            a.pixel.x / s.log_focals[self.group[a.view]].exp(),
            a.pixel.y / s.log_focals[self.group[a.view]].exp(),
            1.0,
        ) * self.depth(s, a);
        let t = s.poses[b.view].transform(s.poses[a.view].inverse().transform(y));
        if t.z <= 1e-9 {
            return None;
        }
        let f = s.log_focals[self.group[b.view]].exp();
        let d = (DVec2::new(t.x, t.y) * (f / t.z) - b.pixel) / self.pixel_scale;
        let depth = (t.z / self.depth(s, b) - 1.0) / DEPTH_SCALE;
        Some(([d.x, d.y, depth], y, t))
    }

    /// Residuals with their derivatives.
    fn row(&self, s: &State, a: &End, b: &End) -> Option<JacobianRow> {
        let (r, y, t) = self.residual(s, a, b)?;
        let mut row = JacobianRow { r, entries: [(0, [0.0; 3]); MAX_ENTRIES], count: 0 };
        let f = s.log_focals[self.group[b.view]].exp();
        let k = f / (t.z * self.pixel_scale);
        let seen = self.depth(s, b);
        // ∂r/∂t, one row per residual.
        let jt = [
            DVec3::new(k, 0.0, -k * t.x / t.z),
            DVec3::new(0.0, k, -k * t.y / t.z),
            DVec3::new(0.0, 0.0, 1.0 / (seen * DEPTH_SCALE)),
        ];
        let dot = |d: DVec3| jt.map(|j| j.dot(d));
        let relative: DMat3 = s.poses[b.view].rotation * s.poses[a.view].rotation.transpose();
        if b.view > 0 {
            // T ← exp(ρ, θ) T: δt = ρ − [t]× θ.
            let turn = skew(t);
            for c in 0..3 {
                row.push(6 * (b.view - 1) + c, dot(DVec3::AXES[c]));
                row.push(6 * (b.view - 1) + 3 + c, dot(-turn.col(c)));
            }
        }
        if a.view > 0 {
            // The inverse moves the other way, in the first camera's frame: δy = −ρ + [y]× θ.
            let turn = relative * skew(y);
            for c in 0..3 {
                row.push(6 * (a.view - 1) + c, dot(-relative.col(c)));
                row.push(6 * (a.view - 1) + 3 + c, dot(turn.col(c)));
            }
        }
        row.push(self.focal_offset() + self.group[a.view], dot(relative * DVec3::new(-y.x, -y.y, 0.0)));
        row.push(self.focal_offset() + self.group[b.view], [k * t.x, k * t.y, 0.0]);
        let along = dot(relative * y);
        row.push(self.kappa_offset() + a.view, along);
        let away = [0.0, 0.0, -t.z / (seen * DEPTH_SCALE)];
        row.push(self.kappa_offset() + b.view, away);
        for c in 0..4 {
            row.push(self.grid_offset(a.view) + a.corners[c], along.map(|v| v * a.weights[c]));
            row.push(self.grid_offset(b.view) + b.corners[c], away.map(|v| v * b.weights[c]));
        }
        Some(row)
    }

    /// Linear priors as (unknowns with factors, residual).
    fn priors(&self, s: &State) -> Vec<(Vec<(usize, f64)>, f64)> {
        let mut out = Vec::new();
        for (g, (mean, sigma)) in self.priors.iter().enumerate() {
            out.push((vec![(self.focal_offset() + g, 1.0 / sigma)], (s.log_focals[g] - mean) / sigma));
        }
        let sum: f64 = s.kappa.iter().sum();
        let all = (0..s.kappa.len()).map(|v| (self.kappa_offset() + v, 1.0 / GAUGE_SIGMA)).collect();
        out.push((all, (sum - self.start_kappa) / GAUGE_SIGMA));
        for (v, l) in self.lattices.iter().enumerate() {
            let offset = self.grid_offset(v);
            for i in 0..l.columns * l.rows {
                let a = s.grid[v][i];
                let sigma = SIZE_SIGMA * (1.0 + 20.0 * self.spread[v][i]);
                out.push((vec![(offset + i, 1.0 / sigma)], a / sigma));
                let mut neighbour = |j: usize| {
                    let row = vec![(offset + i, 1.0 / STEP_SIGMA), (offset + j, -1.0 / STEP_SIGMA)];
                    out.push((row, (a - s.grid[v][j]) / STEP_SIGMA));
                };
                if i % l.columns + 1 < l.columns {
                    neighbour(i + 1);
                }
                if i / l.columns + 1 < l.rows {
                    neighbour(i + l.columns);
                }
            }
        }
        out
    }

    /// Robust cost; `c` stretches the Cauchy scales.
    fn cost(&self, s: &State, c: f64) -> f64 {
        let mut sum = 0.0;
        for l in &self.links {
            for (a, b) in [(0, 1), (1, 0)] {
                // Behind the camera: as bad as a residual of a thousand scales.
                let r = self.residual(s, &l.ends[a], &l.ends[b]).map_or([1e3; 3], |r| r.0);
                sum += l.weight * (cauchy(r[0] * r[0] + r[1] * r[1], c) + cauchy(r[2] * r[2], c));
            }
        }
        sum + self.priors(s).iter().map(|p| p.1 * p.1).sum::<f64>()
    }

    /// Lower triangle of the normal matrix, and the gradient.
    fn normal(&self, c: f64) -> (DMatrix<f64>, DVector<f64>) {
        let n = self.unknowns();
        let (mut h, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
        for l in &self.links {
            for (a, b) in [(0, 1), (1, 0)] {
                let Some(row) = self.row(&self.state, &l.ends[a], &l.ends[b]) else { continue };
                let wp = l.weight * cauchy_weight(row.r[0] * row.r[0] + row.r[1] * row.r[1], c);
                let w = [wp, wp, l.weight * cauchy_weight(row.r[2] * row.r[2], c)];
                for p in 0..row.count {
                    let (i, d) = row.entries[p];
                    let scaled: [f64; 3] = std::array::from_fn(|k| w[k] * d[k]);
                    g[i] += (0..3).map(|k| scaled[k] * row.r[k]).sum::<f64>();
                    for q in 0..=p {
                        let (j, e) = row.entries[q];
                        h[(i.max(j), i.min(j))] += (0..3).map(|k| scaled[k] * e[k]).sum::<f64>();
                    }
                }
            }
        }
        for (row, r) in self.priors(&self.state) {
            for &(i, a) in &row {
                g[i] += a * r;
                for &(j, b) in &row {
                    if j <= i {
                        h[(i, j)] += a * b;
                    }
                }
            }
        }
        (h, g)
    }

    fn stepped(&self, d: &DVector<f64>) -> State {
        let mut s = self.state.clone();
        for v in 1..s.poses.len() {
            let at = |k: usize| -d[6 * (v - 1) + k];
            let step = Pose::exp(DVec3::new(at(0), at(1), at(2)), DVec3::new(at(3), at(4), at(5)));
            s.poses[v] = step.compose(&s.poses[v]).orthonormalised();
        }
        // Steps beyond e^±0.3 leave the range where the linearisation holds.
        let limited = |v: f64| v.clamp(-0.3, 0.3);
        for (g, f) in s.log_focals.iter_mut().enumerate() {
            *f -= limited(d[self.focal_offset() + g]);
        }
        for (v, k) in s.kappa.iter_mut().enumerate() {
            *k -= limited(d[self.kappa_offset() + v]);
        }
        for v in 0..s.grid.len() {
            let offset = self.grid_offset(v);
            s.grid[v].iter_mut().enumerate().for_each(|(i, a)| *a -= limited(d[offset + i]));
        }
        s
    }

    /// Graduated Levenberg–Marquardt: the Cauchy scales start at eight times their value for ten steps, then halve every
    /// three.
    pub(super) fn solve(&mut self, progress: &dyn Progress) -> Result<()> {
        let mut lambda = 1e-4;
        for step in 0..60 {
            progress.check()?;
            let halvings = if step < 10 { 0 } else { ((step - 10) / 3 + 1).min(3) };
            let c = 8.0 / (1 << halvings) as f64;
            let before = self.cost(&self.state, c);
            let (h, g) = self.normal(c);
            let mut after = before;
            for _ in 0..8 {
                let mut damped = h.clone();
                for i in 0..g.len() {
                    damped[(i, i)] *= 1.0 + lambda;
                }
                if let Some(d) = cholesky::solve(damped, &g) {
                    let next = self.stepped(&d);
                    let cost = self.cost(&next, c);
                    if cost < before {
                        (self.state, after) = (next, cost);
                        lambda = (lambda * 0.1).max(1e-12);
                        break;
                    }
                }
                lambda *= 10.0;
            }
            // The invariances of docs/method.md#pointmap-adjustment (1e-6) need a tighter end than a picture would.
            if halvings == 3 && before - after <= 1e-11 * before {
                break;
            }
        }
        self.focal_log_sigma = self.focal_sigma();
        Ok(())
    }

    /// σ of the first ln f: square root of the diagonal of the inverse normal matrix.
    fn focal_sigma(&self) -> f64 {
        let (h, g) = self.normal(1.0);
        let mut unit = DVector::zeros(g.len());
        unit[self.focal_offset()] = 1.0;
        cholesky::solve(h, &unit).map_or(f64::INFINITY, |x| x[self.focal_offset()].max(0.0).sqrt())
    }

    /// Leaves out pairs whose median reprojection error exceeds `fraction` of the long side; true if there were any.
    pub(super) fn drop_wrong_pairs(&mut self, fraction: f64) -> bool {
        let pairs = self.links.iter().map(|l| l.pair + 1).max().unwrap_or(0);
        let mut wrong = vec![false; pairs];
        for (k, bad) in wrong.iter_mut().enumerate() {
            let mut errors: Vec<f64> = self
                .links
                .iter()
                .filter(|l| l.pair == k)
                .filter_map(|l| self.residual(&self.state, &l.ends[0], &l.ends[1]))
                .map(|(r, ..)| r[0].hypot(r[1]) * self.pixel_scale)
                .collect();
            *bad = median(&mut errors).is_some_and(|e| e > fraction * self.long);
        }
        if wrong.iter().all(|w| !w) || wrong.iter().filter(|w| !**w).count() + 1 < self.state.poses.len() {
            return false;
        }
        self.links.retain(|l| !wrong[l.pair]);
        true
    }

    /// Unit of length: the median depth of the matched points becomes 1.
    pub(super) fn normalise(&mut self) {
        let mut depths: Vec<f64> =
            self.links.iter().flat_map(|l| l.ends.iter().map(|e| self.depth(&self.state, e))).collect();
        let Some(scale) = median(&mut depths) else { return };
        for p in &mut self.state.poses {
            p.translation /= scale;
        }
        for k in &mut self.state.kappa {
            *k -= scale.ln();
        }
    }

    #[cfg(test)]
    pub(super) fn worst_gradient_error(&self) -> f64 {
        let mut worst: f64 = 0.0;
        for l in self.links.iter().step_by(self.links.len() / 20 + 1) {
            let row = self.row(&self.state, &l.ends[0], &l.ends[1]).unwrap();
            for &(i, d) in &row.entries[..row.count] {
                let moved = |h: f64| {
                    let mut step = DVector::zeros(self.unknowns());
                    step[i] = -h;
                    self.residual(&self.stepped(&step), &l.ends[0], &l.ends[1]).unwrap().0
                };
                let (up, down) = (moved(1e-6), moved(-1e-6));
                for k in 0..3 {
                    let numeric = (up[k] - down[k]) / 2e-6;
                    worst = worst.max((numeric - d[k]).abs() / (d[k].abs() + 1.0));
                }
            }
        }
        worst
    }
}
