//! Executed instructions of the training passes do not grow: counted in the interpreter at subgroup
//! sizes of CPU devices and GPUs, since seconds differ between machines and counts do not.
use super::{Interpreted, interpreted};
use spirv_interpreter::{Counts, Order, Schedule};
use splatvk::gpu::Recorder;
use splatvk::math::Random;
use splatvk::pass::adam::{Moments, Schedule as Rates};
use splatvk::pass::fused_update::SplatAdam;
use splatvk::pass::project::DEPTH_BITS;
use splatvk::pass::sort::Sort;
use splatvk::pass::ssim_l1::SsimL1;
use splatvk::pass::sum::PARTIALS;
use splatvk::pass::{RasterOptions, Rasterizer, SplatBuffers, View};
use splatvk::scene::seeded;
use std::collections::BTreeMap;

/// The scene of `splatvk bench`, cut to four by three tiles: lists are as long as there.
const SPLATS: usize = 250;
const SIZE: [u32; 2] = [32, 24];
/// Keys of the sort: several of its partition tiles.
const PAIRS: usize = 8192;

/// Unit of a cost.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Per {
    Entry,
    Splat,
    Pair,
    Pixel,
}

/// Instructions of a family at a subgroup size, per unit of work: arithmetic, of these
/// transcendental, subgroup operations, accesses of workgroup memory, accesses of buffers, atomics,
/// and barriers per hundred units. A change that makes one larger states so in its commit.
type Limit = (u32, &'static str, Per, [f64; 7]);

const LIMITS: &[Limit] = &[
    (8, "bin_large", Per::Entry, [0.22, 0.00, 0.00, 0.00, 0.05, 0.00, 0.00]),
    (8, "bin_ranges", Per::Entry, [10.26, 0.00, 0.00, 0.00, 9.49, 0.00, 0.00]),
    (8, "bin_sweep", Per::Entry, [18.26, 0.77, 0.36, 0.21, 0.40, 0.21, 3.60]),
    (8, "camera_sum", Per::Splat, [37.48, 0.00, 0.00, 5.40, 0.08, 0.00, 1024.00]),
    (8, "fused_update", Per::Splat, [172.80, 6.40, 1.28, 5.69, 8.86, 0.00, 38.40]),
    (8, "project", Per::Splat, [40.21, 2.82, 0.00, 0.00, 5.90, 0.00, 0.00]),
    (8, "raster_backward_shared", Per::Entry, [392.56, 16.11, 5.16, 22.36, 1.68, 1.51, 115.09]),
    (8, "raster_forward", Per::Entry, [126.82, 5.20, 10.13, 0.00, 1.20, 0.00, 0.00]),
    (8, "sort_digits", Per::Pair, [5.38, 0.00, 0.00, 0.19, 0.16, 0.47, 6.25]),
    (8, "sort_sweep", Per::Pair, [53.05, 0.00, 13.97, 4.58, 0.81, 0.53, 5.86]),
    (8, "ssim_columns", Per::Pixel, [32.77, 0.00, 0.00, 0.00, 1.81, 0.00, 0.00]),
    (8, "ssim_gradient", Per::Pixel, [30.17, 0.00, 0.00, 0.00, 2.22, 0.00, 0.00]),
    (8, "ssim_rows_shared", Per::Pixel, [110.34, 1.88, 0.00, 17.91, 1.78, 0.00, 150.00]),
    (8, "sum", Per::Pixel, [172.05, 0.00, 0.00, 22.50, 0.22, 0.00, 4800.00]),
    (32, "bin_large", Per::Entry, [0.22, 0.00, 0.00, 0.00, 0.05, 0.00, 0.00]),
    (32, "bin_ranges", Per::Entry, [2.59, 0.00, 0.00, 0.00, 2.38, 0.00, 0.00]),
    (32, "bin_sweep", Per::Entry, [5.84, 0.24, 0.09, 0.15, 0.12, 0.07, 3.60]),
    (32, "camera_sum", Per::Splat, [9.80, 0.00, 0.00, 1.80, 0.08, 0.00, 256.00]),
    (32, "fused_update", Per::Splat, [49.16, 1.86, 0.32, 1.60, 2.35, 0.00, 9.60]),
    (32, "project", Per::Splat, [10.06, 0.70, 0.00, 0.00, 1.49, 0.00, 0.00]),
    (32, "raster_backward_shared", Per::Entry, [105.55, 4.18, 1.34, 9.89, 0.50, 0.39, 31.19]),
    (32, "raster_forward", Per::Entry, [41.93, 1.62, 0.04, 5.34, 0.39, 0.00, 3.72]),
    (32, "sort_digits", Per::Pair, [1.34, 0.00, 0.00, 0.05, 0.04, 0.12, 1.56]),
    (32, "sort_sweep", Per::Pair, [12.81, 0.00, 3.49, 1.02, 0.21, 0.13, 5.86]),
    (32, "ssim_columns", Per::Pixel, [8.19, 0.00, 0.00, 0.00, 0.45, 0.00, 0.00]),
    (32, "ssim_gradient", Per::Pixel, [7.54, 0.00, 0.00, 0.00, 0.55, 0.00, 0.00]),
    (32, "ssim_rows_shared", Per::Pixel, [39.84, 0.75, 0.00, 6.19, 0.66, 0.00, 37.50]),
    (32, "sum", Per::Pixel, [44.56, 0.00, 0.00, 7.50, 0.18, 0.00, 1200.00]),
    (64, "bin_large", Per::Entry, [0.11, 0.00, 0.00, 0.00, 0.03, 0.00, 0.00]),
    (64, "bin_ranges", Per::Entry, [1.31, 0.00, 0.00, 0.00, 1.20, 0.00, 0.00]),
    (64, "bin_sweep", Per::Entry, [3.00, 0.13, 0.05, 0.05, 0.06, 0.04, 1.80]),
    (64, "camera_sum", Per::Splat, [5.24, 0.00, 0.00, 1.28, 0.08, 0.00, 128.00]),
    (64, "fused_update", Per::Splat, [26.00, 0.99, 0.16, 0.86, 1.22, 0.00, 4.80]),
    (64, "project", Per::Splat, [5.04, 0.35, 0.00, 0.00, 0.75, 0.00, 0.00]),
    (64, "raster_backward_shared", Per::Entry, [59.11, 2.13, 0.69, 7.81, 0.31, 0.20, 16.89]),
    (64, "raster_forward", Per::Entry, [26.33, 1.00, 0.02, 5.29, 0.25, 0.00, 2.25]),
    (64, "sort_digits", Per::Pair, [0.67, 0.00, 0.00, 0.02, 0.02, 0.06, 0.78]),
    (64, "sort_sweep", Per::Pair, [7.96, 0.00, 1.75, 0.50, 0.12, 0.07, 5.86]),
    (64, "ssim_columns", Per::Pixel, [8.16, 0.00, 0.00, 0.00, 0.45, 0.00, 0.00]),
    (64, "ssim_gradient", Per::Pixel, [7.51, 0.00, 0.00, 0.00, 0.55, 0.00, 0.00]),
    (64, "ssim_rows_shared", Per::Pixel, [29.91, 0.38, 0.00, 4.97, 0.47, 0.00, 18.75]),
    (64, "sum", Per::Pixel, [23.53, 0.00, 0.00, 5.33, 0.17, 0.00, 600.00]),
];

/// A device that counts, with workgroups in order.
fn counting(subgroup_size: usize) -> Interpreted {
    let on = interpreted(subgroup_size, true);
    Interpreted { schedule: Schedule { order: Order::Rising, in_flight: 1, ..on.schedule }, ..on }
}

/// Counts of one training step by family, and the number of entries.
fn step(on: &Interpreted) -> (BTreeMap<&'static str, Counts>, f64) {
    let device = on.open();
    let (splats, camera) = seeded::benchmark(SPLATS, SIZE[0], SIZE[1], 0, 0);
    let params = SplatBuffers::upload(&device, &splats, &[], 0).unwrap();
    let mut raster = Rasterizer::new(&device, SPLATS, 0, SIZE[0], SIZE[1]).unwrap();
    raster.set_view(&View::new(&camera, 0.05)).unwrap();
    let options = RasterOptions::default();
    // Grows the lists; only the step below counts.
    raster.forward(&params, &options).unwrap();
    on.counts.lock().unwrap().clear();
    let frame = raster.frame();
    let target = device.buffer_from("target", &vec![0.5f32; 3 * frame.pixels() as usize]).unwrap();
    let sums = device.buffer::<f32>("sums", 2 * PARTIALS).unwrap();
    let ssim = SsimL1::new(&device, std::slice::from_ref(&frame.bands)).unwrap();
    let moments = [3, 3, 4, 1, 3].map(|width| Moments::new(&device, SPLATS * width).unwrap());
    let rates = Rates::new(&device, 6).unwrap();
    let mut rec = Recorder::new(&device, "step");
    raster.record_forward(&mut rec, &params, &options);
    let band = frame.bands.get(0);
    let (planes, upstream) = (&frame.planes, &frame.planes_grad);
    ssim.record(&mut rec, (&frame.bands, &band), planes, &target, upstream, None, [0.8, 0.2], (&sums, 0));
    raster.record_band_backward(&mut rec, &params, &options, &band);
    let state = SplatAdam { moments: &moments, schedule: &rates, needles: None };
    raster.record_update(&mut rec, &params, &options, &state);
    rec.run().unwrap();
    let entries = f64::from(raster.frame().status.read().unwrap()[0]);
    let mut counts = std::mem::take(&mut *on.counts.lock().unwrap());
    counts.retain(|family, _| !family.starts_with("sort"));
    (counts, entries)
}

/// Counts of the sort of [`PAIRS`] keys as wide as depths.
fn sort(on: &Interpreted) -> BTreeMap<&'static str, Counts> {
    let device = on.open();
    let mut random = Random::new(1);
    let pairs: Vec<u32> = (0..2 * PAIRS).map(|_| random.bits() as u32).collect();
    let pairs = device.buffer_from("pairs", &pairs).unwrap();
    let count = device.buffer_from("count", &[PAIRS as u32]).unwrap();
    let mut rec = Recorder::new(&device, "sort");
    Sort::new(&device, PAIRS).unwrap().record(&mut rec, &pairs, &count, DEPTH_BITS);
    rec.run().unwrap();
    std::mem::take(&mut *on.counts.lock().unwrap())
}

