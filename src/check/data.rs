//! Checks of passes over arrays.
use super::compared::{Found, close, equal, worst};
use crate::gpu::{Device, Recorder};
use crate::math::Random;
use crate::pass::adam::{self, Class, Moments, Schedule};
use crate::pass::close::Tolerance;
use crate::pass::compact;
use crate::pass::scan::{Scan, exclusive_scan};
use crate::pass::sort::{Sort, SortAlgorithm, sort_pairs};

/// A prime number of elements, more than a workgroup.
const COUNT: usize = 20_011;

fn words(count: usize, seed: u64) -> Vec<u32> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.below(u32::MAX as usize) as u32).collect()
}

pub(super) fn buffers(device: &Device) -> Found {
    let mut expected = words(COUNT, 1);
    let from = device.buffer_from("from", &expected)?;
    let to = device.buffer::<u32>("to", COUNT)?;
    let mut rec = Recorder::new(device, "self-check of buffers");
    rec.fill(&to, 7);
    rec.copy_bytes(&from, 40, &to, 40, 4000);
    rec.download(&to);
    rec.run()?;
    to.write_at(3, &[1, 2])?;
    expected[..10].fill(7);
    expected[1010..].fill(7);
    expected[3..5].copy_from_slice(&[1, 2]);
    Ok(equal("words", &to.read()?, &expected))
}

pub(super) fn scan(device: &Device) -> Found {
    let values: Vec<u32> = words(COUNT, 2).iter().map(|v| v >> 20).collect();
    let buffer = device.buffer_from("values", &values)?;
    let count = device.buffer_from("count", &[COUNT as u32])?;
    let starts = device.buffer::<u32>("starts", COUNT)?;
    let total = device.buffer::<u32>("total", 1)?;
    let scan = Scan::new(device)?;
    let mut rec = Recorder::new(device, "self-check of the prefix sum");
    scan.record(&mut rec, &buffer, &count, &starts, &total);
    rec.run()?;
    let (expected, sum) = exclusive_scan(&values);
    Ok(equal("total", &total.read()?, &[sum]).and(equal("starts", &starts.read()?, &expected)))
}

pub(super) fn sort(device: &Device, algorithm: SortAlgorithm) -> Found {
    let mut expected: Vec<[u32; 2]> =
        words(COUNT, 3).into_iter().zip(0..).map(|(k, v)| [k >> 4, v]).collect();
    let pairs = device.buffer_from("pairs", expected.as_flattened())?;
    let count = device.buffer_from("count", &[COUNT as u32])?;
    let sort = Sort::with(device, COUNT, algorithm)?;
    let mut rec = Recorder::new(device, "self-check of the sort");
    // Fewer bits than the keys have, so that equal keys must keep their order.
    sort.record(&mut rec, &pairs, &count, 20);
    rec.run()?;
    sort_pairs(&mut expected, 20);
    Ok(equal("pairs", &pairs.read()?, expected.as_flattened()))
}

pub(super) fn gather(device: &Device) -> Found {
    let from = words(3 * COUNT, 4);
    let index: Vec<u32> = words(COUNT / 2, 5).iter().map(|v| v % COUNT as u32).collect();
    let (rows, indices) = (device.buffer_from("rows", &from)?, device.buffer_from("index", &index)?);
    let gathered = compact::gather(device, "gathered", &rows, &indices, index.len(), 3)?;
    Ok(equal("rows", &gathered.read()?, &compact::gather_rows(&from, &index, 3)))
}

pub(super) fn adam(device: &Device) -> Found {
    let mut random = Random::new(6);
    let start: Vec<f32> = (0..COUNT).map(|_| random.normal() as f32).collect();
    let parameters = device.buffer_from("parameters", &start)?;
    let gradients = device.buffer::<f32>("gradients", COUNT)?;
    let guard = device.buffer::<u32>("guard", 2)?;
    let moments = Moments::new(device, COUNT)?;
    let mut schedule = Schedule::new(device, 1)?;
    let mut expected: Vec<f64> = start.iter().map(|&v| v.into()).collect();
    let mut state = vec![[0.0; 2]; COUNT];
    for step in 1..=3 {
        let g: Vec<f32> = (0..COUNT).map(|_| random.normal() as f32).collect();
        gradients.write(&g)?;
        schedule.set(step, &[[1e-2, 1e-2]])?;
        let mut rec = Recorder::new(device, "self-check of Adam");
        let class = Class { slot: 0, count: COUNT, stride: 1, head: 1 };
        schedule.record(&mut rec, class, &parameters, &gradients, &moments, &guard);
        rec.run()?;
        let g: Vec<f64> = g.iter().map(|&v| v.into()).collect();
        adam::adam(&mut expected, &g, &mut state, 1e-2, adam::EPSILON, step);
    }
    // Three steps of 1e-2 on numbers around 1, rounded to f32.
    let tolerance =
        Tolerance { relative_l2: 1e-6, absolute: 2e-6, relative: 1e-6, outliers: 0.0, outlier_factor: 1.0 };
    Ok(worst([close("parameters", &parameters.read()?, &expected, &tolerance)]))
}
