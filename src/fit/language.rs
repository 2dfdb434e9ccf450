//! Language stage: trains features of splats to render to the code of each pixel
//! (docs/internals/method.md#language-training), `L = λ2·L_img + (1−λ2)·L_sem`, from lifted
//! features.
use super::lift::{CodeTargets, code_length, lift};
use super::losses::Losses;
use super::model::{Model, not_finite};
use super::options::{FeatureStorage, LanguageOptions, Start};
use super::photos::Photos;
use super::scale::SceneScale;
use super::schedule::ViewOrder;
use super::training::{self, StepReport, Trainer, Training};
use super::views::{Views, slot};
use crate::gpu::{Buffer, Device, Recorder};
use crate::pass::channels::BASE_CHANNELS;
use crate::pass::options::{FeatureMode, RasterOptions};
use crate::pass::{codes, regularise, sum};
use crate::progress::Progress;
use crate::scene::{Camera, LEVEL_NAMES, LanguageField, LevelField, RgbImage, Splats};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Slot of the language loss in the loss sums; Σ|x−y| and ΣSSIM precede it.
const LANGUAGE_SUM: u32 = 2;
/// Least gain of decode accuracy over two measurements; a smaller gain ends the training
/// (docs/internals/method.md#stopping).
const MIN_GAIN: f64 = 1e-3;

/// One measurement during the language stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct LanguagePoint {
    /// 1-based step; 0 = after lifting.
    pub step: usize,
    /// Mean L_sem since the last point.
    pub loss: f64,
    /// Share of labelled training pixels that decode to their label, index as in [`LEVEL_NAMES`];
    /// `None` for levels without features in the model.
    pub accuracy: Vec<Option<f64>>,
}

impl LanguagePoint {
    /// Mean accuracy of the levels of the model.
    pub fn mean_accuracy(&self) -> f64 {
        let (sum, n) = self.accuracy.iter().flatten().fold((0.0, 0usize), |(s, n), a| (s + a, n + 1));
        sum / n.max(1) as f64
    }
}

/// Last accuracy of a level that was measured while features were trained.
pub fn decode_accuracy(curve: &[LanguagePoint], level: usize) -> Option<f64> {
    curve.iter().rev().find_map(|p| *p.accuracy.get(level)?)
}

/// Result of the language stage.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[non_exhaustive]
pub struct TrainedLanguage {
    /// Splats of the shared model; with `per_level` the given splats, since every level has its own
    /// ([`LevelField::splats`]).
    pub splats: Splats,
    /// The given field, with features [N, d] as rendered (linear blending).
    pub field: LanguageField,
    /// Measurements; with `per_level` those of all levels one after the other, with continued
    /// steps.
    pub curve: Vec<LanguagePoint>,
    /// Wall-clock time, seconds.
    pub seconds: f64,
}

/// Trains the features of all levels that have codes and targets.
pub fn train_language(
    device: &Device,
    images: &[RgbImage],
    cameras: &[Camera],
    splats: &Splats,
    field: LanguageField,
    options: &LanguageOptions,
    progress: &dyn Progress,
) -> Result<TrainedLanguage> {
    let photos = Photos { images, cameras, depths: None, coverage: &[] };
    train_language_of(device, photos, splats, field, options, progress)
}

