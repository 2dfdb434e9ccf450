//! Radial lens distortion.
use super::Camera;
use glam::{DMat2, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Radial distortion in normalised camera coordinates, `x_d = x (1 + k1 r² + k2 r⁴)` with `x = (X/Z, Y/Z)` and `r = |x|`
/// (Brown 1966; COLMAP's `RADIAL`, and its `OPENCV` without tangential terms).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Coefficient of r².
    pub k1: f64,
    /// Coefficient of r⁴.
    pub k2: f64,
}

impl Lens {
    /// A pinhole.
    pub const NONE: Lens = Lens { k1: 0.0, k2: 0.0 };

    /// Whether it changes nothing.
    pub fn is_none(&self) -> bool {
        *self == Lens::NONE
    }

    /// Where the lens images an ideal position.
    pub fn distort(&self, x: DVec2) -> DVec2 {
        let r2 = x.length_squared();
        x * (1.0 + r2 * (self.k1 + r2 * self.k2))
    }

    /// ∂ distorted / ∂ ideal position.
    pub fn jacobian(&self, x: DVec2) -> DMat2 {
        let r2 = x.length_squared();
        let (scale, slope) = (1.0 + r2 * (self.k1 + r2 * self.k2), 2.0 * (self.k1 + 2.0 * r2 * self.k2));
        DMat2::from_cols(
            DVec2::new(scale + slope * x.x * x.x, slope * x.x * x.y),
            DVec2::new(slope * x.x * x.y, scale + slope * x.y * x.y),
        )
    }

    /// The ideal position that the lens images at `y`: Newton's method on the radius. Beyond the radius at which the
    /// distortion folds back there is none; the position at the fold is returned there.
    pub fn undistort(&self, y: DVec2) -> DVec2 {
        let target = y.length();
        if self.is_none() || target < 1e-12 {
            return y;
        }
        let mut r = target;
        // Newton converges quadratically from here; twenty steps are far more than any lens that can be inverted takes.
        for _ in 0..20 {
            let r2 = r * r;
            let slope = 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2);
            // At a fold the derivative vanishes: half the radius leads back to the branch that starts at the centre.
            let next = if slope > 0.05 {
                r - (r * (1.0 + r2 * (self.k1 + r2 * self.k2)) - target) / slope
            } else {
                0.5 * r
            };
            let done = (next - r).abs() < 1e-14 * r.max(1.0);
            r = next.clamp(0.0, 2.0 * r.max(target));
            if done {
                break;
            }
        }
        y * (r / target)
    }

    /// Where a world point shows in the photo that a camera takes through this lens, pixels.
    pub fn project(&self, camera: &Camera, world: DVec3) -> DVec2 {
        let t = camera.pose.transform(world);
        let d = self.distort(t.truncate() / t.z);
        DVec2::new(camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy)
    }

    /// Camera-frame ray with z = 1 through a pixel position of that photo.
    pub fn ray(&self, camera: &Camera, pixel: DVec2) -> DVec3 {
        self.undistort(camera.ray(pixel).truncate()).extend(1.0)
    }

    /// Whether the distortion grows with the radius up to `radius` (normalised): beyond a fold it cannot be undone.
    pub fn is_invertible_to(&self, radius: f64) -> bool {
        // The derivative is a quadratic in r²; between 0 and the end its least value lies at an end or at the vertex.
        let at = |r2: f64| 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2);
        let end = radius * radius;
        let vertex = if self.k2 == 0.0 { end } else { -0.3 * self.k1 / self.k2 };
        at(end) > 0.0 && (!(0.0..end).contains(&vertex) || at(vertex) > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENSES: [Lens; 4] = [
        Lens { k1: -0.12, k2: 0.03 },
        Lens { k1: 0.06, k2: -0.02 },
        Lens { k1: -0.25, k2: 0.08 },
        Lens { k1: 0.2, k2: 0.0 },
    ];

    #[test]
    fn undistort_inverts_distort() {
        for lens in LENSES {
            for k in 0..60 {
                let x = DVec2::from_angle(0.7 * k as f64) * (k as f64 / 60.0 * 0.8);
                assert!(lens.is_invertible_to(0.8));
                assert!((lens.undistort(lens.distort(x)) - x).length() < 1e-12, "{lens:?} {x}");
            }
        }
    }

    #[test]
    fn the_jacobian_is_the_derivative() {
        for lens in LENSES {
            let x = DVec2::new(0.31, -0.42);
            for (axis, column) in [(DVec2::X, 0), (DVec2::Y, 1)] {
                let h = 1e-6;
                let numeric = (lens.distort(x + axis * h) - lens.distort(x - axis * h)) / (2.0 * h);
                assert!((numeric - lens.jacobian(x).col(column)).length() < 1e-9);
            }
        }
    }

    #[test]
    fn folds_are_noticed_and_inverted_without_harm() {
        let fold = Lens { k1: -0.5, k2: 0.0 };
        // d(r − r³/2)/dr = 0 at r = 0.816.
        assert!(fold.is_invertible_to(0.81) && !fold.is_invertible_to(0.82));
        assert!(fold.undistort(DVec2::new(2.0, 0.0)).is_finite());
        // Grows to r² = 0.5, shrinks to 1, grows again.
        assert!(!Lens { k1: -1.0, k2: 0.4 }.is_invertible_to(1.5));
    }
}
