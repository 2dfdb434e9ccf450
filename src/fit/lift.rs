//! Code targets in GPU memory, and lifting: the blending-weighted mean of the codes of the pixels
//! of each splat (docs/internals/method.md#lifting).
use super::model::Model;
use super::views::Views;
use crate::gpu::{self, Buffer, Device, Recorder};
use crate::pass::bands::Band;
use crate::pass::codes::{self, Mode, Targets};
use crate::pass::options::{FeatureMode, RasterOptions};
use crate::progress::Progress;
use crate::scene::{Camera, LevelField, RgbImage};
use crate::{Error, Result};
use rayon::prelude::*;

/// Least blending weight over labelled pixels, in pixels; splats with less start without a feature,
/// whose direction would be noise (docs/internals/method.md#lifting).
pub(super) const MIN_WEIGHT: f32 = 0.05;
/// Length of a lifted raw feature: far above ε, so that steps rotate it without collapsing it.
const LIFTED_LENGTH: f32 = 0.5;

/// Labels, codes and loss weights of all views and levels.
pub(super) struct CodeTargets {
    levels: u32,
    width: u32,
    /// [ΣK, d], all levels.
    codes: Buffer<f32>,
    /// Per view and band: [levels, rows·W] rows of `codes`, −1 = none or halo.
    labels: Vec<Vec<Buffer<i32>>>,
    /// Per view: [levels] weight of one labelled value.
    weights: Vec<Buffer<f32>>,
}

impl CodeTargets {
    /// Checks and uploads the targets. `weight` is the weight of L_sem, the mean over levels of the
    /// mean absolute difference over labelled pixels and channels.
    pub(super) fn new(
        device: &Device,
        levels: &[&LevelField],
        images: &[RgbImage],
        views: &Views,
        weight: f64,
    ) -> Result<Self> {
        let width = levels[0].codebook.code_dim;
        if levels.iter().any(|l| l.codebook.code_dim != width) {
            return Err(Error::work("all levels must have codes of one length to share a model"));
        }
        let codes: Vec<f32> = levels.iter().flat_map(|l| l.codebook.codes.iter().copied()).collect();
        let (mut labels, mut weights) = (Vec::new(), Vec::new());
        for (view, image) in images.iter().enumerate() {
            let (mut rows, mut scale, mut first) = (Vec::new(), Vec::new(), 0);
            for level in levels {
                let start = rows.len();
                rows.extend(rows_of(level, view, image.data.len(), first)?);
                let valid = rows[start..].iter().filter(|r| **r >= 0).count().max(1);
                scale.push((weight / (levels.len() * valid * width) as f64) as f32);
                first += level.codebook.len() as i32;
            }
            let bands = &views.stage(view).raster.frame().bands;
            let band = |b| device.buffer_from("code labels", &bands.cut_inner(&b, &rows, -1));
            labels.push(bands.iter().map(band).collect::<gpu::Result<_>>()?);
            weights.push(device.buffer_from("code weights", &scale)?);
        }
        Ok(CodeTargets {
            levels: levels.len() as u32,
            width: width as u32,
            codes: device.buffer_from("codes", &codes)?,
            labels,
            weights,
        })
    }

    /// Targets of the language loss in one band of a view.
    pub(super) fn of(&self, view: usize, band: &Band) -> Targets<'_> {
        Targets {
            labels: &self.labels[view][band.index],
            codes: &self.codes,
            weights: &self.weights[view],
            levels: self.levels,
            width: self.width,
        }
    }
}

/// The labels of one level and view as rows of the common code table, whose first row for this
/// level is `first`.
fn rows_of(level: &LevelField, view: usize, pixels: usize, first: i32) -> Result<Vec<i32>> {
    let Some(map) = level.targets.get(view) else {
        return Ok(vec![-1; pixels]);
    };
    let codes = level.codebook.len() as i32;
    if map.data.len() != pixels || map.data.iter().any(|&l| l >= codes) {
        return Err(Error::work(format!(
            "the code targets of view {view} do not fit its photo ({} values for {pixels} pixels) or codebook",
            map.data.len()
        )));
    }
    Ok(map.data.iter().map(|&l| if l < 0 { -1 } else { l + first }).collect())
}

/// Sums of codes and weights of the splats over all labelled pixels.
pub(super) struct Lifted {
    /// [N, levels·d] blending-weighted sums of codes, `Σ_px w c`.
    pub(super) sums: Vec<f32>,
    /// [N, levels] blending weights of labelled pixels, `Σ_px w`, in pixels.
    pub(super) weights: Vec<f32>,
}

/// Passes over all photos that lift codes onto the splats of the model.
///
/// The gradient of `Σ_px F(px)·c(px)` by a splat's feature is `Σ_px w(px) c(px)`, so one backward
/// pass per view with the codes as upstream gives the weighted sums, and with ones as upstream of a
/// colour the weights themselves.
pub(super) struct Lifting<'a> {
    pub(super) device: &'a Device,
    pub(super) views: &'a mut Views,
    pub(super) cameras: &'a [Camera],
    pub(super) model: &'a Model,
    pub(super) raster: RasterOptions,
    pub(super) targets: &'a CodeTargets,
    /// Checked for cancellation before every pass.
    pub(super) progress: &'a dyn Progress,
}

