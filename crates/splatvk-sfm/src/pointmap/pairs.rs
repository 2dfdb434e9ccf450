//! Step D: relative pose and scale of each pair, estimated in both directions.
use super::canonical::{Canonical, Focals, median_confidence};
use super::matches::PixelMatch;
use crate::math::median;
use crate::numeric::{cauchy_weight, from_na, rotation_angle, to_na};
use crate::resect::resect;
use crate::scene::{ModelView, PairPointmaps, Pointmap, Pose};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Matrix3, Vector3};

/// Relative pose of a pair that passed the checks: an edge of the view graph.
#[derive(Clone, Debug)]
pub(super) struct Edge {
    pub(super) first: usize,
    pub(super) second: usize,
    /// First camera → second camera; translation in the canonical unit of the first view.
    pub(super) pose: Pose,
    /// κ_second − κ_first = ln(canonical unit of the second view / that of the first); global depth
    /// = canonical depth · e^κ.
    pub(super) log_scale: f64,
    pub(super) score: f64,
}

/// Similarity transform `y = scale · rotation · x + translation`.
pub(super) struct Umeyama {
    pub(super) rotation: DMat3,
    pub(super) scale: f64,
    pub(super) translation: DVec3,
}

/// Weighted least-squares similarity between point sets (Umeyama 1991); `weights` ≥ 0.
pub(super) fn umeyama(x: &[DVec3], y: &[DVec3], weights: &[f64]) -> Option<Umeyama> {
    let total: f64 = weights.iter().sum();
    if total <= 0.0 || x.len() < 3 {
        return None;
    }
    let weighted_mean = |v: &[DVec3]| v.iter().zip(weights).map(|(p, w)| *p * *w).sum::<DVec3>() / total;
    let (mx, my) = (weighted_mean(x), weighted_mean(y));
    let (mut h, mut size) = (DMat3::ZERO, 0.0);
    for ((p, q), w) in x.iter().zip(y).zip(weights) {
        let (a, b) = (*p - mx, *q - my);
        h += DMat3::from_cols(b * a.x, b * a.y, b * a.z) * *w;
        size += w * a.length_squared();
    }
    let svd = to_na(&h).svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    let sign = (u * vt).determinant().signum();
    let d = Vector3::new(1.0, 1.0, sign);
    let rotation = from_na(&(u * Matrix3::from_diagonal(&d) * vt));
    let scale = svd.singular_values.dot(&d) / size;
    (scale.is_finite() && scale > 0.0).then_some(Umeyama {
        rotation,
        scale,
        translation: my - rotation * mx * scale,
    })
}

/// One direction of a pair: pixels of view `seen` as points in the camera of view `frame`.
struct Direction<'a> {
    /// Points of view `seen` in the camera of `frame`.
    cross: &'a Pointmap,
    /// Points of view `seen` in its own camera.
    own: &'a Pointmap,
    /// Points of view `frame` in its own camera, at the scale of `cross`.
    base: &'a Pointmap,
    frame: usize,
    seen: usize,
}

/// Relative pose frame → seen, with the share of inliers.
struct Relative {
    pose: Pose,
    log_scale: f64,
    inliers: f64,
}

/// Points used per direction.
const SAMPLES: usize = 4096;

