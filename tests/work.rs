//! The counted work of a run, stage by stage, does not grow: steps, submissions, and transfers
//! between host and device. Seconds differ between machines, counts do not.
#![allow(clippy::unwrap_used)] // helpers of tests
mod fixture;

use fixture::{camera, data, truth};
use splatvk::gpu::{self, Options, TestDevice, WorkCounts};
use splatvk::infer::Registry;
use splatvk::photo::{self, Photo};
use splatvk::progress::{Progress, Silent};
use splatvk::run::{self, Extras, ReconstructionConfig};
use std::sync::Mutex;

/// Longer side of the photos, pixels: a run with shaders takes seconds on a CPU device.
const SIZE: usize = 160;

/// Most work of a stage: steps, submissions, reads, and KiB read and written.
type Limit = (&'static str, [u64; 5]);

/// The work of a run on four photos of 160 × 120 pixels with known cameras, at the preset draft,
/// with some room: a tile list that overflows repeats a step. A change that saves a fifth of a count
/// lowers it here, too.
const LIMITS: [Limit; 5] = [
    ("dense stereo", [550, 62, 1, 1250, 1850]),
    ("splats", [200, 255, 530, 15_000, 8200]),
    ("language", [0, 22, 57, 25_600, 2750]),
    ("decode", [4, 17, 39, 3000, 10_800]),
    ("seen", [4, 8, 9, 8900, 4300]),
];

/// Progress that notes the work of the device at the beginning of every stage.
struct Counter {
    device: gpu::Device,
    stages: Mutex<Vec<(&'static str, u64, WorkCounts)>>,
}

impl Progress for Counter {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.stages.lock().unwrap().push((stage, steps, self.device.work()));
    }
    fn step(&self, _: u64, _: &str) {}
    fn end(&self) {}
    fn warn(&self, message: &str) {
        eprintln!("{message}");
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        // Networks, which do not use the device.
        Box::new(Silent)
    }
}

fn photos() -> (Vec<Photo>, Extras) {
    let files = photo::gather(&[data("breakfast/images")], &Silent).unwrap();
    let photos = photo::load_each(&files, SIZE, &Silent).unwrap();
    let truth = truth();
    let given = photos.iter().map(|photo| {
        let named = |frame: &&serde_json::Value| frame["file"].as_str().unwrap().contains(&photo.stem);
        let frame = truth["frames"].as_array().unwrap().iter().find(named).unwrap();
        let size = (photo.image.width as u32, photo.image.height as u32);
        camera(frame, &photo.stem).resized(size.0, size.1).into()
    });
    let cameras = given.collect();
    (photos, Extras { cameras, queries: vec!["mug".into()] })
}

/// Work of each stage of a run, by shaders alone, as on a GPU.
fn counted() -> Vec<(&'static str, [u64; 5])> {
    let disabled =
        ["native passes", "plane sweep on the host", "text queries on the host"].map(str::to_owned).into();
    let device = TestDevice::open(&Options { disabled, ..gpu::options(None) }).unwrap();
    let counter = Counter { device: (*device).clone(), stages: Mutex::default() };
    let (photos, extras) = photos();
    let registry = Registry::open(None).unwrap();
    let config = ReconstructionConfig::default();
    run::reconstruct(&config, &extras, &device, &registry, photos, &counter).unwrap();
    counter.begin("end", 0);
    let stages = counter.stages.into_inner().unwrap();
    let work = stages.windows(2).map(|pair| {
        let [(stage, steps, before), (_, _, after)] = pair else { unreachable!() };
        let w = *after - *before;
        (*stage, [*steps, w.submissions, w.reads, w.bytes_read >> 10, w.bytes_written >> 10])
    });
    work.collect()
}

#[test]
fn counted_work_does_not_grow() {
    let counted = counted();
    for (stage, work) in &counted {
        println!("    (\"{stage}\", {work:?}),");
    }
    for (stage, limits) in LIMITS {
        let found = counted.iter().filter(|(s, _)| *s == stage);
        let total = found.fold([0; 5], |sum: [u64; 5], (_, work)| std::array::from_fn(|k| sum[k] + work[k]));
        for ((name, limit), total) in
            ["steps", "submissions", "reads", "KiB read", "KiB written"].into_iter().zip(limits).zip(total)
        {
            assert!(total <= limit, "{stage}: {total} {name}, at most {limit} so far");
            assert!(5 * total >= 4 * limit, "{stage}: {total} {name}: lower the limit of {limit}");
        }
    }
}
