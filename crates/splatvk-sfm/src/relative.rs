//! Errors of relative poses, which need no common frame, and the area under their recall curve.
use super::numeric::rotation_angle;
use crate::scene::{Camera, Pose};
use serde::Serialize;

/// Errors of one pair of cameras.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PairError {
    /// Indices of the two cameras.
    pub pair: [usize; 2],
    /// Angle between the two relative rotations, degrees.
    pub rotation_degrees: f64,
    /// Angle between the directions from the first camera to the second, seen by the first,
    /// degrees; `None` where the true centres coincide.
    pub direction_degrees: Option<f64>,
}

impl PairError {
    /// The larger of the two angles.
    pub fn worst(&self) -> f64 {
        self.direction_degrees.map_or(self.rotation_degrees, |d| d.max(self.rotation_degrees))
    }
}

/// Errors of all pairs of cameras, in order.
pub fn pair_errors(estimated: &[Camera], truth: &[Camera]) -> Vec<PairError> {
    let n = estimated.len().min(truth.len());
    let centres: Vec<_> = truth.iter().map(|c| c.pose.centre()).collect();
    let reach = centres.iter().map(|c| c.distance(centres[0])).fold(0.0, f64::max);
    let relative = |c: &[Camera], i: usize, j: usize| -> Pose { c[j].pose.compose(&c[i].pose.inverse()) };
    let pairs = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
    pairs
        .map(|(i, j)| {
            let (e, t) = (relative(estimated, i, j), relative(truth, i, j));
            // Centre of the second camera in the frame of the first.
            let (to_e, to_t) = (e.centre(), t.centre());
            // A millionth of the rig's size is rounding, not a direction.
            let apart = to_t.length() > 1e-6 * reach;
            let angle = if to_e.length() > 0.0 { to_e.angle_between(to_t).to_degrees() } else { 180.0 };
            PairError {
                pair: [i, j],
                rotation_degrees: rotation_angle(&(e.rotation * t.rotation.transpose())).to_degrees(),
                direction_degrees: apart.then_some(angle),
            }
        })
        .collect()
}

/// Area under the curve "share of the pairs whose larger angle is below x" for x from 0 to
/// `degrees`, over `degrees`: 1 is perfect. Exact, without bins. Pairs that are `missing` (a camera
/// was not found) count as failures. `None` without pairs.
pub fn auc(errors: &[PairError], missing: usize, degrees: f64) -> Option<f64> {
    let count = errors.len() + missing;
    let sum: f64 = errors.iter().map(|e| (1.0 - e.worst() / degrees).max(0.0)).sum();
    (count > 0).then(|| sum / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn camera(pose: Pose) -> Camera {
        Camera { name: String::new(), width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0, pose }
    }

    #[test]
    fn pair_errors_equal_applied_angles() {
        let truth: Vec<Camera> = (0..3)
            .map(|k| {
                let k = f64::from(k);
                camera(Pose::exp(DVec3::new(k, 0.4 * k * k, 0.1), DVec3::new(0.1, 0.3 * k, -0.2)))
            })
            .collect();
        let g = Pose::exp(DVec3::new(1.0, -2.0, 0.3), DVec3::new(0.4, 1.1, 0.2));
        let mut moved = truth.clone();
        for c in &mut moved {
            c.pose = c.pose.compose(&g);
            c.pose.translation *= 3.0;
        }
        let errors = pair_errors(&moved, &truth);
        assert_eq!(errors.iter().map(|e| e.pair).collect::<Vec<_>>(), [[0, 1], [0, 2], [1, 2]]);
        assert!(errors.iter().all(|e| e.worst() < 1e-5), "{errors:?}");
        assert!(auc(&errors, 0, 3.0).unwrap() > 0.999_99);
        // Turn the last camera about its own centre: two rotations change, one direction seen from
        // it does not exist.
        let turn = Pose::exp(DVec3::ZERO, DVec3::X * 1.5f64.to_radians());
        moved[2].pose = turn.compose(&moved[2].pose);
        let errors = pair_errors(&moved, &truth);
        assert!(errors[0].worst() < 1e-5);
        for e in &errors[1..] {
            assert!((e.rotation_degrees - 1.5).abs() < 1e-6 && e.direction_degrees.unwrap() < 1e-5, "{e:?}");
        }
        // (1 + ½ + ½) / 3, and with a camera missing half of that
        assert!((auc(&errors, 0, 3.0).unwrap() - 2.0 / 3.0).abs() < 1e-6);
        assert!((auc(&errors, 3, 3.0).unwrap() - 1.0 / 3.0).abs() < 1e-6);
        assert_eq!(auc(&errors[1..], 0, 1.0), Some(0.0));
        assert_eq!(auc(&[], 0, 3.0), None);
    }

    #[test]
    fn coincident_centres_have_no_direction() {
        let at = |x: f64| camera(Pose { translation: DVec3::X * x, ..Pose::IDENTITY });
        let errors = pair_errors(&[at(0.0), at(1.0), at(1.0)], &[at(0.0), at(-1.0), at(-1.0)]);
        assert_eq!(errors[2].direction_degrees, None);
        assert!((errors[0].direction_degrees.unwrap() - 180.0).abs() < 1e-6);
    }
}
