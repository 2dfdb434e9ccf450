//! Camera pose refinement by Adam on left twists, `T ← exp(−lr·m̂/(√v̂+ε))·T`
//! (docs/internals/method.md#pose-refinement).
use super::schedule::Exponential;
use crate::scene::Pose;
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Largest rotation (rad) and translation (in units of the scene scale) of one step, so that a
/// single bad gradient cannot move a camera out of the scene.
const MAX_STEP: f64 = 1e-3;

/// Adam state of one camera.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct PoseAdam {
    step: i32,
    first: [f64; 6],
    second: [f64; 6],
}

impl PoseAdam {
    /// Applies one step for the gradient by the twist (ρ, θ). `rate` is the step size in radians;
    /// translations use `rate · scale`, with the scene scale in world units.
    pub fn update(&mut self, pose: &Pose, gradient: [f64; 6], rate: f64, scale: f64) -> Pose {
        if gradient.iter().any(|g| !g.is_finite()) {
            return *pose;
        }
        self.step += 1;
        let mut twist = [0.0; 6];
        for i in 0..6 {
            self.first[i] = 0.9 * self.first[i] + 0.1 * gradient[i];
            self.second[i] = 0.999 * self.second[i] + 0.001 * gradient[i] * gradient[i];
            let m = self.first[i] / (1.0 - 0.9f64.powi(self.step));
            let v = self.second[i] / (1.0 - 0.999f64.powi(self.step));
            twist[i] = (-rate * m / (v.sqrt() + 1e-15)).clamp(-MAX_STEP, MAX_STEP);
        }
        let rho = DVec3::new(twist[0], twist[1], twist[2]) * scale;
        let theta = DVec3::new(twist[3], twist[4], twist[5]);
        Pose::exp(rho, theta).compose(pose).orthonormalised()
    }
}

/// Schedule of pose refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseOptions {
    /// First step (0-based) that moves cameras, after the splats have settled.
    pub start: usize,
    /// Radians per step; translations use the same number times the scene scale.
    pub rate: Exponential,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pose_adam_minimises_a_quadratic() {
        let target = Pose::exp(DVec3::new(0.02, -0.01, 0.03), DVec3::new(0.008, -0.004, 0.006));
        let mut pose = Pose::IDENTITY;
        let mut adam = PoseAdam::default();
        for step in 0..400 {
            // Gradient of ½|log(T·target⁻¹)|² to first order: the small-angle twist of the
            // difference.
            let difference = pose.compose(&target.inverse());
            let r = difference.rotation;
            let theta =
                DVec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x) * 0.5;
            let rho = difference.translation;
            let gradient = [rho.x, rho.y, rho.z, theta.x, theta.y, theta.z];
            let rate = Exponential { start: 1e-3, end: 1e-5, steps: 400 }.at(step);
            pose = adam.update(&pose, gradient, rate, 1.0);
        }
        let left = pose.compose(&target.inverse());
        assert!(left.translation.length() < 2e-4, "{}", left.translation);
        assert!((left.rotation.x_axis.x - 1.0).abs() < 1e-7);
    }

    #[test]
    fn pose_adam_ignores_non_finite_gradients() {
        let pose = Pose::exp(DVec3::X, DVec3::Y * 0.1);
        assert_eq!(PoseAdam::default().update(&pose, [f64::NAN; 6], 1e-3, 1.0), pose);
    }
}
