//! Many views of a wavy wall, whose depth is known exactly.
use super::*;
use crate::progress::{peak_memory, reset_peak_memory};
use crate::scene::{Pose, RgbImage};
use splatvk_infer::best_pairs::BestPairs;

/// `count` views of the wall z = 4 + 0.35 sin(2.1 x) cos(1.7 y) from a patch in front of it, all
/// looking at its middle; photos are `photo_scale` times the network's size. The wall does not
/// occlude itself: its slope is below one, and it is seen at less than 45° from the side.
fn wall(count: usize, width: usize, height: usize, photo_scale: usize) -> Case {
    let (mut views, mut cameras, mut depths) = (Vec::new(), Vec::new(), Vec::new());
    let photo = (photo_scale * width, photo_scale * height);
    for k in 0..count {
        // Evenly over the patch for any number of views (R₂ sequence).
        let (u, v) = ((0.7549 * k as f64).fract() - 0.5, (0.5698 * k as f64).fract() - 0.5);
        let centre = DVec3::new(2.4 * u, 1.4 * v, 0.1 * (3.0 * u).sin());
        let forward = (DVec3::new(0.0, 0.0, 4.0) - centre).normalize();
        let right = DVec3::Y.cross(forward).normalize();
        let rotation = glam::DMat3::from_cols(right, forward.cross(right), forward).transpose();
        let camera = Camera {
            name: format!("wall_{k:02}"),
            width: width as u32,
            height: height as u32,
            fx: 1.1 * width as f64,
            fy: 1.1 * width as f64,
            cx: 0.5 * width as f64,
            cy: 0.5 * height as f64,
            pose: Pose { rotation, translation: -(rotation * centre) },
        };
        let depth =
            |p: usize| wall_depth(&camera, DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5));
        depths.push((0..width * height).map(depth).collect());
        views.push(ModelView {
            name: camera.name.clone(),
            image: RgbImage { width: photo.0, height: photo.1, data: vec![[0.5; 3]; photo.0 * photo.1] },
            width,
            height,
            from_working: Affine::resize((photo.0 as u32, photo.1 as u32), (width as u32, height as u32)),
            exif_focal: None,
            camera_group: 0,
        });
        cameras.push(camera);
    }
    Case { views, cameras, depths }
}

/// Depth of the wall at a pixel of a camera.
fn wall_depth(camera: &Camera, pixel: DVec2) -> f64 {
    let centre = camera.pose.centre();
    let mut z = 4.0;
    // Each round leaves less than three quarters of the error.
    for _ in 0..60 {
        let x = camera.unproject(pixel, z);
        let surface = 4.0 + 0.35 * (2.1 * x.x).sin() * (1.7 * x.y).cos();
        z += (surface - x.z) * z / (x.z - centre.z);
    }
    z
}

impl Case {
    /// Pointmaps of all pairs, without matches.
    fn maps(&self, noise: f64) -> Vec<PairPointmaps> {
        let mut rng = Random::new(7);
        let mut scale = || (0.3 * rng.normal()).exp();
        let pairs = (0..self.views.len()).flat_map(|i| (i + 1..self.views.len()).map(move |j| (i, j)));
        let pairs: Vec<_> = pairs.map(|(i, j)| (i, j, scale(), scale())).collect();
        let mut map = |v: usize, frame: usize, s: f64| self.map(v, frame, s, noise, &mut rng);
        let pointmaps = |(i, j, s, t): (usize, usize, f64, f64)| PairPointmaps {
            first: i,
            second: j,
            x11: map(i, i, s),
            x21: map(j, i, s),
            x22: map(j, j, t),
            x12: map(i, j, t),
            descriptors: None,
        };
        pairs.into_iter().map(pointmaps).collect()
    }
}

/// Processor time of this process so far, seconds: unlike wall time independent of other load.
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(')').next().unwrap_or_default();
    // User and system time, in hundredths of a second (proc(5)).
    after_name.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// Processor time (seconds) and memory (bytes) of a reconstruction, pointmaps included.
