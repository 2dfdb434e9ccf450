//! Compares every pass on a device with its CPU reference, in seconds: `splatvk doctor --check`.
//! Variants that gave wrong results are disabled for this device and driver ([`KernelVariant`]),
//! and the faster of two correct ones is preferred ([`choose`]).
pub mod choose;
mod compared;
mod data;
mod first_use;
mod images;
mod render;
mod timing;

use crate::Result;
use crate::gpu::{Device, KernelVariant, Options};
use crate::pass::GradientReduction;
use compared::Found;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

pub use first_use::open;
pub use timing::{SceneSize, time_variants};

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

/// A comparison of a pass, or of one of its variants, with the CPU reference.
#[derive(Clone, Copy)]
pub struct Case {
    /// The pass.
    pub pass: &'static str,
    /// Its variant, where there are several.
    pub variant: Option<KernelVariant>,
    check: fn(&Device) -> Found,
}

const fn case(pass: &'static str, variant: Option<KernelVariant>, check: fn(&Device) -> Found) -> Case {
    Case { pass, variant, check }
}

impl Case {
    /// Runs the comparison.
    pub fn row(&self, device: &Device) -> Row {
        let begun = Instant::now();
        let outcome = (self.check)(device).unwrap_or_else(|e| Err(e.to_string()));
        Row { pass: self.pass, variant: self.variant, time: begun.elapsed(), outcome }
    }
}

/// All comparisons, in the order in which passes build on each other, for a device with or without
/// float atomics.
pub fn cases(float_atomics: bool) -> impl Iterator<Item = Case> {
    let listed = [data::CASES, render::CASES, images::CASES].into_iter().flatten();
    listed.copied().chain([by_atomics(float_atomics)])
}

const fn by_atomics(float_atomics: bool) -> Case {
    let variant = match float_atomics {
        true => KernelVariant::FloatAtomics,
        false => KernelVariant::AtomicGradients,
    };
    case("gradients", Some(variant), |d| render::backward(d, GradientReduction::Atomics))
}

/// Compares all passes and reports each row when it is done; an error of `report` ends the check.
/// `device` is opened with `options` and should have no disabled variants. A wrong variant that can
/// be replaced is disabled for the later passes that build on it.
pub fn run(
    device: &Device,
    options: &Options,
    report: &mut dyn FnMut(&Row) -> Result<()>,
) -> Result<Vec<Row>> {
    compare(device.clone(), options, &|_| true, report)
}

/// [`run`] for some of the cases.
fn compare(
    mut device: Device,
    options: &Options,
    compares: &dyn Fn(&Case) -> bool,
    report: &mut dyn FnMut(&Row) -> Result<()>,
) -> Result<Vec<Row>> {
    let mut rows: Vec<Row> = Vec::new();
    for case in cases(device.info().float_atomics).filter(compares) {
        rows.push(case.row(&device));
        report(&rows[rows.len() - 1])?;
        let disabled = names(&wrong_variants(&rows));
        if disabled != device.info().disabled {
            device = Device::open(&Options { disabled, ..options.clone() })?;
        }
    }
    if device.info().disabled.contains(KernelVariant::FloatAtomics.name()) {
        // The replacement of the disabled variant.
        rows.push(by_atomics(false).row(&device));
        report(&rows[rows.len() - 1])?;
    }
    Ok(rows)
}

/// Names for [`Options::disabled`] and [`Device::disable`].
pub fn names(variants: &BTreeSet<KernelVariant>) -> BTreeSet<String> {
    variants.iter().map(|v| v.name().to_owned()).collect()
}

/// Variants with wrong results.
pub fn wrong(rows: &[Row]) -> BTreeSet<KernelVariant> {
    rows.iter().filter(|r| r.outcome.is_err()).filter_map(|r| r.variant).collect()
}

/// Variants to disable: those with wrong results and a correct replacement.
pub fn wrong_variants(rows: &[Row]) -> BTreeSet<KernelVariant> {
    let wrong = wrong(rows);
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
