//! Level paths around the middle of a scene.
use crate::scene::{Camera, Pose, Splats};
use glam::{DMat3, DVec3};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Largest gap between photos, seen from the middle, up to which they surround it.
const GAP: f64 = 75.0 * PI / 180.0;
/// Angle beyond the outermost photos: little comes into view that they do not show.
const BESIDE: f64 = 8.0 * PI / 180.0;
/// Steepest look downwards or upwards.
const STEEPEST: f64 = 75.0 * PI / 180.0;
/// Look downwards and field of view without photos.
const PITCH: f64 = 20.0 * PI / 180.0;
const FIELD: f64 = 45.0 * PI / 180.0;

/// A level circle, or a swing along a part of it.
#[derive(Clone, Debug)]
pub struct Orbit {
    target: DVec3,
    up: DVec3,
    /// Unit vector from the target towards the middle of the path, horizontal.
    front: DVec3,
    radius: f64,
    /// Angle above the horizon, radians.
    elevation: f64,
    /// Angle of the path, radians; a full turn is a circle.
    span: f64,
    /// Intrinsics and size.
    lens: Camera,
}

impl Orbit {
    /// Along photos: at their mean distance and height about the point that they look at, as far
    /// around as they are, and a little further. `span` replaces that angle, radians.
    pub fn of_photos(photos: &[Camera], target: DVec3, up: DVec3, span: Option<f64>) -> Option<Orbit> {
        let offsets: Vec<DVec3> = photos.iter().map(|c| c.pose.centre() - target).collect();
        let level = |v: &DVec3| *v - up * v.dot(up);
        let side = up.any_orthonormal_vector();
        let ahead = up.cross(side);
        let mut azimuths: Vec<f64> = offsets.iter().map(|o| ahead.dot(*o).atan2(side.dot(*o))).collect();
        azimuths.sort_by(f64::total_cmp);
        let last = *azimuths.last()?;
        // The gap after each photo, up to the next one around.
        let gaps = azimuths.iter().zip(azimuths.iter().skip(1).copied().chain([azimuths[0] + TAU]));
        let (gap, after) =
            gaps.map(|(a, b)| (b - a, b)).fold((0.0, last), |m, g| if g.0 > m.0 { g } else { m });
        let covered = TAU - gap;
        let own = if gap <= GAP { TAU } else { (covered + 2.0 * BESIDE).min(TAU) };
        let middle = after + covered / 2.0;
        let n = offsets.len() as f64;
        let elevation = offsets.iter().map(|o| o.dot(up).atan2(level(o).length())).sum::<f64>() / n;
        Some(Orbit {
            target,
            up,
            front: side * middle.cos() + ahead * middle.sin(),
            radius: offsets.iter().map(|o| o.length()).sum::<f64>() / n,
            elevation: elevation.clamp(-STEEPEST, STEEPEST),
            span: span.unwrap_or(own),
            lens: centred(photos.first()?),
        })
    }

    /// Around splats without photos: from outside, a little from above. The middle is the median of
    /// their centres, and a sphere with three quarters of them fills the picture of `size` (width,
    /// height).
    pub fn around(splats: &Splats, up: DVec3, span: Option<f64>, size: (u32, u32)) -> Option<Orbit> {
        let finite = |m: &&[f32; 3]| m.iter().all(|v| v.is_finite());
        let means: Vec<DVec3> =
            splats.means.iter().filter(finite).map(|m| DVec3::from(m.map(f64::from))).collect();
        let quantile = |share: f64, value: &dyn Fn(&DVec3) -> f64| {
            let mut values: Vec<f64> = means.iter().map(value).collect();
            values.sort_by(f64::total_cmp);
            values.get((share * values.len().saturating_sub(1) as f64) as usize).copied()
        };
        let [x, y, z] = [0, 1, 2].map(|k| quantile(0.5, &|m| m[k]));
        let target = DVec3::new(x?, y?, z?);
        let radius = quantile(0.75, &|m| m.distance(target))?.max(1e-6);
        // Files of Gaussians are seen along +z: from the side of −z.
        let back = -DVec3::Z;
        let front = (back - up * back.dot(up)).normalize_or(up.any_orthonormal_vector());
        let (width, height) = (f64::from(size.0), f64::from(size.1));
        let focal = height / 2.0 / (FIELD / 2.0).tan();
        let narrow = (width / height).min(1.0) * (FIELD / 2.0).tan();
        let lens = Camera {
            name: String::new(),
            width: size.0,
            height: size.1,
            fx: focal,
            fy: focal,
            cx: width / 2.0,
            cy: height / 2.0,
            pose: Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
        };
        let radius = radius / narrow.atan().sin();
        Some(Orbit { target, up, front, radius, elevation: PITCH, span: span.unwrap_or(TAU), lens })
    }

    /// Angle of the path, radians.
    pub fn span(&self) -> f64 {
        self.span
    }

    /// Cameras of a film that repeats without a jump: around, or to both ends of the swing.
    pub fn cameras(&self, frames: usize) -> Vec<Camera> {
        let share = |k: usize| k as f64 / frames.max(1) as f64;
        let angle = |k: usize| match self.span >= TAU - 1e-9 {
            true => TAU * share(k),
            false => self.span / 2.0 * (TAU * share(k)).sin(),
        };
        (0..frames).map(|k| Camera { name: format!("frame_{k:04}"), ..self.at(angle(k)) }).collect()
    }

