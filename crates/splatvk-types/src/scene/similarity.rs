//! Similarity transforms between world frames of different scale.
use super::{Camera, Pose};
use glam::{DMat3, DVec3};

/// `x ↦ scale · rotation · x + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Uniform scale.
    pub scale: f64,
    /// Rotation.
    pub rotation: DMat3,
    /// Translation, target units.
    pub translation: DVec3,
}

impl Similarity {
    /// Transforms a point.
    pub fn transform(&self, p: DVec3) -> DVec3 {
        self.rotation * p * self.scale + self.translation
    }

    /// The transform back.
    pub fn inverse(&self) -> Similarity {
        let (scale, rotation) = (1.0 / self.scale, self.rotation.transpose());
        Similarity { scale, rotation, translation: rotation * self.translation * -scale }
    }

    /// Camera with the same image of the transformed points as `camera` has of the original ones.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let rotation = camera.pose.rotation * self.rotation.transpose();
        let translation = camera.pose.translation * self.scale - rotation * self.translation;
        Camera { pose: Pose { rotation, translation }, ..camera.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    #[test]
    fn similarity_camera_keeps_pixels() {
        let pose = Pose::exp(DVec3::new(0.3, 1.0, -2.0), DVec3::new(0.1, -0.8, 0.4));
        let camera = Camera {
            name: "a".into(),
            width: 640,
            height: 480,
            fx: 600.0,
            fy: 610.0,
            cx: 321.0,
            cy: 239.0,
            pose,
        };
        let turn = Pose::exp(DVec3::ZERO, DVec3::new(-0.4, 1.2, 0.6)).rotation;
        let by = Similarity { scale: 2.5, rotation: turn, translation: DVec3::new(1.0, -3.0, 0.5) };
        let (pixel, depth) = (DVec2::new(12.0, 401.0), 3.5);
        let (seen, z) = by.camera(&camera).project(by.transform(camera.unproject(pixel, depth)));
        assert!((seen - pixel).length() < 1e-9 && (z - 2.5 * depth).abs() < 1e-9);
        let point = DVec3::new(3.0, -0.2, 7.0);
        assert!(by.inverse().transform(by.transform(point)).distance(point) < 1e-12);
    }
}
