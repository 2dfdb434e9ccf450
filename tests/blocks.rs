//! Processing in blocks where a device cannot bind everything at once, with the results of the
//! whole.
#![allow(clippy::unwrap_used)] // helpers of tests
mod support;
use glam::DVec3;
use splatvk::fit::{self, LanguageOptions, Preset, RgbOptions};
use splatvk::gpu::{self, Device, Options, Recorder, TestDevice, test_device};
use splatvk::pass::GradientReduction;
use splatvk::pass::bands::Band;
use splatvk::pass::{FrameBuffers, Rasterizer, RenderedFrame, Renderer, SplatBuffers};
use splatvk::progress::Silent;
use splatvk::query::{QueryOptions, TextQuery, answer};
use splatvk::run::view::Viewer;
use splatvk::scene::seeded;
use splatvk::scene::{Camera, Codebook, Image, LanguageField, LevelField, Pose, RgbImage, Splats};
use support::{GpuGradients, Scene, in_bands};

const MIB: u64 = 1 << 20;

/// A device with a limited binding size.
fn limited(bytes: u64, deterministic: bool) -> TestDevice {
    TestDevice::open(&Options { max_binding: Some(bytes), deterministic, ..gpu::options(None) }).unwrap()
}

/// Largest difference, relative to the largest value.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let scale = a.iter().fold(1e-12f32, |m, v| m.max(v.abs()));
    a.iter().zip(b).fold(0.0f32, |m, (x, y)| m.max((x - y).abs())) / scale
}

#[track_caller]
fn assert_alike(a: &GpuGradients, b: &GpuGradients, what: &str) {
    let mut pairs: Vec<(Vec<f32>, Vec<f32>)> =
        parameters(&a.splats).into_iter().zip(parameters(&b.splats)).collect();
    pairs.push((a.features.clone(), b.features.clone()));
    pairs.push((a.camera.clone(), b.camera.clone()));
    for (k, (x, y)) in pairs.iter().enumerate() {
        // The same numbers summed in another order: about 1e-6 for sums of a thousand values of
        // both signs.
        let off = difference(x, y);
        assert!(off < 2e-5, "{what}, class {k}: {off}");
    }
}

fn parameters(s: &Splats) -> [Vec<f32>; 5] {
    [
        s.means.as_flattened().to_vec(),
        s.log_scales.as_flattened().to_vec(),
        s.quats.as_flattened().to_vec(),
        s.opacity_logits.clone(),
        s.sh.clone(),
    ]
}

/// 800 × 600 with 52 channels is 97 MiB of gradients: whole, in two bands and in twelve. The lists
/// of 16 MiB are too short for all entries at once where gradients are kept per entry.
#[test]
fn bands_equal_whole_frame() {
    let (splats, camera) = seeded::benchmark(4000, 800, 600, 1, 3);
    let scene = Scene::new(splats, &camera, 48, 3);
    let upstream = scene.upstream(5);
    let whole = limited(128 * MIB, false);
    let (image, atomics, one) = in_bands(&scene, &whole, GradientReduction::Atomics, &upstream);
    assert!(one == 1 && image.iter().all(|v| v.is_finite()));
    for (mib, bands) in [(128, 1), (64, 2), (16, 12)] {
        let device = limited(mib * MIB, false);
        for summation in [GradientReduction::Atomics, GradientReduction::Entries] {
            let (planes, gradients, count) = in_bands(&scene, &device, summation, &upstream);
            assert_eq!(count, bands, "{mib} MiB");
            assert!(planes == image, "{mib} MiB {summation:?}: other planes");
            assert_alike(&atomics, &gradients, &format!("{mib} MiB {summation:?}"));
        }
    }
}

/// A rasterizer for two sizes has the results of one for each, whichever image came before.
#[test]
fn sizes_share_a_rasterizer() {
    let (splats, camera) = seeded::benchmark(3000, 200, 96, 1, 3);
    let portrait = Camera { width: 96, height: 200, cx: camera.cy, cy: camera.cx, ..camera.clone() };
    let scenes = [&camera, &portrait].map(|camera| Scene::new(splats.clone(), camera, 5, 3));
    for limit in [None, Some(1 << 19)] {
        let options = Options { max_binding: limit, deterministic: true, ..gpu::options(None) };
        let device = TestDevice::open(&options).unwrap();
        let (params, _) = scenes[0].upload(&device);
        let sizes = scenes.each_ref().map(|scene| scene.view.size);
        let mut shared = Rasterizer::for_sizes(&device, splats.len(), 5, &sizes).unwrap();
        assert!(shared.set_size([300, 200]).is_err());
        for scene in [&scenes[1], &scenes[0], &scenes[1]] {
            shared.set_size(scene.view.size).unwrap();
            shared.set_view(&scene.view).unwrap();
            let [width, height] = scene.view.size;
            let mut own = Rasterizer::new(&device, splats.len(), 5, width, height).unwrap();
            own.set_view(&scene.view).unwrap();
            let upstream = scene.upstream(5);
            let [a, b] =
                [&mut shared, &mut own].map(|raster| stepped(&device, raster, &params, scene, &upstream));
            assert!(a.0 == b.0, "{width} × {height}, at most {limit:?} bytes");
            // Lists that another size has grown divide the image into other strips, so that the
            // sums may have another order.
            for (a, b) in a.1.iter().zip(&b.1) {
                let off = difference(a, b);
                assert!(off < if limit.is_some() { 2e-5 } else { 1e-12 }, "{width} × {height}: {off}");
            }
        }
    }
}

