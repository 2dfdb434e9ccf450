//! Two-view geometry with an uncertain focal length: RANSAC over five points, local optimisation of
//! rotation, translation and focal length together, and detection of views without parallax.
use super::minimal::{FivePoint, decompose_essential, essential, triangulate_two};
use super::numeric::minimise_small;
use crate::math::{Random, median};
use crate::scene::Pose;
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Relative pose of two views with an estimated focal length. Pixels are centred and divided by the
/// prior focal length of their photo; `stretch` is the estimated focal length as a multiple of the
/// prior.
#[derive(Clone, Debug)]
pub(crate) struct TwoView {
    /// First camera → second camera, |translation| = 1.
    pub(crate) pose: Pose,
    pub(crate) stretch: f64,
    pub(crate) inliers: Vec<usize>,
    /// Median angle between the two rays of a point, degrees.
    pub(crate) parallax: f64,
    /// Median residual of the best rotation without translation, prior-focal units.
    pub(crate) rotation_residual: f64,
}

/// Squared Sampson error of `yᵀ F x`.
pub(crate) fn sampson(f: &DMat3, x: DVec2, y: DVec2) -> f64 {
    signed_sampson(f, x, y).powi(2)
}

/// First-order signed distance to the epipolar constraint.
fn signed_sampson(f: &DMat3, x: DVec2, y: DVec2) -> f64 {
    let (x, y) = (x.extend(1.0), y.extend(1.0));
    let fx = *f * x;
    let ft = f.transpose() * y;
    let e = y.dot(fx);
    e / (fx.x * fx.x + fx.y * fx.y + ft.x * ft.x + ft.y * ft.y).max(1e-300).sqrt()
}

/// F between centred pixels of two cameras with known focal lengths; `pose` maps the first camera
/// to the second.
pub(crate) fn fundamental(pose: &Pose, f1: f64, f2: f64) -> DMat3 {
    let inverse = |f: f64| DMat3::from_diagonal(DVec3::new(1.0 / f, 1.0 / f, 1.0));
    inverse(f2) * essential(pose) * inverse(f1)
}

/// F in prior-focal units from E in true units.
fn stretched(e: &DMat3, m: f64) -> DMat3 {
    let k = DMat3::from_diagonal(DVec3::new(1.0 / m, 1.0 / m, 1.0));
    k * *e * k
}

fn ray(p: DVec2, m: f64) -> DVec3 {
    (p / m).extend(1.0)
}

/// Matches in prior-focal units, and the squared inlier threshold.
struct CentredMatches<'a> {
    x: &'a [DVec2],
    y: &'a [DVec2],
    t2: f64,
}

