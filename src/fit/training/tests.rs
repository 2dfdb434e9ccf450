use super::*;
use crate::fit::losses::Losses;
use crate::fit::rgb::fit_photos;
use crate::fit::{
    DensifyOptions, LanguageOptions, LanguageRun, Photos, Preset, RgbOptions, RgbRun, pose::PoseOptions,
    scale::SceneScale, schedule::Exponential,
};
use crate::gpu::{Device, KernelVariant, Options, TestDevice};
use crate::scene::seeded;
use crate::scene::{Camera, Codebook, Image, LevelField, Pose, RgbImage, Splats};
use glam::DVec3;
use std::time::Duration;

const COUNTED: usize = 8;

/// Cost per step of a stage once every view is recorded, and its results.
#[derive(Debug, PartialEq)]
struct Outcome {
    submissions: f64,
    allocations: f64,
    splats: Splats,
    features: Vec<f32>,
    camera: Vec<f32>,
}

fn device(staging: bool) -> TestDevice {
    TestDevice::open(&Options { staging, deterministic: true, ..crate::gpu::options(None) }).unwrap()
}

fn scene() -> (Splats, Vec<Camera>, Vec<RgbImage>) {
    let (splats, camera) = seeded::small(300, 75, 53, 0, 3);
    let cameras: Vec<Camera> = [0.0, 0.01]
        .map(|a| Camera {
            pose: Pose::exp(DVec3::ZERO, DVec3::X * a).compose(&camera.pose),
            ..camera.clone()
        })
        .into();
    let image =
        |i: usize| (0..75 * 53).map(|p| [0, 1, 2].map(|c| ((p * (c + 2) + i) % 17) as f32 / 16.0)).collect();
    (splats, cameras, (0..2).map(|i| RgbImage { width: 75, height: 53, data: image(i) }).collect())
}

fn measure(device: &Device, run: &mut impl Training) -> Outcome {
    for iteration in 0..COUNTED {
        run.step(iteration).unwrap();
    }
    let before = (device.submissions(), device.memory().allocations);
    for iteration in COUNTED..2 * COUNTED {
        run.step(iteration).unwrap();
    }
    run.finish_step().unwrap();
    let submissions = (device.submissions() - before.0) as f64 / COUNTED as f64;
    let allocations = (device.memory().allocations - before.1) as f64 / COUNTED as f64;
    let resources = run.trainer().step_resources();
    let (splats, features) = resources.params.download().unwrap();
    let camera = resources.raster.camera().cast::<f32>().read().unwrap();
    Outcome { submissions, allocations, splats, features, camera }
}

/// How the host and the device work together.
#[derive(Clone, Copy, Debug)]
struct Way {
    overlaps: bool,
    /// Entries in the tile lists at first, if too few.
    short_lists: Option<usize>,
}

const ONE_BY_ONE: Way = Way { overlaps: false, short_lists: None };

fn go(device: &Device, run: &mut impl Training, way: Way) -> Outcome {
    run.trainer_mut().overlaps = way.overlaps;
    if let Some(entries) = way.short_lists {
        run.trainer_mut().views.raster.grow(entries).unwrap();
    }
    measure(device, run)
}

fn colour_options() -> RgbOptions {
    let rate = Exponential { start: 1e-3, end: 1e-4, steps: 2 * COUNTED };
    // Slow enough that no tile list grows while steps are counted.
    let rates = RgbOptions::preset(Preset::Paper).rates;
    RgbOptions { poses: Some(PoseOptions { start: 0, rate }), rates, ..RgbOptions::preset(Preset::Draft) }
}

fn colour(device: &Device, way: Way) -> Outcome {
    let (splats, cameras, images) = scene();
    let options = colour_options();
    let scale = SceneScale::measure(&cameras, &splats.means);
    let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
    let mut run = RgbRun::new(device, photos, &splats, scale, &options).unwrap();
    go(device, &mut run, way)
}

