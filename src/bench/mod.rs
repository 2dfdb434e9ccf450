//! `splatvk bench`: reproducible workloads, per-pass and whole-step times with their spread, and the device's own limits
//! measured in the same run.
//!
//! The steps are those of [`crate::fit`], recorded by the code that trains; learning rates are zero, so that every
//! repetition does the same work on the same scene. The photo to fit is the scene's own render, a little paler.
pub mod compare;
pub mod measure;
pub mod report;
mod training;
pub mod workload;

pub use measure::{Budget, Spread};
pub use report::{Report, Row, Section};
pub use workload::Workload;

use crate::gpu::Device;
use crate::{Error, Result};

/// What to measure beside the training step on colour alone.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// How long each measurement runs.
    pub budget: Budget,
    /// Feature channels of the second step: 0 = none, at most 16, or a multiple of 16 up to 48.
    pub features: usize,
}

impl Default for Options {
    fn default() -> Self {
        Options { budget: Budget::default(), features: 16 }
    }
}

/// Measures the training step of a workload.
pub fn training(device: &Device, workload: &Workload, options: &Options) -> Result<Report> {
    check_features(options.features)?;
    let mut report = Report::new(device);
    report.sections.push(training::colour(device, workload, &options.budget)?);
    if options.features > 0 {
        let section = training::with_features(device, workload, options.features, &options.budget)?;
        report.sections.push(section);
    }
    report.relate();
    Ok(report)
}

pub(crate) fn check_features(features: usize) -> Result<()> {
    if features <= 16 || (features.is_multiple_of(16) && features <= 48) {
        return Ok(());
    }
    Err(Error::input(format!("--features {features}: choose 0 to 16, 32 or 48 channels")))
}
