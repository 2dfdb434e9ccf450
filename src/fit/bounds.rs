//! Bounds on the position and size of splats (docs/internals/method.md#bounds): a splat at a camera
//! hides its whole photo, and once it is opaque no gradient reaches the splats behind it.
use super::model::Model;
use crate::Result;
use crate::math::quantile;
use crate::scene::{Camera, Splats};
use glam::DVec3;
use rayon::prelude::*;

/// Largest standard deviation of a splat over its distance to the nearest camera. Three standard
/// deviations are then less than half of that distance, within which the affine approximation of
/// the projection holds.
const LARGEST: f64 = 0.15;
/// Least depth of splats in a view, as a share of the 0.001 quantile of the depths of its points.
const NEAREST: f64 = 0.5;
/// Points per view of which the quantile is taken.
const SAMPLES: usize = 20_000;

/// Bounds of splats before the cameras.
pub(super) struct Bounds {
    cameras: Vec<Camera>,
    /// Per camera the least depth inside its image, world units.
    nearest: Vec<f64>,
}

impl Bounds {
    /// Bounds from cameras and positions on surfaces.
    pub(super) fn new(cameras: &[Camera], positions: &[[f32; 3]]) -> Bounds {
        let stride = positions.len().div_ceil(SAMPLES).max(1);
        let nearest = |camera: &Camera| {
            let shown = positions.iter().step_by(stride).filter_map(|p| depth_inside(camera, position(p)));
            NEAREST * quantile(&mut shown.collect::<Vec<f64>>(), 0.001).unwrap_or(0.0)
        };
        Bounds { cameras: cameras.to_vec(), nearest: cameras.iter().map(nearest).collect() }
    }

    /// True where a splat is nearer than all surfaces of a photo.
    fn too_near(&self, p: DVec3) -> bool {
        let mut views = self.cameras.iter().zip(&self.nearest);
        views.any(|(camera, nearest)| depth_inside(camera, p).is_some_and(|z| z < *nearest))
    }

    /// Logarithm of the largest standard deviation at a position.
    fn largest(&self, p: DVec3) -> f32 {
        let distances = self.cameras.iter().map(|c| c.pose.centre().distance(p));
        // Without a camera there is no bound; at a camera the bound is near zero.
        (LARGEST * distances.fold(f64::INFINITY, f64::min)).max(1e-12).ln() as f32
    }

    /// Shortens the scales of one splat to the bound and to `most`; returns whether any was too
    /// large.
    fn shorten(&self, mean: &[f32; 3], log_scales: &mut [f32], most: f32) -> bool {
        let largest = self.largest(position(mean)).min(most);
        let mut changed = false;
        for s in log_scales.iter_mut().filter(|s| **s > largest) {
            (*s, changed) = (largest, true);
        }
        changed
    }

    /// Removes splats that are too near and shortens those that are too large.
    pub(super) fn clamp_to_bounds(&self, splats: Splats) -> Splats {
        let is_far = |i: &usize| !self.too_near(position(&splats.means[*i]));
        let rows: Vec<usize> = (0..splats.len()).into_par_iter().filter(is_far).collect();
        let mut splats = splats.picked(&rows);
        splats.means.par_iter().zip(&mut splats.log_scales).for_each(|(mean, scales)| {
            self.shorten(mean, scales, f32::INFINITY);
        });
        splats
    }

    /// [`Bounds::clamp_to_bounds`] for splats in training; those that no photo shows do not grow.
    /// Returns whether splats were removed, which makes recordings of steps invalid.
    pub(super) fn clamp_model_to_bounds(&self, model: &mut Model) -> Result<bool> {
        let means = model.values.means.read()?;
        let mut scales = model.values.log_scales.read()?;
        let splats = || means.par_chunks_exact(3).map(|m| [m[0], m[1], m[2]]);
        let shortened = splats().zip(scales.par_chunks_exact_mut(3));
        let most = |row: usize| {
            let unseen = row.checked_sub(model.first_unseen());
            unseen.map_or(f32::INFINITY, |unseen| model.unseen[unseen])
        };
        let changed = shortened
            .enumerate()
            .map(|(row, (mean, scales))| self.shorten(&mean, scales, most(row)))
            .reduce(|| false, |a, b| a | b);
        if changed {
            model.values.log_scales.write(&scales)?;
        }
        let far = splats().enumerate().filter(|(_, mean)| !self.too_near(position(mean)));
        model.keep(&far.map(|(row, _)| row as u32).collect::<Vec<u32>>())
    }
}