/// [`train_language`] with the coverage of the photos.
pub(crate) fn train_language_of(
    device: &Device,
    photos: Photos,
    splats: &Splats,
    field: LanguageField,
    options: &LanguageOptions,
    progress: &dyn Progress,
) -> Result<TrainedLanguage> {
    let clock = Instant::now();
    let active: Vec<usize> = (0..field.levels.len())
        .filter(|&l| !field.levels[l].codebook.is_empty() && !field.levels[l].targets.is_empty())
        .collect();
    if active.is_empty() {
        return Err(Error::work("the language stage has no labelled pixels on any level: check the masks"));
    }
    let groups: Vec<Vec<usize>> =
        if options.per_level { active.iter().map(|&l| vec![l]).collect() } else { vec![active] };
    progress.begin("language", (options.iterations * groups.len()) as u64);
    let mut out = TrainedLanguage { splats: splats.clone(), field, curve: Vec::new(), seconds: 0.0 };
    for (g, group) in groups.iter().enumerate() {
        let levels: Vec<(usize, &LevelField)> = group.iter().map(|&l| (l, &out.field.levels[l])).collect();
        let fields: Vec<&LevelField> = levels.iter().map(|l| l.1).collect();
        let made = if options.iterations == 0 && options.start == Start::Lifted {
            lifted_model(device, photos.cameras, splats, &fields, options.epsilon, progress)?
        } else {
            let mut run = Run::new(device, photos, splats, &levels, options, progress)?;
            training::train(&mut run, g, options.iterations, progress)?;
            let made = run.finish()?;
            let before = g * options.iterations;
            out.curve.extend(run.curve.drain(..).map(|p| LanguagePoint { step: before + p.step, ..p }));
            made
        };
        let features = made.features.into_iter().zip(made.reliability);
        for (&level, (features, reliability)) in group.iter().zip(features) {
            match options.storage {
                FeatureStorage::Mixes => out.field.levels[level].set_features(features),
                FeatureStorage::Numbers => out.field.levels[level].set_numbers(features),
            }
            out.field.levels[level].reliability = reliability;
        }
        match group.as_slice() {
            [level] if options.per_level => out.field.levels[*level].splats = Some(made.splats),
            _ => out.splats = made.splats,
        }
    }
    progress.end();
    out.seconds = clock.elapsed().as_secs_f64();
    Ok(out)
}

/// Splats with their features.
struct FeaturedSplats {
    splats: Splats,
    /// Per level, [N, d] as rendered.
    features: Vec<Vec<f32>>,
    /// Per level, [N].
    reliability: Vec<Vec<f32>>,
}

/// The given splats with lifted features.
fn lifted_model(
    device: &Device,
    cameras: &[Camera],
    splats: &Splats,
    levels: &[&LevelField],
    epsilon: f32,
    progress: &dyn Progress,
) -> Result<FeaturedSplats> {
    let (count, width) = (levels.len(), code_length(levels)?);
    let lifted = lift(device, cameras, splats, levels, progress)?;
    Ok(FeaturedSplats {
        splats: splats.clone(),
        features: rendered_features(lifted.features(width), count, width, epsilon),
        reliability: (0..count).map(|l| lifted.reliability(l, count, width)).collect(),
    })
}

/// Divides raw features [N, levels·d] by their length plus ε and separates the levels.
fn rendered_features(mut all: Vec<f32>, levels: usize, d: usize, epsilon: f32) -> Vec<Vec<f32>> {
    all.par_chunks_exact_mut(d).for_each(|feature| {
        let norm = feature.iter().map(|v| v * v).sum::<f32>().sqrt();
        feature.iter_mut().for_each(|v| *v /= norm + epsilon);
    });
    let features_of =
        |l: usize| all.chunks_exact(levels * d).flat_map(move |f| &f[l * d..(l + 1) * d]).copied();
    (0..levels).into_par_iter().map(|l| features_of(l).collect()).collect()
}

/// Training of one model, with all levels or one.
pub(crate) struct Run<'a> {
    trainer: Trainer,
    options: &'a LanguageOptions,
    /// Levels with their index in the field.
    levels: Vec<(usize, &'a LevelField)>,
    width: usize,
    extent: f64,
    targets: CodeTargets,
    /// Language loss per pixel of a band.
    loss: Buffer<f32>,
    /// Reliability per level, [N].
    reliability: Vec<Vec<f32>>,
    /// Losses since the last measurement.
    recent: Vec<f64>,
    curve: Vec<LanguagePoint>,
}

/// State of the stage besides the model, for checkpoints.
#[derive(Serialize, Deserialize)]
pub(crate) struct StageState {
    recent: Vec<f64>,
    curve: Vec<LanguagePoint>,
}