impl Lifting<'_> {
    /// Computes the sums and weights of all photos.
    pub(super) fn sums(&mut self) -> Result<Lifted> {
        let (splats, levels) = (self.model.count(), self.targets.levels as usize);
        let mut lifted = Lifted {
            sums: vec![0.0; splats * levels * self.targets.width as usize],
            weights: vec![0.0; splats * levels],
        };
        for view in 0..self.cameras.len() {
            self.add_gradients(view, Mode::Lift, &mut lifted.sums)?;
            let frame = self.views.stage(view).raster.frame();
            for (row, by_level) in
                lifted.weights.chunks_exact_mut(levels).zip(frame.colour_gradients(splats)?)
            {
                row.iter_mut().zip(by_level).for_each(|(sum, w)| *sum += w);
            }
            // Cleared, because a loss without colours would leave these values.
            let colours = 3 * frame.bands.pixels();
            frame.planes_grad.write_at(0, &vec![0f32; colours])?;
        }
        Ok(lifted)
    }

    /// Adds the gradients by the features of one view to `sums`.
    pub(super) fn add_gradients(&mut self, view: usize, mode: Mode, sums: &mut [f32]) -> Result<()> {
        self.progress.check()?;
        self.views.set_camera(view, &self.cameras[view])?;
        // The sums are gradients by the rendered features.
        let raster = &RasterOptions { feature_mode: FeatureMode::Linear, ..self.raster };
        let (model, targets) = (self.model, self.targets);
        let stage = self.views.stage_mut(view);
        let scratch = self.device.buffer::<f32>("language loss", stage.raster.frame().bands.pixels())?;
        loop {
            let frame = stage.raster.frame();
            let mut rec = Recorder::new(self.device, "lift");
            stage.raster.record_projection(&mut rec, &model.values, raster);
            for band in frame.bands.iter() {
                stage.raster.record_band(&mut rec, &model.values, &band);
                codes::record(&mut rec, &targets.of(view, &band), frame, &scratch, mode);
                stage.raster.record_band_backward(&mut rec, &model.values, raster, &band);
            }
            let gradients = &model.feature_gradients;
            stage.raster.record_feature_gradients(&mut rec, &model.values, raster, gradients);
            rec.download(&frame.status);
            rec.run()?;
            match stage.raster.overflow()? {
                Some(needed) => stage.raster.grow(needed)?,
                None => break,
            }
        }
        let seen = model.feature_gradients.read_range(0..sums.len())?;
        sums.par_iter_mut().zip(seen).for_each(|(s, v)| *s += v);
        Ok(())
    }
}

impl Lifted {
    /// Raw start features [N, levels·d], in the directions of the sums.
    pub(super) fn features(&self, width: usize) -> Vec<f32> {
        let mut features = self.sums.clone();
        // The length of a sum is at most the weight, and equal if all codes agree.
        features.par_chunks_exact_mut(width).filter(|f| length(f) <= MIN_WEIGHT).for_each(|f| f.fill(0.0));
        unit_start(features, width)
    }

    /// Reliability [N] of one of `levels`: the length of the mean of the unit codes of the pixels
    /// of a splat (docs/internals/method.md#reliability), in steps of 1/255; 0 for splats without
    /// pixels.
    pub(super) fn reliability(&self, level: usize, levels: usize, width: usize) -> Vec<f32> {
        let sums = self.sums.chunks_exact(width).skip(level).step_by(levels);
        let weights = self.weights.iter().skip(level).step_by(levels);
        let mean_length = |(sum, &weight): (&[f32], &f32)| {
            if weight > MIN_WEIGHT { (255.0 * (length(sum) / weight).min(1.0)).round() / 255.0 } else { 0.0 }
        };
        sums.zip(weights).map(mean_length).collect()
    }
}

/// Scales features to the length that training starts from; zeros stay.
pub(super) fn unit_start(mut features: Vec<f32>, width: usize) -> Vec<f32> {
    features.par_chunks_exact_mut(width).for_each(|feature| {
        let norm = length(feature);
        if norm > 0.0 {
            feature.iter_mut().for_each(|v| *v *= LIFTED_LENGTH / norm);
        }
    });
    features
}

/// Length of a vector.
fn length(v: &[f32]) -> f32 {
    v.iter().map(|v| v * v).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reliability_is_length_of_mean_code() {
        // Two levels of two numbers: one code throughout, two codes in equal parts; hardly any
        // weight, two opposite codes.
        let sums = vec![3.0, 0.0, 1.0, 1.0, 0.01, 0.0, 0.0, 0.0];
        let lifted = Lifted { sums, weights: vec![3.0, 2.0, 0.01, 4.0] };
        assert_eq!(lifted.reliability(0, 2, 2), [1.0, 0.0]);
        // √½ in steps of 1/255.
        assert_eq!(lifted.reliability(1, 2, 2), [180.0 / 255.0, 0.0]);
    }
}
