//! Milliseconds per pass on the seeded benchmark scene; the figures in docs/performance.md come from here:
//! `cargo test --test timings -- --ignored --nocapture`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // helpers of tests
mod support;
use splatvk::gpu::{Device, Recorder};
use splatvk::pass::seeded;
use std::collections::BTreeMap;
use support::Scene;

fn measure(device: &Device, n: usize, width: u32, height: u32, sh_degree: u32, dim: usize) {
    let (splats, camera) = seeded::benchmark(n, width, height, sh_degree, 0);
    let scene = Scene::new(splats, &camera, dim, 0);
    let (params, mut raster) = scene.upload(device);
    raster.forward(&params, &scene.options).unwrap();
    raster.frame().planes_grad.write(&scene.upstream(1)).unwrap();
    let gradients = params.zeros_like(device).unwrap();
    // Best of five after one warm-up: the first run of a pipeline includes the driver's compilation.
    let mut best: BTreeMap<(usize, String), f64> = BTreeMap::new();
    let mut whole = f64::INFINITY;
    for round in 0..6 {
        let mut rec = Recorder::new(device, "step");
        raster.record_forward(&mut rec, &params, &scene.options);
        raster.record_backward(&mut rec, &params, &scene.options, &gradients);
        let program = rec.compile().unwrap();
        let started = std::time::Instant::now();
        let times = program.run_timed().unwrap();
        if round == 0 {
            println!(
                "first run, with the driver's compilation: {:.0} ms",
                started.elapsed().as_secs_f64() * 1e3
            );
            continue;
        }
        whole = whole.min(started.elapsed().as_secs_f64() * 1e3);
        for (k, (label, ms)) in times.into_iter().enumerate() {
            let slot = best.entry((k, label)).or_insert(f64::INFINITY);
            *slot = slot.min(ms);
        }
    }
    let entries = raster.frame().status.read::<u32>().unwrap()[0];
    println!(
        "{n} splats, {width} × {height}, SH {sh_degree}, {dim} features: {entries} tile entries, {whole:.1} ms"
    );
    for ((_, label), ms) in best {
        println!("  {label:<24} {ms:8.2}");
    }
}

#[test]
#[ignore = "a measurement, minutes on a busy machine"]
fn timings() {
    let device = Device::open(None).unwrap();
    println!("{}", device.info().name);
    for dim in [0, 3, 16, 48] {
        measure(&device, 100_000, 640, 480, 0, dim);
    }
    measure(&device, 100_000, 640, 480, 3, 0);
}
