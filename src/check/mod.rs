//! Compares every pass on a device with its CPU reference, in seconds: `splatvk doctor --check`.
//! Variants that gave wrong results are disabled for this device and driver ([`KernelVariant`]).
mod compared;
mod data;
mod images;
mod render;

use crate::Result;
use crate::gpu::{Device, KernelVariant, Options};
use crate::pass::sort::SortAlgorithm;
use crate::pass::ssim_l1::SsimRowKernel;
use crate::pass::{GradientReduction, ShGradientKernel, TileBinning, TileSums};
use compared::Found;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

/// One comparison.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Row {
    /// The pass.
    pub pass: &'static str,
    /// Its variant, where there are several.
    pub variant: Option<KernelVariant>,
    /// Wall-clock time of device and reference, with the driver's compilation.
    pub time: Duration,
    /// The compared values and their distance, or the fault.
    pub outcome: std::result::Result<String, String>,
}

struct Case {
    pass: &'static str,
    variant: Option<KernelVariant>,
    check: fn(&Device) -> Found,
}

const fn case(pass: &'static str, variant: Option<KernelVariant>, check: fn(&Device) -> Found) -> Case {
    Case { pass, variant, check }
}

/// All comparisons, in the order in which passes build on each other.
const CASES: &[Case] = &[
    case("buffers: upload, copy, fill, download", None, data::buffers),
    case("prefix sum", None, data::scan),
    case("radix sort", Some(KernelVariant::ChunkSort), |d| data::sort(d, SortAlgorithm::Chunks)),
    case("radix sort", Some(KernelVariant::SweepSort), |d| data::sort(d, SortAlgorithm::Sweep)),
    case("gather", None, data::gather),
    case("Adam", None, data::adam),
    case("projection and rendering", Some(KernelVariant::CountedLists), |d| {
        render::forward(d, TileBinning::Counting)
    }),
    case("projection and rendering", Some(KernelVariant::SortedLists), |d| {
        render::forward(d, TileBinning::Sorting)
    }),
    case("tile lists", Some(KernelVariant::SortedLists), render::sorted_lists),
    case("blending weights by label", None, render::label_weights),
    case("gradients", Some(KernelVariant::StoredGradients), |d| {
        render::backward(d, GradientReduction::Entries)
    }),
    case("gradients", Some(KernelVariant::ShuffledSums), |d| render::tile_sums(d, TileSums::Shuffles)),
    case("gradients", Some(KernelVariant::SharedSums), |d| render::tile_sums(d, TileSums::Shared)),
    case("gradients of SH", Some(KernelVariant::ShPerThread), |d| {
        render::sh_gradients(d, ShGradientKernel::PerThread)
    }),
    case("gradients of SH", Some(KernelVariant::ShShared), |d| {
        render::sh_gradients(d, ShGradientKernel::Shared)
    }),
    case("projection backward with Adam", Some(KernelVariant::FusedUpdate), render::update),
    case("depth and needle losses", None, render::regularisers),
    case("SSIM and L1 loss", Some(KernelVariant::SsimStrips), |d| images::ssim_l1(d, SsimRowKernel::Strips)),
    case("SSIM and L1 loss", Some(KernelVariant::SsimShared), |d| images::ssim_l1(d, SsimRowKernel::Shared)),
    case("code loss", None, images::codes),
    case("decoding of codes", None, images::decode),
    case("search of a text query", Some(KernelVariant::DeviceQuery), images::query),
    case("packing of images", None, images::pack),
    case("plane sweep stereo", Some(KernelVariant::DeviceSweep), images::plane_sweep),
];

/// Compares all passes and reports each row when it is done; an error of `report` ends the check.
/// `device` is opened with `options` and should have no disabled variants. A wrong variant that can
/// be replaced is disabled for the later passes that build on it.
pub fn run(
    device: &Device,
    options: &Options,
    report: &mut dyn FnMut(&Row) -> Result<()>,
) -> Result<Vec<Row>> {
    let mut device = device.clone();
    let mut rows: Vec<Row> = Vec::new();
    let by_atomics =
        |variant| case("gradients", Some(variant), |d| render::backward(d, GradientReduction::Atomics));
    let last = match device.info().float_atomics {
        true => by_atomics(KernelVariant::FloatAtomics),
        false => by_atomics(KernelVariant::AtomicGradients),
    };
    for case in CASES.iter().chain([&last]) {
        rows.push(row(&device, case));
        report(&rows[rows.len() - 1])?;
        let disabled = names(&wrong_variants(&rows));
        if disabled != device.info().disabled {
            device = Device::open(&Options { disabled, ..options.clone() })?;
        }
    }
    if device.info().disabled.contains(KernelVariant::FloatAtomics.name()) {
        // The replacement of the disabled variant.
        rows.push(row(&device, &by_atomics(KernelVariant::AtomicGradients)));
        report(&rows[rows.len() - 1])?;
    }
    Ok(rows)
}

fn row(device: &Device, case: &Case) -> Row {
    let begun = Instant::now();
    let outcome = (case.check)(device).unwrap_or_else(|e| Err(e.to_string()));
    Row { pass: case.pass, variant: case.variant, time: begun.elapsed(), outcome }
}

/// Names for [`Options::disabled`] and [`Device::disable`].
pub fn names(variants: &BTreeSet<KernelVariant>) -> BTreeSet<String> {
    variants.iter().map(|v| v.name().to_owned()).collect()
}

/// Variants to disable: those with wrong results and a correct replacement.
pub fn wrong_variants(rows: &[Row]) -> BTreeSet<KernelVariant> {
    let wrong: BTreeSet<KernelVariant> =
        rows.iter().filter(|r| r.outcome.is_err()).filter_map(|r| r.variant).collect();
    let has_replacement = |variant: &KernelVariant| {
        let other = variant.replacement();
        !wrong.contains(&other) || !wrong.contains(&other.replacement())
    };
    wrong.iter().filter(|v| has_replacement(v)).copied().collect()
}

/// Whether a row is wrong without a replacement.
pub fn is_fatal(row: &Row, disabled: &BTreeSet<KernelVariant>) -> bool {
    row.outcome.is_err() && row.variant.is_none_or(|v| !disabled.contains(&v))
}

#[cfg(test)]
mod tests;