/// Planes of all bands, and gradients.
fn stepped(
    device: &Device,
    raster: &mut Rasterizer,
    params: &SplatBuffers,
    scene: &Scene,
    upstream: &[f32],
) -> (Vec<Vec<f32>>, Vec<Vec<f32>>) {
    let mut planes = Vec::new();
    let gradients = params.zeros_like(device).unwrap();
    let bands: Vec<_> = raster.frame().bands.iter().collect();
    let read = |frame: &FrameBuffers, _: &Band| {
        planes.push(frame.planes.read_range(0..9 * frame.pixels() as usize)?);
        Ok(())
    };
    raster.forward_bands(params, &scene.options, read).unwrap();
    for band in &bands {
        let frame = raster.frame();
        let part = frame.bands.cut_inner(band, upstream, 0.0);
        frame.planes_grad.write_at(0, &part).unwrap();
        let mut rec = Recorder::new(device, "step");
        if band.index == 0 {
            raster.record_projection(&mut rec, params, &scene.options);
        }
        raster.record_band(&mut rec, params, band);
        raster.record_band_backward(&mut rec, params, &scene.options, band);
        if band.index + 1 == bands.len() {
            raster.record_gradients(&mut rec, params, &scene.options, &gradients);
        }
        rec.run().unwrap();
    }
    let (splats, features) = gradients.download().unwrap();
    (planes, parameters(&splats).into_iter().chain([features]).collect())
}

/// Code gradients of all features at once would be 205.7 MiB for this many splats, whatever the
/// image.
#[test]
fn entry_gradients_fit_many_splats() {
    let (splats, camera) = seeded::benchmark(130_000, 320, 240, 0, 4);
    let scene = Scene::new(splats, &camera, 48, 4);
    let upstream = scene.upstream(6);
    let device = test_device();
    let (_, atomics, _) = in_bands(&scene, &device, GradientReduction::Atomics, &upstream);
    let (_, entries, _) = in_bands(&scene, &device, GradientReduction::Entries, &upstream);
    assert_alike(&atomics, &entries, "130,000 splats");
}

#[test]
fn large_image_renders_in_bands() {
    // 700,000 pixels: two bands at 128 MiB.
    let (splats, camera) = seeded::benchmark(2000, 1000, 700, 0, 3);
    let features = seeded::features(2000, 48, 1);
    let frame = |mib: u64| -> RenderedFrame {
        let device = limited(mib * MIB, false);
        Renderer::new(&device, &splats, &features, 48).unwrap().render(&camera).unwrap()
    };
    assert!(frame(128) == frame(24));
}

/// Landscape, portrait and panorama cameras, and the splats rendered by them.
fn photos(device: &Device, splats: &Splats, sizes: &[(u32, u32)]) -> (Vec<Camera>, Vec<RgbImage>) {
    let mut renderer = Renderer::new(device, splats, &[], 0).unwrap();
    let cameras: Vec<Camera> = sizes.iter().enumerate().map(camera).collect();
    let images = cameras.iter().map(|c| renderer.render(c).unwrap().rgb).collect();
    (cameras, images)
}

fn camera((i, &(width, height)): (usize, &(u32, u32))) -> Camera {
    let a = i as f64 - 0.5;
    let pose = Pose::exp(DVec3::new(-0.3 * a, 0.1 * a, 0.0), DVec3::new(0.01 * a, 0.05 * a, 0.0));
    seeded::camera(width, height, pose)
}

