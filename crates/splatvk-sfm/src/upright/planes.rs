//! Planar surfaces among the points of a scene, by sequential RANSAC.
use crate::math::Random;
use crate::scene::{Camera, PointCloud};
use glam::DVec3;
use nalgebra::{Matrix3, SymmetricEigen};

/// Planar surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    /// Unit normal of either sign.
    pub normal: DVec3,
    /// Share of the scene's points on the surface.
    pub share: f64,
}

/// Sampled points: a surface with a twentieth of the scene still has 200 of them.
const SAMPLES: usize = 4000;
/// Neighbours that a hypothesis is fitted to.
const NEIGHBOURS: usize = 24;
/// Hypotheses per surface: one with a twentieth of the points is hit 15 times.
const TRIALS: usize = 300;
/// Largest distance of an inlier, share of its depth: twice the median error of stereo on
/// `breakfast` (docs/internals/results.md).
const THICKNESS: f64 = 0.006;
/// Least share of the points on a surface.
const MIN_SHARE: f64 = 0.05;
/// Most surfaces.
const MAX_SURFACES: usize = 5;

/// A point and its inlier distance.
type Sample = (DVec3, f64);

/// Surfaces by falling number of points.
pub(super) fn surfaces(points: &PointCloud, cameras: &[Camera]) -> Vec<Surface> {
    let step = points.len().div_ceil(SAMPLES).max(1);
    let sample = |k: usize| {
        let p = glam::Vec3::from_array(points.positions[k]).as_dvec3();
        let depths = cameras.iter().map(|c| c.project(p).1).filter(|z| *z > 0.0);
        (p, THICKNESS * depths.fold(f64::INFINITY, f64::min))
    };
    let mut left: Vec<Sample> =
        (0..points.len()).step_by(step).map(sample).filter(|s| s.1.is_finite()).collect();
    let all = left.len();
    let mut random = Random::new(0);
    let mut found = Vec::new();
    while found.len() < MAX_SURFACES && left.len() > NEIGHBOURS {
        let tried = (0..TRIALS).map(|_| fit_plane(&left, &nearest(&left, random.below(left.len()))));
        let inlier_count = |plane: &(DVec3, DVec3)| left.iter().filter(|s| lies_on(s, plane)).count();
        let Some(best) = tried.max_by_key(inlier_count) else { break };
        // Two fits to its own inliers: the hypothesis is that of a small patch.
        let best = (0..2).fold(best, |best, _| {
            fit_plane(&left, &(0..left.len()).filter(|k| lies_on(&left[*k], &best)).collect::<Vec<_>>())
        });
        let share = inlier_count(&best) as f64 / all as f64;
        if share < MIN_SHARE {
            break;
        }
        found.push(Surface { normal: best.1, share });
        left.retain(|s| !lies_on(s, &best));
    }
    found
}

fn lies_on((p, thickness): &Sample, (middle, normal): &(DVec3, DVec3)) -> bool {
    (*p - *middle).dot(*normal).abs() < *thickness
}

/// Nearest neighbours of a point.
fn nearest(points: &[Sample], of: usize) -> Vec<usize> {
    let squared_distance = |k: &usize| points[*k].0.distance_squared(points[of].0);
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.select_nth_unstable_by(NEIGHBOURS, |a, b| squared_distance(a).total_cmp(&squared_distance(b)));
    order.truncate(NEIGHBOURS);
    order
}

/// Least-squares plane: a point on it and its normal.
fn fit_plane(points: &[Sample], of: &[usize]) -> (DVec3, DVec3) {
    let n = of.len().max(1) as f64;
    let middle = of.iter().map(|k| points[*k].0).sum::<DVec3>() / n;
    let mut moments = Matrix3::zeros();
    for k in of {
        let d = crate::numeric::vec_na(points[*k].0 - middle);
        moments += d * d.transpose();
    }
    let eigen = SymmetricEigen::new(moments);
    let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    (middle, DVec3::new(normal[0], normal[1], normal[2]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    #[test]
    fn surfaces_finds_planes_among_clutter() {
        let mut random = Random::new(3);
        let mut cloud = PointCloud::default();
        for _ in 0..9000 {
            let (a, b) = (random.uniform() - 0.5, random.uniform() - 0.5);
            let p = match random.below(9) {
                0..=3 => DVec3::new(a, 0.3, 1.0 + b),
                4..=6 => DVec3::new(a, b, 1.6),
                _ => DVec3::new(a, b, 1.0 + 0.5 * random.uniform()),
            };
            cloud.positions.push((p + 0.001 * DVec3::splat(random.normal())).as_vec3().to_array());
        }
        let camera = Camera {
            name: String::new(),
            width: 64,
            height: 48,
            fx: 60.0,
            fy: 60.0,
            cx: 32.0,
            cy: 24.0,
            pose: Pose::IDENTITY,
        };
        let found = surfaces(&cloud, &[camera]);
        assert!((found[0].share - 0.45).abs() < 0.05 && found[0].normal.y.abs() > 0.9999, "{found:?}");
        assert!((found[1].share - 0.34).abs() < 0.05 && found[1].normal.z.abs() > 0.9999, "{found:?}");
        assert!(found.iter().skip(2).all(|s| s.share < 0.1), "{found:?}");
    }
}
