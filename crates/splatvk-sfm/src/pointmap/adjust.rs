//! Step F: joint adjustment of cameras, focal lengths, view scales and a smooth depth correction
//! per view to the matches (Levenberg–Marquardt in f64).
use super::canonical::Focals;
use super::normal::{NormalEquations, SparsityPattern};
use super::problem::{PairLinks, Problem, State, Step};
use super::solver::Factored;
use super::tree::Registration;
use crate::Result;
use crate::math::median;
use crate::progress::Progress;
use glam::DVec2;
use nalgebra::DVector;

/// Relative error of a step: the cameras must agree to 10⁻⁶ for any order of the views.
const STEP_TOLERANCE: f64 = 1e-6;
/// Schedule of (factor on the Cauchy scales, most steps, least relative gain of a step). Wide
/// scales come first so that outliers do not hold a start that is far off. Only the last gain
/// matters: the invariances of docs/internals/method.md#pointmap-adjustment (10⁻⁶) need a smaller
/// one than a picture would.
const SCALES: [(f64, usize, f64); 4] = [(8.0, 10, 1e-4), (4.0, 3, 1e-4), (2.0, 3, 1e-4), (1.0, 44, 1e-11)];

/// Problem with its current solution.
pub(super) struct Adjustment {
    pub(super) state: State,
    pub(super) problem: Problem,
    /// Matches of rejected pairs.
    dropped: Vec<PairLinks>,
    pub(super) focal_log_sigma: f64,
}

impl Adjustment {
    pub(super) fn new(mut problem: Problem, start: &Registration, focals: &Focals) -> Adjustment {
        let state = State::new(start, focals, &problem.lattices);
        problem.fix_gauge(&state);
        Adjustment { state, problem, dropped: Vec::new(), focal_log_sigma: 0.0 }
    }

    pub(super) fn focal(&self, view: usize) -> f64 {
        self.state.log_focals[self.problem.group[view]].exp()
    }

    /// ln(global depth / canonical depth) at a position of a view.
    pub(super) fn log_correction(&self, view: usize, p: DVec2) -> f64 {
        let (corners, weights) = self.problem.lattices[view].corners(p);
        self.state.kappa[view]
            + corners.iter().zip(weights).map(|(c, w)| w * self.state.grid[view][*c]).sum::<f64>()
    }

    /// Levenberg–Marquardt through the [`SCALES`].
    pub(super) fn solve(&mut self, progress: &dyn Progress) -> Result<()> {
        let patterns = SparsityPattern::all(&self.problem);
        for (stretch, steps, min_gain) in SCALES {
            self.minimise(&patterns, stretch, steps, min_gain, progress)?;
        }
        self.focal_log_sigma = focal_sigma(&self.problem, &patterns, &self.state);
        Ok(())
    }

    /// Takes at most `steps` steps with Cauchy scales times `stretch`, until one gains less than
    /// the share `min_gain` of the cost.
    fn minimise(
        &mut self,
        patterns: &[SparsityPattern],
        stretch: f64,
        steps: usize,
        min_gain: f64,
        progress: &dyn Progress,
    ) -> Result<()> {
        let mut lambda = 1e-4;
        let mut before = self.problem.cost(&self.state, stretch);
        for _ in 0..steps {
            progress.check()?;
            let normal = NormalEquations::new(&self.problem, patterns, &self.state, stretch);
            let mut after = before;
            for _ in 0..8 {
                if let Some(d) = Factored::new(&normal, lambda).and_then(|f| f.step(STEP_TOLERANCE)) {
                    let next = self.state.updated(&self.problem, &d);
                    let cost = self.problem.cost(&next, stretch);
                    if cost < before {
                        (self.state, after) = (next, cost);
                        lambda = (lambda * 0.1).max(1e-12);
                        break;
                    }
                }
                lambda *= 10.0;
            }
            if before - after <= min_gain * before {
                break;
            }
            before = after;
        }
        Ok(())
    }

    /// Rejects the matches of pairs whose median reprojection error exceeds `fraction` of the long
    /// side; true if there are any.
    pub(super) fn drop_wrong_pairs(&mut self, fraction: f64) -> bool {
        let (problem, state) = (&mut self.problem, &self.state);
        let limit = fraction * problem.long_side;
        let wrong: Vec<bool> = (problem.pairs.iter())
            .map(|p| problem.median_error(state, p).is_some_and(|e| e > limit))
            .collect();
        for (pair, _) in problem.pairs.iter_mut().zip(&wrong).filter(|p| *p.1) {
            self.dropped.push(PairLinks { views: pair.views, links: std::mem::take(&mut pair.links) });
        }
        wrong.contains(&true)
    }

    /// Robust cost of all matches, with those of rejected pairs.
    pub(super) fn total_match_cost(&self) -> f64 {
        [&self.problem.pairs, &self.dropped]
            .map(|pairs| self.problem.match_cost(pairs, &self.state, 1.0))
            .iter()
            .sum()
    }

    /// Sets the unit of length: the median depth of the matched points becomes 1.
    pub(super) fn normalise(&mut self) {
        let (problem, state) = (&self.problem, &self.state);
        let mut depths: Vec<f64> = (problem.pairs.iter())
            .flat_map(|p| p.links.iter().flat_map(|l| problem.depths(state, p, l)))
            .collect();
        let Some(scale) = median(&mut depths) else { return };
        for p in &mut self.state.poses {
            p.translation /= scale;
        }
        for k in &mut self.state.kappa {
            *k -= scale.ln();
        }
    }
}

/// σ of the first ln f: square root of the diagonal of the inverse normal matrix.
fn focal_sigma(problem: &Problem, patterns: &[SparsityPattern], state: &State) -> f64 {
    let normal = NormalEquations::new(problem, patterns, state, 1.0);
    let focal = problem.focal(0);
    let mut unit = Step {
        camera: DVector::zeros(problem.camera_unknowns()),
        grid: vec![0.0; problem.grid(problem.lattices.len())],
    };
    unit.camera[focal] = 1.0;
    let column = Factored::new(&normal, 0.0).and_then(|f| f.solve(&unit, STEP_TOLERANCE));
    column.map_or(f64::INFINITY, |x| x.camera[focal].max(0.0).sqrt())
}
