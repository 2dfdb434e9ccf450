//! `splatvk bench`: reproducible workloads, per-pass and whole-step times with their spread, and
//! the device's own limits measured in the same run.
//!
//! The steps are those of [`crate::fit`], recorded by the code that trains; learning rates are
//! zero, so that every repetition does the same work on the same scene. The photo to fit is the
//! scene's own render, a little paler.
pub mod cameras;
pub mod compare;
mod growth;
mod latency;
pub mod masks;
pub mod measure;
mod model;
pub mod report;
mod roofline;
mod sorting;
mod training;
pub mod workload;

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
    /// What was found so far.
    pub report: BenchReport,
}

impl<'a> Bench<'a> {
    /// Measures the device's limits.
    pub fn new(device: &'a Device, budget: Budget) -> Result<Bench<'a>> {
        let (roofline, section) = roofline::measure(device, &budget)?;
        let mut report = BenchReport::new(device);
        report.sections.push(section);
        Ok(Bench { device, budget, roofline, report })
    }

    /// The training step on colour, and then with `features` more channels (0 = leave that out).
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

    /// The training step on seeded scenes of growing size that are otherwise like `like`.
    pub fn growth(&mut self, sizes: &[usize], like: &Workload) -> Result<()> {
        let limits = (&self.budget, &self.roofline);
        self.report.sections.push(growth::measure(self.device, sizes, like, limits)?);
        Ok(())
    }

    /// The radix sort of random keys with values.
    pub fn sort(&mut self, keys: usize) -> Result<()> {
        let limits = (&self.budget, &self.roofline);
        self.report.sections.push(sorting::measure(self.device, keys, limits)?);
        Ok(())
    }

    /// A text query in all views of a scene.
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

/// The channels that steps with features exist for.
pub fn check_features(features: usize) -> Result<()> {
    if features <= 16 || (features.is_multiple_of(16) && features <= 48) {
        return Ok(());
    }
    Err(Error::input(format!("--features {features}: choose 0 to 16, 32 or 48 channels")))
}
