//! Gradients of the whole render on the GPU compared with the f64 reference, which itself is
//! checked by central differences.
mod support;
use splatvk::gpu::{self, NATIVE_FLOAT_ATOMICS, Options, Recorder, TestDevice, test_device};
use splatvk::pass::{DeviceChoices, FeatureMode, GradientReduction, ShGradientKernel, TileSums};
use splatvk::scene::{seeded, sh_coefficients};
use support::{GpuGradients, Scene, assert_class, assert_gradients};

/// Reduced by atomics, with both reductions within a tile, and by entries; the latter is
/// bit-reproducible.
#[test]
fn random_scenes_match_reference() {
    let device = test_device();
    let choices = |summation| DeviceChoices { summation, ..DeviceChoices::of(&device) };
    let (atomics, entries) = (choices(GradientReduction::Atomics), choices(GradientReduction::Entries));
    let tile_sums = match atomics.tile_sums {
        TileSums::Shuffles => TileSums::Shared,
        TileSums::Shared => TileSums::Shuffles,
    };
    let other_sums = DeviceChoices { tile_sums, ..atomics };
    for (n, sh_degree, dim) in [(1, 3, 3), (10, 3, 0), (300, 1, 0), (100, 2, 8), (500, 1, 16), (100, 0, 48)] {
        let scene = Scene::small(n, sh_degree, dim, 60 + n as u64);
        println!("{n} splats, degree {sh_degree}, {dim} features");
        let upstream = scene.upstream(7);
        assert_gradients(&scene, &scene.gradients_by(&device, atomics, &upstream), 7);
        if dim == 0 {
            assert_gradients(&scene, &scene.gradients_by(&device, other_sums, &upstream), 7);
        }
        let gradients = scene.gradients_by(&device, entries, &upstream);
        assert_gradients(&scene, &gradients, 7);
        assert_eq!(gradients, scene.gradients_by(&device, entries, &upstream));
    }
}

/// Opacities that fall where the projection dilates a splat, and splats that no longer reach a
/// pixel.
#[test]
fn antialiased_scenes_match_reference() {
    let device = test_device();
    for (n, seed) in [(1, 81), (100, 82)] {
        let mut scene = Scene::small(n, 1, 3, seed);
        let upstream = scene.upstream(7);
        let plain = scene.gradients(&device, &upstream);
        scene.splats.antialiased = true;
        // A needle of a thousandth of a pixel, and a splat without extent along the third axis.
        scene.splats.log_scales[0] = [-1.0, -9.0, -9.0];
        scene.splats.log_scales[n / 2][2] = f32::MIN_POSITIVE.ln();
        let gradients = scene.gradients(&device, &upstream);
        assert_ne!(gradients, plain);
        assert_gradients(&scene, &gradients, 7);
    }
}

/// More splats than the backward pass of the projection has threads on a CPU device.
#[test]
fn all_of_many_splats_get_gradients() {
    let device = test_device();
    let n = 64 * 64 + 900;
    let (splats, camera) = seeded::benchmark(n, 40, 24, 0, 68);
    let scene = Scene::new(splats, &camera, 0, 68);
    assert_gradients(&scene, &scene.gradients(&device, &scene.upstream(11)), 11);
}

/// A step with short lists first, which determines the size of the entry buffers.
#[test]
fn entry_gradients_fit_grown_lists() {
    let device = test_device();
    let ways = DeviceChoices { summation: GradientReduction::Entries, ..DeviceChoices::of(&device) };
    let mut scene = Scene::small(12, 0, 3, 67);
    scene.splats.log_scales.fill([-6.0; 3]);
    let upstream = scene.upstream(12);
    let (small, mut raster) = scene.upload_for(&device, ways);
    // Every splat in every tile.
    scene.splats.log_scales.fill([3.0, 2.5, 2.0]);
    scene.splats.opacity_logits.fill(-3.0);
    let (large, _) = scene.upload_for(&device, ways);
    let gradients = large.zeros_like(&device).unwrap();
    for params in [&small, &large] {
        raster.forward(params, &scene.options).unwrap();
        raster.frame().planes_grad.write(&upstream).unwrap();
        let mut rec = Recorder::new(&device, "backward");
        raster.record_backward(&mut rec, params, &scene.options, &gradients);
        rec.run().unwrap();
    }
    let (splats, features) = gradients.download().unwrap();
    let grown = GpuGradients { splats, features, camera: raster.frame().camera_grad.read().unwrap() };
    assert_eq!(grown, scene.gradients_by(&device, ways, &upstream));
}

