//! Derivatives against finite differences, and the blocked equations against a dense matrix.
use super::super::adjust::Adjustment;
use super::super::normal::{NormalEquations, SparsityPattern, camera_indices};
use super::super::problem::{GAUGE_WEIGHT, Problem, STEP_WEIGHT, State, Step};
use super::super::solver::Factored;
use super::*;
use crate::numeric::cauchy_weight;
use nalgebra::{DMatrix, DVector};

/// Adjustment at its start, with non-zero corrections.
fn unsolved(views: usize) -> Adjustment {
    let (mut case, _) = case();
    case.views.truncate(views);
    let (pairs, matches) = case.input(FAULTS);
    let canonical = canonical::canonical_maps(&case.views, &pairs);
    let focals = canonical::focals(&case.views, &canonical);
    let edges: Vec<Edge> = pairs
        .iter()
        .zip(&matches)
        .filter_map(|(p, m)| pairs::edge(&case.views, p, &m.matches, &canonical, &focals, 0))
        .collect();
    assert_eq!(edges.len(), pairs.len());
    let start = tree::register(views, &edges).unwrap();
    let mut a =
        Adjustment::new(Problem::new(&case.views, &canonical, &focals, &pairs, &matches), &start, &focals);
    let mut rng = Random::new(31);
    a.state.grid.iter_mut().flatten().for_each(|v| *v = 0.01 * rng.normal());
    a.state.log_focals.iter_mut().for_each(|f| *f += 0.01);
    a
}

/// Residuals of a match in one direction, with their derivatives.
struct JacobianRow {
    pair: usize,
    link: usize,
    side: usize,
    weight: f64,
    r: [f64; 3],
    /// (index among all unknowns, derivatives); an unknown that both views share stands twice.
    entries: Vec<(usize, [f64; 3])>,
}

/// Rows of every match in both directions.
fn jacobian_rows(p: &Problem, s: &State) -> Vec<JacobianRow> {
    let mut out = Vec::new();
    for (k, pair) in p.pairs.iter().enumerate() {
        let indices = camera_indices(p, pair.views);
        for (l, link) in pair.links.iter().enumerate() {
            let d = p.depths(s, pair, link);
            for side in 0..2 {
                let ends = [&link.ends[side], &link.ends[1 - side]];
                let row = p.direction(s, pair, side).row(ends[0], ends[1], [d[side], d[1 - side]]).unwrap();
                let mut entries = Vec::new();
                for (slot, index) in indices.iter().enumerate() {
                    entries.extend(index.map(|i| (i, row.camera.map(|r| r[slot]))));
                }
                for (end, by) in [row.by_point_depth, [0.0, 0.0, row.by_pixel_depth]].into_iter().enumerate()
                {
                    let view = pair.views[if end == 0 { side } else { 1 - side }];
                    for (corner, weight) in ends[end].corners.iter().zip(ends[end].weights) {
                        entries.push((p.camera_unknowns() + p.grid(view) + corner, by.map(|v| v * weight)));
                    }
                }
                out.push(JacobianRow { pair: k, link: l, side, weight: link.weight, r: row.r, entries });
            }
        }
    }
    out
}

fn flattened(step: &Step) -> DVector<f64> {
    DVector::from_iterator(step.camera.len() + step.grid.len(), step.camera.iter().chain(&step.grid).copied())
}

fn unflattened(p: &Problem, all: &DVector<f64>) -> Step {
    let n = p.camera_unknowns();
    Step { camera: all.rows(0, n).into_owned(), grid: all.iter().skip(n).copied().collect() }
}

#[test]
fn row_derivatives_equal_finite_differences() {
    let a = unsolved(4);
    let (p, s) = (&a.problem, &a.state);
    let n = p.camera_unknowns() + p.grid(4);
    let all = jacobian_rows(p, s);
    for line in all.iter().step_by(all.len() / 40) {
        let residual = |s: &State| {
            let (pair, side) = (&p.pairs[line.pair], line.side);
            let ends = pair.links[line.link].ends;
            let d = p.depths(s, pair, &pair.links[line.link]);
            let depths = [d[side], d[1 - side]];
            p.direction(s, pair, side).residual(&ends[side], &ends[1 - side], depths).unwrap()
        };
        let mut sums = std::collections::BTreeMap::<usize, [f64; 3]>::new();
        for (i, d) in &line.entries {
            let sum = sums.entry(*i).or_default();
            (0..3).for_each(|k| sum[k] += d[k]);
        }
        for (i, d) in sums {
            let moved = |h: f64| {
                let mut step = DVector::zeros(n);
                step[i] = -h;
                residual(&s.updated(p, &unflattened(p, &step)))
            };
            let (up, down) = (moved(1e-6), moved(-1e-6));
            for c in 0..3 {
                let numeric = (up[c] - down[c]) / 2e-6;
                assert!((numeric - d[c]).abs() < 1e-6 * (d[c].abs() + 1.0), "{i} {c}: {numeric} {}", d[c]);
            }
        }
    }
}

