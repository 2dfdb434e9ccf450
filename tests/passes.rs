//! Compares every rasterisation pass on the GPU with its f64 reference, with validation on.
mod support;
use glam::DVec3;
use splatvk::gpu::{Device, Options, Recorder, TestDevice, native, options, test_device};
use splatvk::math::Random;
use splatvk::pass::channels::BASE_CHANNELS;
use splatvk::pass::raster_backward;
use splatvk::pass::raster_forward::{Cutoffs, ReferenceScene};
use splatvk::pass::{
    DeviceChoices, FeatureMode, GradientReduction, RasterOptions, Rasterizer, Renderer, SplatBuffers,
    TileBinning, View, pairs,
};
use splatvk::scene::seeded;
use splatvk::scene::{Pose, Splats};
use support::{IMAGE, Scene, assert_close, assert_images, assert_lists, rendered};

/// Round splat in front of an unrotated camera, grey unless coloured.
fn splat(mean: [f32; 3], scale: f32, opacity_logit: f32) -> Splats {
    Splats {
        means: vec![mean],
        log_scales: vec![[scale.ln(); 3]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]],
        opacity_logits: vec![opacity_logit],
        sh_degree: 0,
        sh: vec![0.0; 3],
        antialiased: false,
    }
}

fn append(to: &mut Splats, other: Splats) {
    to.means.extend(other.means);
    to.log_scales.extend(other.log_scales);
    to.quats.extend(other.quats);
    to.opacity_logits.extend(other.opacity_logits);
    to.sh.extend(other.sh);
}

fn front_scene(splats: Splats, width: u32, height: u32) -> Scene {
    let camera = seeded::camera(width, height, Pose::IDENTITY);
    Scene::new(splats, &camera, 0, 0)
}

#[test]
fn random_scenes_match_reference() {
    let device = test_device();
    for (n, sh_degree, dim) in [(1, 0, 0), (10, 3, 3), (100, 2, 8), (500, 1, 16), (100, 0, 48), (10, 0, 21)] {
        let scene = Scene::small(n, sh_degree, dim, 40 + n as u64);
        println!("{n} splats, degree {sh_degree}, {dim} features");
        assert_images(&scene.render(&device), &scene.reference());
    }
}

#[test]
fn linear_features_match_reference() {
    let device = test_device();
    let mut scene = Scene::small(60, 3, 5, 3);
    scene.options = RasterOptions { feature_mode: FeatureMode::Linear, sh_degree: 1, ..scene.options };
    let out = scene.render(&device);
    // The reference has no separate active degree: cut the coefficients instead.
    scene.splats.sh = scene.splats.sh.chunks_exact(48).flat_map(|c| c[..12].to_vec()).collect();
    scene.splats.sh_degree = 1;
    assert_images(&out, &scene.reference());
}

/// One round splat on the axis: o e^(−½ r² / (f²s²/z² + 0.3)), in closed form.
#[test]
fn single_gaussian_matches_closed_form() {
    let device = test_device();
    let (logit, scale, z) = (0.7f64, 0.12f64, 2.5f64);
    let scene = front_scene(splat([0.0, 0.0, z as f32], scale as f32, logit as f32), 48, 32);
    let out = scene.render(&device);
    let opacity = 1.0 / (1.0 + (-logit).exp());
    let variance = (scene.view.focal[0] * scale / z).powi(2) + 0.3;
    let mut expected = Vec::new();
    for y in 0..32 {
        for x in 0..48 {
            let r2 = (f64::from(x) + 0.5 - 24.0).powi(2) + (f64::from(y) + 0.5 - 16.0).powi(2);
            let alpha = opacity * (-0.5 * r2 / variance).exp();
            expected.push(1.0 - if alpha < 1.0 / 255.0 { 0.0 } else { alpha });
        }
    }
    assert_close("transmittance", &out.transmittance, &expected, &IMAGE);
}

