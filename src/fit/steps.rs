//! Single training steps, for benchmarks: the very steps that the training loops run and record.
use super::{LanguageRun, RgbRun};
use crate::Result;
use crate::gpu::Recorder;
use crate::pass::rasterizer::{RasterOptions, Rasterizer, SplatBuffers};

/// A training stage that takes one step at a time.
pub(crate) trait Steps {
    /// One whole step on the next view, as training does it: schedule, device work, loss read back.
    fn step(&mut self, iteration: usize) -> Result<()>;
    /// The device work of a step on view 0.
    fn record(&self) -> Recorder;
    /// What a step of view 0 renders with.
    fn parts(&self) -> Parts<'_>;
}

/// The rasteriser of a step and what it binds.
pub(crate) struct Parts<'a> {
    pub raster: &'a Rasterizer,
    pub params: &'a SplatBuffers,
    pub gradients: &'a SplatBuffers,
    pub options: &'a RasterOptions,
}

impl Steps for RgbRun<'_> {
    fn step(&mut self, iteration: usize) -> Result<()> {
        RgbRun::step(self, iteration)
    }
    fn record(&self) -> Recorder {
        RgbRun::record(self, 0)
    }
    fn parts(&self) -> Parts<'_> {
        Parts {
            raster: &self.views.stage(0).raster,
            params: &self.model.values,
            gradients: &self.model.gradients,
            options: &self.raster,
        }
    }
}

impl Steps for LanguageRun<'_> {
    fn step(&mut self, iteration: usize) -> Result<()> {
        LanguageRun::step(self, iteration)
    }
    fn record(&self) -> Recorder {
        LanguageRun::record(self, 0)
    }
    fn parts(&self) -> Parts<'_> {
        Parts {
            raster: &self.views.stage(0).raster,
            params: &self.model.values,
            gradients: &self.model.gradients,
            options: &self.raster,
        }
    }
}

impl LanguageRun<'_> {
    /// Replaces the raw features [N, levels·d].
    pub(crate) fn set_features(&self, features: &[f32]) -> Result<()> {
        self.model.values.features.write(features)
    }
}
