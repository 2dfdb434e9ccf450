//! Checks of passes over arrays.
use super::compared::{Found, close, each, equal, worst};
use super::{Case, case};
use crate::gpu::{Device, KernelVariant, Recorder};
use crate::math::Random;
use crate::pass::adam::{self, Class, Moments, Schedule};
use crate::pass::close::Tolerance;
use crate::pass::scan::{Scan, exclusive_scan};
use crate::pass::sort::{Sort, SortAlgorithm, sort_pairs};
use crate::pass::{compact, sum as sums};

pub(super) const CASES: &[Case] = &[
    case("buffers: upload, copy, fill, download", None, buffers),
    case("prefix sum", None, scan),
    case("radix sort", Some(KernelVariant::ChunkSort), |d| sort(d, SortAlgorithm::Chunks)),
    case("radix sort", Some(KernelVariant::SweepSort), |d| sort(d, SortAlgorithm::Sweep)),
    case("gather", None, gather),
    case("sum", None, sum),
    case("Adam", None, adam),
];

/// A prime number of elements, more than a workgroup.
const COUNT: usize = 20_011;

fn words(count: usize, seed: u64) -> Vec<u32> {
    let mut random = Random::new(seed);
    (0..count).map(|_| random.below(u32::MAX as usize) as u32).collect()
}