/// With one colour everywhere and a black background the image is colour · A for all splats.
#[test]
fn constant_colour_gives_colour_times_alpha() {
    let device = test_device();
    let mut scene = Scene::small(300, 0, 0, 8);
    scene.view.background = [0.0; 3];
    let colour = [0.8, 0.3, 0.55];
    scene.splats.sh = (0..300).flat_map(|_| colour.map(|c: f32| (c - 0.5) / 0.282_094_8)).collect();
    let out = scene.render(&device);
    for (k, c) in colour.into_iter().enumerate() {
        let plane = &out.planes[k * scene.pixels()..(k + 1) * scene.pixels()];
        let expected: Vec<f64> =
            out.transmittance.iter().map(|t| f64::from(c) * (1.0 - f64::from(*t))).collect();
        assert_close("colour times alpha", plane, &expected, &IMAGE);
    }
}

#[test]
fn image_is_independent_of_order() {
    let device = test_device();
    let scene = Scene::small(400, 2, 0, 12);
    let order = Random::new(1).permutation(400);
    let s = &scene.splats;
    let width = 3 * s.sh_len();
    let shuffled = Splats {
        means: order.iter().map(|&i| s.means[i]).collect(),
        log_scales: order.iter().map(|&i| s.log_scales[i]).collect(),
        quats: order.iter().map(|&i| s.quats[i]).collect(),
        opacity_logits: order.iter().map(|&i| s.opacity_logits[i]).collect(),
        sh_degree: 2,
        sh: order.iter().flat_map(|&i| s.sh[i * width..(i + 1) * width].to_vec()).collect(),
        antialiased: false,
    };
    let other = Scene { splats: shuffled, features: Vec::new(), ..Scene::small(1, 0, 0, 0) };
    let other = Scene { view: scene.view.clone(), options: scene.options, ..other };
    let (a, b) = (scene.render(&device), other.render(&device));
    // Depths differ, so the sorted order and all roundings are the same.
    assert_eq!(a.planes, b.planes);
    assert_eq!(a.transmittance, b.transmittance);
}

/// Equal depths keep the order of the splats: the first one is in front, in both versions.
#[test]
fn equal_depths_keep_index_order() {
    let device = test_device();
    let mut splats = splat([0.0, 0.0, 2.0], 0.3, 4.0);
    for i in 1..20 {
        append(&mut splats, splat([0.002 * i as f32, 0.0, 2.0], 0.3, 4.0));
    }
    splats.sh = (0..60).map(|i| ((i * 7) % 11) as f32 / 5.0 - 1.0).collect();
    let scene = front_scene(splats, 40, 40);
    assert_images(&scene.render(&device), &scene.reference());
}

#[test]
fn extreme_splats_match_reference() {
    let device = test_device();
    let mut splats = splat([0.1, 0.0, 2.0], 0.2, 12.0); // opacity 0.999994: α is clamped at 0.99
    append(&mut splats, splat([0.0, 0.1, -2.0], 0.5, 3.0)); // behind
    append(&mut splats, splat([0.0, 0.0, 0.04], 0.5, 3.0)); // in front of the near plane
    append(&mut splats, splat([40.0, 0.0, 2.0], 0.1, 3.0)); // far outside the image
    append(&mut splats, splat([-1.9, 0.3, 2.0], 0.9, 1.0)); // outside, but reaches into the image; clamped Jacobian
    append(&mut splats, splat([0.0, 0.0, 9.0], 30.0, 0.0)); // covers everything
    append(&mut splats, splat([0.2, 0.2, 3.0], 1e-6, 2.0)); // smaller than a pixel: visible by the dilation alone
    append(&mut splats, splat([0.0, 0.2, 3.0], 0.1, -9.0)); // opacity below 1/255
    append(&mut splats, splat([0.0, 0.2, 3.0], 0.1, -200.0)); // exp would overflow
    let mut needle = splat([-0.1, -0.1, 2.2], 1.0, 2.0); // 1 : 1000, rotated
    needle.log_scales[0] = [0.8f32.ln(), 0.0008f32.ln(), 0.0008f32.ln()];
    needle.quats[0] = [0.9, 0.1, -0.2, 0.35];
    append(&mut splats, needle);
    let scene = front_scene(splats, 61, 47);
    let reference = scene.reference();
    let visible: Vec<bool> = reference.projected.iter().map(Option::is_some).collect();
    assert_eq!(visible, [true, false, false, true, true, true, true, false, false, true]);
    assert_images(&scene.render(&device), &reference);
}