    /// The level camera at an angle from the middle of the path that looks at the target.
    fn at(&self, angle: f64) -> Camera {
        let out = self.front * angle.cos() + self.up.cross(self.front) * angle.sin();
        let elevation = self.elevation.clamp(-FRAC_PI_2 + 0.1, FRAC_PI_2 - 0.1);
        let offset = (out * elevation.cos() + self.up * elevation.sin()) * self.radius;
        let forward = -offset.normalize();
        let right = forward.cross(self.up).normalize();
        let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
        let pose = Pose { rotation, translation: -(rotation * (self.target + offset)) };
        Camera { pose, ..self.lens.clone() }
    }
}

/// A camera with its principal point in the middle and even sides, as videos have them.
fn centred(camera: &Camera) -> Camera {
    let even = |side: u32| (side / 2 * 2).max(2);
    let (width, height) = (even(camera.width), even(camera.height));
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    Camera { width, height, cx, cy, ..camera.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::seeded;

    const UP: DVec3 = DVec3::new(0.0, -1.0, 0.0);
    const TARGET: DVec3 = DVec3::new(0.3, 0.1, 2.0);

    /// Photos at azimuths (degrees) around the target, 30° above it, at distance 2.
    fn photos(azimuths: &[f64]) -> Vec<Camera> {
        let lens = seeded::small(4, 65, 48, 0, 1).1;
        let at = |degrees: &f64| {
            let (a, e) = (degrees.to_radians(), PI / 6.0);
            let centre = TARGET + 2.0 * DVec3::new(a.sin() * e.cos(), -e.sin(), -a.cos() * e.cos());
            let pose = Pose { rotation: DMat3::IDENTITY, translation: -centre };
            Camera { pose, ..lens.clone() }
        };
        azimuths.iter().map(at).collect()
    }

    #[test]
    fn orbit_is_level_and_looks_at_the_middle() {
        let photos = photos(&[0.0, 72.0, 144.0, 216.0, 288.0]);
        let orbit = Orbit::of_photos(&photos, TARGET, UP, None).unwrap();
        assert_eq!(orbit.span(), TAU, "photos all around");
        let cameras = orbit.cameras(36);
        for camera in &cameras {
            let offset = camera.pose.centre() - TARGET;
            assert!((offset.length() - 2.0).abs() < 1e-9);
            assert!((offset.dot(UP) - 1.0).abs() < 1e-9, "30° above");
            assert!(camera.pose.rotation.row(0).dot(UP).abs() < 1e-12, "no roll");
            assert!(camera.pose.rotation.row(1).dot(UP) < 0.0, "upright");
            let (pixel, depth) = camera.project(TARGET);
            assert!((pixel - glam::DVec2::new(32.0, 24.0)).length() < 1e-9 && depth > 0.0);
            assert!((camera.pose.rotation.determinant() - 1.0).abs() < 1e-12);
        }
        let step = |a: &Camera, b: &Camera| a.pose.centre().distance(b.pose.centre());
        assert!((step(&cameras[35], &cameras[0]) - step(&cameras[0], &cameras[1])).abs() < 1e-9, "it closes");
    }

    #[test]
    fn swing_stays_near_the_photos() {
        // Across the azimuth where angles begin anew.
        for turn in [0.0, 90.0, 180.0, 270.0] {
            let photos = photos(&[turn - 20.0, turn, turn + 30.0]);
            let orbit = Orbit::of_photos(&photos, TARGET, UP, None).unwrap();
            assert!((orbit.span().to_degrees() - 66.0).abs() < 1e-9, "{}", orbit.span().to_degrees());
            let cameras = orbit.cameras(40);
            let flat = |c: &Camera| (c.pose.centre() - TARGET) * DVec3::new(1.0, 0.0, 1.0);
            let middle = flat(&photos[1]);
            let angles = cameras.iter().map(|c| flat(c).angle_between(middle).to_degrees());
            let most = angles.fold(0.0, f64::max);
            assert!((most - 38.0).abs() < 0.2, "8° beyond the photo at 30°: {most}");
            assert_eq!(Orbit::of_photos(&photos, TARGET, UP, Some(TAU)).unwrap().span(), TAU);
        }
        assert!(Orbit::of_photos(&[], TARGET, UP, None).is_none());
    }

    #[test]
    fn splats_without_photos_are_seen_from_outside() {
        let splats = seeded::small(200, 64, 48, 0, 3).0;
        let orbit = Orbit::around(&splats, UP, None, (640, 360)).unwrap();
        let cameras = orbit.cameras(12);
        for camera in &cameras {
            let inside = splats.means.iter().filter(|m| {
                let (pixel, depth) = camera.project(DVec3::from(m.map(f64::from)));
                depth > 0.0 && pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < 640.0 && pixel.y < 360.0
            });
            assert!(inside.count() >= 150);
        }
        assert!(Orbit::around(&Splats::default(), UP, None, (64, 48)).is_none());
    }
}
