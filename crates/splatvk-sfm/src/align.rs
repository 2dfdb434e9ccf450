//! Errors of estimated cameras against known ones, for `eval` and the tests.
use super::numeric::{nearest_rotation, rotation_angle};
use crate::scene::{Camera, Similarity};
use glam::{DMat3, DVec3};

/// Errors per camera after the similarity that best maps the estimate onto the truth.
#[derive(Clone, Debug)]
pub struct PoseErrors {
    /// Estimated world → true world.
    pub similarity: Similarity,
    /// Rotation error per camera, degrees.
    pub rotation_degrees: Vec<f64>,
    /// Distance of the camera centres per camera, as a fraction of `mean_depth`.
    pub centre: Vec<f64>,
    /// |f / f_true − 1| per camera, at equal image widths.
    pub focal: Vec<f64>,
}

/// Compares cameras in order. `mean_depth` is the mean camera-z of the true scene, true units. The
/// global rotation is the chordal mean of the per-camera rotations, so that collinear centres are
/// no problem; scale and translation are least squares over the centres. Empty input gives empty
/// errors.
pub fn pose_errors(estimated: &[Camera], truth: &[Camera], mean_depth: f64) -> PoseErrors {
    let pairs: Vec<_> = estimated.iter().zip(truth).collect();
    let n = pairs.len().max(1) as f64;
    let sum = pairs
        .iter()
        .map(|(e, t)| t.pose.rotation.transpose() * e.pose.rotation)
        .fold(DMat3::ZERO, |a, b| a + b);
    let rotation = nearest_rotation(&sum);
    let mean_e = pairs.iter().map(|(e, _)| e.pose.centre()).sum::<DVec3>() / n;
    let mean_t = pairs.iter().map(|(_, t)| t.pose.centre()).sum::<DVec3>() / n;
    let (mut dot, mut norm) = (0.0, 0.0);
    for (e, t) in &pairs {
        let x = rotation * (e.pose.centre() - mean_e);
        dot += x.dot(t.pose.centre() - mean_t);
        norm += x.length_squared();
    }
    let scale = if norm > 0.0 { dot / norm } else { 1.0 };
    let similarity = Similarity { scale, rotation, translation: mean_t - rotation * mean_e * scale };
    let angle = |e: &Camera, t: &Camera| {
        rotation_angle(&(rotation * e.pose.rotation.transpose() * t.pose.rotation)).to_degrees()
    };
    PoseErrors {
        similarity,
        rotation_degrees: pairs.iter().map(|(e, t)| angle(e, t)).collect(),
        centre: pairs
            .iter()
            .map(|(e, t)| (similarity.transform(e.pose.centre()) - t.pose.centre()).length() / mean_depth)
            .collect(),
        focal: pairs
            .iter()
            .map(|(e, t)| (e.fx / e.width as f64 * t.width as f64 / t.fx - 1.0).abs())
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    fn camera(pose: Pose) -> Camera {
        Camera {
            name: String::new(),
            width: 640,
            height: 480,
            fx: 600.0,
            fy: 600.0,
            cx: 320.0,
            cy: 240.0,
            pose,
        }
    }

    #[test]
    fn pose_errors_are_invariant_to_similarity() {
        let truth: Vec<_> = (0..4)
            .map(|k| {
                let k = k as f64;
                camera(Pose::exp(DVec3::new(k, 0.3 * k * k, -0.1 * k), DVec3::new(0.1, 0.2 * k, 0.05)))
            })
            .collect();
        let g = Pose::exp(DVec3::new(1.0, 2.0, 3.0), DVec3::new(0.4, -1.0, 0.7));
        let mut moved: Vec<_> = truth
            .iter()
            .map(|c| {
                let mut p = c.pose.compose(&g);
                p.translation *= 2.5;
                let mut c = c.clone();
                c.pose = Pose { rotation: p.rotation, translation: p.translation };
                c
            })
            .collect();
        let e = pose_errors(&moved, &truth, 2.0);
        assert!(e.rotation_degrees.iter().chain(&e.centre).all(|v| *v < 1e-9), "{e:?}");
        assert!((e.similarity.scale - 1.0 / 2.5).abs() < 1e-12);
        // Turning one of four cameras by 1° moves the mean by a quarter of it.
        moved[2].pose.rotation =
            Pose::exp(DVec3::ZERO, DVec3::X * 1f64.to_radians()).rotation * moved[2].pose.rotation;
        moved[1].fx *= 1.02;
        let e = pose_errors(&moved, &truth, 2.0);
        assert!((e.rotation_degrees[2] - 0.75).abs() < 0.01 && (e.rotation_degrees[0] - 0.25).abs() < 0.01);
        assert!((e.focal[1] - 0.02).abs() < 1e-12);
    }
}