impl Direction<'_> {
    fn solve(
        &self,
        views: &[ModelView],
        canonical: &[Canonical],
        focals: &Focals,
        seed: u64,
    ) -> Option<Relative> {
        let view = &views[self.seen];
        let chosen = confident_pixels(self.cross, self.own);
        let world: Vec<DVec3> = chosen.iter().map(|&k| self.cross.point(k)).collect();
        let pixels: Vec<DVec2> = chosen
            .iter()
            .map(|&k| {
                DVec2::new((k % view.width) as f64 + 0.5, (k / view.width) as f64 + 0.5) - view.centre()
            })
            .collect();
        let threshold = (0.005 * view.width as f64).max(2.0);
        let found = resect(&world, &pixels, focals.of(self.seen), threshold, 512, seed)?;
        let rotation = self.procrustes(&chosen, &world)?;
        let inliers = found.inliers.len() as f64 / chosen.len() as f64;
        let difference = rotation_angle(&(rotation * found.pose.rotation.transpose())).to_degrees();
        // Few inliers, or PnP contradicts Procrustes (docs/internals/method.md#pair-poses).
        if inliers < 0.15 || difference > 15.0 {
            return None;
        }
        let to_canonical = median_ratio(&canonical[self.frame], self.base)?;
        let mut ratios: Vec<f64> = chosen
            .iter()
            .zip(&world)
            .map(|(&k, x)| found.pose.transform(*x).z * to_canonical / canonical[self.seen].points[k].z)
            .filter(|r| r.is_finite() && *r > 0.0)
            .collect();
        let mut pose = found.pose;
        pose.translation *= to_canonical;
        Some(Relative { pose, log_scale: median(&mut ratios)?.ln(), inliers })
    }

    /// Rotation frame → seen by Procrustes alignment, three rounds with Cauchy weights.
    fn procrustes(&self, chosen: &[usize], world: &[DVec3]) -> Option<DMat3> {
        let own: Vec<DVec3> = chosen.iter().map(|&k| self.own.point(k)).collect();
        let base: Vec<f64> = chosen
            .iter()
            .map(|&k| (self.own.confidence[k] as f64 * self.cross.confidence[k] as f64).sqrt())
            .collect();
        let mut weights = base.clone();
        let mut fit = umeyama(world, &own, &weights)?;
        for _ in 0..3 {
            let r2: Vec<f64> = world
                .iter()
                .zip(&own)
                .map(|(x, y)| (fit.rotation * *x * fit.scale + fit.translation - *y).length_squared())
                .collect();
            let c = median(&mut r2.clone())?.sqrt().max(1e-12);
            weights = base.iter().zip(&r2).map(|(b, r)| b * cauchy_weight(*r, c)).collect();
            fit = umeyama(world, &own, &weights)?;
        }
        Some(fit.rotation)
    }
}

/// Up to [`SAMPLES`] pixels, evenly thinned from the more confident half.
fn confident_pixels(cross: &Pointmap, own: &Pointmap) -> Vec<usize> {
    let joint_confidence = |k: usize| (cross.confidence[k] * own.confidence[k]) as f64;
    let usable: Vec<usize> =
        (0..cross.points.len()).filter(|&k| cross.point(k).is_finite() && own.point(k).is_finite()).collect();
    let Some(least) = median(&mut usable.iter().map(|&k| joint_confidence(k)).collect::<Vec<_>>()) else {
        return Vec::new();
    };
    let good: Vec<usize> = usable.into_iter().filter(|&k| joint_confidence(k) >= least).collect();
    let step = (good.len() / SAMPLES).max(1);
    good.into_iter().step_by(step).take(SAMPLES).collect()
}

/// Median ratio of canonical z to the z of `map`, over the more confident half.
fn median_ratio(c: &Canonical, map: &Pointmap) -> Option<f64> {
    let least = median_confidence(map)?;
    let mut ratios: Vec<f64> = (0..map.points.len())
        .filter(|&k| map.confidence[k] as f64 >= least && map.points[k][2] > 0.0 && c.points[k].z > 0.0)
        .map(|k| c.points[k].z / map.points[k][2] as f64)
        .collect();
    median(&mut ratios)
}

/// Relative pose of a pair from the direction with more inliers; `None` if both are rejected.
pub(super) fn edge(
    views: &[ModelView],
    pair: &PairPointmaps,
    matches: &[PixelMatch],
    canonical: &[Canonical],
    focals: &Focals,
    seed: u64,
) -> Option<Edge> {
    let (first, second) = (pair.first, pair.second);
    let forward = Direction { cross: &pair.x21, own: &pair.x22, base: &pair.x11, frame: first, seen: second }
        .solve(views, canonical, focals, seed);
    let backward =
        Direction { cross: &pair.x12, own: &pair.x11, base: &pair.x22, frame: second, seen: first }
            .solve(views, canonical, focals, seed)
            .map(|b| {
                let mut pose = b.pose.inverse();
                // Unit of the second view → unit of the first.
                pose.translation *= (-b.log_scale).exp();
                Relative { pose, log_scale: -b.log_scale, inliers: b.inliers }
            });
    let best = match (forward, backward) {
        (Some(f), Some(b)) => Some(if b.inliers > f.inliers { b } else { f }),
        (f, b) => f.or(b),
    }?;
    let mean = matches.iter().map(|m| m.weight).sum::<f64>() / matches.len().max(1) as f64;
    Some(Edge {
        first,
        second,
        pose: best.pose,
        log_scale: best.log_scale,
        score: best.inliers * mean.sqrt() * (matches.len() as f64).sqrt(),
    })
}