/// Position in f64.
fn position(p: &[f32; 3]) -> DVec3 {
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

    /// Splats of (mean, standard deviation along the first axis).
    fn splats(rows: &[([f32; 3], f32)]) -> Splats {
        let n = rows.len();
        Splats {
            means: rows.iter().map(|s| s.0).collect(),
            log_scales: rows.iter().map(|s| [s.1.ln(), -9.0, -9.0]).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: vec![0.0; n],
            sh: vec![0.0; 3 * n],
            sh_degree: 0,
            antialiased: false,
        }
    }

    /// Bounds of a wall two units away.
    fn bounds() -> Bounds {
        let wall: Vec<[f32; 3]> =
            (0..1600).map(|i| [(i % 40) as f32 * 0.1 - 1.95, (i / 40) as f32 * 0.07 - 1.4, 2.0]).collect();
        Bounds::new(&[camera()], &wall)
    }

    #[test]
    fn clamping_removes_near_shrinks_large_splats() {
        let given = splats(&[
            ([0.0, 0.0, 0.9], 0.01),  // before the wall, nearer than half of it
            ([0.0, 0.0, 1.1], 0.01),  // before the wall
            ([0.9, 0.0, 0.15], 0.83), // beside the camera: the veil of a photo
            ([0.0, 0.0, 2.0], 0.4),   // 11° of the photo: too large
            ([3.0, 0.0, -4.0], 0.7),  // behind the camera, small for its distance
        ]);
        let clamped = bounds().clamp_to_bounds(given);
        assert_eq!(clamped.means, [[0.0, 0.0, 1.1], [0.9, 0.0, 0.15], [0.0, 0.0, 2.0], [3.0, 0.0, -4.0]]);
        let sizes: Vec<f32> = clamped.log_scales.iter().map(|s| s[0].exp()).collect();
        let expected = [0.01, 0.15 * 0.9f32.hypot(0.15), 0.3, 0.7];
        assert!(sizes.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{sizes:?}");
        assert!(clamped.log_scales.iter().all(|s| s[1..] == [-9.0; 2]), "other axes stay");
    }

    #[test]
    fn clamp_model_matches_clamped_splats() {
        let device = crate::gpu::test_device();
        let given = splats(&[([0.0, 0.0, 0.9], 0.01), ([0.9, 0.0, 0.15], 0.83), ([0.0, 0.0, 2.0], 0.2)]);
        let mut model = Model::new(&device, &given, 0).unwrap();
        assert!(bounds().clamp_model_to_bounds(&mut model).unwrap());
        assert_eq!(model.splats().unwrap(), bounds().clamp_to_bounds(given));
        assert!(!bounds().clamp_model_to_bounds(&mut model).unwrap(), "once is enough");
    }

    #[test]
    fn splats_that_no_photo_shows_do_not_grow() {
        let device = crate::gpu::test_device();
        let given = splats(&[([0.0, 0.0, 2.0], 0.2), ([0.0, 0.0, 0.9], 0.01), ([0.5, 0.0, 2.0], 0.2)]);
        let mut model = Model::new(&device, &given, 0).unwrap();
        model.unseen = [0.01f32, 0.1].map(f32::ln).into();
        assert!(bounds().clamp_model_to_bounds(&mut model).unwrap(), "the second is too near");
        let sizes: Vec<f32> = model.splats().unwrap().log_scales.iter().map(|s| s[0].exp()).collect();
        assert!((sizes[0] - 0.2).abs() < 1e-6 && (sizes[1] - 0.1).abs() < 1e-6, "{sizes:?}");
        assert_eq!(model.unseen, [0.1f32.ln()], "the rest keeps its sizes");
        let restored = Model::restored(&device, &model.state().unwrap()).unwrap();
        assert_eq!(restored.unseen, model.unseen);
    }

    #[test]
    fn bounds_without_points_limit_sizes_only() {
        let clamped = Bounds::new(&[camera()], &[]).clamp_to_bounds(splats(&[([0.0, 0.0, 0.1], 1.0)]));
        assert!((clamped.log_scales[0][0].exp() - 0.015).abs() < 1e-6);
    }
}
