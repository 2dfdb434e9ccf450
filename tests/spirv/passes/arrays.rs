//! Passes over plain arrays: scan, gather, sum, sort.
use super::require;
use splatvk::gpu::{Device, Recorder};
use splatvk::pass::seeded::Random;
use splatvk::pass::sort::{Shape, Sort, sort_pairs};
use splatvk::pass::{compact, scan, sum};

fn words(n: usize, below: u64, seed: u64) -> Vec<u32> {
    let mut random = Random::new(seed);
    (0..n).map(|_| (random.bits() % below) as u32).collect()
}

pub fn scan(device: &Device) -> Result<(), String> {
    for n in [0, 1, 700] {
        let values = words(n, 1000, 1001);
        let input = device.buffer_from("scan values", &values).unwrap();
        let count = device.buffer_from("scan count", &[n as u32]).unwrap();
        let starts = device.buffer::<u32>("scan starts", n).unwrap();
        let total = device.buffer::<u32>("scan total", 1).unwrap();
        let pass = scan::Scan::new(device).unwrap();
        let mut rec = Recorder::new(device, "scan");
        pass.record(&mut rec, &input, &count, &starts, &total);
        rec.run().map_err(|e| e.to_string())?;
        let (expected, sum) = scan::exclusive_scan(&values);
        require("starts", starts.read().unwrap() == expected)?;
        require("total", total.read().unwrap() == [sum])?;
    }
    Ok(())
}

pub fn gather(device: &Device) -> Result<(), String> {
    for (rows, stride) in [(1, 1), (100, 3), (33, 7)] {
        let (from, index) = (words(50 * stride, 1 << 32, 1002), words(rows, 50, 1003));
        let source = device.buffer_from("gather from", &from).unwrap();
        let at = device.buffer_from("gather index", &index).unwrap();
        let out =
            compact::gather(device, "gathered", &source, &at, rows, stride).map_err(|e| e.to_string())?;
        require("rows", out.read().unwrap() == compact::gather_rows(&from, &index, stride))?;
    }
    Ok(())
}

pub fn sum(device: &Device) -> Result<(), String> {
    for n in [1, 300, 20_000] {
        let mut random = Random::new(1004);
        let values: Vec<f32> = (0..n).map(|_| random.uniform(0.0, 1.0) as f32).collect();
        let input = device.buffer_from("sum values", &values).unwrap();
        let partials = device.buffer::<f32>("sum partials", sum::PARTIALS).unwrap();
        let result = device.buffer::<f32>("sum result", 3).unwrap();
        let mut rec = Recorder::new(device, "sum");
        sum::record(&mut rec, &input, &partials, &result, 1);
        rec.run().map_err(|e| e.to_string())?;
        let expected: f64 = values.iter().map(|v| f64::from(*v)).sum();
        let got = result.read().unwrap();
        // Some 20 000 / 16 384 + 16 roundings of 6e-8 each.
        require("sum", (f64::from(got[1]) - expected).abs() <= 2e-6 * expected)?;
        require("other slots", got[0] == 0.0 && got[2] == 0.0)?;
    }
    Ok(())
}

fn sort(device: &Device, shape: Shape) -> Result<(), String> {
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
        rec.run().map_err(|e| e.to_string())?;
        let mut expected = pairs[..n].to_vec();
        sort_pairs(&mut expected, bits);
        require("order", buffer.read().unwrap()[..2 * n] == *expected.as_flattened())?;
    }
    Ok(())
}

pub fn sort_chunks(device: &Device) -> Result<(), String> {
    sort(device, Shape::Chunks)
}

pub fn sort_sweep(device: &Device) -> Result<(), String> {
    sort(device, Shape::Sweep)
}
