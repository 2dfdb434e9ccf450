//! Lens distortion.
use super::Camera;
use glam::{DMat2, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Distortion in normalised camera coordinates: maps the ideal position `x = (X/Z, Y/Z)` to its
/// image `x_d`. The coefficients are those of OpenCV and COLMAP, with `r = |x|`:
///
/// - rectilinear: `x_d = x (1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶) + q r² + 2 x
///   (q·x)` with `q = (p2, p1)` (Brown 1966; `OPENCV`, `FULL_OPENCV`, and with fewer terms
///   `SIMPLE_RADIAL` and `RADIAL`);
/// - fisheye: `x_d = x θ/r (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)` with `θ = atan r` (Kannala and
///   Brandt 2006; `OPENCV_FISHEYE`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Lens {
    /// Coefficient of r² (fisheye: of θ²).
    pub k1: f64,
    /// Coefficient of r⁴ (fisheye: of θ⁴).
    pub k2: f64,
    /// Coefficient of r⁶ (fisheye: of θ⁶).
    pub k3: f64,
    /// Coefficient of r² in the denominator (fisheye: of θ⁸).
    pub k4: f64,
    /// Coefficient of r⁴ in the denominator.
    pub k5: f64,
    /// Coefficient of r⁶ in the denominator.
    pub k6: f64,
    /// Tangential, along y.
    pub p1: f64,
    /// Tangential, along x.
    pub p2: f64,
    /// Whether the projection is equidistant, `r_d = θ` without coefficients, instead of
    /// rectilinear.
    pub fisheye: bool,
}

impl Lens {
    /// No distortion: a pinhole.
    pub const NONE: Lens = Lens::radial(0.0, 0.0);

    /// Radial distortion alone.
    pub const fn radial(k1: f64, k2: f64) -> Lens {
        Lens { k1, k2, k3: 0.0, k4: 0.0, k5: 0.0, k6: 0.0, p1: 0.0, p2: 0.0, fisheye: false }
    }

    /// Whether there is no distortion.
    pub fn is_none(&self) -> bool {
        *self == Lens::NONE
    }

    /// Whether only k1 and k2 are set.
    pub fn is_radial(&self) -> bool {
        *self == Lens::radial(self.k1, self.k2)
    }

    /// Whether all coefficients are finite numbers.
    pub fn is_finite(&self) -> bool {
        [self.k1, self.k2, self.k3, self.k4, self.k5, self.k6, self.p1, self.p2].iter().all(|v| v.is_finite())
    }

