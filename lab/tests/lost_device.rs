//! Training on a device that is lost or runs out of memory: the error, and the continuation on
//! another device with the same result.
#![allow(clippy::unwrap_used, clippy::panic)] // a panic is how a test fails
use glam::DVec2;
use splatlab::generate::{self, SceneSpec};
use splatvk::Error;
use splatvk::fit::{Preset, RgbOptions, Trained};
use splatvk::gpu::{Device, Options, Recorder};
use splatvk::infer::Registry;
use splatvk::photo::{self, Photo};
use splatvk::pipeline::{Graph, Store};
use splatvk::pose::Geometry;
use splatvk::progress::{Progress, Recorded};
use splatvk::run::stages::{CameraOrigin, Cameras, DenseDepth, DepthPriors, PriorOrigin, TrainColour};
use splatvk::scene::PointCloud;
use std::error::Error as _;
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

const STEPS: usize = 60;

fn device() -> Device {
    Device::open(&Options { deterministic: true, ..splatvk::gpu::options(None) }).unwrap()
}

/// Three photos of a generated scene, its exact cameras, and a point for every fourth pixel.
fn scene() -> (Vec<Photo>, Geometry) {
    let spec = SceneSpec { seed: 1000, views: 3, size: (96, 72), ..SceneSpec::default() };
    let world = generate::build_scene(&spec).unwrap();
    let (mut photos, mut points) = (Vec::new(), PointCloud::default());
    for (view, camera) in world.train.iter().enumerate() {
        let seen = generate::render(&world, camera, 0.0, 0);
        for (x, y) in (0..72).step_by(2).flat_map(|y| (0..96).step_by(2).map(move |x| (x, y))) {
            let z = seen.depth.data[y * 96 + x];
            if z > 0.0 {
                let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                points.positions.push(camera.unproject(pixel, f64::from(z)).as_vec3().to_array());
                points.colours.push(seen.image.data[y * 96 + x]);
                points.confidence.push(1.0);
                points.view.push(view as u32);
                points.radius.push(z / camera.fx as f32);
            }
        }
        let name = format!("{view}.png");
        photos.push(photo::from_pixels(Path::new(&name), &seen.image, Some(camera.fx), 96).unwrap());
    }
    let geometry = Geometry { cameras: world.train.clone(), points, ..Geometry::default() };
    (photos, geometry)
}

/// Records the steps after which figures were reported.
#[derive(Default)]
struct Steps(Mutex<Vec<u64>>);