/// Dense normal matrix and gradient, entry by entry from the rows and priors.
fn dense(p: &Problem, s: &State, c: f64) -> (DMatrix<f64>, DVector<f64>) {
    let grids = p.camera_unknowns();
    let n = grids + p.grid(p.lattices.len());
    let (mut h, mut g) = (DMatrix::zeros(n, n), DVector::zeros(n));
    let mut add = |entries: &[(usize, f64)], r: f64, w: f64| {
        for (i, d) in entries {
            g[*i] += w * d * r;
            entries.iter().for_each(|(j, e)| h[(*i, *j)] += w * d * e);
        }
    };
    for JacobianRow { weight, r, entries, .. } in jacobian_rows(p, s) {
        let wp = weight * cauchy_weight(r[0] * r[0] + r[1] * r[1], c);
        let w = [wp, wp, weight * cauchy_weight(r[2] * r[2], c)];
        for k in 0..3 {
            let line: Vec<(usize, f64)> = entries.iter().map(|(i, d)| (*i, d[k])).collect();
            add(&line, r[k], w[k]);
        }
    }
    for (group, (mean, sigma)) in p.focal_priors.iter().enumerate() {
        add(&[(p.focal(group), 1.0)], s.log_focals[group] - mean, sigma.powi(-2));
    }
    let all: Vec<(usize, f64)> = (0..p.lattices.len()).map(|v| (p.kappa(v), 1.0)).collect();
    add(&all, p.gauge(s), GAUGE_WEIGHT);
    for (v, l) in p.lattices.iter().enumerate() {
        let unknown = |i: usize| grids + p.grid(v) + i;
        for y in 0..l.rows {
            for x in 0..l.columns {
                let i = y * l.columns + x;
                add(&[(unknown(i), 1.0)], s.grid[v][i], p.size_weights[v][i]);
                for j in [(x + 1 < l.columns).then_some(i + 1), (y + 1 < l.rows).then_some(i + l.columns)] {
                    let Some(j) = j else { continue };
                    add(&[(unknown(i), 1.0), (unknown(j), -1.0)], s.grid[v][i] - s.grid[v][j], STEP_WEIGHT);
                }
            }
        }
    }
    (h, g)
}

#[test]
fn blocked_solution_equals_dense_solution() {
    let a = unsolved(3);
    let (p, s) = (&a.problem, &a.state);
    let patterns = SparsityPattern::all(p);
    let normal = NormalEquations::new(p, &patterns, s, 2.0);
    let (h, g) = dense(p, s, 2.0);
    for damping in [0.0, 1e-2] {
        let mut damped = h.clone();
        (0..g.len()).for_each(|i| damped[(i, i)] *= 1.0 + damping);
        let want = damped.cholesky().unwrap().solve(&g);
        let found = flattened(&Factored::new(&normal, damping).unwrap().step(1e-12).unwrap());
        // A condition number of 10⁸: 10⁻¹⁶ of f64 leaves 10⁻⁸.
        assert!((&found - &want).norm() < 1e-7 * want.norm(), "{}", (&found - &want).norm() / want.norm());
    }
}

#[test]
fn focal_sigma_equals_dense_inverse() {
    let (mut case, _) = case();
    case.views.truncate(2);
    let (pairs, matches) = case.input(FAULTS);
    let a = solved(&case.views, &pairs, &matches);
    let (h, _) = dense(&a.problem, &a.state, 1.0);
    let i = a.problem.focal(0);
    let want = h.try_inverse().unwrap()[(i, i)].sqrt();
    assert!((a.focal_log_sigma / want - 1.0).abs() < 1e-6, "{} {want}", a.focal_log_sigma);
}

fn solved(views: &[ModelView], pairs: &[PairPointmaps], matches: &[PairMatches]) -> Adjustment {
    let canonical = canonical::canonical_maps(views, pairs);
    let focals = canonical::focals(views, &canonical);
    let edges: Vec<Edge> = pairs
        .iter()
        .zip(matches)
        .filter_map(|(p, m)| pairs::edge(views, p, &m.matches, &canonical, &focals, 0))
        .collect();
    let start = tree::register(views.len(), &edges).unwrap();
    let mut a = Adjustment::new(Problem::new(views, &canonical, &focals, pairs, matches), &start, &focals);
    a.solve(&Silent).unwrap();
    a
}
