use super::*;
use crate::gpu::test_device;
use crate::pass::plane_sweep::{GpuMatcher, Matcher};
use crate::pass::plane_sweep_cpu::{CpuMatcher, hash};
use crate::progress::Silent;
use crate::scene::Pose;
use glam::{DMat3, DVec2};
use std::path::Path;

/// Photos with exact depth.
pub(super) struct Set {
    pub(super) images: Vec<RgbImage>,
    pub(super) cameras: Vec<Camera>,
    pub(super) depth: Vec<Plane<f32>>,
    pub(super) sparse: Vec<DVec3>,
}

/// Smooth noise over the plane, three octaves down to about four pixels: something to match everywhere.
fn texture(u: f64, v: f64) -> f32 {
    let lattice = |x: i64, y: i64, octave: u32| {
        let h = hash(x as u32 ^ hash(y as u32 ^ hash(octave)));
        (h >> 8) as f64 / 16_777_216.0
    };
    let mut value = 0.0;
    for octave in 0..3u32 {
        let (x, y) = (u * (1 << octave) as f64, v * (1 << octave) as f64);
        let (fx, fy) = (x - x.floor(), y - y.floor());
        let (ix, iy) = (x.floor() as i64, y.floor() as i64);
        let (sx, sy) = (fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy));
        let top = lattice(ix, iy, octave) * (1.0 - sx) + lattice(ix + 1, iy, octave) * sx;
        let bottom = lattice(ix, iy + 1, octave) * (1.0 - sx) + lattice(ix + 1, iy + 1, octave) * sx;
        value += (top * (1.0 - sy) + bottom * sy) / 3.0;
    }
    value as f32
}

/// A slanted square in front of a slanted wall, seen by three cameras about 12° apart.
pub(super) fn synthetic(width: u32, height: u32) -> Set {
    synthetic_from(width, height, 0.8)
}

/// The same with the outer cameras `reach` away from the middle one.
fn synthetic_from(width: u32, height: u32, reach: f64) -> Set {
    let f = 1.1 * width as f64;
    let cameras: Vec<Camera> = [-reach, 0.0, reach]
        .iter()
        .enumerate()
        .map(|(i, &x)| Camera {
            name: format!("{i}"),
            width,
            height,
            fx: f,
            fy: f,
            cx: width as f64 / 2.0,
            cy: height as f64 / 2.0,
            // Turned about the vertical axis to keep looking at the point 4 units ahead.
            pose: Pose {
                rotation: DMat3::from_rotation_y((x / 4.0f64).atan()),
                translation: -(DMat3::from_rotation_y((x / 4.0f64).atan()) * DVec3::new(x, 0.1 * x, 0.0)),
            },
        })
        .collect();
    // (normal, offset) of the wall and of the square's plane.
    let planes = [(DVec3::new(0.2, 0.1, 1.0), 4.5), (DVec3::new(-0.3, 0.2, 1.0), 3.3)];
    let mut set = Set { images: vec![], cameras: cameras.clone(), depth: vec![], sparse: vec![] };
    for camera in &cameras {
        let mut image = RgbImage { width: width as usize, height: height as usize, data: vec![] };
        let mut depth = Plane::filled(width as usize, height as usize, 0.0f32);
        let (eye, to_world) = (camera.pose.centre(), camera.pose.inverse().rotation);
        for k in 0..(width * height) as usize {
            let pixel = DVec2::new((k as u32 % width) as f64 + 0.5, (k as u32 / width) as f64 + 0.5);
            let ray = to_world * camera.ray(pixel);
            let hit = |(normal, offset): (DVec3, f64)| (offset - normal.dot(eye)) / normal.dot(ray);
            let near = eye + ray * hit(planes[1]);
            let on_square = near.x.abs() < 0.7 && near.y.abs() < 0.5;
            let z = if on_square { hit(planes[1]) } else { hit(planes[0]) };
            let p = eye + ray * z;
            // Base period of 16 pixels at a depth of 4 for 160-pixel photos.
            let period = 16.0 * 4.0 / (1.1 * 160.0);
            let shade = texture(p.x / period + 100.0 * on_square as u8 as f64, p.y / period);
            // Two tints, so that filling has an edge to find.
            let tint = if on_square { [1.0, 0.6, 0.5] } else { [0.6, 0.8, 1.0] };
            image.data.push(tint.map(|t: f32| (t * (0.2 + 0.8 * shade) * 255.0).round() / 255.0));
            depth.data[k] = z as f32;
            if k % 97 == 0 {
                set.sparse.push(p);
            }
        }
        set.images.push(image);
        set.depth.push(depth);
    }
    set
}