impl CentredMatches<'_> {
    /// Truncated squared error relative to the threshold, summed; stops early above `limit`.
    fn score(&self, f: &DMat3, limit: f64) -> f64 {
        let mut sum = 0.0;
        for (k, (x, y)) in self.x.iter().zip(self.y).enumerate() {
            sum += (sampson(f, *x, *y) / self.t2).min(1.0);
            if k % 32 == 31 && sum > limit {
                return f64::INFINITY;
            }
        }
        sum
    }

    /// Refines (R, t, ln stretch) on the near-inliers with a Cauchy loss and the focal prior.
    fn polish(&self, pose: &Pose, m: f64, prior_sigma: f64, steps: usize) -> (Pose, f64) {
        let f = stretched(&essential(pose), m);
        let near: Vec<usize> =
            (0..self.x.len()).filter(|&k| sampson(&f, self.x[k], self.y[k]) < 4.0 * self.t2).collect();
        if near.len() < 8 {
            return (*pose, m);
        }
        // Noise is about a third of the threshold; Cauchy at that scale.
        let c2 = self.t2 / 9.0;
        let updated = |v: &[f64; 7]| {
            let turn = Pose::exp(DVec3::ZERO, DVec3::new(v[0], v[1], v[2]));
            let t = pose.translation + DVec3::new(v[3], v[4], v[5]);
            Pose { rotation: turn.rotation * pose.rotation, translation: t.normalize() }
        };
        let (v, _) = minimise_small([0.0; 7], [1e-7; 7], steps, |v, out| {
            let f = stretched(&essential(&updated(v)), m * v[6].clamp(-1.0, 1.0).exp());
            out.clear();
            out.extend(near.iter().map(|&k| {
                let r = signed_sampson(&f, self.x[k], self.y[k]);
                // Signed root of the Cauchy loss: smooth through zero, as Gauss–Newton needs.
                (r * r / c2).ln_1p().sqrt().copysign(r)
            }));
            let length = pose.translation + DVec3::new(v[3], v[4], v[5]);
            out.push((length.length() - 1.0) * 10.0);
            out.push(((m.ln() + v[6]) / prior_sigma).clamp(-1e6, 1e6));
        });
        let p = updated(&v);
        (p.orthonormalised(), m * v[6].clamp(-1.0, 1.0).exp())
    }

    /// Decomposition of `e` with most points in front of both cameras.
    fn choose_pose(&self, e: &DMat3, m: f64) -> Pose {
        let f = stretched(e, m);
        let used: Vec<usize> =
            (0..self.x.len()).filter(|&k| sampson(&f, self.x[k], self.y[k]) < self.t2).collect();
        let count_in_front = |p: &Pose| {
            used.iter()
                .filter(|&&k| triangulate_two(p, ray(self.x[k], m), ray(self.y[k], m)).is_some())
                .count()
        };
        let candidates = decompose_essential(e);
        let mut best = (0, candidates[0]);
        for p in candidates {
            let count = count_in_front(&p);
            if count > best.0 {
                best = (count, p);
            }
        }
        best.1
    }

    /// RANSAC at a fixed stretch. Matches are sorted best first; samples prefer the front of the
    /// list.
    fn ransac(&self, m: f64, iterations: usize, prior_sigma: f64, seed: u64) -> Option<(f64, Pose, f64)> {
        let solver = FivePoint::new();
        let mut rng = Random::new(seed);
        let n = self.x.len();
        let mut best: Option<(f64, Pose, f64)> = None;
        let mut needed = iterations;
        let mut k = 0;
        while k < needed {
            // Growing prefix, as in PROSAC: all matches take part after a third of the iterations.
            let reach = (n * 3 * (k + 1) / iterations).clamp(n.min(40), n);
            k += 1;
            let s = rng.sample::<5>(reach);
            let x = s.map(|i| ray(self.x[i], m));
            let y = s.map(|i| ray(self.y[i], m));
            for e in solver.solve(&x, &y) {
                let limit = best.as_ref().map_or(f64::INFINITY, |b| b.0);
                let value = self.score(&stretched(&e, m), limit.max(1.0) * 1.2);
                if value >= limit * 1.1 {
                    continue;
                }
                let (pose, m2) = self.polish(&self.choose_pose(&e, m), m, prior_sigma, 6);
                let refined = self.score(&stretched(&essential(&pose), m2), f64::INFINITY);
                if refined < limit {
                    best = Some((refined, pose, m2));
                    // 99.9 % chance of one clean sample at this inlier ratio.
                    let inlier = (1.0 - refined / n as f64).clamp(0.01, 0.99);
                    let enough = (0.001f64.ln() / (1.0 - inlier.powi(5)).ln()).ceil();
                    needed = iterations.min((enough as usize).max(60)).max(k);
                }
            }
        }
        best
    }
}

/// Estimates the relative pose of two views from matches sorted best first. `x`, `y`: centred
/// pixels over prior focal length; `threshold` in the same unit; `prior_sigma` is that of ln
/// stretch. `seed` draws the samples.
pub(crate) fn estimate(
    x: &[DVec2],
    y: &[DVec2],
    threshold: f64,
    prior_sigma: f64,
    seed: u64,
) -> Option<TwoView> {
    let n = x.len();
    if n < 8 {
        return None;
    }
    let data = CentredMatches { x, y, t2: threshold * threshold };
    // ±1.5 σ of the prior covers 87 % of cameras; the local optimisation bridges the steps between.
    let stretches: Vec<f64> = if prior_sigma > 0.1 {
        [0.0, -0.75, 0.75, -1.5, 1.5].iter().map(|k: &f64| (k * prior_sigma).exp()).collect()
    } else {
        vec![1.0]
    };
    let of_stretch = |(k, m): (usize, &f64)| {
        let iterations = if k == 0 { 1500 } else { 300 };
        data.ransac(*m, iterations, prior_sigma, seed ^ (0x5eed_0001 + k as u64))
    };
    let all: Vec<Option<(f64, Pose, f64)>> = stretches.par_iter().enumerate().map(of_stretch).collect();
    let mut best: Option<(f64, Pose, f64)> = None;
    for found in all.into_iter().flatten() {
        if best.as_ref().is_none_or(|b| found.0 < b.0) {
            best = Some(found);
        }
    }
    let (_, mut pose, mut m) = best?;
    for _ in 0..3 {
        (pose, m) = data.polish(&pose, m, prior_sigma, 20);
    }
    let f = stretched(&essential(&pose), m);
    let (mut inliers, mut angles) = (Vec::new(), Vec::new());
    for k in 0..n {
        if sampson(&f, x[k], y[k]) >= data.t2 {
            continue;
        }
        let (a, b) = (ray(x[k], m), ray(y[k], m));
        if let Some(p) = triangulate_two(&pose, a, b) {
            inliers.push(k);
            angles.push(p.angle_between(p - pose.centre()).to_degrees());
        }
    }
    let parallax = median(&mut angles)?;
    let rotation_residual = pure_rotation_residual(x, y, &inliers, &pose, m);
    Some(TwoView { pose, stretch: m, inliers, parallax, rotation_residual })
}