fn cost(count: usize, size: (usize, usize)) -> (f64, u64) {
    let case = wall(count, size.0, size.1, 1);
    let all = case.maps(0.003);
    let start = processor_seconds();
    let mut best = BestPairs::new(&case.views);
    all.into_iter().for_each(|pair| best.add(pair));
    let maps = network_output(&case.views, &best.finish());
    let used = maps.pairs.len();
    reset_peak_memory();
    let before = peak_memory() - (used * 4 * size.0 * size.1 * size_of::<[f32; 4]>()) as u64;
    let g = reconstruct(maps, 0, &Silent).unwrap().geometry;
    let seconds = processor_seconds() - start;
    let e = pose_errors(&g.cameras, &case.cameras, 4.0);
    let worst = |v: &[f64]| v.iter().fold(0f64, |m, e| m.max(*e));
    println!(
        "{count} views of {} × {}, {used} pairs: {seconds:.1} s, {:.0} MB, worst rotation {:.4}°, centre {:.5}, focal {:.5}, {} points",
        size.0,
        size.1,
        (peak_memory() - before) as f64 / 1e6,
        worst(&e.rotation_degrees),
        worst(&e.centre),
        worst(&e.focal),
        g.points.len()
    );
    (seconds, peak_memory() - before)
}

#[test]
fn focals_prefer_exif_to_points() {
    let mut case = wall(2, 64, 48, 1);
    let canonical = canonical::canonical_maps(&case.views, &case.maps(0.0));
    let points = canonical::focals(&case.views, &canonical).of(0);
    assert!((points / case.cameras[0].fx - 1.0).abs() < 0.01, "{points}");
    case.views.iter_mut().for_each(|v| v.exif_focal = Some(80.0));
    let exif = canonical::focals(&case.views, &canonical);
    assert_eq!((exif.of(0), exif.of(1)), (80.0, 80.0));
}

/// Depth at working size belongs to the pixel centres of the photo, which has four pixels per model
/// pixel here: an offset of half a model pixel shows.
#[test]
fn working_depth_belongs_to_pixel_centres() {
    let case = wall(3, 128, 96, 4);
    let (pairs, matches) = case.input(Faults { depth: 0.0, pixels: 0.0, outliers: 0.0, scale: 0.7 });
    let g = aligned(&case.views, &pairs, &matches);
    for (v, map) in g.depths.iter().enumerate() {
        let known: Vec<usize> = (0..512 * 384).step_by(61).filter(|p| map.depth.data[*p] > 0.0).collect();
        let median_error = |shift: DVec2| {
            let truth = |p: usize| DVec2::new((p % 512) as f64 + 0.5, (p / 512) as f64 + 0.5) + shift;
            let ratio =
                |p: &usize| f64::from(map.depth.data[*p]) / wall_depth(&case.cameras[v], truth(*p) / 4.0);
            let ratios: Vec<f64> = known.iter().map(ratio).collect();
            let middle = median(&mut ratios.clone()).unwrap();
            median(&mut ratios.iter().map(|r| (r / middle - 1.0).abs()).collect::<Vec<_>>()).unwrap()
        };
        let here = median_error(DVec2::ZERO);
        let moved = [DVec2::X, DVec2::NEG_X, DVec2::Y, DVec2::NEG_Y].map(|d| median_error(2.0 * d));
        println!("view {v}: median error of depth {here:.6}, half a pixel off {moved:.6?}");
        assert!(known.len() > 2000 && moved.iter().all(|m| here < 0.5 * m), "{here} {moved:?}");
        assert_eq!((g.cameras[v].cx, g.cameras[v].cy), (256.0, 192.0));
    }
}

/// Sixteen views of a size that is fast enough for a test; SPLATVK_TEST_SIZE=512x384 for the size
/// of the networks.
#[test]
#[ignore = "seconds and bytes: run it alone, in release, with MALLOC_MMAP_THRESHOLD_=65536 so that what is freed goes back"]
fn reconstruct_cost_grows_linearly_with_views() {
    let text = std::env::var("SPLATVK_TEST_SIZE").unwrap_or("256x192".into());
    let (w, h) = text.split_once('x').unwrap();
    let size = (w.parse().unwrap(), h.parse().unwrap());
    let (few, many) = (cost(4, size), cost(16, size));
    println!("time {:.1} ×, memory {:.1} ×", many.0 / few.0, many.1 as f64 / few.1 as f64);
}