/// With the same upstream everywhere, the means move mostly by the view dependence of colours.
#[test]
fn view_dependent_colours_match_reference() {
    let device = test_device();
    let mut scene = Scene::small(15, 3, 0, 70);
    scene.splats.sh.fill(0.3);
    // Bright enough that no colour is clamped at 0.
    scene.splats.sh.chunks_exact_mut(48).for_each(|c| c[..3].fill(6.0));
    let pixels = scene.pixels();
    let mut upstream = vec![0.0; 5 * pixels];
    upstream[..3 * pixels].fill(1.0);
    let reference = scene.reference_gradients(&scene.reference(), &upstream).params.means;
    let reference: Vec<f64> = reference.iter().flat_map(|m| m.to_array()).collect();
    let gradients = scene.gradients(&device, &upstream);
    assert_class("means", gradients.splats.means.as_flattened(), &reference);
}

/// Edge cases of docs/internals/method.md#tolerances: clamped α, clamped Jacobian, needle, behind
/// the camera, transparent, outside, a clamped colour.
#[test]
fn edge_cases_match_reference() {
    let device = test_device();
    let mut scene = Scene::small(12, 3, 3, 31);
    let inverse = |v: glam::DVec3| {
        (scene.view.rotation.transpose() * (v - scene.view.translation)).as_vec3().to_array()
    };
    let place = |x, y, z| inverse(glam::DVec3::new(x, y, z));
    let s = &mut scene.splats;
    (s.means[0], s.opacity_logits[0]) = (place(0.05, 0.0, 1.9), 7.0);
    (s.means[1], s.log_scales[1]) = (place(-2.6, 0.2, 2.0), [0.5, 0.1, 0.2]);
    (s.means[2], s.log_scales[2]) = (place(0.1, 2.4, 2.0), [0.3, 0.5, 0.1]);
    (s.means[3], s.log_scales[3]) = (place(0.1, -0.1, 2.2), [-0.5, -7.4, -7.4]);
    s.means[4] = place(0.0, 0.1, -2.0);
    s.means[5] = place(30.0, 0.0, 2.0);
    s.opacity_logits[6] = -9.0;
    s.sh[7 * 48] = -4.0; // red clamped at 0
    let upstream = scene.upstream(3);
    let gradients = scene.gradients(&device, &upstream);
    assert_gradients(&scene, &gradients, 3);
    for hidden in [4, 5, 6] {
        assert_eq!(gradients.splats.means[hidden], [0.0; 3]);
        assert_eq!(gradients.splats.opacity_logits[hidden], 0.0);
        assert!(gradients.features[3 * hidden..3 * hidden + 3].iter().all(|&g| g == 0.0));
    }
    assert_eq!(gradients.splats.sh[7 * 48], 0.0);
}

/// Linear features, and features of exactly zero in the gauge, where the Jacobian is 1/ε; with one
/// gauge, and with one per level.
#[test]
fn feature_modes_match_reference() {
    let device = test_device();
    let mut scene = Scene::small(40, 0, 6, 5);
    scene.features[6..12].fill(0.0);
    let upstream = scene.upstream(5);
    assert_gradients(&scene, &scene.gradients(&device, &upstream), 5);
    for mode in [FeatureMode::Gauge { epsilon: 1e-3, blocks: 2 }, FeatureMode::Linear] {
        scene.options.feature_mode = mode;
        assert_gradients(&scene, &scene.gradients(&device, &upstream), 5);
    }
}

