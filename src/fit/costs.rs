//! Costs of a training step on a GPU that need no GPU: commands, barriers, memory, and pairs of
//! pixels and splats. A change that makes one larger states so in its commit.
use super::options::Rates;
use super::scale::SceneScale;
use super::{Photos, Preset, RgbOptions, RgbRun, Training};
use crate::gpu::{Options, TestDevice, idle_device, native, options, test_device};
use crate::pass::{RasterOptions, Rasterizer, SplatBuffers, View, pairs};
use crate::scene::{RgbImage, seeded};
use std::collections::BTreeMap;

/// Commands and barriers of the step of `splatvk bench` on a seeded scene, its commands by pass, and
/// the bytes of device memory of its training.
struct Step {
    counts: (usize, usize),
    passes: BTreeMap<&'static str, usize>,
    bytes: f64,
}

fn step(splats: usize, [width, height]: [u32; 2], degree: u32) -> Step {
    let device = idle_device();
    let (splats, camera) = seeded::benchmark(splats, width, height, degree, 0);
    let (width, height) = (width as usize, height as usize);
    let images = [RgbImage { width, height, data: vec![[0.5; 3]; width * height] }];
    let cameras = [camera];
    let options = RgbOptions {
        rates: Rates::STILL,
        poses: None,
        virtual_views: 0,
        ..RgbOptions::preset(Preset::Default)
    };
    let scale = SceneScale::measure(&cameras, &splats.means);
    let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
    let before = device.memory().current;
    let run = RgbRun::new(&device, photos, &splats, scale, &options).unwrap();
    let program = run.record(0).compile().unwrap();
    let mut passes = BTreeMap::new();
    program.passes().for_each(|pass| *passes.entry(pass).or_default() += 1);
    Step { counts: program.counts(), passes, bytes: (device.memory().current - before) as f64 }
}

#[test]
fn commands_of_a_step_do_not_grow() {
    for degree in [0, 3] {
        let Step { counts, passes, .. } = step(100_000, [640, 480], degree);
        println!("SH {degree}: {counts:?} {passes:?}");
        assert_eq!(counts, (20, 18), "commands and barriers: {passes:?}");
    }
}

#[test]
fn memory_of_training_does_not_grow() {
    for (degree, most) in [(0, 335.0), (3, 695.0)] {
        let [small, large] = [100_000, 200_000].map(|splats| step(splats, [64, 48], degree).bytes);
        let per_splat = (large - small) / 1e5;
        println!("SH {degree}: {per_splat:.1} bytes per splat");
        assert!(per_splat <= most, "SH {degree}: {per_splat} bytes per splat");
    }
    let [small, large] = [[640, 480], [1280, 960]].map(|size| step(1000, size, 0).bytes);
    let per_pixel = (large - small) / (3.0 * 640.0 * 480.0);
    println!("{per_pixel:.1} bytes per pixel");
    assert!(per_pixel <= 144.0, "{per_pixel} bytes per pixel");
}

/// Pairs that raster passes evaluate in vain, on the scene of `splatvk bench`.
#[test]
fn evaluated_pairs_do_not_grow() {
    let natives = TestDevice::open(&Options { natives: native::ALL, ..options(None) }).unwrap();
    for (device, most) in [(&test_device(), 2.93), (&natives, 1.99)] {
        let (splats, camera) = seeded::benchmark(100_000, 640, 480, 0, 0);
        let params = SplatBuffers::upload(device, &splats, &[], 0).unwrap();
        let mut raster = Rasterizer::new(device, splats.len(), 0, 640, 480).unwrap();
        raster.set_view(&View::new(&camera, 0.05)).unwrap();
        raster.forward(&params, &RasterOptions::default()).unwrap();
        let pairs = pairs::count(device, &raster).unwrap();
        let ratio = pairs.evaluated / pairs.blended;
        println!("{ratio:.3} evaluated per blended pair");
        assert!(ratio <= most && ratio > most - 0.1, "{ratio} evaluated per blended pair");
    }
}
