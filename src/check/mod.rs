//! Every pass on a device against its CPU twin, in seconds: `splatvk doctor --check`. Which ways of computing gave wrong results is
//! kept for the device and its driver, and they are not used there any more ([`crate::gpu::Way`]).
mod compared;
mod data;
mod images;
mod render;

use crate::Result;
use crate::gpu::{Device, Options, Way};
use crate::pass::sort::Shape;
use crate::pass::ssim_l1::Rows;
use crate::pass::{Grouping, Summation};
use compared::Found;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

/// One comparison.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Row {
    /// What was computed.
    pub pass: &'static str,
    /// In which way, where there are several.
    pub way: Option<Way>,
    /// Wall-clock time of device and twin, with the driver's compilation.
    pub time: Duration,
    /// What was compared and how close it is; or what is wrong.
    pub outcome: std::result::Result<String, String>,
}

struct Case {
    pass: &'static str,
    way: Option<Way>,
    check: fn(&Device) -> Found,
}

const fn case(pass: &'static str, way: Option<Way>, check: fn(&Device) -> Found) -> Case {
    Case { pass, way, check }
}

/// Wrong results of the first are found in nearly all others.
const CASES: &[Case] = &[
    case("buffers: upload, copy, fill, download", None, data::buffers),
    case("prefix sum", None, data::scan),
    case("radix sort", Some(Way::ChunkSort), |d| data::sort(d, Shape::Chunks)),
    case("radix sort", Some(Way::SweepSort), |d| data::sort(d, Shape::Sweep)),
    case("gather", None, data::gather),
    case("Adam", None, data::adam),
    case("projection and rendering", Some(Way::CountedLists), |d| render::forward(d, Grouping::Counting)),
    case("projection and rendering", Some(Way::SortedLists), |d| render::forward(d, Grouping::Sorting)),
    case("gradients", Some(Way::StoredGradients), |d| render::backward(d, Summation::Entries)),
    case("depth and needle losses", None, render::regularisers),
    case("SSIM and L1 loss", Some(Way::SsimStrips), |d| images::ssim_l1(d, Rows::Strips)),
    case("SSIM and L1 loss", Some(Way::SsimShared), |d| images::ssim_l1(d, Rows::Shared)),
    case("code loss", None, images::codes),
    case("decoding of codes", None, images::decode),
    case("packing of images", None, images::pack),
    case("plane sweep stereo", None, images::plane_sweep),
];

/// Compares all passes, and tells of each as it is done, until that is an error. Of `device`, opened with `options`, nothing should
/// be switched off; what is found wrong and can be replaced is, for the passes after it that build on it.
pub fn run(device: &Device, options: &Options, told: &mut dyn FnMut(&Row) -> Result<()>) -> Result<Vec<Row>> {
    let mut device = device.clone();
    let mut rows: Vec<Row> = Vec::new();
    let by_atomics = |way| case("gradients", Some(way), |d| render::backward(d, Summation::Atomics));
    let last = match device.info().float_atomics {
        true => by_atomics(Way::FloatAtomics),
        false => by_atomics(Way::AtomicGradients),
    };
    for case in CASES.iter().chain([&last]) {
        rows.push(row(&device, case));
        told(&rows[rows.len() - 1])?;
        let without = wrong_ways(&rows);
        if without != device.info().without {
            device = Device::with(&Options { without, ..options.clone() })?;
        }
    }
    if device.info().without.contains(&Way::FloatAtomics) {
        // What the device is left with.
        rows.push(row(&device, &by_atomics(Way::AtomicGradients)));
        told(&rows[rows.len() - 1])?;
    }
    Ok(rows)
}

fn row(device: &Device, case: &Case) -> Row {
    let begun = Instant::now();
    let outcome = (case.check)(device).unwrap_or_else(|e| Err(e.to_string()));
    Row { pass: case.pass, way: case.way, time: begun.elapsed(), outcome }
}

/// The ways that gave wrong results where one that replaces them did not: what to switch off.
pub fn wrong_ways(rows: &[Row]) -> BTreeSet<Way> {
    let wrong: BTreeSet<Way> = rows.iter().filter(|r| r.outcome.is_err()).filter_map(|r| r.way).collect();
    let replaced = |way: &Way| {
        let other = way.replacement();
        !wrong.contains(&other) || !wrong.contains(&other.replacement())
    };
    wrong.iter().filter(|way| replaced(way)).copied().collect()
}

/// Whether a row is wrong and nothing can be used in its place.
pub fn is_fatal(row: &Row, switched_off: &BTreeSet<Way>) -> bool {
    row.outcome.is_err() && row.way.is_none_or(|way| !switched_off.contains(&way))
}

#[cfg(test)]
mod tests;