fn language(device: &Device, way: Way) -> Outcome {
    let (splats, cameras, images) = scene();
    let labels = |v: usize| (0..75 * 53).map(|p| ((p / 9 + v) % 3) as i32).collect();
    let level = LevelField {
        codebook: Codebook {
            embedding_dim: 1,
            code_dim: 3,
            embeddings: vec![1.0; 3],
            codes: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            ..Codebook::default()
        },
        targets: (0..2).map(|v| Image { width: 75, height: 53, data: labels(v) }).collect(),
        ..LevelField::default()
    };
    let options = LanguageOptions::preset(Preset::Draft);
    let mut run = LanguageRun::new(
        device,
        Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] },
        &splats,
        &[(0, &level)],
        &options,
        &crate::progress::Silent,
    )
    .unwrap();
    go(device, &mut run, way)
}

/// Views of two sizes put their gradients at different places of one buffer.
#[test]
fn sizes_leave_each_other_no_gradients() {
    let device = device(false);
    let (splats, mut cameras, mut images) = scene();
    (cameras[1].width, cameras[1].height) = (40, 30);
    images[1] = RgbImage { width: 40, height: 30, data: images[1].data[..40 * 30].to_vec() };
    let options = LanguageOptions { detach_geometry: true, ..LanguageOptions::preset(Preset::Draft) };
    let level = LevelField {
        codebook: Codebook {
            embedding_dim: 1,
            code_dim: 1,
            embeddings: vec![1.0],
            codes: vec![1.0],
            ..Codebook::default()
        },
        targets: images
            .iter()
            .map(|i| Image { width: i.width, height: i.height, data: vec![0; i.data.len()] })
            .collect(),
        ..LevelField::default()
    };
    let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
    let mut run =
        LanguageRun::new(&device, photos, &splats, &[(0, &level)], &options, &crate::progress::Silent)
            .unwrap();
    for iteration in 0..4 {
        run.step(iteration).unwrap();
        run.finish_step().unwrap();
        let frame = run.trainer().step_resources().raster.frame();
        let (pixels, written) = (frame.pixels() as usize, frame.planes_grad.read().unwrap());
        assert!(written[..4 * pixels].iter().all(|g| *g == 0.0), "gradients by colours");
        assert!(written[4 * pixels..5 * pixels].iter().any(|g| *g != 0.0));
    }
}

#[test]
fn step_is_one_submission_without_allocation() {
    let (mapped, staged) = (device(false), device(true));
    assert!(!staged.info().mapped);
    for stage in [colour, language] {
        let (here, there) = (stage(&mapped, ONE_BY_ONE), stage(&staged, ONE_BY_ONE));
        assert_eq!((there.submissions, there.allocations), (1.0, 0.0));
        assert_eq!(here, there, "other bits without mapped memory");
    }
}

/// Two steps in flight, also where both find their lists too short.
#[test]
fn overlapping_steps_give_the_same_bits() {
    for staging in [false, true] {
        let device = device(staging);
        for stage in [colour, language] {
            let expected = stage(&device, ONE_BY_ONE);
            for short_lists in [None, Some(8)] {
                for overlaps in [true, false] {
                    let way = Way { overlaps, short_lists };
                    let found = stage(&device, way);
                    assert_eq!(found, expected, "{way:?}, staging {staging}");
                }
            }
        }
    }
}

/// Parameters after training with each update.
fn by_update(train: impl Fn(&Device) -> [Vec<f32>; 6]) -> [[Vec<f32>; 6]; 2] {
    [KernelVariant::FusedUpdate, KernelVariant::SeparateUpdate].map(|disabled| {
        let disabled = [disabled.name().to_owned()].into();
        let options = Options { disabled, deterministic: true, ..crate::gpu::options(None) };
        train(&TestDevice::open(&options).unwrap())
    })
}

fn numbers(splats: Splats, features: Vec<f32>) -> [Vec<f32>; 6] {
    let Splats { means, log_scales, quats, opacity_logits, sh, .. } = splats;
    let [means, log_scales] = [means, log_scales].map(|v| v.as_flattened().to_vec());
    [means, log_scales, quats.as_flattened().to_vec(), opacity_logits, sh, features]
}