/// The lists contain all entries of the reference's exact test, nearest first, and a few more
/// within the margin of the GPU's test.
#[test]
fn tile_lists_contain_reference_entries() {
    let scene = Scene::small(500, 0, 0, 77);
    let (total, extra) = assert_lists(&test_device(), &scene);
    assert!(total > 1000 && extra * 100 < total, "{extra} of {total}");
}

#[test]
fn tile_lists_forget_last_view() {
    let device = test_device();
    let whole = front_scene(splat([0.0, 0.0, 5.0], 50.0, -3.0), 40, 40);
    // Nothing in the first 24 of 25 tiles.
    let corner = front_scene(splat([0.889, 0.889, 2.0], 0.02, 2.0), 40, 40);
    for grouping in [TileBinning::Counting, TileBinning::Sorting] {
        let ways = DeviceChoices { grouping, ..DeviceChoices::of(&device) };
        let (params, mut raster) = whole.upload_for(&device, ways);
        raster.forward(&params, &whole.options).unwrap();
        assert_eq!(raster.tile_lists().unwrap(), vec![vec![0u32]; 25], "{grouping:?}");
        let (params, _) = corner.upload(&device);
        raster.forward(&params, &corner.options).unwrap();
        let mut expected = vec![Vec::<u32>::new(); 25];
        expected[24].push(0);
        assert_eq!(raster.tile_lists().unwrap(), expected, "{grouping:?}");
        assert_images(&rendered(&raster), &corner.reference());
    }
}

/// lavapipe leaves the loops of a shader after 65535 iterations: more lanes share the 4.7 million
/// entries of these lists.
#[test]
fn long_lists_are_complete() {
    let device = test_device();
    let mut splats = Splats::default();
    for k in 0..300 {
        append(&mut splats, splat([0.0, 0.0, 5.0 + 0.01 * k as f32], 50.0, 3.0));
    }
    let scene = front_scene(splats, 1000, 1000);
    for grouping in [TileBinning::Counting, TileBinning::Sorting] {
        let (params, mut raster) =
            scene.upload_for(&device, DeviceChoices { grouping, ..DeviceChoices::of(&device) });
        raster.forward(&params, &scene.options).unwrap();
        let (lists, all) = (raster.tile_lists().unwrap(), Vec::from_iter(0..300u32));
        assert_eq!(lists.len(), 125 * 125);
        assert!(lists.iter().all(|list| *list == all), "{grouping:?}");
    }
}

/// Splats beside the image have no tile, but where they are sorted, too, the lane that reaches the
/// splats behind them walks over them: 200 000 that are smaller than a tile, or as tall as the
/// image's 125 rows of tiles.
#[test]
fn splats_beside_the_image_end_no_list() {
    const BESIDE: u32 = 200_000;
    let device = test_device();
    for height in [0.1f32, 40.0] {
        let mut splats = splat([0.0, 0.0, 1.9], 50.0, -3.0);
        for k in 0..BESIDE {
            let mut beside = splat([-10.0, 0.0, 2.0 + 1e-5 * k as f32], 0.1, 3.0);
            beside.log_scales[0][1] = height.ln();
            append(&mut splats, beside);
        }
        append(&mut splats, splat([0.0, 0.0, 9.0], 50.0, 3.0));
        let scene = front_scene(splats, 40, 1000);
        for grouping in [TileBinning::Counting, TileBinning::Sorting] {
            for summation in [GradientReduction::Atomics, GradientReduction::Entries] {
                let choices = DeviceChoices { grouping, summation, ..DeviceChoices::of(&device) };
                let (params, mut raster) = scene.upload_for(&device, choices);
                raster.forward(&params, &scene.options).unwrap();
                let lists = raster.tile_lists().unwrap();
                let whole = lists.iter().filter(|list| **list == [0, BESIDE + 1]).count();
                assert_eq!(whole, 5 * 125, "height {height}, {grouping:?}, {summation:?}");
            }
        }
    }
}

