//! Step E: poses along the maximum spanning tree of the pairs, averaged over all pairs.
use super::pairs::Edge;
use crate::numeric::rotation_log;
use crate::scene::Pose;
use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, DVector};

/// Poses (camera 0 = identity) and log scales κ (view 0 = 0): global depth = canonical depth · e^κ.
#[derive(Clone, Debug)]
pub(super) struct Registration {
    pub(super) poses: Vec<Pose>,
    pub(super) kappa: Vec<f64>,
}

/// Registers all views; `Err` lists the views that no chain of pairs connects with view 0.
pub(super) fn register(n: usize, edges: &[Edge]) -> Result<Registration, Vec<usize>> {
    let mut poses: Vec<Option<Pose>> = vec![None; n];
    let mut kappa: Vec<f64> = vec![0.0; n];
    poses[0] = Some(Pose::IDENTITY);
    loop {
        // Prim's algorithm: the best edge between a registered and an unregistered view.
        let mut best: Option<&Edge> = None;
        for e in edges {
            let crossing = poses[e.first].is_some() != poses[e.second].is_some();
            if crossing && best.is_none_or(|b| e.score > b.score) {
                best = Some(e);
            }
        }
        let Some(e) = best else { break };
        match (poses[e.first], poses[e.second]) {
            (Some(first), _) => {
                let mut relative = e.pose;
                relative.translation *= kappa[e.first].exp();
                kappa[e.second] = kappa[e.first] + e.log_scale;
                poses[e.second] = Some(relative.compose(&first));
            }
            (None, Some(second)) => {
                kappa[e.first] = kappa[e.second] - e.log_scale;
                let mut relative = e.pose;
                relative.translation *= kappa[e.first].exp();
                poses[e.first] = Some(relative.inverse().compose(&second));
            }
            (None, None) => break,
        }
    }
    let unregistered: Vec<usize> = (0..n).filter(|v| poses[*v].is_none()).collect();
    if !unregistered.is_empty() {
        return Err(unregistered);
    }
    let mut out = Registration { poses: poses.into_iter().flatten().collect(), kappa };
    average_rotations(&mut out, edges);
    average_scales(&mut out, edges);
    average_translations(&mut out, edges);
    Ok(out)
}

/// Largest component of the view graph, ascending; of equal ones the one with the lowest view.
pub(super) fn largest_component(views: usize, pairs: &[[usize; 2]]) -> Vec<usize> {
    let mut label: Vec<usize> = (0..views).collect();
    for [a, b] in pairs {
        let (kept, replaced) = (label[*a].min(label[*b]), label[*a].max(label[*b]));
        label.iter_mut().filter(|l| **l == replaced).for_each(|l| *l = kept);
    }
    let members = |l: usize| (0..views).filter(|v| label[*v] == l).collect::<Vec<_>>();
    (0..views).map(members).rev().max_by_key(Vec::len).unwrap_or_default()
}

/// L1 weight of an edge with residual length `r`; the floor keeps the weight of exact edges finite.
fn l1_weight(weight: f64, r: f64) -> f64 {
    weight / r.max(1e-4)
}

/// Weighted linear equation: (unknowns with coefficients, right-hand side, weight).
type Equation = (Vec<(usize, f64)>, f64, f64);

