//! Milliseconds per pass on the seeded benchmark scene; the figures in docs/performance.md come from here:
//! `cargo test --test timings -- --ignored --nocapture`.
//!
//! On a CPU device the processor time of the process, divided by its cores, is what a pass would take on an otherwise
//! idle machine; it hardly depends on what else runs. The wall time (best run) is printed beside it.
#![allow(clippy::unwrap_used)] // helpers of tests
mod support;
use splatvk::gpu::{Device, Recorder};
use splatvk::pass::rasterizer::{FrameBuffers, Rasterizer, SplatBuffers};
use splatvk::pass::{bin, project, project_backward, raster_backward, raster_forward, seeded};
use std::time::Instant;
use support::Scene;

/// Processor seconds of this process so far, all threads; Linux counts them in hundredths.
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(')').next().unwrap_or_default();
    let ticks: f64 =
        after_name.split_whitespace().skip(11).take(2).filter_map(|t| t.parse::<f64>().ok()).sum();
    ticks / 100.0
}

/// Runs what `record` records: once to warm up, then until a second of processor time is used.
fn measure(device: &Device, label: &str, record: &dyn Fn(&mut Recorder)) {
    let mut rec = Recorder::new(device, label);
    record(&mut rec);
    let program = rec.compile().unwrap();
    program.run().unwrap();
    let cores = std::thread::available_parallelism().map_or(1, usize::from) as f64;
    let (before, mut runs, mut best) = (processor_seconds(), 0, f64::INFINITY);
    while processor_seconds() - before < 1.0 && runs < 500 {
        let start = Instant::now();
        program.run().unwrap();
        best = best.min(start.elapsed().as_secs_f64() * 1e3);
        runs += 1;
    }
    let processor = (processor_seconds() - before) * 1e3 / f64::from(runs) / cores;
    println!("  {label:<22} {processor:8.2} ms processor / cores, {best:8.2} ms best wall, {runs} runs");
}

fn scene_timings(device: &Device, n: usize, size: [u32; 2], sh_degree: u32, dim: usize) {
    let (splats, camera) = seeded::benchmark(n, size[0], size[1], sh_degree, 0);
    let scene = Scene::new(splats, &camera, dim, 0);
    let (params, mut raster) = scene.upload(device);
    raster.forward(&params, &scene.options).unwrap();
    raster.frame().planes_grad.write(&scene.upstream(1)).unwrap();
    let gradients = params.zeros_like(device).unwrap();
    let entries = raster.frame().status.read::<u32>().unwrap()[0];
    println!("{n} splats, {} × {}, SH {sh_degree}, {dim} features: {entries} tile entries", size[0], size[1]);
    single_passes(device, &scene, &params, &raster, &gradients);
    measure(device, "forward", &|rec| raster.record_forward(rec, &params, &scene.options));
    measure(device, "forward + backward", &|rec| {
        raster.record_forward(rec, &params, &scene.options);
        raster.record_backward(rec, &params, &scene.options, &gradients);
    });
}

fn single_passes(
    device: &Device,
    scene: &Scene,
    params: &SplatBuffers,
    raster: &Rasterizer,
    gradients: &SplatBuffers,
) {
    let (camera, degree, frame): (_, _, &FrameBuffers) = (raster.camera(), params.sh_degree, raster.frame());
    // In the order of a step, but the projection first rewrites the sort keys; the last line of `scene_timings`
    // sorts them again.
    measure(device, "binning", &|rec| bin::record(rec, frame, params.count));
    measure(device, "raster forward", &|rec| raster_forward::record(rec, camera, frame));
    measure(device, "raster backward", &|rec| raster_backward::record(rec, frame, true));
    measure(device, "projection backward", &|rec| {
        project_backward::record(rec, params, camera, frame, degree, gradients, &frame.camera_grad);
        project_backward::record_features(rec, params, frame, scene.options.feature_mode, gradients);
    });
    measure(device, "projection", &|rec| {
        project::record(rec, params, camera, frame, degree);
        project::record_features(rec, params, frame, scene.options.feature_mode);
    });
}

#[test]
#[ignore = "a measurement, a minute or more"]
fn timings() {
    let device = Device::open(None).unwrap();
    println!("{}", device.info().name);
    for (sh_degree, dim) in [(0, 0), (3, 0), (0, 3), (0, 16), (0, 48)] {
        scene_timings(&device, 100_000, [640, 480], sh_degree, dim);
    }
}