/// Without coupling, the loss of the features changes only the features.
#[test]
fn detached_features_leave_geometry_unchanged() {
    let device = test_device();
    for dim in [3, 24] {
        let mut scene = Scene::small(50, 0, dim, 9);
        let upstream = scene.upstream(9);
        let coupled = scene.gradients(&device, &upstream);
        scene.options.features_move_geometry = false;
        let detached = scene.gradients(&device, &upstream);
        let pixels = scene.pixels();
        let mut without = upstream.clone();
        without[4 * pixels..(4 + dim) * pixels].fill(0.0);
        let rgb_only = scene.gradients(&device, &without);
        let wide = |v: &[f32]| v.iter().map(|&x| x.into()).collect::<Vec<f64>>();
        assert_class(
            "means",
            detached.splats.means.as_flattened(),
            &wide(rgb_only.splats.means.as_flattened()),
        );
        assert_class("pose", &detached.camera, &wide(&rgb_only.camera));
        assert_class("features", &detached.features, &wide(&coupled.features));
        assert_ne!(coupled.splats.means, detached.splats.means);
    }
}

/// The compare-and-swap path of gpu/atomic_float.glsl computes the same sums.
#[test]
fn gradients_match_without_float_atomics() {
    let device = TestDevice::open(&Options {
        disabled: [NATIVE_FLOAT_ATOMICS.to_owned()].into(),
        ..gpu::options(None)
    })
    .unwrap();
    assert!(!device.info().float_atomics);
    let scene = Scene::small(100, 1, 3, 14);
    let upstream = scene.upstream(14);
    let ways = DeviceChoices { summation: GradientReduction::Atomics, ..DeviceChoices::of(&device) };
    assert_gradients(&scene, &scene.gradients_by(&device, ways, &upstream), 14);
}

/// A common translation of scene and camera changes nothing: Σ ∂μ = Rᵀ ∂ρ, here over a whole GPU
/// scene.
#[test]
fn common_translation_is_a_gauge() {
    let device = test_device();
    let scene = Scene::small(200, 3, 0, 15);
    let g = scene.gradients(&device, &scene.upstream(15));
    let sum: glam::DVec3 = g.splats.means.iter().map(|&m| glam::Vec3::from(m).as_dvec3()).sum();
    let rho: Vec<f64> = g.camera[..3].iter().map(|&x| x.into()).collect();
    let moved = (scene.view.rotation * sum).as_vec3().to_array();
    assert_class("translation", &moved, &rho);
}

/// Widths that leave the last launch partly unused: sums by entry must not reach the next splat.
#[test]
fn partial_launch_widths_match_reference() {
    let device = test_device();
    for dim in [4, 10, 24, 37] {
        let scene = Scene::small(30, 0, dim, 90 + dim as u64);
        let upstream = scene.upstream(9);
        for summation in [GradientReduction::Atomics, GradientReduction::Entries] {
            let ways = DeviceChoices { summation, ..DeviceChoices::of(&device) };
            assert_gradients(&scene, &scene.gradients_by(&device, ways, &upstream), 9);
        }
    }
}

/// Each degree, a degree below that of the coefficients, and more splats than a CPU device has
/// threads. The kernels compute the same products of the same factors.
#[test]
fn sh_gradient_kernels_match_reference() {
    let device = test_device();
    let kernels = [ShGradientKernel::PerThread, ShGradientKernel::Shared];
    let ways = kernels.map(|sh_gradients| DeviceChoices {
        sh_gradients,
        summation: GradientReduction::Entries,
        ..DeviceChoices::of(&device)
    });
    for (n, sh_degree) in [(70, 0), (100, 1), (64, 2), (64 * 64 + 900, 3)] {
        let (splats, camera) = seeded::benchmark(n, 40, 24, sh_degree, 69);
        let mut scene = Scene::new(splats, &camera, 0, 69);
        let upstream = scene.upstream(12);
        let both = ways.map(|ways| scene.gradients_by(&device, ways, &upstream));
        assert_gradients(&scene, &both[1], 12);
        assert_eq!(both[0], both[1]);
        scene.options.sh_degree = sh_degree / 2;
        let both = ways.map(|ways| scene.gradients_by(&device, ways, &upstream));
        assert_eq!(both[0], both[1]);
        let used = |i: usize| i % (3 * scene.splats.sh_len()) < 3 * sh_coefficients(sh_degree / 2);
        let sh = both[1].splats.sh.iter().enumerate();
        assert!(sh.filter(|(i, v)| !used(*i) && **v != 0.0).count() == 0, "unused coefficients");
    }
}
