//! Tests of stereo with the plane sweep of the device.
use crate::gpu::{Options, TestDevice, options, test_device};
use crate::math::hash;
use crate::pass::plane_sweep::{DevicePlaneSweep, GpuMatcher, Matcher, ReferenceView};
use crate::pass::plane_sweep_cpu::CpuMatcher;
use crate::pose::stereo::{Dense, StereoOptions, dense, pyramid, run_schedule};
use crate::progress::Silent;
use glam::{DVec3, Vec4};
use splatvk_test_support::stereo::{breakfast, errors, synthetic, synthetic_from, within};

/// The binding holds a reference and its one source, but not all three views.
#[test]
fn grouped_views_match_as_all_together() {
    let set = synthetic(96, 72);
    let run = |binding: u64| {
        let options = Options { max_binding: Some(binding), ..options(None) };
        let device = TestDevice::open(&options).unwrap();
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
fn device_planes_match_reference() {
    let device = test_device();
    let set = synthetic(96, 72);
    let options = StereoOptions { rounds: vec![1], ..StereoOptions::default() };
    let levels = pyramid(&set.images, &set.cameras, &set.sparse, &options).unwrap();
    let level = &levels[0];
    let matchers = |start: &[Vec4]| {
        let gpu = GpuMatcher::new(&device, &level.luma, &level.references, &level.sources, start).unwrap();
        (gpu, CpuMatcher::new(level.luma.clone(), level.sources.clone(), start.to_vec()))
    };
    let (mut gpu, mut cpu) = matchers(&vec![Vec4::ZERO; level.pixels()]);
    for r in &level.references {
        let r = ReferenceView { seed: 5, planes: 24, ..*r };
        gpu.sweep(&r).unwrap();
        cpu.sweep(&r).unwrap();
    }
    let swept = cpu.planes().unwrap();
    assert_same_planes(&gpu.planes().unwrap(), &swept);
    for (geometric, smoothness) in [(0.0, 0.0), (0.1, 0.0), (0.1, 0.1)] {
        for parity in 0..2 {
            let (mut gpu, mut cpu) = matchers(&swept);
            let r = ReferenceView { seed: 9, geometric, smoothness, parity, ..level.references[1] };
            gpu.refine(&r).unwrap();
            cpu.refine(&r).unwrap();
            let refined = cpu.planes().unwrap();
            assert!(refined != swept, "refinement changed nothing");
            assert_same_planes(&gpu.planes().unwrap(), &refined);
        }
    }
}

/// Asserts that planes and costs agree. Rounding (exp, sqrt, order of sums) differs, so nearly
/// equal hypotheses may win either way.
fn assert_same_planes(a: &[Vec4], b: &[Vec4]) {
    let same: Vec<usize> = (0..a.len())
        .filter(|&k| (a[k].truncate() - b[k].truncate()).length() < 1e-4 * a[k].truncate().length())
        .collect();
    let worst = same.iter().map(|&k| (a[k].w - b[k].w).abs()).fold(0.0, f32::max);
    assert!(same.len() * 1000 > a.len() * 985, "only {} of {} planes agree", same.len(), a.len());
    assert!(worst < 2e-3, "costs differ by {worst}");
}

#[test]
fn slanted_planes_are_recovered_reproducibly() {
    let device = test_device();
    let set = synthetic(160, 120);
    let run = || {
        dense(
            &DevicePlaneSweep::new(&device),
            &set.images,
            &[],
            &set.cameras,
            &set.sparse,
            &[],
            &StereoOptions::default(),
            &Silent,
        )
        .unwrap()
    };
    let Dense { depths, points, .. } = run();
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
    let again = run();
    assert!(again.depths == depths && again.points == points, "same input and seed, different output");
}

/// Little parallax and sensor noise: 1.5 px of mismatch are 3 % of the depth, and the noise is a
/// tenth of the contrast.
#[test]
fn noisy_photos_with_little_parallax_match() {
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
    let Dense { depths, .. } = dense(
        &DevicePlaneSweep::new(&device),
        &set.images,
        &[],
        &set.cameras,
        &set.sparse,
        &[],
        &StereoOptions::default(),
        &Silent,
    )
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
    let Dense { depths, .. } = dense(
        &DevicePlaneSweep::new(&device),
        &set.images,
        &[],
        &set.cameras,
        &set.sparse,
        &[],
        &options,
        &Silent,
    )
    .unwrap();
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
    let Dense { depths, .. } = dense(
        &DevicePlaneSweep::new(&device),
        &set.images,
        &[],
        &set.cameras,
        &set.sparse,
        &[],
        &StereoOptions::default(),
        &Silent,
    )
    .unwrap();
    for (found, exact) in depths.iter().zip(&set.depth) {
        assert_eq!((found.depth.width, found.depth.height), (exact.width, exact.height));
        let (e, _) = errors(&found.depth, exact);
        assert!(within(&e, 0.01) > 0.9, "within 1 %: {}", within(&e, 0.01));
    }
}

#[test]
fn breakfast_depth_at_quarter_resolution() {
    let device = test_device();
    let set = breakfast(4);
    let Dense { depths, points, .. } = dense(
        &DevicePlaneSweep::new(&device),
        &set.images,
        &[],
        &set.cameras,
        &set.sparse,
        &[],
        &StereoOptions::default(),
        &Silent,
    )
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