impl<'a> Run<'a> {
    pub(crate) fn new(
        device: &Device,
        photos: Photos,
        splats: &Splats,
        levels: &[(usize, &'a LevelField)],
        options: &'a LanguageOptions,
        progress: &dyn Progress,
    ) -> Result<Self> {
        let fields: Vec<&LevelField> = levels.iter().map(|l| l.1).collect();
        let width = fields[0].codebook.code_dim;
        let channels = width * levels.len();
        let Photos { images, cameras, .. } = photos;
        let scale = SceneScale::measure(cameras, &splats.means);
        let model = Model::new(device, splats, channels)?;
        let (capacity, near) = (splats.len(), scale.near());
        let views = Views::new(device, &[(photos, &options.losses)], capacity, channels, near)?;
        let targets = CodeTargets::new(device, &fields, images, &views, 1.0 - options.image_weight)?;
        let raster = RasterOptions {
            sh_degree: splats.sh_degree,
            feature_mode: FeatureMode::Gauge { epsilon: options.epsilon, blocks: levels.len() },
            features_move_geometry: !options.detach_geometry,
        };
        let lifted = lift(device, cameras, splats, &fields, progress)?;
        let reliability = (0..levels.len()).map(|l| lifted.reliability(l, levels.len(), width)).collect();
        match options.start {
            Start::Zero => {}
            Start::Lifted => model.values.features.write(&lifted.features(width))?,
        }
        let loss = device.buffer::<f32>("language loss", views.most_pixels())?;
        let order = ViewOrder::new(cameras.len(), 0, options.seed);
        Ok(Run {
            trainer: Trainer::new(device, raster, model, views, cameras.to_vec(), order)?,
            options,
            levels: levels.to_vec(),
            width,
            extent: scale.extent,
            targets,
            loss,
            reliability,
            recent: Vec::new(),
            curve: Vec::new(),
        })
    }

    /// True when the last two measurements gained less than [`MIN_GAIN`].
    fn settled(&self) -> bool {
        match self.curve.as_slice() {
            [.., a, b, c] => c.mean_accuracy().max(b.mean_accuracy()) - a.mean_accuracy() < MIN_GAIN,
            _ => false,
        }
    }

    /// Renders all training views and counts the labelled pixels that decode to their label.
    fn measure(&mut self, step: usize) -> Result<LanguagePoint> {
        let mut counts = vec![[0usize; 2]; self.levels.len()];
        let (t, levels, width) = (&mut self.trainer, &self.levels, self.width);
        for (view, camera) in t.cameras.iter().enumerate() {
            t.views.set_camera(view, camera)?;
            let raster = &mut t.views.raster;
            raster.forward_bands(&t.model.values, &t.raster, |frame, band| {
                let pixels = frame.bands.pixels();
                for (l, (_, level)) in levels.iter().enumerate() {
                    let Some(labels) = level.targets.get(view) else { continue };
                    let labels = frame.bands.cut_inner(band, &labels.data, -1);
                    let first = (BASE_CHANNELS + l * width) * pixels;
                    let block = frame.planes.read_range(first..first + width * pixels)?;
                    let [right, valid] = count_decoded(level, &labels, &block);
                    counts[l][0] += right;
                    counts[l][1] += valid;
                }
                Ok(())
            })?;
        }
        let mut accuracy = vec![None; LEVEL_NAMES.len()];
        for ((level, _), [right, valid]) in self.levels.iter().zip(counts) {
            accuracy[*level] = Some(right as f64 / valid.max(1) as f64);
        }
        let loss = self.recent.iter().sum::<f64>() / self.recent.len().max(1) as f64;
        self.recent.clear();
        Ok(LanguagePoint { step, loss, accuracy })
    }

    /// Replaces the raw features [N, levels·d].
    pub(crate) fn set_features(&self, features: &[f32]) -> Result<()> {
        Ok(self.trainer.model.values.features.write(features)?)
    }

    fn finish(&mut self) -> Result<FeaturedSplats> {
        let model = &self.trainer.model;
        let splats = model.splats()?;
        let (levels, d) = (self.levels.len(), self.width);
        let all = model.values.features.read_range(0..splats.len() * levels * d)?;
        let bad = not_finite(&all);
        if bad > 0 {
            return Err(Error::work(format!(
                "the language stage produced {bad} of {} features that are not finite; nothing was kept",
                all.len()
            )));
        }
        let features = rendered_features(all, levels, d, self.options.epsilon);
        Ok(FeaturedSplats { splats, features, reliability: std::mem::take(&mut self.reliability) })
    }
}

impl Training for Run<'_> {
    type StageState = StageState;

    fn trainer(&self) -> &Trainer {
        &self.trainer
    }
    fn trainer_mut(&mut self) -> &mut Trainer {
        &mut self.trainer
    }

    fn schedule(&mut self, iteration: usize) -> Result<()> {
        let model = &mut self.trainer.model;
        model.set_rates(&self.options.rates, self.options.feature_rate, self.extent, iteration)
    }

    fn record(&self, view: usize) -> Recorder {
        let Trainer { device, raster, model, views, .. } = &self.trainer;
        let (item, rasterizer) = (&views.list[view], &views.raster);
        let frame = rasterizer.frame();
        let mut rec = Recorder::new(device, "language step");
        if views.have_several_sizes() {
            // Not every plane of gradients is written.
            rec.fill(&frame.planes_grad, 0);
        }
        rasterizer.record_projection(&mut rec, &model.values, raster);
        let Losses { l1, dssim, .. } = self.options.losses;
        let weights = [l1, dssim].map(|w| w * self.options.image_weight);
        for band in item.bands.iter() {
            rasterizer.record_band(&mut rec, &model.values, &band);
            if !self.options.detach_geometry {
                let (target, sums) = (&item.target[band.index], (&views.sums, slot(&band)));
                let gradient = &frame.planes_grad;
                views.loss.record(
                    &mut rec,
                    (&item.bands, &band),
                    &frame.planes,
                    target,
                    gradient,
                    item.covered,
                    weights,
                    sums,
                );
                if let Some((alpha, weight)) = &item.alpha {
                    let alpha = (&alpha[band.index], self.options.image_weight * weight);
                    regularise::record_depth_and_alpha(&mut rec, frame, None, Some(alpha));
                }
            }
            codes::record(&mut rec, &self.targets.of(view, &band), frame, &self.loss);
            let sums = (&views.sums, slot(&band) + LANGUAGE_SUM);
            sum::record(&mut rec, &self.loss, (0..item.bands.pixels(), None), sums);
            rasterizer.record_band_backward(&mut rec, &model.values, raster, &band);
        }
        if !self.options.detach_geometry {
            model.record_update(&mut rec, rasterizer, raster, None);
        }
        model.record_feature_update(&mut rec, rasterizer, raster);
        rec.download(&frame.status);
        rec.download(&views.sums);
        rec
    }

    fn read_back(&mut self, view: usize, _: usize) -> Result<()> {
        self.recent.push(self.trainer.views.total(view)?[LANGUAGE_SUM as usize]);
        Ok(())
    }

    fn review_is_due(&self, step: usize) -> bool {
        let LanguageOptions { check_every: every, iterations: last, .. } = *self.options;
        // A run that is measured only at its end needs no measurement at its start.
        every > 0 && (step == last || (step.is_multiple_of(every) && every < last))
    }

    fn review(&mut self, step: usize) -> Result<StepReport> {
        if !self.review_is_due(step) {
            return Ok(StepReport::default());
        }
        self.trainer.model.check(step)?;
        let point = self.measure(step)?;
        let figures = vec![("loss", point.loss), ("accuracy", point.mean_accuracy())];
        let percent = |(name, a): (&str, &Option<f64>)| a.map(|a| format!("{name} {:.1} %", 100.0 * a));
        let shares: Vec<String> = LEVEL_NAMES.into_iter().zip(&point.accuracy).filter_map(percent).collect();
        let note = Some(format!("decoded: {}", shares.join(", ")));
        self.curve.push(point);
        Ok(StepReport { figures, note, finished: self.options.stops_early && self.settled() })
    }

    fn stage_state(&self) -> Result<StageState> {
        Ok(StageState { recent: self.recent.clone(), curve: self.curve.clone() })
    }

    fn set_stage_state(&mut self, kept: StageState) -> Result<()> {
        (self.recent, self.curve) = (kept.recent, kept.curve);
        Ok(())
    }
}

/// Counts (pixels that decode to their label, labelled pixels) of planar features [d, H·W].
fn count_decoded(level: &LevelField, labels: &[i32], features: &[f32]) -> [usize; 2] {
    let pixels = labels.len();
    let d = level.codebook.code_dim;
    labels
        .par_iter()
        .enumerate()
        .filter(|(_, label)| **label >= 0)
        .map(|(p, &label)| {
            let feature: Vec<f32> = (0..d).map(|k| features[k * pixels + p]).collect();
            [usize::from(level.codebook.decode(&feature) == Some(label as usize)), 1]
        })
        .reduce(|| [0, 0], |a, b| [a[0] + b[0], a[1] + b[1]])
}