/// Weighted least-squares solution of linear equations in `n` unknowns.
fn least_squares(n: usize, rows: &[Equation]) -> Option<DVector<f64>> {
    let (mut h, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
    for (row, b, w) in rows {
        for &(i, a) in row {
            g[i] += w * a * b;
            for &(j, c) in row {
                h[(i, j)] += w * a * c;
            }
        }
    }
    // Keeps unknowns without equations at zero.
    for i in 0..n {
        h[(i, i)] += 1e-12;
    }
    Some(h.cholesky()?.solve(&g))
}

/// Rotation averaging by iteratively re-weighted least squares on so(3).
fn average_rotations(p: &mut Registration, edges: &[Edge]) {
    for _ in 0..20 {
        let mut rows = Vec::new();
        for e in edges {
            let (a, b) = (&p.poses[e.first].rotation, &p.poses[e.second].rotation);
            // exp(ω_b) R_b ≈ R_ba exp(ω_a) R_a, so R_ba ω_a − ω_b = log(R_b R_aᵀ R_baᵀ).
            let residual = rotation_log(&(*b * a.transpose() * e.pose.rotation.transpose()));
            let w = l1_weight(e.score, residual.length());
            for k in 0..3 {
                let mut row = Vec::new();
                if e.first > 0 {
                    row.extend((0..3).map(|c| (3 * (e.first - 1) + c, e.pose.rotation.col(c)[k])));
                }
                if e.second > 0 {
                    row.push((3 * (e.second - 1) + k, -1.0));
                }
                rows.push((row, residual[k], w));
            }
        }
        let Some(x) = least_squares(3 * (p.poses.len() - 1), &rows) else { return };
        for v in 1..p.poses.len() {
            let w = DVec3::new(x[3 * v - 3], x[3 * v - 2], x[3 * v - 1]);
            p.poses[v].rotation = Pose::exp(DVec3::ZERO, w).rotation * p.poses[v].rotation;
        }
        if x.amax() < 1e-12 {
            break;
        }
    }
}

fn average_scales(p: &mut Registration, edges: &[Edge]) {
    for _ in 0..20 {
        let rows: Vec<_> = edges
            .iter()
            .map(|e| {
                let r = p.kappa[e.second] - p.kappa[e.first] - e.log_scale;
                let mut row = Vec::new();
                if e.first > 0 {
                    row.push((e.first - 1, -1.0));
                }
                if e.second > 0 {
                    row.push((e.second - 1, 1.0));
                }
                (row, -r, l1_weight(e.score, r.abs()))
            })
            .collect();
        let Some(x) = least_squares(p.kappa.len() - 1, &rows) else { return };
        for v in 1..p.kappa.len() {
            p.kappa[v] += x[v - 1];
        }
    }
}

/// With known rotations and scales, τ_b = R_ba τ_a + e^{κ_a} t_ba is linear.
fn average_translations(p: &mut Registration, edges: &[Edge]) {
    for _ in 0..20 {
        let mut rows = Vec::new();
        for e in edges {
            let relative: DMat3 = p.poses[e.second].rotation * p.poses[e.first].rotation.transpose();
            let offset = e.pose.translation * p.kappa[e.first].exp();
            let residual = p.poses[e.second].translation - relative * p.poses[e.first].translation - offset;
            let w = l1_weight(e.score, residual.length() / offset.length().max(1e-9));
            for k in 0..3 {
                let mut row = Vec::new();
                if e.first > 0 {
                    row.extend((0..3).map(|c| (3 * (e.first - 1) + c, -relative.col(c)[k])));
                }
                if e.second > 0 {
                    row.push((3 * (e.second - 1) + k, 1.0));
                }
                rows.push((row, -residual[k], w));
            }
        }
        let Some(x) = least_squares(3 * (p.poses.len() - 1), &rows) else { return };
        for v in 1..p.poses.len() {
            p.poses[v].translation += DVec3::new(x[3 * v - 3], x[3 * v - 2], x[3 * v - 1]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;
    use crate::numeric::rotation_angle;

    #[test]
    fn register_corrects_a_wrong_edge() {
        let mut rng = Random::new(4);
        let truth: Vec<Pose> = (0..5)
            .map(|k| {
                let k = k as f64;
                Pose::exp(DVec3::new(k, 0.2 * k * k, 0.1), DVec3::new(0.1 * k, -0.3 * k, 0.2 * k))
            })
            .collect();
        let kappa: Vec<f64> = (0..5).map(|_| rng.normal() * 0.5).collect();
        let mut edges = Vec::new();
        for i in 0..5 {
            for j in i + 1..5 {
                let mut pose = truth[j].compose(&truth[i].inverse());
                pose.translation *= (-(kappa[i] - kappa[0])).exp();
                edges.push(Edge { first: i, second: j, pose, log_scale: kappa[j] - kappa[i], score: 1.0 });
            }
        }
        // This edge is not in the tree, only in the average.
        edges[6].pose.rotation = Pose::exp(DVec3::ZERO, DVec3::Y * 0.2).rotation * edges[6].pose.rotation;
        edges[6].score = 0.3;
        let p = register(5, &edges).unwrap();
        let back = truth[0].inverse();
        for v in 0..5 {
            let want = truth[v].compose(&back);
            assert!(rotation_angle(&(p.poses[v].rotation * want.rotation.transpose())) < 1e-3, "{v}");
            assert!((p.poses[v].translation - want.translation).length() < 1e-2, "{v}");
            assert!((p.kappa[v] - (kappa[v] - kappa[0])).abs() < 1e-9);
        }
        assert_eq!(register(5, &edges[..1]).unwrap_err(), [2, 3, 4]);
    }

    #[test]
    fn largest_component_ignores_pair_order() {
        assert_eq!(largest_component(6, &[[5, 2], [0, 1], [4, 5], [4, 2]]), [2, 4, 5]);
        assert_eq!(largest_component(4, &[[3, 2], [1, 0]]), [0, 1]);
        assert_eq!(largest_component(3, &[]), [0]);
        assert_eq!(largest_component(3, &[[2, 1], [0, 2]]), [0, 1, 2]);
    }
}
