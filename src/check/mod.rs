//! Every pass on a device against its CPU twin, in seconds: `splatvk doctor --check`. Which ways of computing gave wrong results is
//! kept for the device and its driver, and they are not used there any more ([`crate::gpu::Way`]).
mod compared;
mod data;
mod images;
mod render;

use crate::Result;
use crate::gpu::{Device, Options, Way};
use crate::pass::sort::Shape;
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
    case("gradients", Some(Way::AtomicGradients), |d| render::backward(d, Summation::Atomics)),
    case("gradients", Some(Way::StoredGradients), |d| render::backward(d, Summation::Entries)),
    case("depth and needle losses", None, render::regularisers),
    case("SSIM and L1 loss", None, images::ssim_l1),
    case("code loss", None, images::codes),
    case("decoding of codes", None, images::decode),
    case("packing of images", None, images::pack),
    case("plane sweep stereo", None, images::plane_sweep),
];

/// Compares all passes, and tells of each as it is done. The device is opened without what is switched off on it.
pub fn run(options: &Options, told: &mut dyn FnMut(&Row)) -> Result<Vec<Row>> {
    let plain = Options { cache: None, ..options.clone() };
    let device = Device::with(&plain)?;
    let mut rows = Vec::new();
    let mut tell = |row: Row| {
        told(&row);
        rows.push(row);
    };
    CASES.iter().for_each(|case| tell(row(&device, case.pass, case.way, case.check)));
    if device.info().float_atomics {
        // With and without, the same pass: what only one of them gets wrong is their fault.
        tell(row(&device, "float atomics", Some(Way::FloatAtomics), |d| {
            render::backward(d, Summation::Atomics)
        }));
        let emulated = Device::with(&Options { without: [Way::FloatAtomics].into(), ..plain })?;
        tell(row(&emulated, "float atomics, emulated", None, |d| render::backward(d, Summation::Atomics)));
    }
    Ok(rows)
}

fn row(device: &Device, pass: &'static str, way: Option<Way>, check: fn(&Device) -> Found) -> Row {
    let begun = Instant::now();
    let outcome = check(device).unwrap_or_else(|e| Err(e.to_string()));
    Row { pass, way, time: begun.elapsed(), outcome }
}

/// The ways that gave wrong results where others did not: what to switch off. Native float atomics are blamed for wrong atomic
/// gradients if these are right without them.
pub fn wrong_ways(rows: &[Row]) -> BTreeSet<Way> {
    let mut wrong: BTreeSet<Way> = rows.iter().filter(|r| r.outcome.is_err()).filter_map(|r| r.way).collect();
    let emulated = rows.iter().any(|r| r.pass == "float atomics, emulated" && r.outcome.is_ok());
    match wrong.contains(&Way::FloatAtomics) && emulated {
        true => wrong.remove(&Way::AtomicGradients),
        false => wrong.remove(&Way::FloatAtomics),
    };
    let without_other = |way: &Way| way.replacement().is_some_and(|other| wrong.contains(&other));
    wrong.iter().filter(|way| !without_other(way)).copied().collect()
}

/// Whether a row is wrong and nothing can be used in its place.
pub fn is_fatal(row: &Row, switched_off: &BTreeSet<Way>) -> bool {
    let replaced = match row.way {
        Some(Way::AtomicGradients) => {
            switched_off.contains(&Way::AtomicGradients) || switched_off.contains(&Way::FloatAtomics)
        }
        Some(way) => switched_off.contains(&way),
        None => false,
    };
    row.outcome.is_err() && !replaced
}

#[cfg(test)]
mod tests;
