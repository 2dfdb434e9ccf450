//! Pinhole cameras and rigid poses.
use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A rigid transform world → camera: `t = R μ + τ` (OpenCV axes).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// R, world → camera.
    pub rotation: DMat3,
    /// τ, world units.
    pub translation: DVec3,
}

impl Pose {
    /// World frame = camera frame.
    pub const IDENTITY: Pose = Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// World point → camera frame.
    pub fn transform(&self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation
    }
    /// The inverse transform (camera → world for a world → camera pose).
    pub fn inverse(&self) -> Pose {
        let r = self.rotation.transpose();
        Pose { rotation: r, translation: -(r * self.translation) }
    }
    /// `self ∘ other`: applies `other` first.
    pub fn compose(&self, other: &Pose) -> Pose {
        Pose {
            rotation: self.rotation * other.rotation,
            translation: self.rotation * other.translation + self.translation,
        }
    }
    /// Camera centre in world coordinates, `C = −Rᵀτ`.
    pub fn centre(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
    /// `exp(ξ)` of a twist ξ = (ρ, θ): rotation `exp([θ]×)`, translation `V ρ`.
    pub fn exp(rho: DVec3, theta: DVec3) -> Pose {
        let angle2 = theta.length_squared();
        let angle = angle2.sqrt();
        // Taylor series below 1e-4 rad: the closed forms lose all digits there.
        let (a, b, c) = if angle < 1e-4 {
            (1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0)
        } else {
            (angle.sin() / angle, (1.0 - angle.cos()) / angle2, (angle - angle.sin()) / (angle2 * angle))
        };
        let k = skew(theta);
        let k2 = k * k;
        Pose {
            rotation: DMat3::IDENTITY + k * a + k2 * b,
            translation: (DMat3::IDENTITY + k * b + k2 * c) * rho,
        }
    }
    /// Removes rounding drift from the rotation.
    pub fn orthonormalised(&self) -> Pose {
        Pose {
            rotation: DMat3::from_quat(DQuat::from_mat3(&self.rotation).normalize()),
            translation: self.translation,
        }
    }
}

/// The cross-product matrix `[v]×`.
fn skew(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// Longest side of a camera's image, pixels: photos of 200 megapixels have 16,320.
pub const MAX_SIDE: u32 = 16_384;
/// Most pixels of an image: the largest photos that phones take.
pub const MAX_PIXELS: u64 = 200_000_000;
/// Longest file name of a camera, bytes: file systems take 255 with the suffixes of outputs
/// ("_relevancy.npy").
const LONGEST_NAME: usize = 200;
/// Longest name of a camera with its folders, bytes, as Linux takes them.
const LONGEST_PATH: usize = 4096;

/// A pinhole camera without distortion. Pixel units; the centre of the first pixel is (0.5, 0.5).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// File name of the photo, or a label.
    pub name: String,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, pixels.
    pub cx: f64,
    /// Principal point, pixels.
    pub cy: f64,
    /// World → camera.
    pub pose: Pose,
}

impl Camera {
    /// Refuses cameras that are no pinhole, and those for which no output can be written: images
    /// beyond [`MAX_SIDE`] and [`MAX_PIXELS`], names that are not file names.
    pub fn checked(self) -> Result<Camera, String> {
        let c = self;
        c.check_name()?;
        if c.width.max(c.height) > MAX_SIDE || u64::from(c.width) * u64::from(c.height) > MAX_PIXELS {
            return Err(format!(
                "camera {:?}: {} × {} pixels are too many; at most {MAX_SIDE} a side and {} million in all",
                c.name,
                c.width,
                c.height,
                MAX_PIXELS / 1_000_000
            ));
        }
        let finite =
            [c.fx, c.fy, c.cx, c.cy].iter().chain(&c.pose.rotation.to_cols_array()).all(|v| v.is_finite())
                && c.pose.translation.is_finite();
        let r = c.pose.rotation;
        let off =
            (r * r.transpose() - DMat3::IDENTITY).to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
        if !finite || c.fx <= 0.0 || c.fy <= 0.0 || c.width == 0 || c.height == 0 {
            return Err(format!(
                "camera {:?}: sizes and focal lengths must be positive, all numbers finite",
                c.name
            ));
        }
        // Files with 6 printed digits reach 1e-5; a scaled or sheared matrix is far above.
        if off > 1e-3 || r.determinant() < 0.0 {
            return Err(format!("camera {:?}: its matrix is not a rotation (off by {off:.1e})", c.name));
        }
        let pose = if off > 1e-12 { c.pose.orthonormalised() } else { c.pose };
        Ok(Camera { pose, ..c })
    }
    fn check_name(&self) -> Result<(), String> {
        let file = self.name.rsplit(['/', '\\']).next().unwrap_or_default();
        if file.len() > LONGEST_NAME || self.name.len() > LONGEST_PATH {
            let start: String = self.name.chars().take(40).collect();
            return Err(format!(
                "camera {start:?}…: a name of {} bytes is too long ({LONGEST_NAME} at most); rename it",
                file.len()
            ));
        }
        match self.name.chars().any(char::is_control) {
            true => Err(format!("camera {:?}: a control character is in its name; rename it", self.name)),
            false => Ok(()),
        }
    }
    /// Pixel position of a world point and its depth; the depth may be ≤ 0 (behind the camera).
    pub fn project(&self, world: DVec3) -> (DVec2, f64) {
        let t = self.pose.transform(world);
        (DVec2::new(self.fx * t.x / t.z + self.cx, self.fy * t.y / t.z + self.cy), t.z)
    }
    /// World point of a pixel position at camera-z `depth`.
    pub fn unproject(&self, pixel: DVec2, depth: f64) -> DVec3 {
        self.pose.inverse().transform(self.ray(pixel) * depth)
    }
    /// Camera-frame ray with z = 1 through a pixel position.
    pub fn ray(&self, pixel: DVec2) -> DVec3 {
        DVec3::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy, 1.0)
    }
    /// Camera for the same image resized to `width × height`.
    pub fn resized(&self, width: u32, height: u32) -> Camera {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        Camera {
            name: self.name.clone(),
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            pose: self.pose,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_rigid_and_composes() {
        for scale in [1e-9, 1e-5, 0.3, 2.5] {
            let p = Pose::exp(DVec3::new(0.2, -0.4, 0.1) * scale, DVec3::new(0.5, 0.3, -0.7) * scale);
            let error = (p.rotation * p.rotation.transpose() - DMat3::IDENTITY).to_cols_array();
            assert!(error.iter().all(|e| e.abs() < 1e-12), "not orthogonal at {scale}");
            let half =
                Pose::exp(DVec3::new(0.2, -0.4, 0.1) * scale * 0.5, DVec3::new(0.5, 0.3, -0.7) * scale * 0.5);
            let twice = half.compose(&half);
            assert!((twice.translation - p.translation).length() < 1e-12 * (1.0 + scale));
        }
    }

    #[test]
    fn camera_with_unwritable_output_is_refused() {
        let camera = |name: &str, width, height| {
            let pose = Pose::IDENTITY;
            Camera { name: name.into(), width, height, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, pose }.checked()
        };
        assert!(camera("a/b c.jpg", 16_320, 12_240).is_ok());
        assert!(camera(&format!("{}/{}", "f".repeat(300), "x".repeat(200)), 9, 9).is_ok());
        for name in ["a\0b", "a\nb", "\u{1b}[31m", &"x".repeat(201), &"f/".repeat(3000)] {
            let e = camera(name, 9, 9).unwrap_err();
            assert!(e.contains("rename it") && e.len() < 250, "{e}");
        }
        assert!(camera("a", 1_000_000, 4).unwrap_err().contains("too many"));
        assert!(camera("a", 16_000, 16_000).unwrap_err().contains("200 million"));
    }

    #[test]
    fn mirrored_matrix_is_no_rotation() {
        let camera = |diagonal: DVec3| {
            let pose = Pose { rotation: DMat3::from_diagonal(diagonal), ..Pose::IDENTITY };
            Camera { name: "a".into(), width: 9, height: 9, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, pose }
                .checked()
        };
        // A half turn flips two axes, a mirror one.
        assert!(camera(DVec3::new(-1.0, -1.0, 1.0)).is_ok());
        assert!(camera(DVec3::new(-1.0, 1.0, 1.0)).unwrap_err().contains("not a rotation"));
    }

    #[test]
    fn project_inverts_unproject() {
        let camera = Camera {
            name: "a".into(),
            width: 640,
            height: 480,
            fx: 600.0,
            fy: 610.0,
            cx: 321.0,
            cy: 239.0,
            pose: Pose::exp(DVec3::new(0.3, 1.0, -2.0), DVec3::new(0.1, -0.8, 0.4)),
        };
        let pixel = DVec2::new(12.25, 401.5);
        let (back, depth) = camera.project(camera.unproject(pixel, 3.5));
        assert!((back - pixel).length() < 1e-9 && (depth - 3.5).abs() < 1e-12);
    }
}