fn buffers(device: &Device) -> Found {
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

fn scan(device: &Device) -> Found {
    each([0, 1, COUNT], |n| {
        let values: Vec<u32> = words(n, 2).iter().map(|v| v >> 20).collect();
        let buffer = device.buffer_from("scan values", &values)?;
        let count = device.buffer_from("scan count", &[n as u32])?;
        let starts = device.buffer::<u32>("scan starts", n)?;
        let total = device.buffer::<u32>("scan total", 1)?;
        let scan = Scan::new(device)?;
        let mut rec = Recorder::new(device, "self-check of the prefix sum");
        scan.record(&mut rec, &buffer, &count, &starts, &total);
        rec.run()?;
        let (expected, sum) = exclusive_scan(&values);
        // A buffer has at least one element.
        let found = &starts.read()?[..n];
        Ok(equal("total", &total.read()?, &[sum]).and(equal("starts", found, &expected)))
    })
}

/// Sorts the first `n` of `all` pairs by some of the bits of their keys, so that equal keys must
/// keep their order.
fn sort(device: &Device, algorithm: SortAlgorithm) -> Found {
    let cases =
        [(0, 5, 32, 4), (1, 1, 32, 4), (2049, 2049, 10, 4), (3000, 5000, 16, 26), (COUNT, COUNT, 20, 4)];
    each(cases, |(n, all, bits, shift)| {
        let mut expected: Vec<[u32; 2]> =
            words(all, 3).into_iter().zip(0..).map(|(k, v)| [k >> shift, v]).collect();
        let pairs = device.buffer_from("pairs", expected.as_flattened())?;
        let count = device.buffer_from("count", &[n as u32])?;
        let sort = Sort::with(device, all, algorithm)?;
        let mut rec = Recorder::new(device, "self-check of the sort");
        sort.record(&mut rec, &pairs, &count, bits);
        rec.run()?;
        sort_pairs(&mut expected[..n], bits);
        Ok(equal("pairs", &pairs.read()?[..2 * n], expected[..n].as_flattened()))
    })
}

fn gather(device: &Device) -> Found {
    each([(0, 1), (1, 1), (33, 7), (COUNT / 2, 3)], |(rows, stride)| {
        let from = words(COUNT * stride, 4);
        let index: Vec<u32> = words(rows, 5).iter().map(|v| v % COUNT as u32).collect();
        let (source, indices) = (device.buffer_from("rows", &from)?, device.buffer_from("index", &index)?);
        let gathered = compact::gather(device, "gathered", &source, &indices, rows, stride)?;
        let found = &gathered.read()?[..rows * stride];
        Ok(equal("rows", found, &compact::gather_rows(&from, &index, stride)))
    })
}

fn sum(device: &Device) -> Found {
    each([1, 300, COUNT], |n| {
        let mut random = Random::new(7);
        let values: Vec<f32> = (0..n + 3).map(|_| random.uniform() as f32).collect();
        let input = device.buffer_from("sum values", &values)?;
        let result = device.buffer_from("sum result", &[7.0f32; 4 * sums::PARTIALS])?;
        let mut rec = Recorder::new(device, "self-check of the sum");
        sums::record(&mut rec, &input, (3..n + 3, Some(0..3)), (&result, 1));
        rec.run()?;
        let sum = |values: &[f32]| values.iter().map(|v| f64::from(*v)).sum();
        let untouched = 7.0 * sums::PARTIALS as f64;
        let expected = [untouched, sum(&values[3..]), sum(&values[..3]), untouched];
        let result = result.read()?;
        let found = [0, 1, 2, 3].map(|slot| sums::total(&result, slot) as f32);
        // Some 20 011 / 16 384 + 16 roundings of 6e-8 each.
        let tolerance = Tolerance {
            relative_l2: 2e-6,
            absolute: 0.0,
            relative: 2e-6,
            outliers: 0.0,
            outlier_factor: 1.0,
        };
        Ok(worst([close("sums", &found, &expected, &tolerance)]))
    })
}

/// Rows with a head of other rates, and a gradient that is not finite.
fn adam(device: &Device) -> Found {
    let (stride, head, rates) = (9usize, 3usize, [1e-2, 1e-3]);
    let count = 2_003 * stride;
    let mut random = Random::new(6);
    let start: Vec<f32> = (0..count).map(|_| random.normal() as f32).collect();
    let parameters = device.buffer_from("parameters", &start)?;
    let gradients = device.buffer::<f32>("gradients", count)?;
    let guard = device.buffer::<u32>("guard", 2)?;
    let moments = Moments::new(device, count)?;
    let mut schedule = Schedule::new(device, 2)?;
    const STEPS: usize = 3;
    // A step of 1e-2 of numbers around 1, rounded to f32.
    let moved =
        Tolerance { relative_l2: 1e-6, absolute: 1e-6, relative: 1e-6, outliers: 0.0, outlier_factor: 1.0 };
    let rounded = Tolerance { relative_l2: 1e-2, absolute: 1e-30, relative: 2f64.powi(-7), ..moved };
    let mut distances = Vec::new();
    for step in 1..=STEPS {
        let mut g: Vec<f32> = (0..count).map(|_| random.normal() as f32).collect();
        g[5] = f32::NAN;
        gradients.write(&g)?;
        schedule.set(step, &[[0.0; 2], rates])?;
        let mut expected: Vec<f64> = parameters.read()?.into_iter().map(f64::from).collect();
        let mut state: Vec<[f64; 2]> =
            moments.read(count)?.into_iter().map(|pair| pair.map(f64::from)).collect();
        let mut rec = Recorder::new(device, "self-check of Adam");
        let class = Class { slot: 1, count, stride: stride as u32, head: head as u32 };
        schedule.record(&mut rec, class, &parameters, &gradients, &moments, &guard);
        rec.run()?;
        for (i, g) in g.iter().enumerate() {
            let (rate, one) = (rates[usize::from(i % stride >= head)], i..i + 1);
            let (p, mv) = (&mut expected[one.clone()], &mut state[one]);
            adam::adam(p, &[f64::from(*g)], mv, rate, adam::EPSILON, step);
        }
        distances.push(close("parameters", &parameters.read()?, &expected, &moved));
        distances.push(close("moments", moments.read(count)?.as_flattened(), state.as_flattened(), &rounded));
    }
    let faults = equal("gradients that are not finite", &[schedule.faults()?], &[STEPS as u32]);
    Ok(faults.and(worst(distances)))
}
