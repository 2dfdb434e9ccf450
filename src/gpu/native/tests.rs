//! Native passes against their shaders.
use super::ALL;
use crate::fit::scale::SceneScale;
use crate::fit::{Preset, RgbOptions, fit_rgb};
use crate::gpu::Recorder;
use crate::gpu::{Device, Options, TestDevice};
use crate::math::Random;
use crate::pass::adam::{Class, Moments, Schedule};
use crate::pass::bands::{Band, Bands};
use crate::pass::ssim_l1::{SsimL1, SsimRowKernel};
use crate::pass::sum::{self, PARTIALS};
use crate::pass::view::View;
use crate::pass::{RasterOptions, Rasterizer, SplatBuffers, pairs};
use crate::scene::{DepthMap, Image, RgbImage, Splats, seeded};

/// The device without native passes, and with them.
fn devices() -> [TestDevice; 2] {
    let options = crate::gpu::options(None);
    [&[][..], ALL].map(|natives| TestDevice::open(&Options { natives, ..options.clone() }).unwrap())
}

/// Asserts that numbers agree up to rounding, relative to the largest.
fn assert_close(name: &str, shader: &[f32], native: &[f32], tolerance: f32) {
    let scale = shader.iter().fold(0.0f32, |m, v| m.max(v.abs())).max(1e-30);
    let worst = shader.iter().zip(native).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(shader.len() == native.len() && worst <= tolerance * scale, "{name}: {worst} of {scale}");
}

fn numbers(count: usize, seed: u64) -> Vec<f32> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.normal() as f32).collect()
}

#[test]
fn adam_matches_shader() {
    // Neither a whole number of vectors nor of periods; the last gradients are not finite.
    let (count, stride, head) = (3 * 1000 + 1, 12, 3);
    let (values, mut gradients) = (numbers(count, 1), numbers(count, 2));
    (gradients[7], gradients[count - 1]) = (f32::NAN, f32::INFINITY);
    let run = |device: &Device| {
        let parameters = device.buffer_from("parameters", &values).unwrap();
        let by = device.buffer_from("gradients", &gradients).unwrap();
        let guard = device.buffer_from("guard", &[0u32; 3]).unwrap();
        let moments = Moments::new(device, count).unwrap();
        let mut schedule = Schedule::new(device, 2).unwrap();
        for step in 1..4 {
            schedule.set(step, &[[0.0; 2], [0.01, 0.002]]).unwrap();
            let mut rec = Recorder::new(device, "adam");
            let class = Class { slot: 1, count, stride, head };
            schedule.record(&mut rec, class, &parameters, &by, &moments, &guard);
            rec.run().unwrap();
        }
        guard.write(&[0, 1, 0]).unwrap();
        let mut rec = Recorder::new(device, "void");
        let class = Class { slot: 1, count, stride, head };
        schedule.record(&mut rec, class, &parameters, &by, &moments, &guard);
        rec.run().unwrap();
        (parameters.read().unwrap(), moments.read(count).unwrap(), schedule.faults().unwrap())
    };
    let [shader, native] = devices().map(|device| run(&device));
    assert_close("parameters", &shader.0, &native.0, 1e-5);
    // Both add the same noise before they cut bits off: few numbers round differently.
    let pairs = shader.1.iter().zip(&native.1);
    assert!(pairs.filter(|(a, b)| a != b).count() < count / 100);
    assert_eq!((shader.2, native.2), (6, 6));
}