/// Median residual after fitting a rotation and a focal stretch without translation: near the noise
/// when the camera only turned.
fn pure_rotation_residual(x: &[DVec2], y: &[DVec2], used: &[usize], pose: &Pose, m: f64) -> f64 {
    let moved = |v: &[f64; 4], k: usize| {
        let r = Pose::exp(DVec3::ZERO, DVec3::new(v[0], v[1], v[2])).rotation * pose.rotation;
        let s = m * v[3].clamp(-1.0, 1.0).exp();
        let q = r * ray(x[k], s);
        DVec2::new(q.x, q.y) * (s / q.z.max(1e-6)) - y[k]
    };
    // Starts from the rotation of `pose`.
    let (v, _) = minimise_small([0.0; 4], [1e-7; 4], 30, |v, out| {
        out.clear();
        for &k in used {
            let r = moved(v, k) / 0.02;
            let r2 = r.length_squared();
            let w = if r2 > 1e-12 { (r2.ln_1p() / r2).sqrt() } else { 1.0 };
            out.extend([r.x * w, r.y * w]);
        }
    });
    let mut residuals: Vec<f64> = used.iter().map(|&k| moved(&v, k).length()).collect();
    median(&mut residuals).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::rotation_angle;

    fn views(pose: &Pose, focal: f64, n: usize, flat: bool) -> (Vec<DVec2>, Vec<DVec2>) {
        let mut rng = Random::new(21);
        let (mut x, mut y) = (Vec::new(), Vec::new());
        while x.len() < n {
            let depth = if flat { 0.0 } else { rng.normal() * 0.5 };
            let p = DVec3::new(rng.normal(), rng.normal() * 0.8, 4.0 + depth);
            let q = pose.transform(p);
            let noise = |rng: &mut Random| DVec2::new(rng.normal(), rng.normal()) * 1.1;
            let (a, b) = (
                DVec2::new(p.x, p.y) * (focal / p.z) + noise(&mut rng),
                DVec2::new(q.x, q.y) * (focal / q.z) + noise(&mut rng),
            );
            let far = x.len() % 5 == 4;
            x.push(a / 576.0);
            let away = DVec2::new(rng.uniform() - 0.5, rng.uniform() - 0.5) * 500.0;
            y.push(if far { away } else { b } / 576.0);
        }
        (x, y)
    }

    #[test]
    fn estimate_wrong_focal_recovers_rotation() {
        let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.05, 0.45, -0.03));
        // Not an orbit about one centre: equal distances with crossing axes leave the focal length
        // free (Sturm 2001).
        let c = DVec3::new(0.0, 0.0, 4.0);
        let pose =
            Pose { rotation: turn.rotation, translation: DVec3::new(0.3, 0.4, 2.5) - turn.rotation * c };
        let (x, y) = views(&pose, 660.0, 400, false);
        let found = estimate(&x, &y, 3.0 / 576.0, 0.35, 0).unwrap();
        let error = rotation_angle(&(found.pose.rotation * pose.rotation.transpose())).to_degrees();
        let direction = found.pose.translation.angle_between(pose.translation).to_degrees();
        assert!(error < 1.5 && direction < 3.0, "{error} {direction} {}", found.stretch);
        assert!(found.inliers.len() > 290 && found.parallax > 15.0, "{}", found.inliers.len());
        assert!(found.rotation_residual * 576.0 > 10.0);
    }

    #[test]
    fn estimate_pure_rotation_has_no_parallax() {
        let pose = Pose::exp(DVec3::ZERO, DVec3::new(0.02, 0.2, 0.01));
        let (x, y) = views(&pose, 660.0, 300, false);
        let found = estimate(&x, &y, 3.0 / 576.0, 0.35, 0).unwrap();
        assert!(found.rotation_residual * 576.0 < 3.0, "{}", found.rotation_residual * 576.0);
    }
}