impl Progress for Steps {
    fn begin(&self, _: &'static str, _: u64) {}
    fn step(&self, _: u64, _: &str) {}
    fn figures(&self, step: u64, _: &[(&str, f64)]) {
        self.0.lock().unwrap().push(step);
    }
    fn end(&self) {}
    fn warn(&self, _: &str) {}
}

/// Trains the colour stage; returns its output and the reported steps.
fn train(device: &Device, store: &Store) -> (splatvk::Result<Trained>, Vec<u64>) {
    let (photos, geometry) = scene();
    let mut graph = Graph::default();
    let cameras = Cameras::new(photos, CameraOrigin::GivenGeometry(geometry), 0).unwrap();
    let placed = graph.add(cameras, ());
    let priors = graph.add(DepthPriors::new(PriorOrigin::None).unwrap(), (placed,));
    let geometry = graph.add(DenseDepth { preset: Preset::Draft, seed: 0 }, (placed, priors));
    let options = RgbOptions::preset(Preset::Draft).with_iterations(STEPS);
    let trained = graph.add(TrainColour { options, preview: None }, (placed, geometry));
    let (steps, registry) = (Steps::default(), Registry::open(None).unwrap());
    let made = graph
        .run(&[trained.target()], device, &registry, store, &Recorded::new(&steps))
        .map(|mut made| made.take(trained).unwrap());
    (made, steps.0.into_inner().unwrap())
}

#[test]
fn training_resumes_bitwise_after_lost_device() {
    let whole_device = device();
    let (whole, _) = train(&whole_device, &Store::none());
    let (whole, submissions) = (whole.unwrap(), whole_device.submissions());

    let folder = tempfile::tempdir().unwrap();
    let kept = || Store::at(folder.path(), true, Duration::ZERO);
    // A store that keeps no state: the error names none.
    let lost = device();
    lost.lose_after(0);
    let error = train(&lost, &Store::none()).0.unwrap_err();
    assert!(matches!(error, Error::DeviceLost { kept: None, .. }), "{error:?}");
    // Loses the device in the middle of training, twice.
    let mut begun = 0;
    for share in [3, 2] {
        let lost = device();
        lost.lose_after(submissions / share);
        let (error, steps) = train(&lost, &kept());
        let error = error.unwrap_err();
        let Error::DeviceLost { kept: Some(kept), .. } = &error else { panic!("{error:?}") };
        assert!(error.source().is_some() && error.exit_code() == 5);
        let text = error.to_string();
        assert!(text.contains("the device was lost") && text.contains("--resume"), "{text}");
        assert!(!text.contains('\n') && text.ends_with(kept), "{text}");
        // The state is kept after every step; figures are reported after some steps.
        let named: u64 = kept.strip_prefix("stage splats after step ").unwrap().parse().unwrap();
        assert!(steps.iter().all(|s| (begun..=named).contains(s)) && named > begun, "{steps:?}, {text}");
        begun = named;
        // Later work on the lost device fails and does not hang.
        let buffer = lost.buffer::<u32>("after", 4).unwrap();
        let mut after = Recorder::new(&lost, "after");
        after.fill(&buffer, 1);
        assert!(matches!(after.run(), Err(splatvk::gpu::Error::DeviceLost { .. })));
    }
    assert!(begun > 0 && begun < STEPS as u64, "lost in the middle: step {begun}");
    let (resumed, steps) = train(&device(), &kept());
    let resumed = resumed.unwrap();
    assert!(steps[0] >= begun, "first reported step {steps:?}, kept step {begun}");
    assert!(resumed.splats == whole.splats && resumed.cameras == whole.cameras, "the same bits");
    let left = Store::list(folder.path());
    let states = left.iter().filter(|(file, _)| file.to_string_lossy().contains("-state-"));
    assert_eq!(states.count(), 0, "states of stages that have ended: {left:?}");
}

#[test]
fn training_resumes_bitwise_after_out_of_memory() {
    let whole_device = device();
    let (whole, _) = train(&whole_device, &Store::none());
    let (whole, buffers) = (whole.unwrap(), whole_device.memory().allocations);
    let folder = tempfile::tempdir().unwrap();
    let kept = || Store::at(folder.path(), true, Duration::ZERO);
    let full = device();
    full.exhaust_after(0);
    let error = train(&full, &Store::none()).0.unwrap_err();
    assert!(matches!(error, Error::OutOfDeviceMemory { kept: None, .. }), "{error:?}");
    let mut stages = Vec::new();
    for refused in [buffers / 3, buffers - 2] {
        let full = device();
        full.exhaust_after(refused);
        let error = train(&full, &kept()).0.unwrap_err();
        let Error::OutOfDeviceMemory { kept: Some(kept), doing, .. } = &error else { panic!("{error:?}") };
        let text = error.to_string();
        assert!(text.ends_with(kept) && text.contains("--resume") && text.contains("fewer splats"), "{text}");
        assert!(doing.contains("buffer") && error.exit_code() == 5 && error.source().is_some(), "{text}");
        stages.push(kept.clone());
        // The device works again once it has memory.
        full.exhaust_after(u64::MAX / 2);
        assert!(full.buffer::<u32>("after", 4).is_ok());
    }
    println!("{stages:?}");
    let resumed = train(&device(), &kept()).0.unwrap();
    assert!(resumed.splats == whole.splats && resumed.cameras == whole.cameras, "the same bits");
}