/// Splats around the borders of a small image, of any size and direction: none is dropped that
/// reaches a tile, by shaders or in native code.
#[test]
fn splats_at_borders_stay_in_lists() {
    let natives = TestDevice::open(&Options { natives: native::ALL, ..options(None) }).unwrap();
    let mut scene = Scene::small(3000, 0, 0, 78);
    let mut random = Random::new(5);
    for (mean, scales) in scene.splats.means.iter_mut().zip(&mut scene.splats.log_scales) {
        let z = random.between(1.0, 6.0);
        *mean = [random.between(-2.0, 2.0) * z, random.between(-2.0, 2.0) * z, z].map(|x| x as f32);
        *scales = [0; 3].map(|_| random.between(-6.0, 1.0) as f32);
    }
    let device = test_device();
    let (total, extra) = assert_lists(&device, &scene);
    assert!(total > 10_000 && extra * 100 < total, "{extra} of {total}");
    let lists = |device: &Device| {
        let (params, mut raster) = scene.upload_for(device, DeviceChoices::of(device));
        raster.forward(&params, &scene.options).unwrap();
        (pairs::visible(&raster).unwrap(), raster.tile_lists().unwrap())
    };
    let (by_shaders, in_native) = (lists(&device), lists(&natives));
    let entries = |lists: &[Vec<u32>]| lists.iter().map(Vec::len).sum::<usize>();
    assert!(entries(&by_shaders.1).abs_diff(entries(&in_native.1)) * 1000 < total);
    for (visible, lists) in [by_shaders, in_native] {
        let listed: std::collections::BTreeSet<u32> = lists.into_iter().flatten().collect();
        println!("{visible} visible, {} in lists", listed.len());
        assert!(visible >= listed.len() && visible < 3000, "{visible}");
        assert!(visible * 4 < listed.len() * 5, "{visible} of {}", listed.len());
    }
}

/// Many splats in the middle one of three tiles, and a farther one in its corner: either it is
/// drawn, or the frame is refused.
#[test]
fn long_list_is_complete_or_refused() {
    let device = test_device();
    for (count, refused) in [(39_000, false), (70_000, device.info().leaves_long_loops())] {
        // The focal length is 21.6 pixels, the principal point (12, 4).
        let on_diagonal = |pixel: f32, z: f32| [(pixel - 4.0) * z / 21.6, (pixel - 4.0) * z / 21.6, z];
        let mut splats = Splats { sh_degree: 0, ..Splats::default() };
        for k in 0..count {
            append(&mut splats, splat(on_diagonal(2.5, 1.0 + 1e-5 * k as f32), 1e-4, 0.0));
        }
        append(&mut splats, splat(on_diagonal(6.5, 3.0), 0.02, 5.0));
        let scene = front_scene(splats, 24, 8);
        let (params, mut raster) = scene.upload(&device);
        let outcome = raster.forward(&params, &scene.options);
        assert_eq!(outcome.is_err(), refused, "{count}");
        match outcome {
            Ok(()) => {
                let far = rendered(&raster).transmittance[6 * 24 + 14];
                assert!(far < 0.05, "{count}: {far}");
            }
            Err(e) => assert!(e.to_string().contains("70001 splats lie on 8 × 8 pixels"), "{e}"),
        }
    }
}

/// 20 000 splats in one tile (10⁵ take the reference too long), without overflow, saturation or
/// disorder.
#[test]
fn crowded_tile_matches_reference() {
    let device = test_device();
    let mut random = Random::new(4);
    let mut splats = Splats::default();
    for _ in 0..20_000 {
        let (x, y) = (random.scaled_normal(0.02) as f32, random.scaled_normal(0.02) as f32);
        // α of about 0.005: the pixel is not yet saturated after hundreds of splats.
        append(&mut splats, splat([x, y, random.between(2.0, 6.0) as f32], 0.05, -5.2));
        let at = splats.sh.len() - 3;
        splats.sh[at] = random.scaled_normal(0.5) as f32;
    }
    let scene = front_scene(splats, 8, 8);
    assert_images(&scene.render(&device), &scene.reference());
}