#[test]
fn ssim_and_l1_match_shaders() {
    // Sizes below one vector and one window, and a whole number of both.
    for (width, height) in [(75, 53), (13, 7), (7, 5), (130, 33), (24, 80)] {
        for (weighted, weights) in
            [(false, [0.8, 0.2]), (true, [0.8, 0.2]), (false, [0.7, 0.0]), (true, [0.7, 0.0])]
        {
            let pixels = width * height;
            let x: Vec<f32> = numbers(3 * pixels, 3).iter().map(|v| 0.5 + 0.2 * v).collect();
            let noise = numbers(3 * pixels, 4);
            let mut y: Vec<f32> = x.iter().zip(noise).map(|(x, n)| 0.8 * x + 0.05 * n).collect();
            let covered = weighted.then(|| {
                let of = |p: usize| [0.0f32, 1.0, 0.25][(p % width / 4 + p / width / 3) % 3];
                let weights: Vec<f32> = (0..pixels).map(of).collect();
                y.extend(&weights);
                weights.iter().map(|w| f64::from(*w)).sum()
            });
            let run = |device: &Device| {
                let bands = Bands::whole(width, height);
                let pass = SsimL1::with(device, std::slice::from_ref(&bands), SsimRowKernel::Strips).unwrap();
                let (x, y) = (device.buffer_from("x", &x).unwrap(), device.buffer_from("y", &y).unwrap());
                let gradient = device.buffer::<f32>("gradient", 3 * pixels).unwrap();
                let sums = device.buffer::<f32>("sums", 3 * PARTIALS).unwrap();
                let mut rec = Recorder::new(device, "loss");
                // Rows at the edges belong to other bands.
                let band = (&bands, &Band { inner: 2..height - 1, ..bands.get(0) });
                pass.record(&mut rec, band, &x, &y, &gradient, covered, weights, (&sums, 1));
                rec.run().unwrap();
                let sums = sums.read().unwrap();
                let sums = [1, 2].map(|slot| sum::total(&sums, slot) as f32);
                (gradient.read().unwrap(), sums.to_vec())
            };
            let [shader, native] = devices().map(|device| run(&device));
            let (row, last) = (3 * width, 3 * pixels);
            assert!(shader.0[..2 * width].iter().chain(&shader.0[last - width..]).all(|g| *g == 0.0));
            assert!(shader.0[2 * width..row].iter().any(|g| *g != 0.0));
            // E[x²]−E[x]² cancels about three digits.
            assert_close("gradient", &shader.0, &native.0, 1e-3);
            assert_close("sums", &shader.1, &native.1, 1e-5);
        }
    }
}

/// A training step's rasterisation with upstream noise: planes, and gradients of all parameters.
/// Splats of odd degrees are antialiased; `faulty` is an upstream number that is not one.
fn rasterised(
    device: &Device,
    degree: u32,
    features: usize,
    size: [u32; 2],
    faulty: Option<usize>,
) -> Vec<(String, Vec<f32>)> {
    let (mut splats, camera) = seeded::benchmark(900, size[0], size[1], degree, 5);
    splats.antialiased = degree % 2 == 1;
    for i in 0..900 {
        let [x, y, z] = splats.means[i];
        match i % 16 {
            // Behind the camera, far beside the image, and too faint.
            3 => splats.means[i] = [-x, -y, -z],
            8 => splats.means[i] = [50.0 * x, y, z],
            13 => splats.opacity_logits[i] = -20.0,
            _ => {}
        }
    }
    let codes = numbers(900 * features, 6);
    let params = SplatBuffers::upload(device, &splats, &codes, features).unwrap();
    let gradients = params.zeros_like(device).unwrap();
    let mut raster = Rasterizer::new(device, 900, features, size[0], size[1]).unwrap();
    let options = RasterOptions { sh_degree: degree, ..RasterOptions::default() };
    raster.set_view(&View::new(&camera, 0.05)).unwrap();
    raster.forward(&params, &options).unwrap();
    let frame = raster.frame();
    let pixels = frame.pixels() as usize;
    let mut upstream = numbers((5 + features) * pixels, 7);
    faulty.into_iter().for_each(|at| upstream[at] = f32::NAN);
    frame.planes_grad.write(&upstream).unwrap();
    let mut rec = Recorder::new(device, "backward");
    raster.record_backward(&mut rec, &params, &options, &gradients);
    rec.run().unwrap();
    let frame = raster.frame();
    let (by, by_features) = gradients.download().unwrap();
    let mut out = vec![
        ("planes".to_owned(), frame.planes.read().unwrap()),
        ("transmittance".to_owned(), frame.transmittance.read().unwrap()),
        ("camera".to_owned(), frame.camera_grad.read().unwrap()),
        ("means".to_owned(), by.means.as_flattened().to_vec()),
        ("log-scales".to_owned(), by.log_scales.as_flattened().to_vec()),
        ("quaternions".to_owned(), by.quats.as_flattened().to_vec()),
        ("opacities".to_owned(), by.opacity_logits),
        ("SH".to_owned(), by.sh),
        ("features".to_owned(), by_features),
    ];
    for (list, splats) in raster.tile_lists().unwrap().into_iter().enumerate() {
        out.push((format!("list {list}"), splats.iter().map(|s| *s as f32).collect()));
    }
    out
}

