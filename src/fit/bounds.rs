//! Where splats may be and how large (docs/internals/method.md#bounds): a splat at a camera hides
//! its whole photo, and once it is opaque no gradient reaches what it hides.
use super::model::Model;
use crate::Result;
use crate::math::quantile;
use crate::scene::{Camera, Splats};
use glam::DVec3;

/// Largest standard deviation of a splat over its distance to the nearest camera. Three of them are
/// then less than half of that distance: as far as the projection of splats, which is affine about
/// their middle, is to be trusted.
const LARGEST: f64 = 0.15;
/// Nothing stands nearer to a camera than this share of the depth that all but one in a thousand of
/// the points it shows have.
const NEAREST: f64 = 0.5;
/// Points per view that the nearest are sought among.
const SAMPLES: usize = 20_000;

/// The room that the cameras leave to splats.
pub(super) struct Bounds {
    cameras: Vec<Camera>,
    /// Per camera the least depth inside its image, world units.
    nearest: Vec<f64>,
}

impl Bounds {
    /// Of cameras, and the positions that surfaces have.
    pub(super) fn new(cameras: &[Camera], positions: &[[f32; 3]]) -> Bounds {
        let stride = positions.len().div_ceil(SAMPLES).max(1);
        let nearest = |camera: &Camera| {
            let shown = positions.iter().step_by(stride).filter_map(|p| depth_inside(camera, place(p)));
            NEAREST * quantile(&mut shown.collect::<Vec<f64>>(), 0.001).unwrap_or(0.0)
        };
        Bounds { cameras: cameras.to_vec(), nearest: cameras.iter().map(nearest).collect() }
    }

    /// True where a splat would stand before everything that a photo shows.
    fn too_near(&self, p: DVec3) -> bool {
        let mut views = self.cameras.iter().zip(&self.nearest);
        views.any(|(camera, nearest)| depth_inside(camera, p).is_some_and(|z| z < *nearest))
    }

    /// Logarithm of the largest standard deviation at a position.
    fn largest(&self, p: DVec3) -> f32 {
        let distances = self.cameras.iter().map(|c| c.pose.centre().distance(p));
        // Without a camera there is no bound, and at one there is no size.
        (LARGEST * distances.fold(f64::INFINITY, f64::min)).max(1e-12).ln() as f32
    }

    /// Shortens the scales of one splat; whether it had to.
    fn shorten(&self, mean: &[f32; 3], log_scales: &mut [f32]) -> bool {
        let largest = self.largest(place(mean));
        let mut changed = false;
        for s in log_scales.iter_mut().filter(|s| **s > largest) {
            (*s, changed) = (largest, true);
        }
        changed
    }

    /// The splats that stand where they may, none larger than it may be.
    pub(super) fn hold(&self, splats: Splats) -> Splats {
        let mut splats = splats.picked(
            &(0..splats.len()).filter(|i| !self.too_near(place(&splats.means[*i]))).collect::<Vec<_>>(),
        );
        for (mean, scales) in splats.means.iter().zip(&mut splats.log_scales) {
            self.shorten(mean, scales);
        }
        splats
    }

    /// The same for splats in training. Whether splats went: recordings of steps then are out of
    /// date.
    pub(super) fn hold_model(&self, model: &mut Model) -> Result<bool> {
        let means = model.values.means.read()?;
        let mut scales = model.values.log_scales.read()?;
        let splats = || means.chunks_exact(3).map(|m| [m[0], m[1], m[2]]);
        let mut changed = false;
        for (mean, scales) in splats().zip(scales.chunks_exact_mut(3)) {
            changed |= self.shorten(&mean, scales);
        }
        if changed {
            model.values.log_scales.write(&scales)?;
        }
        let rows = splats().zip(0..).filter(|(mean, _)| !self.too_near(place(mean)));
        model.keep(&rows.map(|(_, row)| row).collect::<Vec<u32>>())
    }
}

fn place(p: &[f32; 3]) -> DVec3 {
    DVec3::from(p.map(f64::from))
}

/// Camera z of a position inside the image.
fn depth_inside(camera: &Camera, p: DVec3) -> Option<f64> {
    let (pixel, z) = camera.project(p);
    let inside = |v: f64, size: u32| (0.0..f64::from(size)).contains(&v);
    (z > 0.0 && inside(pixel.x, camera.width) && inside(pixel.y, camera.height)).then_some(z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    /// At the origin, looking along z; 100 × 80 pixels, 90° across.
    fn camera() -> Camera {
        Camera {
            name: String::new(),
            width: 100,
            height: 80,
            fx: 50.0,
            fy: 50.0,
            cx: 50.0,
            cy: 40.0,
            pose: Pose::IDENTITY,
        }
    }

    fn splats(of: &[([f32; 3], f32)]) -> Splats {
        let n = of.len();
        Splats {
            means: of.iter().map(|s| s.0).collect(),
            log_scales: of.iter().map(|s| [s.1.ln(), -9.0, -9.0]).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: vec![0.0; n],
            sh: vec![0.0; 3 * n],
            sh_degree: 0,
            antialiased: false,
        }
    }

    /// A wall two units away.
    fn bounds() -> Bounds {
        let wall: Vec<[f32; 3]> =
            (0..1600).map(|i| [(i % 40) as f32 * 0.1 - 1.95, (i / 40) as f32 * 0.07 - 1.4, 2.0]).collect();
        Bounds::new(&[camera()], &wall)
    }

    #[test]
    fn splats_before_everything_go_and_large_ones_shrink() {
        let given = splats(&[
            ([0.0, 0.0, 0.9], 0.01),  // before the wall, nearer than half of it
            ([0.0, 0.0, 1.1], 0.01),  // before the wall
            ([0.9, 0.0, 0.15], 0.83), // beside the camera: the veil of a photo
            ([0.0, 0.0, 2.0], 0.4),   // 11° of the photo: too large
            ([3.0, 0.0, -4.0], 0.7),  // behind the camera, small for its distance
        ]);
        let held = bounds().hold(given);
        assert_eq!(held.means, [[0.0, 0.0, 1.1], [0.9, 0.0, 0.15], [0.0, 0.0, 2.0], [3.0, 0.0, -4.0]]);
        let sizes: Vec<f32> = held.log_scales.iter().map(|s| s[0].exp()).collect();
        let expected = [0.01, 0.15 * 0.9f32.hypot(0.15), 0.3, 0.7];
        assert!(sizes.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{sizes:?}");
        assert!(held.log_scales.iter().all(|s| s[1..] == [-9.0; 2]), "other axes stay");
    }

    #[test]
    fn a_model_is_held_like_its_splats() {
        let device = crate::gpu::test_device();
        let given = splats(&[([0.0, 0.0, 0.9], 0.01), ([0.9, 0.0, 0.15], 0.83), ([0.0, 0.0, 2.0], 0.2)]);
        let mut model = Model::new(&device, &given, 0).unwrap();
        assert!(bounds().hold_model(&mut model).unwrap());
        assert_eq!(model.splats().unwrap(), bounds().hold(given));
        assert!(!bounds().hold_model(&mut model).unwrap(), "once is enough");
    }

    #[test]
    fn cameras_that_show_nothing_bound_sizes_only() {
        let held = Bounds::new(&[camera()], &[]).hold(splats(&[([0.0, 0.0, 0.1], 1.0)]));
        assert!((held.log_scales[0][0].exp() - 0.015).abs() < 1e-6);
    }
}
