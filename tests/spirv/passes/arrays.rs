//! Passes over plain arrays: scan, gather, sum, sort.
use splatvk::gpu::{Device, Recorder, shaders};
use splatvk::math::Random;
use splatvk::pass::sort::{Sort, SortAlgorithm, sort_pairs};
use splatvk::pass::{compact, scan, sum};

fn words(n: usize, below: u64, seed: u64) -> Vec<u32> {
    let mut random = Random::new(seed);
    (0..n).map(|_| (random.bits() % below) as u32).collect()
}

pub fn scan(device: &Device) {
    for n in [0, 1, 700] {
        let values = words(n, 1000, 1001);
        let input = device.buffer_from("scan values", &values).unwrap();
        let count = device.buffer_from("scan count", &[n as u32]).unwrap();
        let starts = device.buffer::<u32>("scan starts", n).unwrap();
        let total = device.buffer::<u32>("scan total", 1).unwrap();
        let pass = scan::Scan::new(device).unwrap();
        let mut rec = Recorder::new(device, "scan");
        pass.record(&mut rec, &input, &count, &starts, &total);
        rec.run().unwrap();
        let (expected, sum) = scan::exclusive_scan(&values);
        assert!(starts.read().unwrap() == expected, "starts");
        assert_eq!(total.read().unwrap(), [sum]);
    }
}

pub fn gather(device: &Device) {
    for (rows, stride) in [(0, 1), (1, 1), (100, 3), (33, 7)] {
        let (from, index) = (words(50 * stride, 1 << 32, 1002), words(rows, 50, 1003));
        let source = device.buffer_from("gather from", &from).unwrap();
        let at = device.buffer_from("gather index", &index).unwrap();
        let out = compact::gather(device, "gathered", &source, &at, rows, stride).unwrap();
        // A buffer has at least one element.
        assert!(out.read().unwrap()[..rows * stride] == compact::gather_rows(&from, &index, stride), "rows");
    }
}

pub fn sum(device: &Device) {
    for n in [1, 300, 20_000] {
        let mut random = Random::new(1004);
        let values: Vec<f32> = (0..n).map(|_| random.between(0.0, 1.0) as f32).collect();
        let input = device.buffer_from("sum values", &values).unwrap();
        let partials = device.buffer::<f32>("sum partials", sum::PARTIALS).unwrap();
        let result = device.buffer::<f32>("sum result", 3).unwrap();
        let mut rec = Recorder::new(device, "sum");
        sum::record(&mut rec, (&input, n), &partials, (&result, 1));
        rec.run().unwrap();
        let expected: f64 = values.iter().map(|v| f64::from(*v)).sum();
        let got = result.read().unwrap();
        // Some 20 000 / 16 384 + 16 roundings of 6e-8 each.
        assert!((f64::from(got[1]) - expected).abs() <= 2e-6 * expected, "{} {expected}", got[1]);
        assert_eq!((got[0], got[2]), (0.0, 0.0), "other slots");
    }
}

fn sort(device: &Device, shape: SortAlgorithm) {
    for (n, all, bits, range) in [
        (0, 5, 32, 9),
        (1, 1, 32, 9),
        (2049, 2049, 10, 1u64 << 10),
        (3000, 5000, 16, 50),
        (4500, 4500, 32, 1 << 32),
    ] {
        let keys = words(all, range, 1005 + n as u64);
        let pairs: Vec<[u32; 2]> = keys.iter().enumerate().map(|(i, k)| [*k, i as u32]).collect();
        let buffer = device.buffer_from("pairs", pairs.as_flattened()).unwrap();
        let count = device.buffer_from("count", &[n as u32]).unwrap();
        let pass = Sort::with(device, all, shape).unwrap();
        let mut rec = Recorder::new(device, "sort");
        pass.record(&mut rec, &buffer, &count, bits);
        rec.run().unwrap();
        let mut expected = pairs[..n].to_vec();
        sort_pairs(&mut expected, bits);
        assert!(buffer.read().unwrap()[..2 * n] == *expected.as_flattened(), "order");
    }
}

pub fn sort_chunks(device: &Device) {
    sort(device, SortAlgorithm::Chunks);
}

pub fn sort_sweep(device: &Device) {
    sort(device, SortAlgorithm::Sweep);
}

/// The shaders of `splatvk bench`.
pub fn bench(device: &Device) {
    let n = 4 * 256 * shaders::bench_copy::STEPS as usize;
    let data: Vec<f32> = (0..n).map(|k| k as f32).collect();
    let source = device.buffer_from("copy source", &data).unwrap();
    let target = device.buffer::<f32>("copy target", n).unwrap();
    let values = device.buffer_from("fma values", &data[..128]).unwrap();
    let mut rec = Recorder::new(device, "bench");
    rec.dispatch(
        shaders::bench_copy::call(&shaders::bench_copy::Bindings { source: &source, target: &target }),
        [1, 1, 1],
    );
    rec.dispatch(shaders::bench_fma::call(&shaders::bench_fma::Bindings { values: &values }), [2, 1, 1]);
    rec.run().unwrap();
    assert!(target.read().unwrap() == data);
    // x / 2 + 1 / 4 tends to 1 / 2, in each of 16 chains.
    assert!(values.read().unwrap().iter().all(|v| (v - 8.0).abs() < 1e-4));
}