#[test]
fn colour_training_in_bands_matches_whole() {
    let (truth, _) = seeded::benchmark(1500, 320, 240, 0, 9);
    let (cameras, images) = photos(&test_device(), &truth, &[(320, 240), (240, 320), (600, 90), (317, 235)]);
    let mut start = truth.clone();
    start.sh.iter_mut().for_each(|v| *v *= 0.7);
    let options =
        RgbOptions { iterations: 8, report_every: 1, poses: None, ..RgbOptions::preset(Preset::Draft) };
    let scale = fit::scale::SceneScale::measure(&cameras, &truth.means);
    let trained = |bytes: u64| {
        let device = limited(bytes, true);
        fit::fit_rgb(&device, &images, &cameras, start.clone(), scale, None, &options, &Silent).unwrap()
    };
    // 1 MiB: 136 rows of 320 pixels.
    let (whole, bands) = (trained(128 * MIB), trained(MIB));
    for (a, b) in whole.stats.curve.iter().zip(&bands.stats.curve) {
        assert!(
            (a.loss - b.loss).abs() < 1e-5 && (a.ssim.unwrap_or(0.0) - b.ssim.unwrap_or(0.0)).abs() < 1e-5,
            "{a:?} {b:?}"
        );
    }
    // Adam's first steps are as long for tiny gradients as for large ones: single splats may
    // diverge.
    let close = whole.splats.sh.iter().zip(&bands.splats.sh).filter(|(a, b)| (*a - *b).abs() < 1e-3).count();
    assert!(close * 100 > 99 * whole.splats.sh.len(), "{close} of {}", whole.splats.sh.len());
    assert!(whole.stats.psnr.iter().zip(&bands.stats.psnr).all(|(a, b)| (a - b).abs() < 0.01));
}

/// Three levels of eight codes of 16 numbers; labels in squares, none in every fifth.
fn field(images: &[RgbImage]) -> LanguageField {
    let level = |l: u64| {
        let mut codes = seeded::features(8, 16, 40 + l);
        for code in codes.chunks_exact_mut(16) {
            let norm = code.iter().map(|v| v * v).sum::<f32>().sqrt();
            code.iter_mut().for_each(|v| *v /= norm);
        }
        let target = |image: &RgbImage| {
            let square = |i: usize| i % image.width / 50 + 3 * (i / image.width / 50) + l as usize;
            let label = |i: usize| if square(i) % 5 == 0 { -1 } else { (square(i) % 8) as i32 };
            let data = (0..image.data.len()).map(label).collect();
            Image { width: image.width, height: image.height, data }
        };
        let embeddings = (0..64).map(|i| f32::from(u8::from(i % 9 == 0))).collect();
        LevelField {
            codebook: Codebook {
                embedding_dim: 8,
                code_dim: 16,
                embeddings,
                codes,
                weights: vec![1.0; 8],
                members: vec![Vec::new(); 8],
                min_chord: 0.5,
            },
            targets: images.iter().map(target).collect(),
            ..LevelField::default()
        }
    };
    LanguageField { levels: (0..3).map(level).collect(), space: "test".into() }
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn language_in_bands_matches_whole() {
    let (splats, _) = seeded::benchmark(3000, 640, 480, 0, 9);
    let whole = limited(128 * MIB, true);
    let (cameras, images) = photos(&whole, &splats, &[(640, 480), (480, 640)]);
    let untrained = field(&images);
    let options = LanguageOptions { iterations: 2, check_every: 1, ..LanguageOptions::preset(Preset::Draft) };
    let train = |device: &Device| {
        fit::train_language(device, &images, &cameras, &splats, untrained.clone(), &options, &Silent).unwrap()
    };
    let reference = train(&whole);
    let query = TextQuery {
        text: "third".into(),
        embedding: (0..8).map(|k| f32::from(u8::from(k == 3))).collect(),
        canonicals: (0..8).map(|k| f32::from(u8::from(k == 5))).collect(),
        ..Default::default()
    };
    let seen = |device: &Device, field: &LanguageField, camera: &Camera| {
        let view = Viewer::new(device, &splats, field).unwrap().view_with_features(camera).unwrap();
        let answer = answer(&view.codes, field, &query, &QueryOptions::default()).unwrap();
        (view.rendered, view.codes, answer.relevancy())
    };
    for mib in [16, 64] {
        let device = limited(mib * MIB, true);
        let trained = train(&device);
        for (a, b) in reference.curve.iter().zip(&trained.curve) {
            assert!((a.loss - b.loss).abs() < 1e-5, "{mib} MiB: {a:?} {b:?}");
            let pairs = a.accuracy.iter().flatten().zip(b.accuracy.iter().flatten());
            let off = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 1e-3, "{mib} MiB: {a:?} {b:?}");
        }
        for (a, b) in reference.field.levels.iter().zip(&trained.field.levels) {
            let close = a.features.iter().zip(&b.features).filter(|(a, b)| (*a - *b).abs() < 1e-3).count();
            assert!(close * 100 > 99 * a.features.len(), "{mib} MiB: {close} of {}", a.features.len());
        }
        for camera in &cameras {
            // The same scene on both devices gives the same bits.
            assert!(
                seen(&whole, &reference.field, camera) == seen(&device, &reference.field, camera),
                "{mib} MiB"
            );
        }
    }
}