#[test]
fn overflowing_lists_grow_before_drawing() {
    let device = test_device();
    // 40 splats that each cover all of 38 × 25 tiles: far more entries than first allocated.
    let mut splats = Splats::default();
    for i in 0..40 {
        append(&mut splats, splat([0.0, 0.0, 5.0 + i as f32], 50.0, -3.0));
    }
    let scene = front_scene(splats, 300, 200);
    let (params, mut raster) = scene.upload(&device);
    let mut rec = Recorder::new(&device, "forward");
    raster.record_forward(&mut rec, &params, &scene.options);
    rec.run().unwrap();
    let needed = raster.overflow().unwrap().expect("the lists must not fit");
    assert_eq!(needed, 40 * 38 * 25);
    assert!(rendered(&raster).transmittance.iter().all(|&t| t == 1.0), "half a scene was drawn");
    raster.forward(&params, &scene.options).unwrap();
    assert_eq!(raster.overflow().unwrap(), None);
    let all = rendered(&raster).transmittance;
    assert!(all.iter().all(|&t| t < 0.3), "40 layers of opacity 0.047 leave a seventh: {}", all[0]);
}

#[test]
fn renderer_returns_planes_as_maps() {
    let device = test_device();
    let scene = Scene::small(200, 1, 3, 21);
    let (_, camera) = seeded::small(200, 75, 53, 1, 21);
    let mut renderer = Renderer::new(&device, &scene.splats, &scene.features, 3)
        .unwrap()
        .with_near(scene.view.near)
        .with_background(scene.view.background);
    let frame = renderer.render(&camera).unwrap();
    let out = scene.render(&device);
    let pixels = scene.pixels();
    for p in [0, 17, 75 * 26 + 37, pixels - 1] {
        let (x, y) = (p % 75, p / 75);
        assert_eq!(frame.rgb.at(x, y)[1], out.planes[pixels + p]);
        assert_eq!(frame.alpha.at(x, y), 1.0 - out.transmittance[p]);
        assert_eq!(frame.features[3 * p + 2], out.planes[(BASE_CHANNELS + 2) * pixels + p]);
        let alpha = 1.0 - out.transmittance[p];
        let depth = if alpha >= 0.5 { out.planes[3 * pixels + p] / alpha } else { 0.0 };
        assert_eq!(frame.depth.at(x, y), depth);
    }
    // Another size with the same renderer.
    assert_eq!(renderer.render(&camera.resized(40, 28)).unwrap().rgb.data.len(), 40 * 28);
}

/// The default near plane is a hundredth of the median depth of the splats in front of the camera.
#[test]
fn splats_behind_camera_are_ignored() {
    let device = test_device();
    let camera = seeded::camera(24, 16, Pose::IDENTITY);
    let image = |splats: &Splats| Renderer::new(&device, splats, &[], 0).unwrap().render(&camera).unwrap();
    let mut splats = splat([0.0, 0.0, 2.0], 0.3, 2.0);
    let seen = image(&splats);
    assert!(seen.alpha.at(12, 8) > 0.5);
    for z in [-2.0, -400.0, -400.0, -400.0] {
        append(&mut splats, splat([0.1, 0.0, z], 0.5, 3.0));
    }
    assert!(image(&splats) == seen);
}