/// Sorted relative depth errors, and the share of pixels with depth.
fn errors(found: &Plane<f32>, exact: &Plane<f32>) -> (Vec<f32>, f32) {
    let mut errors: Vec<f32> = found
        .data
        .iter()
        .zip(&exact.data)
        .filter(|(f, e)| **f > 0.0 && **e > 0.0)
        .map(|(f, e)| (f - e).abs() / e)
        .collect();
    errors.sort_by(f32::total_cmp);
    let known = exact.data.iter().filter(|e| **e > 0.0).count();
    let share = errors.len() as f32 / known as f32;
    (errors, share)
}

fn within(errors: &[f32], limit: f32) -> f32 {
    errors.iter().filter(|&&e| e < limit).count() as f32 / errors.len() as f32
}

/// With one source each, a reference and its source fit where all three views do not.
#[test]
fn views_are_matched_in_groups_as_all_together() {
    let set = synthetic(96, 72);
    let run = |binding: u64| {
        let options = crate::gpu::Options { max_binding: Some(binding), ..crate::gpu::options(None) };
        let device = crate::gpu::TestDevice::open(&options).unwrap();
        let options = StereoOptions { sources: 1, binding, ..StereoOptions::default() };
        let levels = pyramid(&set.images, &set.cameras, &set.sparse, &options).unwrap();
        run_schedule(&levels, &options, &Silent, |level, start| {
            GpuMatcher::new(&device, &level.luma, &level.references, &level.sources, &start)
        })
        .unwrap()
    };
    let view = 96 * 72 * 16;
    let (grouped, whole) = (run(5 * view / 2), run(3 * view));
    assert_eq!(grouped.len(), 3 * 96 * 72);
    assert!(grouped == whole, "other planes");
}

#[test]
fn of_many_photos_each_is_matched_with_those_at_the_best_angles() {
    // Seven cameras around the points, 10° from one to the next.
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
    // 20°, 30° and 40°; the next has too little parallax, the last ones show other sides.
    assert_eq!(chosen, [2, 3, 4]);
}

