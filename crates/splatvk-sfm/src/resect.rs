//! Absolute pose from points of known position (PnP): RANSAC over three points, then least squares.
use super::minimal::three_point;
use super::numeric::{cauchy_weight, minimise_small};
use crate::math::Random;
use crate::scene::Pose;
use glam::{DVec2, DVec3};

/// A camera pose and the indices of its inliers.
#[derive(Clone, Debug)]
pub(crate) struct Resection {
    pub(crate) pose: Pose,
    pub(crate) inliers: Vec<usize>,
}

/// Squared reprojection error in pixels; infinite behind the camera. `pixel` is relative to the
/// principal point.
fn error2(pose: &Pose, focal: f64, world: DVec3, pixel: DVec2) -> f64 {
    let t = pose.transform(world);
    if t.z <= 1e-9 {
        return f64::INFINITY;
    }
    (DVec2::new(t.x, t.y) * (focal / t.z) - pixel).length_squared()
}

/// World → camera pose from world points and their pixels relative to the principal point (RANSAC
/// over three points, then a Cauchy fit). `threshold` in pixels; `seed` draws the samples. `None`
/// with fewer than four points or inliers.
pub(crate) fn resect(
    world: &[DVec3],
    pixels: &[DVec2],
    focal: f64,
    threshold: f64,
    iterations: usize,
    seed: u64,
) -> Option<Resection> {
    let n = world.len();
    if n < 4 {
        return None;
    }
    let t2 = threshold * threshold;
    let score = |p: &Pose| (0..n).map(|k| error2(p, focal, world[k], pixels[k]).min(t2)).sum::<f64>();
    let mut rng = Random::new(seed ^ 0x5eed_0003);
    let mut best: Option<(f64, Pose)> = None;
    for _ in 0..iterations {
        let s = rng.sample::<3>(n);
        let rays = s.map(|k| DVec3::new(pixels[k].x / focal, pixels[k].y / focal, 1.0));
        for pose in three_point(&s.map(|k| world[k]), &rays) {
            let value = score(&pose);
            if value.is_finite() && best.is_none_or(|b| value < b.0) {
                let refined = polish(&pose, world, pixels, focal, threshold, 5);
                let better = score(&refined);
                best = Some(if better < value { (better, refined) } else { (value, pose) });
            }
        }
    }
    let pose = polish(&best?.1, world, pixels, focal, threshold, 30);
    let inliers: Vec<usize> = (0..n).filter(|&k| error2(&pose, focal, world[k], pixels[k]) < t2).collect();
    (inliers.len() >= 4).then_some(Resection { pose, inliers })
}

/// Robust least squares on the reprojection error (Cauchy at half the threshold).
fn polish(pose: &Pose, world: &[DVec3], pixels: &[DVec2], focal: f64, threshold: f64, steps: usize) -> Pose {
    // Far outliers have no influence; leaving them out keeps the residual vector short.
    let near: Vec<usize> = (0..world.len())
        .filter(|&k| error2(pose, focal, world[k], pixels[k]) < 16.0 * threshold * threshold)
        .collect();
    if near.len() < 4 {
        return *pose;
    }
    let c = 0.5 * threshold;
    let size = pose.translation.length().max(1e-3);
    let updated = |x: &[f64; 6]| {
        Pose::exp(DVec3::new(x[0], x[1], x[2]) * size, DVec3::new(x[3], x[4], x[5])).compose(pose)
    };
    let (x, _) = minimise_small([0.0; 6], [1e-7; 6], steps, |x, out| {
        let p = updated(x);
        out.clear();
        for &k in &near {
            let t = p.transform(world[k]);
            let z = if t.z > 1e-9 { t.z } else { 1e-9 };
            let r = DVec2::new(t.x, t.y) * (focal / z) - pixels[k];
            // sqrt of the Cauchy loss along the residual: its square sums to the loss.
            let r2 = r.length_squared();
            let w =
                if r2 > 1e-12 { (c * c * (r2 / (c * c)).ln_1p() / r2).sqrt() } else { cauchy_weight(r2, c) };
            out.push(r.x * w);
            out.push(r.y * w);
        }
    });
    updated(&x).orthonormalised()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::rotation_angle;

    #[test]
    fn resect_half_outliers_recovers_pose() {
        let mut rng = Random::new(11);
        let truth = Pose::exp(DVec3::new(0.4, -0.2, 0.5), DVec3::new(0.2, -0.5, 0.1));
        let (mut world, mut pixels) = (Vec::new(), Vec::new());
        for k in 0..300 {
            let p = DVec3::new(rng.normal(), rng.normal(), 4.0 + rng.normal() * 0.5);
            let t = truth.transform(p);
            let mut u = DVec2::new(t.x, t.y) * (600.0 / t.z) + DVec2::new(rng.normal(), rng.normal()) * 0.5;
            if k % 2 == 0 {
                u = DVec2::new(rng.uniform() - 0.5, rng.uniform() - 0.5) * 600.0;
            }
            world.push(p);
            pixels.push(u);
        }
        let r = resect(&world, &pixels, 600.0, 3.0, 200, 0).unwrap();
        assert!(rotation_angle(&(r.pose.rotation * truth.rotation.transpose())).to_degrees() < 0.1);
        assert!((r.pose.centre() - truth.centre()).length() < 0.01);
        assert!(r.inliers.len() >= 145);
    }
}