#[test]
fn rasterisation_matches_shaders() {
    for (degree, features) in [(0, 0), (3, 3), (1, 8), (0, 16), (2, 37)] {
        let [shader, native] = devices().map(|device| rasterised(&device, degree, features, [75, 53], None));
        for ((name, shader), (_, native)) in shader.iter().zip(&native) {
            let exact = name.starts_with("list");
            // Sums of noise over some hundred pixels, in another order.
            assert_close(
                &format!("{name}, degree {degree}, {features} features"),
                shader,
                native,
                if exact { 0.0 } else { 3e-4 },
            );
        }
    }
}

/// A gradient that is not a number leaves those that are computed beside it as they are.
#[test]
fn faulty_gradients_change_no_others() {
    let [_, native] = devices();
    for degree in [0, 1] {
        let [clean, faulty] =
            [None, Some(20 * 75 + 30)].map(|at| rasterised(&native, degree, 0, [75, 53], at));
        for ((name, clean), (_, faulty)) in
            clean.iter().zip(&faulty).filter(|((name, v), _)| name != "camera" && !v.is_empty())
        {
            let others = faulty.iter().filter(|v| !v.is_nan()).count();
            let same = clean.iter().zip(faulty).filter(|(a, b)| a == b).count();
            assert!(same == others && 2 * others > clean.len(), "{name}: {same} of {others}");
        }
        assert!(faulty[3].1.iter().any(|v| v.is_nan()));
    }
}

#[test]
fn pair_counts_match_shader() {
    let [shader, native] = devices().map(|device| {
        let (splats, camera) = seeded::benchmark(900, 75, 53, 0, 5);
        let params = SplatBuffers::upload(&device, &splats, &[], 0).unwrap();
        let mut raster = Rasterizer::new(&device, 900, 0, 75, 53).unwrap();
        raster.set_view(&View::new(&camera, 0.05)).unwrap();
        raster.forward(&params, &RasterOptions::default()).unwrap();
        pairs::count(&device, &raster).unwrap()
    });
    // Rounding may move single pairs over a threshold.
    assert!((shader.blended - native.blended).abs() <= 1e-3 * shader.blended, "{shader:?} {native:?}");
    assert!((shader.in_rows - native.in_rows).abs() <= 1e-3 * shader.in_rows, "{shader:?} {native:?}");
    assert!(native.in_rows <= native.evaluated && native.evaluated < shader.evaluated, "{native:?}");
}

/// Splats after some steps with every loss.
fn trained(device: &Device, degree: u32) -> Splats {
    let (splats, camera) = seeded::small(300, 75, 53, degree, 8);
    let depth = Image::filled(75, 53, 3.0);
    let depths = [DepthMap { confidence: Image::filled(75, 53, 1.0), depth }];
    let colour = |p: usize| [0, 1, 2].map(|c| ((p * (c + 2)) % 17) as f32 / 16.0);
    let images = [RgbImage { width: 75, height: 53, data: (0..75 * 53).map(colour).collect() }];
    let cameras = [camera];
    let options =
        RgbOptions { iterations: 4, bounded: false, virtual_views: 0, ..RgbOptions::preset(Preset::Draft) };
    let scale = SceneScale::measure(&cameras, &splats.means);
    let (depths, silent) = (Some(&depths[..]), &crate::progress::Silent);
    fit_rgb(device, &images, &cameras, splats, scale, depths, &options, silent).unwrap().splats
}

/// Every pass, also those that no training step has, against its reference.
#[test]
fn self_check_passes_with_native_passes() {
    let options = Options { natives: ALL, ..crate::gpu::options(None) };
    let device = TestDevice::open(&options).unwrap();
    let rows = crate::check::run(&device, &options, &mut |_| Ok(())).unwrap();
    let wrong: Vec<_> = rows.iter().filter(|row| row.outcome.is_err()).collect();
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn training_steps_match_shaders() {
    for degree in [0, 2] {
        let [shader, native] = devices().map(|device| trained(&device, degree));
        assert_close("means", shader.means.as_flattened(), native.means.as_flattened(), 1e-3);
        assert_close("scales", shader.log_scales.as_flattened(), native.log_scales.as_flattened(), 1e-2);
        assert_close("SH", &shader.sh, &native.sh, 1e-2);
    }
}
