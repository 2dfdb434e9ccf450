//! Camera paths that show a scene between its photos and beside them.
use super::{Camera, Pose};
use glam::{DMat3, DQuat, DVec3};

/// Number of views between two photos that are neighbours.
const BETWEEN: usize = 3;

/// Name of a view beside the photos, and its displacement: degrees to the right, degrees upwards,
/// factor of the distance.
type Beside = (&'static str, [f64; 3]);

/// Views beside the leftmost photo, beside the rightmost one, and around the middle one.
const LEFT: [Beside; 2] = [("left_20", [-20.0, 0.0, 1.0]), ("left_10", [-10.0, 0.0, 1.0])];
const RIGHT: [Beside; 2] = [("right_10", [10.0, 0.0, 1.0]), ("right_20", [20.0, 0.0, 1.0])];
const MIDDLE: [Beside; 4] = [
    ("above_15", [0.0, 15.0, 1.0]),
    ("below_10", [0.0, -10.0, 1.0]),
    ("nearer", [0.0, 0.0, 0.7]),
    ("further", [0.0, 0.0, 1.4]),
];

/// The photos of a scene about the point that they look at.
///
/// ```
/// use glam::{DMat3, DVec3};
/// use splatvk_types::scene::{Camera, CameraOrbit, Pose};
///
/// let camera = |name: &str, x: f64| Camera {
///     name: name.into(),
///     width: 64,
///     height: 48,
///     fx: 60.0,
///     fy: 60.0,
///     cx: 32.0,
///     cy: 24.0,
///     pose: Pose { rotation: DMat3::IDENTITY, translation: DVec3::new(-x, 0.0, 0.0) },
/// };
/// // Two photos side by side that show a point three units in front of them.
/// let photos = [camera("b", 0.5), camera("a", -0.5)];
/// let orbit = CameraOrbit::new(&photos, DVec3::new(0.0, 0.0, 3.0), -DVec3::Y);
/// assert_eq!(orbit.beyond().len(), 8);
/// let names: Vec<_> = orbit.between().into_iter().map(|c| c.name).collect();
/// assert_eq!(names, ["a", "a_b_1", "a_b_2", "a_b_3", "b"]);
/// ```
#[derive(Clone, Debug)]
pub struct CameraOrbit {
    /// From left to right.
    photos: Vec<Camera>,
    /// Index of the photo whose azimuth is nearest to the middle of the others.
    middle: usize,
    target: DVec3,
    up: DVec3,
}

impl CameraOrbit {
    /// Orders photos from left to right about the `target`; `up` is a unit vector.
    pub fn new(photos: &[Camera], target: DVec3, up: DVec3) -> CameraOrbit {
        let offsets: Vec<DVec3> = photos.iter().map(|c| c.pose.centre() - target).collect();
        let horizontal = |v: DVec3| v - up * v.dot(up);
        // Azimuths are relative to the mean direction: the gap behind the photos is at ±180°.
        let mean = offsets.iter().map(|o| horizontal(*o).normalize_or_zero()).sum::<DVec3>();
        let front = if mean.length() > 1e-6 {
            mean.normalize()
        } else {
            horizontal(offsets.first().copied().unwrap_or(DVec3::Z)).normalize_or(up.any_orthonormal_vector())
        };
        let azimuth = |o: DVec3| up.cross(front).dot(o).atan2(front.dot(o));
        let mut order: Vec<(f64, &Camera)> = offsets.iter().map(|o| azimuth(*o)).zip(photos).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));
        let distance = |(_, (azimuth, _)): &(usize, &(f64, &Camera))| azimuth.abs();
        let nearest = order.iter().enumerate().min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let middle = nearest.map_or(0, |(k, _)| k);
        CameraOrbit { photos: order.into_iter().map(|(_, c)| c.clone()).collect(), middle, target, up }
    }

    /// The point that the photos look at.
    pub fn target(&self) -> DVec3 {
        self.target
    }

    /// Unit vector up.
    pub fn up(&self) -> DVec3 {
        self.up
    }

    /// Mean of the directions that are up in the images of cameras; not of unit length.
    pub fn mean_up(cameras: &[Camera]) -> DVec3 {
        cameras.iter().map(|c| -c.pose.rotation.row(1)).sum()
    }

    /// The cameras of the photos from left to right, with three views between neighbours.
    pub fn between(&self) -> Vec<Camera> {
        let mut out = Vec::new();
        for pair in self.photos.windows(2) {
            out.push(pair[0].clone());
            out.extend((1..=BETWEEN).map(|k| Camera {
                name: format!("{}_{}_{k}", pair[0].name, pair[1].name),
                ..self.interpolated(&pair[0], &pair[1], k as f64 / (BETWEEN + 1) as f64)
            }));
        }
        out.extend(self.photos.last().cloned());
        out
    }

    /// Views beside the photos: 20° and 10° to the left of the leftmost one and to the right of the
    /// rightmost one; 15° above the middle one, 10° below it, at 0.7 and 1.4 of its distance.
    pub fn beyond(&self) -> Vec<Camera> {
        let (Some(first), Some(last)) = (self.photos.first(), self.photos.last()) else { return Vec::new() };
        let rows: [(&Camera, &[Beside]); 3] =
            [(first, &LEFT), (last, &RIGHT), (&self.photos[self.middle], &MIDDLE)];
        let views = rows.into_iter().flat_map(|(camera, list)| list.iter().map(move |v| (camera, v)));
        views
            .map(|(camera, (name, [azimuth, elevation, distance]))| Camera {
                name: (*name).into(),
                ..self.displaced(camera, *azimuth, *elevation, *distance)
            })
            .collect()
    }

    /// Cameras of a video from left to right through all photos, with `per_segment` frames from
    /// each photo to the next. With `beyond` it starts 20° to the left of the photos, ends 20° to
    /// the right, and then shows the other views of [`CameraOrbit::beyond`]. All frames have the
    /// size of the first photo.
    pub fn video(&self, beyond: bool, per_segment: usize) -> Vec<Camera> {
        let Some(first) = self.photos.first() else { return Vec::new() };
        let mut stops = self.photos.clone();
        if let ([left, _, _, right, above, below, nearer, further], true) = (&self.beyond()[..], beyond) {
            let middle = &self.photos[self.middle];
            stops.insert(0, left.clone());
            stops.extend([right, middle, above, middle, below, middle, nearer, further].map(Camera::clone));
        }
        for stop in &mut stops {
            let scale = f64::from(first.width) / f64::from(stop.width);
            (stop.fx, stop.fy) = (stop.fx * scale, stop.fy * scale);
            (stop.width, stop.height, stop.cx, stop.cy) = (first.width, first.height, first.cx, first.cy);
        }
        let segments = stops.windows(2);
        let frames = segments.flat_map(|pair| {
            let share = |k: usize| k as f64 / per_segment as f64;
            (0..per_segment).map(move |k| self.interpolated(&pair[0], &pair[1], share(k)))
        });
        frames.chain(stops.last().cloned()).collect()
    }

    /// Camera that turns about the target from `a` (share 0) to `b` (share 1), with the image size
    /// of `a`.
    fn interpolated(&self, a: &Camera, b: &Camera, share: f64) -> Camera {
        let mix = |x: f64, y: f64| x + (y - x) * share;
        let [from, to] = [a, b].map(|c| c.pose.centre() - self.target);
        let turn = DQuat::from_rotation_arc(from.normalize_or(DVec3::Z), to.normalize_or(DVec3::Z));
        let direction = DQuat::IDENTITY.slerp(turn, share) * from.normalize_or(DVec3::Z);
        let centre = self.target + direction * mix(from.length(), to.length());
        let [ra, rb] = [a, b].map(|c| DQuat::from_mat3(&c.pose.rotation));
        let rotation = DMat3::from_quat(ra.slerp(rb, share).normalize());
        // Intrinsics in units of the width, since photos may differ in size.
        let [scale_a, scale_b] = [a, b].map(|c| f64::from(a.width) / f64::from(c.width));
        Camera {
            name: a.name.clone(),
            width: a.width,
            height: a.height,
            fx: mix(a.fx * scale_a, b.fx * scale_b),
            fy: mix(a.fy * scale_a, b.fy * scale_b),
            cx: a.cx,
            cy: a.cy,
            pose: Pose { rotation, translation: -(rotation * centre) },
        }
    }

    /// A camera turned about the target: `azimuth` degrees to the right of a person who looks at
    /// it, `elevation` degrees upwards, at a factor of the distance.
    pub fn displaced(&self, camera: &Camera, azimuth: f64, elevation: f64, distance: f64) -> Camera {
        let offset = camera.pose.centre() - self.target;
        let right = self.up.cross(offset).normalize_or(self.up.any_orthonormal_vector());
        let turn = DQuat::from_axis_angle(self.up, azimuth.to_radians())
            * DQuat::from_axis_angle(right, -elevation.to_radians());
        let rotation = camera.pose.rotation * DMat3::from_quat(turn.inverse());
        let centre = self.target + turn * offset * distance;
        Camera { pose: Pose { rotation, translation: -(rotation * centre) }, ..camera.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TARGET: DVec3 = DVec3::new(0.4, -0.2, 1.0);

    /// A camera at an azimuth (degrees, positive to the right as seen from it) and elevation about
    /// the target that looks at it.
    fn camera(name: &str, azimuth: f64, elevation: f64) -> Camera {
        let (a, e) = (azimuth.to_radians(), elevation.to_radians());
        // World: y down, so up is −y. A camera at azimuth 0 is at −z.
        let offset = DVec3::new(a.sin() * e.cos(), -e.sin(), -a.cos() * e.cos()) * 2.0;
        let forward = -offset.normalize();
        let right = DVec3::Y.cross(forward).normalize();
        let down = forward.cross(right);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        let pose = Pose { rotation, translation: -(rotation * (TARGET + offset)) };
        Camera { name: name.into(), width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0, pose }
    }

    /// Angle between two directions from the target, degrees.
    fn angle(a: &Camera, b: &Camera) -> f64 {
        (a.pose.centre() - TARGET).angle_between(b.pose.centre() - TARGET).to_degrees()
    }

    #[test]
    fn views_beyond_keep_target_centred() {
        let photos = [camera("m", 2.0, 20.0), camera("r", 30.0, 20.0), camera("l", -25.0, 20.0)];
        let orbit = CameraOrbit::new(&photos, TARGET, -DVec3::Y);
        let order: Vec<&str> = orbit.photos.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(order, ["l", "m", "r"]);
        let views = orbit.beyond();
        for view in &views {
            let (pixel, depth) = view.project(TARGET);
            assert!((pixel - glam::DVec2::new(32.0, 24.0)).length() < 1e-9 && depth > 0.0, "{view:?}");
            assert!((view.pose.rotation.determinant() - 1.0).abs() < 1e-12);
        }
        let expected = [
            ("left_20", camera("", -45.0, 20.0)),
            ("left_10", camera("", -35.0, 20.0)),
            ("right_10", camera("", 40.0, 20.0)),
            ("right_20", camera("", 50.0, 20.0)),
            ("above_15", camera("", 2.0, 35.0)),
            ("below_10", camera("", 2.0, 10.0)),
        ];
        for (view, (name, place)) in views.iter().zip(&expected) {
            assert_eq!(view.name, *name);
            assert!((view.pose.centre() - place.pose.centre()).length() < 1e-9, "{name}");
            assert!(
                (view.pose.rotation - place.pose.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-9)
            );
        }
        assert!((views[6].pose.centre().distance(TARGET) - 1.4).abs() < 1e-9);
        assert!((views[7].pose.centre().distance(TARGET) - 2.8).abs() < 1e-9);
    }

    #[test]
    fn views_between_divide_the_angle() {
        let photos = [camera("l", -30.0, 0.0), camera("r", 30.0, 0.0)];
        let orbit = CameraOrbit::new(&photos, TARGET, -DVec3::Y);
        let views = orbit.between();
        let names: Vec<&str> = views.iter().map(|v| v.name.as_str()).collect();
        assert_eq!(names, ["l", "l_r_1", "l_r_2", "l_r_3", "r"]);
        for (k, view) in views.iter().enumerate() {
            assert!((angle(view, &photos[0]) - 15.0 * k as f64).abs() < 1e-6);
            assert!((view.project(TARGET).0 - glam::DVec2::new(32.0, 24.0)).length() < 1e-9);
        }
    }

    #[test]
    fn video_passes_all_stops() {
        let photos = [camera("l", -30.0, 0.0), camera("r", 30.0, 0.0)];
        let orbit = CameraOrbit::new(&photos, TARGET, -DVec3::Y);
        assert_eq!(orbit.video(false, 10).len(), 11);
        let video = orbit.video(true, 10);
        // Left, two photos, right, middle, above, middle, below, middle, nearer, further.
        assert_eq!(video.len(), 101);
        assert!((angle(&video[0], &video[30]) - 100.0).abs() < 1e-6);
        let steps = video.windows(2).map(|p| p[0].pose.centre().distance(p[1].pose.centre()));
        assert!(steps.fold(0.0, f64::max) < 0.3);
    }

    #[test]
    fn photos_around_target_stay_in_order() {
        let photos: Vec<Camera> = (0..6).map(|k| camera(&k.to_string(), 60.0 * f64::from(k), 10.0)).collect();
        let orbit = CameraOrbit::new(&photos, TARGET, -DVec3::Y);
        let steps: Vec<f64> = orbit.photos.windows(2).map(|p| angle(&p[0], &p[1])).collect();
        assert!(steps.iter().all(|s| (s - steps[0]).abs() < 1e-6), "{steps:?}");
    }
}