fn per_unit(counts: &Counts, units: f64) -> [f64; 7] {
    let Counts { arithmetic, transcendental, subgroup, shared, buffers, atomics, barriers } = *counts;
    [arithmetic, transcendental, subgroup, shared, buffers, atomics, 100 * barriers].map(|n| n as f64 / units)
}

#[test]
fn instructions_per_unit_do_not_grow() {
    let mut wrong = Vec::new();
    for size in [8, 32, 64] {
        let on = counting(size);
        let (mut counts, entries) = step(&on);
        counts.extend(sort(&on));
        for (family, counts) in &counts {
            let limit = LIMITS.iter().find(|l| (l.0, l.1) == (size as u32, *family));
            let units = match limit.map(|l| l.2) {
                Some(Per::Entry) => entries,
                Some(Per::Splat) => SPLATS as f64,
                Some(Per::Pair) => PAIRS as f64,
                Some(Per::Pixel) => f64::from(SIZE[0] * SIZE[1]),
                None => f64::NAN,
            };
            let found = per_unit(counts, units);
            let text: Vec<String> = found.iter().map(|n| format!("{n:.2}")).collect();
            let Some((_, _, per, limits)) = limit else {
                wrong.push(format!("{family} at {size} lanes has no row"));
                continue;
            };
            println!("    ({size}, \"{family}\", Per::{per:?}, [{}]),", text.join(", "));
            for (k, (found, limit)) in found.iter().zip(limits).enumerate() {
                if *found > limit + 0.006 {
                    wrong.push(format!("{family} at {size} lanes, number {k}: {found:.2}, at most {limit}"));
                } else if *found < 0.95 * limit - 0.006 {
                    wrong.push(format!("{family} at {size} lanes, number {k}: {found:.2}, lower {limit}"));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
