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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::{
        LanguageOptions, Preset, RgbOptions, pose::PoseOptions, scale::SceneScale, schedule::Exponential,
    };
    use crate::gpu::{Device, Options, TestDevice};
    use crate::pass::seeded;
    use crate::scene::{Camera, Codebook, LevelField, Plane, Pose, RgbImage, Splats};
    use glam::DVec3;

    const COUNTED: usize = 8;

    /// What a stage costs per step once every view has been recorded, and what it ends with.
    #[derive(Debug, PartialEq)]
    struct Outcome {
        submissions: f64,
        allocations: f64,
        splats: Splats,
        features: Vec<f32>,
        camera: Vec<f32>,
    }

    fn device(staging: bool) -> TestDevice {
        TestDevice::with(&Options { staging, deterministic: true, ..Options::from_env(None) }).unwrap()
    }

    fn scene() -> (Splats, Vec<Camera>, Vec<RgbImage>) {
        let (splats, camera) = seeded::small(300, 75, 53, 0, 3);
        let cameras: Vec<Camera> = [0.0, 0.01]
            .map(|a| Camera {
                pose: Pose::exp(DVec3::ZERO, DVec3::X * a).compose(&camera.pose),
                ..camera.clone()
            })
            .into();
        let image = |i: usize| {
            (0..75 * 53).map(|p| [0, 1, 2].map(|c| ((p * (c + 2) + i) % 17) as f32 / 16.0)).collect()
        };
        (splats, cameras, (0..2).map(|i| RgbImage { width: 75, height: 53, data: image(i) }).collect())
    }

    fn measure(device: &Device, run: &mut dyn Steps) -> Outcome {
        for iteration in 0..COUNTED {
            run.step(iteration).unwrap();
        }
        let before = (device.submissions(), device.memory().allocations);
        for iteration in COUNTED..2 * COUNTED {
            run.step(iteration).unwrap();
        }
        let submissions = (device.submissions() - before.0) as f64 / COUNTED as f64;
        let allocations = (device.memory().allocations - before.1) as f64 / COUNTED as f64;
        let parts = run.parts();
        let (splats, features) = parts.params.download().unwrap();
        let camera = parts.raster.camera().cast::<f32>().read().unwrap();
        Outcome { submissions, allocations, splats, features, camera }
    }

    fn colour(device: &Device) -> Outcome {
        let (splats, cameras, images) = scene();
        let mut options = RgbOptions::preset(Preset::Draft);
        let rate = Exponential { start: 1e-3, end: 1e-4, steps: 2 * COUNTED };
        options.poses = Some(PoseOptions { start: 0, rate });
        let scale = SceneScale::measure(&cameras, &splats.means);
        let mut run = RgbRun::new(device, &images, &cameras, &splats, scale, None, &options).unwrap();
        measure(device, &mut run)
    }

    fn language(device: &Device) -> Outcome {
        let (splats, cameras, images) = scene();
        let labels = |v: usize| (0..75 * 53).map(|p| ((p / 9 + v) % 3) as i32).collect();
        let level = LevelField {
            codebook: Codebook {
                embedding_dim: 1,
                code_dim: 3,
                embeddings: vec![1.0; 3],
                codes: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
                ..Codebook::default()
            },
            features: Vec::new(),
            targets: (0..2).map(|v| Plane { width: 75, height: 53, data: labels(v) }).collect(),
        };
        let options = LanguageOptions::preset(Preset::Draft);
        let mut run = LanguageRun::new(device, &images, &cameras, &splats, &[&level], &options).unwrap();
        measure(device, &mut run)
    }

    #[test]
    fn a_step_is_one_submission_without_allocation_on_memory_that_is_not_mapped_too() {
        let (mapped, staged) = (device(false), device(true));
        assert!(!staged.info().mapped);
        for stage in [colour, language] {
            let (here, there) = (stage(&mapped), stage(&staged));
            assert_eq!((there.submissions, there.allocations), (1.0, 0.0));
            assert_eq!(here, there, "other bits without mapped memory");
        }
    }
}
