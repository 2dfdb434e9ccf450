//! `splatvk bench`: reproducible workloads, times of passes and whole steps with their quartiles,
//! and the limits of the device, measured in the same run.
//!
//! The steps are those of [`crate::fit`], recorded by the same code; learning rates are zero, so
//! that every repetition does the same work on the same scene. The photo to fit is a render of the
//! scene, a little paler.
pub mod cameras;
pub mod compare;
mod growth;
mod latency;
mod least;
pub mod masks;
pub mod measure;
mod model;
pub mod report;
mod roofline;
mod sorting;
mod training;
pub mod workload;

pub use least::{Least, Limits};
pub use measure::{Budget, Quartiles};
pub use model::Roofline;
pub use report::{BenchReport, PassRow, Section};
pub use workload::Workload;

use crate::gpu::Device;
use crate::infer::RegionEncoder;
use crate::scene::{Camera, LanguageField, Splats};
use crate::{Error, Result};

/// A series of measurements on one device, the roofline first.
pub struct Bench<'a> {
    device: &'a Device,
    budget: Budget,
    roofline: Roofline,
    /// Results so far.
    pub report: BenchReport,
}

impl<'a> Bench<'a> {
    /// Measures the limits of the device.
    pub fn new(device: &'a Device, budget: Budget) -> Result<Bench<'a>> {
        let (roofline, section) = roofline::measure(device, &budget)?;
        let mut report = BenchReport::new(device);
        report.sections.push(section);
        Ok(Bench { device, budget, roofline, report })
    }

    /// Measures the training step on colour, then with `features` more channels (0 = only colour).
    pub fn training(&mut self, workload: &Workload, features: usize) -> Result<()> {
        check_features(features)?;
        let limits = (&self.budget, &self.roofline);
        self.report.sections.push(training::colour(self.device, workload, limits)?);
        if features > 0 {
            let section = training::with_features(self.device, workload, features, limits)?;
            self.report.sections.push(section);
        }
        self.report.relate();
        Ok(())
    }

    /// Measures the training step on seeded scenes of growing size that are otherwise like `like`.
    pub fn growth(&mut self, sizes: &[usize], like: &Workload) -> Result<()> {
        let limits = (&self.budget, &self.roofline);
        self.report.sections.push(growth::measure(self.device, sizes, like, limits)?);
        Ok(())
    }

    /// Measures the radix sort of random keys with values.
    pub fn sort(&mut self, keys: usize) -> Result<()> {
        let limits = (&self.budget, &self.roofline);
        self.report.sections.push(sorting::measure(self.device, keys, limits)?);
        Ok(())
    }

    /// Measures a text query in all views of a scene.
    pub fn query(
        &mut self,
        scene: (&Splats, LanguageField, &[Camera]),
        encoder: Box<dyn RegionEncoder>,
        text: &str,
    ) -> Result<()> {
        let section = latency::measure(self.device, scene, encoder, text, &self.budget)?;
        self.report.sections.push(section);
        Ok(())
    }
}

/// Checks that training steps exist for a number of feature channels.
pub fn check_features(features: usize) -> Result<()> {
    if features <= 16 || (features.is_multiple_of(16) && features <= 48) {
        return Ok(());
    }
    Err(Error::input(format!("--features {features}: choose 0 to 16, 32 or 48 channels")))
}