#[test]
fn depth_matched_at_half_the_size_is_that_of_the_photos_own_pixels() {
    let set = synthetic(160, 120);
    // Three photos take 0.9 MB, at half their size a quarter of it.
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
fn what_floats_between_two_surfaces_is_no_point() {
    let set = synthetic(32, 24);
    let levels = pyramid(&set.images, &set.cameras, &set.sparse, &StereoOptions::default()).unwrap();
    let level = &levels[0];
    // In the first view a wall, something before it, and a column of pixels half way; the others have no depth.
    let depth = |column: usize| [4.0f32, 3.0, 2.0][usize::from(column >= 16) + usize::from(column > 16)];
    let pixels = level.pixels();
    let mut surface =
        surface::Surface { planes: vec![glam::Vec3::ZERO; pixels], confidence: vec![0.0; pixels] };
    for k in 0..32 * 24 {
        surface.planes[k] = glam::Vec3::Z / depth(k % 32);
        surface.confidence[k] = 0.9;
    }
    let points = fuse::fuse(level, &surface::RelativePoses::new(level), &surface);
    let depths = points.positions.iter().map(|p| level.cameras[0].project(DVec3::from(p.map(f64::from))).1);
    let near = |z: f64| depths.clone().filter(|d| (d / z - 1.0).abs() < 1e-4).count();
    // The columns on both sides of a step may be wrong, too.
    assert_eq!((near(4.0), near(3.0), near(2.0)), (15 * 24, 0, 14 * 24));
    assert_eq!(points.len(), 29 * 24);
}

#[test]
fn device_and_twin_choose_the_same_planes() {
    let device = test_device();
    let set = synthetic(96, 72);
    let options = StereoOptions { rounds: vec![1], ..StereoOptions::default() };
    let levels = pyramid(&set.images, &set.cameras, &set.sparse, &options).unwrap();
    let level = &levels[0];
    let make = |start: &[Vec4]| {
        let gpu = GpuMatcher::new(&device, &level.luma, &level.references, &level.sources, start).unwrap();
        (gpu, CpuMatcher::new(level.luma.clone(), level.sources.clone(), start.to_vec()))
    };
    // Rounding (exp, sqrt, order of sums) differs, so near ties may fall either way; anything else is a bug.
    let compare = |a: &[Vec4], b: &[Vec4]| {
        let same: Vec<usize> = (0..a.len())
            .filter(|&k| (a[k].truncate() - b[k].truncate()).length() < 1e-4 * a[k].truncate().length())
            .collect();
        let worst = same.iter().map(|&k| (a[k].w - b[k].w).abs()).fold(0.0, f32::max);
        assert!(same.len() * 1000 > a.len() * 985, "only {} of {} planes agree", same.len(), a.len());
        assert!(worst < 2e-3, "costs differ by {worst}");
    };
    let (mut gpu, mut cpu) = make(&vec![Vec4::ZERO; level.pixels()]);
    for r in &level.references {
        let r = ReferenceView { seed: 5, planes: 24, ..*r };
        gpu.sweep(&r).unwrap();
        cpu.sweep(&r).unwrap();
    }
    let swept = cpu.planes().unwrap();
    compare(&gpu.planes().unwrap(), &swept);
    for (geometric, smoothness) in [(0.0, 0.0), (0.1, 0.0), (0.1, 0.1)] {
        for parity in 0..2 {
            let (mut gpu, mut cpu) = make(&swept);
            let r = ReferenceView { seed: 9, geometric, smoothness, parity, ..level.references[1] };
            gpu.refine(&r).unwrap();
            cpu.refine(&r).unwrap();
            let refined = cpu.planes().unwrap();
            assert!(refined != swept, "refinement changed nothing");
            compare(&gpu.planes().unwrap(), &refined);
        }
    }
}

#[test]
fn two_slanted_planes_are_recovered_and_runs_repeat() {
    let device = test_device();
    let set = synthetic(160, 120);
    let run = || {
        dense(&device, &set.images, &[], &set.cameras, &set.sparse, &[], &StereoOptions::default(), &Silent)
            .unwrap()
    };
    let (depths, points) = run();
    for (found, exact) in depths.iter().zip(&set.depth) {
        let (e, complete) = errors(&found.depth, exact);
        // Measured: median 0.05 %, 97 % within 1 %, complete; the rest is the square's rim.
        assert!(complete >= 0.98, "complete {complete}");
        assert!(e[e.len() / 2] < 0.002, "median {}", e[e.len() / 2]);
        assert!(within(&e, 0.01) > 0.93, "within 1 %: {}", within(&e, 0.01));
    }
    assert!(points.len() > 160 * 120 && points.len() < 3 * 160 * 120, "{} points", points.len());
    for k in 0..points.len() {
        let camera = &set.cameras[points.view[k] as usize];
        let (_, z) = camera.project(DVec3::from(points.positions[k].map(f64::from)));
        assert!((points.radius[k] as f64 * camera.fx / z - 1.0).abs() < 1e-3, "radius is z / f");
        assert!(points.confidence[k] > 0.0);
    }
    assert!(run() == (depths, points), "same input and seed, different output");
}

/// Little parallax and sensor noise: 1.5 px of mismatch are 3 % of the depth, and noise is a tenth of the contrast.
#[test]
fn noisy_photos_with_little_parallax_give_a_surface() {
    let device = test_device();
    let mut set = synthetic_from(200, 150, 0.4);
    for (view, image) in set.images.iter_mut().enumerate() {
        for (k, c) in image.data.iter_mut().enumerate() {
            // Sum of two uniforms: triangular, σ = 0.02 × 0.41.
            let h = hash(k as u32 ^ hash(view as u32 + 7));
            let noise = ((h & 0xffff) as f32 + (h >> 16) as f32) / 65536.0 - 1.0;
            *c = c.map(|v| (0.3 + 0.08 * v + 0.02 * noise).clamp(0.0, 1.0));
        }
    }
    let (depths, _) =
        dense(&device, &set.images, &[], &set.cameras, &set.sparse, &[], &StereoOptions::default(), &Silent)
            .unwrap();
    for (view, (found, exact)) in depths.iter().zip(&set.depth).enumerate() {
        let (e, complete) = errors(&found.depth, exact);
        println!("view {view}: median {:.4}, within 10 % {:.3}", e[e.len() / 2], within(&e, 0.1));
        assert!(complete >= 0.98, "complete {complete}");
        assert!(e[e.len() / 2] < 0.04, "view {view}: median {}", e[e.len() / 2]);
        assert!(within(&e, 0.1) > 0.75, "view {view}: within 10 %: {}", within(&e, 0.1));
    }
}

#[test]
fn white_frames_get_no_depth() {
    let device = test_device();
    let mut set = synthetic(120, 100);
    for image in &mut set.images {
        for k in 0..image.data.len() {
            if k % 120 < 4 || k / 120 >= 97 {
                image.data[k] = [1.0; 3];
            }
        }
    }
    let options = StereoOptions { planes: 16, coarse_rounds: 2, rounds: vec![2], ..StereoOptions::default() };
    let (depths, _) =
        dense(&device, &set.images, &[], &set.cameras, &set.sparse, &[], &options, &Silent).unwrap();
    for map in depths {
        for k in 0..map.depth.data.len() {
            let frame = k % 120 < 4 || k / 120 >= 97;
            assert_eq!(map.depth.data[k] > 0.0, !frame, "pixel {k}");
            assert_eq!(map.confidence.data[k] > 0.0, !frame, "pixel {k}");
        }
    }
}

#[test]
fn photos_of_different_sizes_are_matched() {
    let device = test_device();
    let mut set = synthetic(160, 120);
    let small = synthetic(120, 90);
    set.images[0] = small.images[0].clone();
    set.cameras[0] = small.cameras[0].clone();
    set.depth[0] = small.depth[0].clone();
    let (depths, _) =
        dense(&device, &set.images, &[], &set.cameras, &set.sparse, &[], &StereoOptions::default(), &Silent)
            .unwrap();
    for (found, exact) in depths.iter().zip(&set.depth) {
        assert_eq!((found.depth.width, found.depth.height), (exact.width, exact.height));
        let (e, _) = errors(&found.depth, exact);
        assert!(within(&e, 0.01) > 0.9, "within 1 %: {}", within(&e, 0.01));
    }
}

#[test]
fn unusable_input_is_refused() {
    let set = synthetic(32, 32);
    let options = StereoOptions::default();
    assert!(pyramid(&set.images[..1], &set.cameras[..1], &set.sparse, &options).is_err());
    let error = pyramid(&set.images, &set.cameras, &[], &options).unwrap_err().to_string();
    assert!(error.contains("no reconstructed point"), "{error}");
}

/// The training views of breakfast shrunk by `shrink`, with exact cameras and 60 exact points per view.
pub(super) fn breakfast(shrink: u32) -> Set {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast");
    let truth = std::fs::read_to_string(root.join("ground_truth.json")).unwrap();
    let truth: serde_json::Value = serde_json::from_str(&truth).unwrap();
    let mut set = Set { images: vec![], cameras: vec![], depth: vec![], sparse: vec![] };
    for frame in truth["frames"].as_array().unwrap().iter().filter(|f| f["split"] == "train") {
        let file = frame["file"].as_str().unwrap();
        let number = |key: &str| frame[key].as_f64().unwrap();
        let m = |r: usize, c: usize| frame["world_to_camera"][r][c].as_f64().unwrap();
        let photo = image::open(root.join(file)).unwrap().to_rgb8();
        let camera = Camera {
            name: file.into(),
            width: photo.width(),
            height: photo.height(),
            fx: number("fx"),
            fy: number("fy"),
            cx: number("cx"),
            cy: number("cy"),
            pose: Pose {
                rotation: DMat3::from_cols_array_2d(&[0, 1, 2].map(|c| [m(0, c), m(1, c), m(2, c)])),
                translation: DVec3::new(m(0, 3), m(1, 3), m(2, 3)),
            },
        };
        let stem = Path::new(file).file_stem().unwrap().to_str().unwrap();
        let depth = crate::format::npy::read_npz(root.join(format!("depth/{stem}.npz"))).unwrap();
        let depth = depth["depth"].to_f32();
        let width = camera.width;
        for k in (0..depth.len()).step_by(depth.len() / 60) {
            if depth[k] > 0.0 {
                let pixel = DVec2::new((k as u32 % width) as f64 + 0.5, (k as u32 / width) as f64 + 0.5);
                set.sparse.push(camera.unproject(pixel, depth[k] as f64));
            }
        }
        let (w, h) = (width / shrink, camera.height / shrink);
        let small = image::imageops::resize(&photo, w, h, image::imageops::FilterType::Triangle);
        let data = small.pixels().map(|p| p.0.map(|v| v as f32 / 255.0)).collect();
        set.images.push(RgbImage { width: w as usize, height: h as usize, data });
        let sampled = (0..(w * h) as usize).map(|k| {
            let (x, y) = (k as u32 % w * shrink + shrink / 2, k as u32 / w * shrink + shrink / 2);
            depth[(y * width + x) as usize]
        });
        set.depth.push(Plane { width: w as usize, height: h as usize, data: sampled.collect() });
        set.cameras.push(camera.resized(w, h));
    }
    set
}

#[test]
fn breakfast_depth_at_a_quarter_of_the_resolution() {
    let device = test_device();
    let set = breakfast(4);
    let (depths, points) =
        dense(&device, &set.images, &[], &set.cameras, &set.sparse, &[], &StereoOptions::default(), &Silent)
            .unwrap();
    for (view, (found, exact)) in depths.iter().zip(&set.depth).enumerate() {
        let (e, complete) = errors(&found.depth, exact);
        println!(
            "view {view}: complete {complete:.3}, median {:.5}, within 1 % {:.3}, 3 % {:.3}",
            e[e.len() / 2],
            within(&e, 0.01),
            within(&e, 0.03)
        );
        assert!(complete >= 0.98);
        assert!(e[e.len() / 2] < 0.005, "view {view}: median {}", e[e.len() / 2]);
        assert!(within(&e, 0.03) > 0.75, "view {view}: within 3 %: {}", within(&e, 0.03));
    }
    let mut of_points: Vec<f32> = (0..points.len())
        .filter_map(|k| {
            let view = points.view[k] as usize;
            let (pixel, z) = set.cameras[view].project(DVec3::from(points.positions[k].map(f64::from)));
            let exact = set.depth[view].at(pixel.x as usize, pixel.y as usize);
            (exact > 0.0).then(|| (z as f32 - exact).abs() / exact)
        })
        .collect();
    of_points.sort_by(f32::total_cmp);
    println!("points: {} median {:.5}", of_points.len(), of_points[of_points.len() / 2]);
    assert!(of_points[of_points.len() / 2] < 0.005);
}
