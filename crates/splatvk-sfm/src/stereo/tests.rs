use super::*;
use crate::scene::Pose;
use glam::{DMat3, DVec2};
use splatvk_test_support::stereo::synthetic;

/// Size of the photos of [`camera_at`].
pub(super) const WIDTH: usize = 160;
pub(super) const HEIGHT: usize = 120;

/// A camera that looks along z, 72° across, moved to the right by `x`.
pub(super) fn camera_at(x: f64) -> Camera {
    Camera {
        name: x.to_string(),
        width: WIDTH as u32,
        height: HEIGHT as u32,
        fx: 110.0,
        fy: 110.0,
        cx: 80.0,
        cy: 60.0,
        pose: Pose { translation: DVec3::new(-x, 0.0, 0.0), ..Pose::IDENTITY },
    }
}

/// Centre of a pixel of these photos.
pub(super) fn pixel_centre(k: usize) -> DVec2 {
    DVec2::new((k % WIDTH) as f64 + 0.5, (k / WIDTH) as f64 + 0.5)
}

#[test]
fn pyramid_chooses_sources_at_best_angles() {
    // Seven cameras around the points at steps of 10°.
    let camera = |k: u32| Camera {
        name: k.to_string(),
        width: 64,
        height: 64,
        fx: 60.0,
        fy: 60.0,
        cx: 32.0,
        cy: 32.0,
        pose: Pose {
            rotation: DMat3::from_rotation_y((10.0 * f64::from(k)).to_radians()),
            translation: DVec3::new(0.0, 0.0, 4.0),
        },
    };
    let cameras: Vec<Camera> = (0..7).map(camera).collect();
    let images = vec![RgbImage { width: 64, height: 64, data: vec![[0.5; 3]; 64 * 64] }; 7];
    let sparse = [DVec3::ZERO, DVec3::X * 0.1, DVec3::Y * 0.1];
    let options = StereoOptions { sources: 3, ..StereoOptions::default() };
    let levels = pyramid(&images, &cameras, &sparse, &options).unwrap();
    let first = &levels[0].references[0];
    let sources = &levels[0].sources[first.first_source as usize..][..first.sources as usize];
    let chosen: Vec<u32> = sources.iter().map(|s| s.size[2] / (64 * 64)).collect();
    // 20°, 30° and 40°; 10° has too little parallax, the others show other sides.
    assert_eq!(chosen, [2, 3, 4]);
}

#[test]
fn depth_map_from_half_size_exact() {
    let set = synthetic(160, 120);
    // Three photos take 0.9 MB, and a quarter of it at half their size.
    let options = StereoOptions { binding: 500_000, ..StereoOptions::default() };
    let levels = pyramid(&set.images, &set.cameras, &set.sparse, &options).unwrap();
    let level = &levels[levels.len() - 1];
    assert_eq!((level.references[1].width, level.references[1].height), (80, 60));
    let plane = glam::Vec3::new(0.05, -0.04, 0.25);
    let pixels = level.pixels();
    let surface = surface::Surface { planes: vec![plane; pixels], confidence: vec![0.9; pixels] };
    let found = depth_map(level, &surface, 1, &set.images[1]).depth;
    assert_eq!((found.width, found.height), (160, 120));
    for (k, z) in found.data.iter().enumerate() {
        let pixel = DVec2::new((k % 160) as f64 + 0.5, (k / 160) as f64 + 0.5);
        let exact = 1.0 / plane.dot(set.cameras[1].ray(pixel).as_vec3());
        assert!((z / exact - 1.0).abs() < 1e-4, "pixel {k}: {z}, not {exact}");
    }
}

#[test]
fn fuse_skips_flying_pixels() {
    let set = synthetic(32, 24);
    let levels = pyramid(&set.images, &set.cameras, &set.sparse, &StereoOptions::default()).unwrap();
    let level = &levels[0];
    // First view: a wall, an object before it, a column of pixels half way. Others: no depth.
    let depth = |column: usize| [4.0f32, 3.0, 2.0][usize::from(column >= 16) + usize::from(column > 16)];
    let pixels = level.pixels();
    let mut surface =
        surface::Surface { planes: vec![glam::Vec3::ZERO; pixels], confidence: vec![0.0; pixels] };
    for k in 0..32 * 24 {
        surface.planes[k] = glam::Vec3::Z / depth(k % 32);
        surface.confidence[k] = 0.9;
    }
    let points = fuse::fuse(level, &surface::RelativePoses::new(level), &surface, &vec![false; pixels]);
    let depths = points.positions.iter().map(|p| level.cameras[0].project(DVec3::from(p.map(f64::from))).1);
    let count_at = |z: f64| depths.clone().filter(|d| (d / z - 1.0).abs() < 1e-4).count();
    // The columns on both sides of a step are skipped, too.
    assert_eq!((count_at(4.0), count_at(3.0), count_at(2.0)), (15 * 24, 0, 14 * 24));
    assert_eq!(points.len(), 29 * 24);
}

#[test]
fn pyramid_rejects_unusable_input() {
    let set = synthetic(32, 32);
    let options = StereoOptions::default();
    assert!(pyramid(&set.images[..1], &set.cameras[..1], &set.sparse, &options).is_err());
    let error = pyramid(&set.images, &set.cameras, &[], &options).unwrap_err().to_string();
    assert!(error.contains("no reconstructed point"), "{error}");
}