/// Weights of splats in a view, in one band and in strips of the image; colours and features must
/// not matter.
#[test]
fn view_weights_match_reference() {
    let device = test_device();
    for (n, dim) in [(300, 0), (120, 3)] {
        let scene = Scene::small(n, 2, dim, 33);
        let (_, camera) = seeded::small(n, 75, 53, 2, 33);
        let forward = scene.reference();
        let list = ReferenceScene {
            projected: &forward.projected,
            features: &forward.rendered_features,
            feature_dim: dim,
            order: &forward.order,
            view: &scene.view,
        };
        let mut upstream = vec![0.0; (BASE_CHANNELS + dim + 1) * scene.pixels()];
        upstream[..scene.pixels()].fill(1.0);
        let reference = raster_backward::reference(&list, &Cutoffs::STANDARD, &upstream);
        let expected: Vec<f64> = reference.geometry.iter().map(|g| g.channels[0]).collect();
        let mut renderer =
            Renderer::new(&device, &scene.splats, &scene.features, dim).unwrap().with_near(scene.view.near);
        let weights = renderer.weights(&camera).unwrap();
        let most = expected.iter().copied().fold(0.0, f64::max);
        for (i, (got, want)) in weights.iter().zip(&expected).enumerate() {
            // If alpha is just at its bound, one pixel may count in one version only.
            assert!((f64::from(*got) - want).abs() <= 1e-4 * most + 0.005, "splat {i}: {got} {want}");
        }
        let alpha: f64 = forward.image.transmittance.iter().map(|t| 1.0 - t).sum();
        let sum: f64 = weights.iter().map(|w| f64::from(*w)).sum();
        assert!((sum / alpha - 1.0).abs() < 1e-3, "all weights are all of what is opaque: {sum} {alpha}");
        assert_eq!(renderer.weights(&camera).unwrap().len(), n, "a second time on the same buffers");
    }
    // A wall hides the splat behind it.
    let mut splats = splat([0.0, 0.0, 2.0], 0.8, 9.0);
    for k in 1..6 {
        append(&mut splats, splat([0.0, 0.0, 2.0 + 0.01 * k as f32], 0.8, 9.0));
    }
    append(&mut splats, splat([0.0, 0.0, 4.0], 0.02, 9.0));
    let camera = seeded::camera(40, 40, Pose::IDENTITY);
    let weights = Renderer::new(&device, &splats, &[], 0).unwrap().weights(&camera).unwrap();
    assert!(weights[0] > 100.0 && weights[6] < 1e-3, "{weights:?}");
}

#[test]
fn rasterizer_refuses_unusable_input() {
    let device = test_device();
    let (mut splats, camera) = seeded::small(3, 16, 16, 0, 0);
    assert!(Rasterizer::new(&device, 3, 0, 0, 16).is_err(), "no pixels");
    assert!(SplatBuffers::upload(&device, &splats, &[0.0; 5], 2).is_err(), "feature count");
    let mut raster = Rasterizer::new(&device, 2, 0, 16, 16).unwrap();
    let params = SplatBuffers::upload(&device, &splats, &[], 0).unwrap();
    assert!(raster.forward(&params, &RasterOptions::default()).is_err(), "more splats than room");
    assert!(raster.set_view(&View::new(&camera.resized(8, 8), 0.1)).is_err(), "another size");
    splats.quats.pop();
    assert!(SplatBuffers::upload(&device, &splats, &[], 0).is_err(), "lengths");
}

#[test]
fn empty_scene_shows_background() {
    let device = test_device();
    let scene = front_scene(Splats::default(), 16, 9);
    let out = scene.render(&device);
    let pixels = scene.pixels();
    assert!(out.transmittance.iter().all(|&t| t == 1.0));
    assert!((0..3).all(|k| out.planes[k * pixels] == scene.view.background[k] as f32));
    let far = DVec3::new(0.0, 0.0, -9.0);
    let behind = front_scene(splat([0.0, 0.0, far.z as f32], 0.5, 2.0), 16, 9).render(&device);
    assert_eq!(behind.planes, out.planes);
}

/// gsplat's `rasterize_mode="antialiased"`: the opacity of a splat of variance v px² is multiplied
/// by v / (v + 0.3).
#[test]
fn antialiased_opacity_follows_dilation() {
    let device = test_device();
    let ratio = max_alpha(&device, true) / max_alpha(&device, false);
    assert!((ratio - 0.25 / 0.55).abs() < 1e-3, "{ratio}");
}

/// Largest alpha of a splat 0.5 px wide at depth 2.
fn max_alpha(device: &Device, antialiased: bool) -> f32 {
    let mut scene = front_scene(splat([0.0, 0.0, 2.0], 1.0, 0.0), 33, 33);
    let sigma = 0.5f32;
    scene.splats.log_scales = vec![[(sigma * 2.0 / scene.view.focal[0] as f32).ln(); 3]];
    scene.splats.antialiased = antialiased;
    let rendered = scene.render(device);
    assert_images(&rendered, &scene.reference());
    rendered.transmittance.iter().map(|t| 1.0 - t).fold(0.0, f32::max)
}