    /// Factor of the radius and its derivative by r².
    fn scale(&self, r2: f64) -> (f64, f64) {
        if self.fisheye {
            return self.fisheye_scale(r2);
        }
        let value = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        let slope = self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3);
        let below = 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6));
        let below_slope = self.k4 + r2 * (2.0 * self.k5 + r2 * 3.0 * self.k6);
        (value / below, (slope * below - value * below_slope) / (below * below))
    }

    fn fisheye_scale(&self, r2: f64) -> (f64, f64) {
        // Series of θ/r about the axis; the next term is below 1e-16.
        if r2 < 1e-8 {
            return (1.0 + r2 * (self.k1 - 1.0 / 3.0), self.k1 - 1.0 / 3.0);
        }
        let r = r2.sqrt();
        let theta = r.atan();
        let t2 = theta * theta;
        let image = theta * (1.0 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))));
        let by_theta =
            1.0 + t2 * (3.0 * self.k1 + t2 * (5.0 * self.k2 + t2 * (7.0 * self.k3 + t2 * 9.0 * self.k4)));
        let slope = (by_theta / (1.0 + r2) * r - image) / r2;
        (image / r, slope / (2.0 * r))
    }

    /// Distorted position of an ideal position.
    pub fn distort(&self, x: DVec2) -> DVec2 {
        let r2 = x.length_squared();
        let q = DVec2::new(self.p2, self.p1);
        x * (self.scale(r2).0 + 2.0 * q.dot(x)) + q * r2
    }

    /// ∂ distorted / ∂ ideal position.
    pub fn jacobian(&self, x: DVec2) -> DMat2 {
        let (scale, slope) = self.scale(x.length_squared());
        let q = DVec2::new(self.p2, self.p1);
        // Column k is the derivative by coordinate k.
        let column = |axis: DVec2| {
            let along = x.dot(axis);
            axis * (scale + 2.0 * q.dot(x))
                + x * (2.0 * slope * along + 2.0 * q.dot(axis))
                + q * (2.0 * along)
        };
        DMat2::from_cols(column(DVec2::X), column(DVec2::Y))
    }

    /// Ideal position of the distorted position `y`, by Newton's method. Beyond the radius at which
    /// radial distortion folds back there is none, and the position at the fold is returned.
    pub fn undistort(&self, y: DVec2) -> DVec2 {
        let target = y.length();
        if self.is_none() || target < 1e-12 {
            return y;
        }
        if !self.is_radial() {
            return self.undistort_general(y);
        }
        let mut r = target;
        // Newton converges quadratically from here; twenty steps are far more than any invertible
        // lens takes.
        for _ in 0..20 {
            let r2 = r * r;
            let slope = 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2);
            // At a fold the derivative vanishes: half the radius leads back to the branch that
            // starts at the centre.
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

    /// Inverts a general distortion by Newton's method in the plane; steps are halved until they
    /// reduce the error.
    fn undistort_general(&self, y: DVec2) -> DVec2 {
        // A fisheye images the whole half space within θ = π/2.
        let start = if self.fisheye { y.length().min(1.5).tan() / y.length() } else { 1.0 };
        let mut x = y * start;
        let mut miss = self.distort(x) - y;
        for _ in 0..50 {
            let jacobian = self.jacobian(x);
            if jacobian.determinant() <= 0.0 || miss.length() < 1e-15 {
                break;
            }
            let step = jacobian.inverse() * miss;
            let nearer = (0..30)
                .map(|k| x - step * 0.5f64.powi(k))
                .find(|x| (self.distort(*x) - y).length() < miss.length());
            let Some(next) = nearer else { break };
            (x, miss) = (next, self.distort(next) - y);
        }
        x
    }

    /// Pixel position of a world point in the distorted photo of a camera.
    pub fn project(&self, camera: &Camera, world: DVec3) -> DVec2 {
        let t = camera.pose.transform(world);
        let d = self.distort(t.truncate() / t.z);
        DVec2::new(camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy)
    }

    /// Camera-frame ray with z = 1 through a pixel position of the distorted photo.
    pub fn ray(&self, camera: &Camera, pixel: DVec2) -> DVec3 {
        self.undistort(camera.ray(pixel).truncate()).extend(1.0)
    }

    /// Whether radial distortion grows with the radius up to `radius` (normalised); beyond a fold
    /// it cannot be inverted.
    pub fn is_invertible_to(&self, radius: f64) -> bool {
        // The derivative is a quadratic in r²; its minimum between 0 and the end lies at an end or
        // at the vertex.
        let slope = |r2: f64| 1.0 + r2 * (3.0 * self.k1 + 5.0 * r2 * self.k2);
        let end = radius * radius;
        let vertex = if self.k2 == 0.0 { end } else { -0.3 * self.k1 / self.k2 };
        slope(end) > 0.0 && (!(0.0..end).contains(&vertex) || slope(vertex) > 0.0)
    }

    /// Whether the distortion is one-to-one within the image of a pinhole: nowhere between the
    /// principal point and the edges does it fold back or change its sign.
    pub fn is_invertible_in(&self, camera: &Camera) -> bool {
        // Samples on each edge, and between the principal point and each of them. A fold between
        // two samples spans less than a hundredth of the image.
        const STEPS: u32 = 64;
        let (w, h) = (f64::from(camera.width), f64::from(camera.height));
        let share = |k: u32| f64::from(k) / f64::from(STEPS);
        let edges = (0..STEPS).flat_map(|k| {
            let (u, v) = (w * share(k), h * share(k));
            [(u, 0.0), (w, v), (w - u, h), (0.0, h - v)].map(|(x, y)| DVec2::new(x, y))
        });
        self.is_none()
            || edges.into_iter().all(|pixel| {
                let end = camera.ray(pixel).truncate();
                (1..=STEPS).map(share).all(|t| {
                    let (scale, _) = self.scale((end * t).length_squared());
                    scale > 0.0 && scale.is_finite() && self.jacobian(end * t).determinant() > 0.0
                })
            })
    }

    /// Distortion of the image turned by `quarters` quarter turns clockwise.
    pub fn turned(&self, quarters: u8) -> Lens {
        // q turns with the image: (x, y) → (−y, x).
        (0..quarters % 4).fold(*self, |lens, _| Lens { p2: -lens.p1, p1: lens.p2, ..lens })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENSES: [Lens; 7] = [
        Lens::radial(-0.12, 0.03),
        Lens::radial(0.06, -0.02),
        Lens::radial(-0.25, 0.08),
        Lens::radial(0.2, 0.0),
        Lens { p1: 0.004, p2: -0.003, ..Lens::radial(-0.1, 0.02) },
        Lens { k3: -0.01, k4: 0.1, k5: -0.02, k6: 0.003, p1: 0.001, ..Lens::radial(0.05, 0.01) },
        Lens { k3: 0.001, k4: -0.0005, fisheye: true, ..Lens::radial(0.02, -0.004) },
    ];

    /// A camera of 640 × 480 pixels.
    fn camera(focal: f64) -> Camera {
        Camera {
            name: String::new(),
            width: 640,
            height: 480,
            fx: focal,
            fy: focal,
            cx: 320.0,
            cy: 240.0,
            pose: crate::scene::Pose::IDENTITY,
        }
    }

    #[test]
    fn undistort_inverts_distort() {
        for lens in LENSES {
            for k in 0..60 {
                let x = DVec2::from_angle(0.7 * k as f64) * (k as f64 / 60.0 * 0.8);
                assert!(!lens.is_radial() || lens.is_invertible_to(0.8));
                assert!((lens.undistort(lens.distort(x)) - x).length() < 1e-12, "{lens:?} {x}");
            }
        }
    }

    #[test]
    fn jacobian_is_derivative() {
        for lens in LENSES {
            let x = DVec2::new(0.31, -0.42);
            for (axis, column) in [(DVec2::X, 0), (DVec2::Y, 1)] {
                let h = 1e-6;
                let numeric = (lens.distort(x + axis * h) - lens.distort(x - axis * h)) / (2.0 * h);
                assert!((numeric - lens.jacobian(x).col(column)).length() < 1e-9);
            }
        }
    }

    /// The expected values are those of pycolmap 4.2.1 (`Camera.img_from_cam`).
    #[test]
    fn positions_agree_with_colmap() {
        let opencv = Lens { p1: 0.004, p2: -0.003, ..Lens::radial(-0.11, 0.03) };
        let rational = Lens {
            k3: -0.01,
            k4: 0.1,
            k5: -0.02,
            k6: 0.003,
            p1: 0.001,
            p2: -0.002,
            ..Lens::radial(0.05, 0.01)
        };
        let fisheye = Lens { k3: 0.001, k4: -0.0005, fisheye: true, ..Lens::radial(0.02, -0.004) };
        let plain = Lens { fisheye: true, ..Lens::NONE };
        for (lens, first, second) in [
            (opencv, [0.29896263, -0.40506373], [0.57310061, 0.24101005]),
            (rational, [0.30528649, -0.41407984], [0.58834121, 0.24591676]),
            (fisheye, [0.28696943, -0.38879729], [0.53535502, 0.22306459]),
            (plain, [0.28570493, -0.38708409], [0.53203867, 0.22168278]),
        ] {
            for (x, expected) in [([0.31, -0.42], first), ([0.6, 0.25], second)] {
                let off = lens.distort(DVec2::from_array(x)) - DVec2::from_array(expected);
                assert!(off.length() < 1e-8, "{lens:?} at {x:?}: off by {off}");
            }
        }
    }

    #[test]
    fn lens_turns_with_picture() {
        for lens in LENSES {
            let x = DVec2::new(0.31, -0.42);
            let turn = |x: DVec2| DVec2::new(-x.y, x.x);
            assert!((lens.turned(1).distort(turn(x)) - turn(lens.distort(x))).length() < 1e-15);
            assert_eq!(lens.turned(4), lens);
        }
    }

    #[test]
    fn fold_within_image_is_not_invertible() {
        // The corner is at r = 400/f, the fold of k1 = −0.5 at 0.816.
        assert!(Lens::radial(-0.5, 0.0).is_invertible_in(&camera(500.0)));
        assert!(!Lens::radial(-0.5, 0.0).is_invertible_in(&camera(480.0)));
        assert!(Lens { fisheye: true, ..Lens::NONE }.is_invertible_in(&camera(100.0)));
        // A denominator that vanishes within the image, and tangential terms that fold one side.
        assert!(!Lens { k4: -2.0, ..Lens::NONE }.is_invertible_in(&camera(400.0)));
        assert!(!Lens { p2: 0.3, ..Lens::NONE }.is_invertible_in(&camera(400.0)));
    }

    #[test]
    fn undistort_beyond_fold_is_finite() {
        let fold = Lens::radial(-0.5, 0.0);
        // d(r − r³/2)/dr = 0 at r = 0.816.
        assert!(fold.is_invertible_to(0.81) && !fold.is_invertible_to(0.82));
        assert!(fold.undistort(DVec2::new(2.0, 0.0)).is_finite());
        // Grows to r² = 0.5, shrinks to 1, grows again.
        assert!(!Lens::radial(-1.0, 0.4).is_invertible_to(1.5));
    }
}