/// Adam's first steps have the length of the rate whatever the gradient, so that where it is
/// rounding alone the parameters may go apart: these are the outliers.
fn assert_same_training([separate, fused]: [[Vec<f32>; 6]; 2]) {
    for (class, (a, b)) in separate.iter().zip(&fused).enumerate() {
        assert_eq!(a.len(), b.len(), "class {class}");
        let apart = a.iter().zip(b).filter(|(a, b)| (**a - **b).abs() > 1e-5 * (1.0 + a.abs())).count();
        println!("class {class}: {apart} of {} numbers", a.len());
        assert!(apart * 100 <= a.len(), "class {class}: {apart} of {} numbers", a.len());
    }
}

/// With refined poses, penalised needles and pruning.
#[test]
fn fused_update_trains_the_same() {
    let (_, cameras, images) = scene();
    for sh_degree in [0, 3] {
        let (mut start, _) = seeded::small(301, 75, 53, sh_degree, 3);
        start.log_scales[0] = [-1.0, -4.0, -4.0];
        start.opacity_logits[1] = -9.0;
        let options = RgbOptions {
            iterations: 2 * COUNTED,
            prune_from: COUNTED,
            prune_every: COUNTED,
            losses: Losses { needles: Some(0.1), ..Losses::PHOTOS },
            ..colour_options()
        };
        let scale = SceneScale::measure(&cameras, &start.means);
        let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
        assert_same_training(by_update(|device| {
            let silent = &crate::progress::Silent;
            let out = fit_photos(device, photos, start.clone(), scale, &options, silent).unwrap();
            assert!(out.splats.len() < start.len(), "pruned");
            numbers(out.splats, Vec::new())
        }));
    }
    assert_same_training(by_update(|device| {
        let Outcome { splats, features, .. } = language(device, ONE_BY_ONE);
        numbers(splats, features)
    }));
}

/// Progress with a checkpoint only.
struct CheckpointOnly(Checkpoint);

impl Progress for CheckpointOnly {
    fn begin(&self, _: &'static str, _: u64) {}
    fn step(&self, _: u64, _: &str) {}
    fn end(&self) {}
    fn warn(&self, _: &str) {}
    fn checkpoint(&self) -> Option<&Checkpoint> {
        Some(&self.0)
    }
}

/// With splats that grow between checkpoint and end, by sums from before the checkpoint.
#[test]
fn resumed_training_has_the_same_bits() {
    let device = device(false);
    let (splats, cameras, images) = scene();
    let scale = SceneScale::measure(&cameras, &splats.means);
    let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
    let growing = DensifyOptions { every: COUNTED + 4, gradient: 1e-6, ..DensifyOptions::PUBLISHED };
    for densify in [None, Some(growing)] {
        let options = RgbOptions { densify, ..colour_options() };
        let new = || RgbRun::new(&device, photos, &splats, scale, &options).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let progress = CheckpointOnly(Checkpoint::new(folder.path().join("state"), Duration::ZERO, true));
        let (mut whole, mut resumed) = (new(), new());
        (0..COUNTED).for_each(|iteration| whole.step(iteration).unwrap());
        whole.finish_step().unwrap();
        save(&whole, COUNTED, &progress).unwrap();
        assert_eq!(restore(&mut resumed, &progress).unwrap(), COUNTED);
        let [a, b] = [&mut whole, &mut resumed].map(|run| {
            for iteration in COUNTED..2 * COUNTED {
                run.step(iteration).unwrap();
                run.finish_step().unwrap();
                run.review(iteration + 1).unwrap();
            }
            (run.trainer().step_resources().params.download().unwrap(), run.trainer().cameras.clone())
        });
        assert!(a == b, "other bits");
        assert_eq!(a.0.0.len() > splats.len(), densify.is_some(), "{} splats", a.0.0.len());
    }
}
