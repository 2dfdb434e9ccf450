//! Points of a bundle adjustment at their own optimum. With the cameras held, every point is a
//! problem of three unknowns: solving those after each step of the cameras leaves a problem in the
//! cameras alone (variable projection, Golub & Pereyra 1973; embedded point iterations, Jeong et
//! al. 2010), which needs fewer steps.
use super::Problem;
use super::normal::{Curvature, whitening};
use super::problem::{MIN_LEN, Observation};
use crate::numeric::cauchy;
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Newton steps of a point after a step of the cameras.
const STEPS: usize = 2;

/// Cost of a point with its derivatives.
struct PointCost {
    cost: f64,
    g: DVec3,
    h: DMat3,
}

impl Problem {
    /// Moves every point towards its optimum, from `self.points` or from `before`, whichever costs
    /// less, and returns the whole cost.
    pub(super) fn relax_points(&mut self, before: &[DVec3], c: f64, curvature: Curvature) -> f64 {
        let relaxed = {
            let problem = &*self;
            let of_points: Vec<&[Observation]> =
                problem.observations.chunk_by(|a, b| a.point == b.point).collect();
            let relax = |seen: &[Observation]| problem.relaxed(seen, before, c, curvature);
            of_points.into_par_iter().with_min_len(MIN_LEN / 4).map(relax).collect::<Vec<_>>()
        };
        let mut sum = self.prior_cost();
        for (point, x, cost) in relaxed {
            self.points[point] = x;
            sum += cost;
        }
        sum
    }

    fn relaxed(
        &self,
        seen: &[Observation],
        before: &[DVec3],
        c: f64,
        curvature: Curvature,
    ) -> (usize, DVec3, f64) {
        let point = seen[0].point;
        let mut x = self.points[point];
        let mut at = self.point_cost(seen, x, c, curvature);
        if before[point] != x {
            let old = self.point_cost(seen, before[point], c, curvature);
            if old.cost < at.cost {
                (x, at) = (before[point], old);
            }
        }
        for _ in 0..STEPS {
            let step = at.h.inverse() * at.g;
            let there = self.point_cost(seen, x - step, c, curvature);
            if there.cost.partial_cmp(&at.cost) != Some(std::cmp::Ordering::Less) {
                break;
            }
            (x, at) = (x - step, there);
        }
        (point, x, at.cost)
    }

    /// Cost of the observations of a point at `x`.
    fn point_cost(&self, seen: &[Observation], x: DVec3, c: f64, curvature: Curvature) -> PointCost {
        let mut out = PointCost { cost: 0.0, g: DVec3::ZERO, h: DMat3::from_diagonal(DVec3::splat(1e-12)) };
        for o in seen {
            let (t, p) = self.project_point(o, x);
            if t.z <= 1e-9 {
                out.cost += cauchy(1e12, c);
                continue;
            }
            let r = (p - o.pixel) / o.sigma;
            out.cost += cauchy(r.length_squared(), c);
            let camera = self.camera_ids[o.view];
            let intrinsics = &self.intrinsics[camera];
            let f = intrinsics.focal * self.zoom[o.view] / (o.sigma * t.z);
            let at = DVec2::new(t.x, t.y) / t.z;
            let jacobian = intrinsics.lens.jacobian(at);
            let to_world = self.poses[o.view].rotation.transpose();
            let rows = [0, 1].map(|axis| {
                let by = jacobian.row(axis) * f;
                to_world * DVec3::new(by.x, by.y, -by.dot(at))
            });
            let white = whitening(r, c, curvature);
            let (u, v) = white.rows(rows[0], rows[1]);
            let r = white.residual(r);
            out.g += u * r.x + v * r.y;
            out.h += DMat3::from_cols(u * u.x + v * v.x, u * u.y + v * v.y, u * u.z + v * v.z);
        }
        out
    }
}
