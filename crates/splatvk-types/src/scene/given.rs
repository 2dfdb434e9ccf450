//! Cameras as files state them, with their distortion.
use super::{Camera, Lens, Pose};
use glam::DMat3;
use serde::{Deserialize, Serialize};

/// A camera with the distortion of its photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GivenCamera {
    /// Pinhole camera of the undistorted photo.
    pub camera: Camera,
    /// The lens.
    pub lens: Lens,
}

impl From<Camera> for GivenCamera {
    fn from(camera: Camera) -> GivenCamera {
        GivenCamera { camera, lens: Lens::NONE }
    }
}

impl GivenCamera {
    /// Like [`Camera::checked`]; also refuses distortion that cannot be inverted within the image.
    pub fn checked(self) -> Result<GivenCamera, String> {
        let camera = self.camera.checked()?;
        if !self.lens.is_finite() {
            return Err(format!("camera {:?}: its lens has numbers that are not finite", camera.name));
        }
        if !self.lens.is_invertible_in(&camera) {
            return Err(format!(
                "camera {:?}: its lens distortion folds back within the picture ({:?}), so that it cannot be taken out; \
                 check its coefficients",
                camera.name, self.lens
            ));
        }
        Ok(GivenCamera { camera, ..self })
    }

    /// Camera of the same photo turned by `quarters` quarter turns clockwise.
    pub fn turned(&self, quarters: u8) -> GivenCamera {
        // A quarter turn maps pixel (x, y) to (height − y, x), and so axis x to y and y to −x.
        let quarter = DMat3::from_cols_array(&[0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
        let camera = (0..quarters % 4).fold(self.camera.clone(), |c, _| Camera {
            width: c.height,
            height: c.width,
            fx: c.fy,
            fy: c.fx,
            cx: f64::from(c.height) - c.cy,
            cy: c.cx,
            pose: Pose { rotation: quarter * c.pose.rotation, translation: quarter * c.pose.translation },
            name: c.name,
        });
        GivenCamera { camera, lens: self.lens.turned(quarters) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DVec2, DVec3};

    #[test]
    fn turned_camera_projects_to_turned_pixel() {
        let camera = Camera {
            name: "a".into(),
            width: 640,
            height: 480,
            fx: 600.0,
            fy: 610.0,
            cx: 311.0,
            cy: 239.0,
            pose: Pose::exp(DVec3::new(0.3, 1.0, -2.0), DVec3::new(0.1, -0.8, 0.4)),
        };
        let given = GivenCamera { camera, lens: Lens { p1: 0.01, p2: -0.02, ..Lens::radial(-0.1, 0.02) } };
        let point = given.camera.unproject(DVec2::new(500.0, 100.0), 3.0);
        let seen = given.lens.project(&given.camera, point);
        let turned = given.turned(1);
        assert_eq!((turned.camera.width, turned.camera.height), (480, 640));
        let there = turned.lens.project(&turned.camera, point);
        assert!((there - DVec2::new(480.0 - seen.y, seen.x)).length() < 1e-9, "{there} {seen}");
        assert!(turned.clone().checked().is_ok());
        assert_eq!(given.turned(4), given);
    }
}
