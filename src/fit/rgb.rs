//! RGB stage: fits splats, initialised from points, to the photos and refines the cameras
//! (docs/internals/method.md#splats).
use super::bounds::Bounds;
use super::densify::Density;
use super::init::splats_from_points;
use super::losses::Losses;
use super::model::Model;
use super::options::RgbOptions;
use super::photos::Photos;
use super::pose::PoseAdam;
use super::scale::SceneScale;
use super::schedule::ViewOrder;
use super::sh_degree::ViewDependence;
use super::stats::{CurvePoint, FitStats};
use super::training::{self, StepReport, Trainer, Training};
use super::unseen::{backdrop, continued_surfaces};
use super::views::Views;
use super::virtual_views::virtual_views;
use crate::gpu::{Device, Recorder};
use crate::pass::compact;
use crate::pass::metrics::psnr_masked;
use crate::pass::options::{FeatureMode, RasterOptions};
use crate::pass::ssim_l1::ImageLoss;
use crate::progress::Progress;
use crate::scene::{Camera, Coverage, DepthMap, Outside, PointCloud, RgbImage, Splats};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::time::Instant;

#[cfg(test)]
mod tests;

/// Upper bound of PSNR, dB: above the rounding noise of 8-bit photos, 10·log10(12·255²) = 58.9 dB,
/// so that a render that happens to match exactly does not outweigh all other views.
pub(crate) const MOST_PSNR: f64 = 60.0;

/// Result of the RGB stage.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Trained {
    /// Fitted splats.
    pub splats: Splats,
    /// Refined cameras; the first as given.
    pub cameras: Vec<Camera>,
    /// Splats behind the scene, no part of it: blurred colours where neither a photo nor a continued
    /// surface shows anything.
    #[serde(default)]
    pub backdrop: Splats,
    /// Statistics.
    pub stats: FitStats,
}

impl Trained {
    /// Splats of another program, with the cameras that show them.
    pub fn given(splats: Splats, cameras: Vec<Camera>) -> Trained {
        let stats = FitStats { splats: [splats.len(); 2], ..FitStats::default() };
        Trained { splats, cameras, backdrop: Splats::default(), stats }
    }

    /// Adds the backdrop. It is no part of training: before an opaque background surfaces would stay
    /// transparent.
    pub(super) fn with_backdrop(self, photos: &Photos, options: &RgbOptions) -> Trained {
        if options.margin <= 0.0 || photos.show_emptiness() {
            return self;
        }
        let photos = Photos { cameras: &self.cameras, ..*photos };
        Trained { backdrop: backdrop(&photos, &self.splats.means), ..self }
    }
}

/// Fits splats to photos. `depths`, if given, regularises where a view's depth is known.
/// Deterministic for a seed up to the order of float atomics on the device.
pub fn train_rgb(
    device: &Device,
    images: &[RgbImage],
    cameras: &[Camera],
    points: &PointCloud,
    depths: Option<&[DepthMap]>,
    options: &RgbOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    train_photos(device, Photos { images, cameras, depths, coverage: &[] }, points, options, progress)
}

/// [`train_rgb`] with the coverage of the photos.
pub(crate) fn train_photos(
    device: &Device,
    photos: Photos,
    points: &PointCloud,
    options: &RgbOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    let cameras = photos.cameras;
    progress.begin("initial splats", 2);
    let mut start = splats_from_points(points, &options.init, options.seed)?;
    progress.step(1, "");
    let mut unseen = continued_surfaces(&photos, options);
    if options.bounded {
        let bounds = Bounds::new(cameras, &points.positions);
        (start, unseen) = (bounds.clamp_to_bounds(start), bounds.clamp_to_bounds(unseen));
    }
    let scale = SceneScale::of(cameras, points);
    progress.end();
    let trained = fit_with_unseen(device, photos, start, unseen, scale, options, progress)?;
    Ok(trained.with_backdrop(&photos, options))
}

/// [`train_rgb`] from given splats instead of points, with their SH degree.
pub fn fit_rgb(
    device: &Device,
    images: &[RgbImage],
    cameras: &[Camera],
    start: Splats,
    scale: SceneScale,
    depths: Option<&[DepthMap]>,
    options: &RgbOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    let photos = Photos { images, cameras, depths, coverage: &[] };
    fit_photos(device, photos, start, scale, options, progress)
}

/// [`fit_rgb`] with the coverage of the photos.
pub(crate) fn fit_photos(
    device: &Device,
    photos: Photos,
    start: Splats,
    scale: SceneScale,
    options: &RgbOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    fit_with_unseen(device, photos, start, Splats::default(), scale, options, progress)
}

/// [`fit_photos`] with splats of continued surfaces. They are trained, since photos show some of
/// them at borders and edges, but do not grow: no photo would hold that against them.
pub(super) fn fit_with_unseen(
    device: &Device,
    photos: Photos,
    mut start: Splats,
    unseen: Splats,
    scale: SceneScale,
    options: &RgbOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    let clock = Instant::now();
    progress.begin("splats", options.iterations as u64);
    let largest = unseen.log_scales.iter().map(|s| s[0].max(s[1]).max(s[2])).collect();
    start.append_raised(unseen);
    let mut run = Run::new(device, photos, &start, scale, options)?;
    run.trainer.model.unseen = largest;
    training::train(&mut run, 0, options.iterations, progress)?;
    let (splats, cameras, psnr, poses_refined) = run.finish()?;
    progress.end();
    let stats = FitStats {
        curve: run.curve,
        psnr,
        splats: [start.len(), splats.len()],
        poses_refined,
        view_dependence: ViewDependence::default(),
        seconds: clock.elapsed().as_secs_f64(),
    };
    Ok(Trained { splats, cameras, backdrop: Splats::default(), stats })
}

impl Photos<'_> {
    /// Whether a photo has an empty background.
    pub(super) fn show_emptiness(&self) -> bool {
        self.coverage.iter().flatten().any(|c| c.outside == Outside::Empty)
    }

    /// PSNR of a render of a photo over its used pixels, dB.
    pub(super) fn psnr(&self, photo: usize, rendered: &RgbImage) -> f64 {
        let weights = self.coverage.get(photo).and_then(Option::as_ref).map(Coverage::weights);
        let counts = |i: usize| weights.as_ref().is_none_or(|w| w.data[i] > 0.0);
        psnr_masked(rendered, &self.images[photo], counts).min(MOST_PSNR)
    }
}

/// One fit.
pub(crate) struct Run<'a> {
    trainer: Trainer,
    options: &'a RgbOptions,
    scale: SceneScale,
    photos: Photos<'a>,
    bounds: Option<Bounds>,
    density: Option<Density>,
    poses: Vec<PoseAdam>,
    /// Losses since the last report.
    recent: Vec<StepLoss>,
    /// The photo of the last step on one, and whether a step on a virtual view followed.
    last: (usize, bool),
    /// Last measured PSNR per view, dB.
    psnr: Vec<Option<f64>>,
    curve: Vec<CurvePoint>,
}

/// Objective of a step on a photo, and its SSIM if the objective has it.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct StepLoss {
    total: f64,
    ssim: Option<f64>,
}

/// State of the stage besides the model, for checkpoints.
#[derive(Serialize, Deserialize)]
pub(crate) struct StageState {
    poses: Vec<PoseAdam>,
    recent: Vec<StepLoss>,
    last: (usize, bool),
    psnr: Vec<Option<f64>>,
    curve: Vec<CurvePoint>,
    /// Sums of [`Density`]; empty without density control.
    #[serde(default)]
    density: Vec<f32>,
}

impl<'a> Run<'a> {
    pub(crate) fn new(
        device: &Device,
        photos: Photos<'a>,
        start: &Splats,
        scale: SceneScale,
        options: &'a RgbOptions,
    ) -> Result<Self> {
        let raster = RasterOptions {
            sh_degree: start.sh_degree,
            feature_mode: FeatureMode::Linear,
            features_move_geometry: true,
        };
        let (count, confidence) = (options.virtual_views, options.min_confidence);
        let virtual_views = virtual_views(&photos, count, confidence, options.seed);
        let mut groups = vec![(photos, &options.losses)];
        if !virtual_views.images.is_empty() {
            groups.push((virtual_views.photos(), &Losses::VIRTUAL));
        }
        let growth = options.densify.map_or(1, |densify| densify.growth);
        let views = Views::new(device, &groups, growth * start.len(), 0, scale.near())?;
        let density =
            options.densify.map(|densify| Density::new(device, densify, start.len())).transpose()?;
        let model = Model::new(device, start, 0)?;
        let order = ViewOrder::new(photos.cameras.len(), virtual_views.cameras.len(), options.seed);
        let cameras = [photos.cameras, &virtual_views.cameras].concat();
        let trainer = Trainer::new(device, raster, model, views, cameras, order)?;
        Ok(Run {
            trainer,
            options,
            scale,
            photos,
            density,
            bounds: options.bounded.then(|| Bounds::new(photos.cameras, &start.means)),
            poses: vec![PoseAdam::default(); photos.cameras.len()],
            recent: Vec::new(),
            last: (0, true),
            psnr: vec![None; photos.cameras.len()],
            curve: Vec::new(),
        })
    }

    /// The terms of the objective for a view.
    fn losses(&self, view: usize) -> &Losses {
        if view < self.photos.cameras.len() { &self.options.losses } else { &Losses::VIRTUAL }
    }

    /// Refines a pose; camera 0 stays, because it defines the world frame.
    fn move_camera(&mut self, view: usize, iteration: usize) -> Result<()> {
        let Some(poses) = self.options.poses.filter(|p| view > 0 && iteration >= p.start) else {
            return Ok(());
        };
        let g = self.trainer.views.raster.frame().camera_grad.read()?;
        let twist = [g[0], g[1], g[2], g[3], g[4], g[5]].map(f64::from);
        let rate = poses.rate.at(iteration);
        let pose = &mut self.trainer.cameras[view].pose;
        *pose = self.poses[view].update(pose, twist, rate, self.scale.median_depth);
        Ok(())
    }

    /// Measures a point of the loss curve and checks for gradients that are not finite.
    fn measure(&mut self, step: usize) -> Result<CurvePoint> {
        let t = &mut self.trainer;
        t.model.check(step)?;
        let (photo, is_old) = self.last;
        // A virtual view overwrites the render.
        let rendered = if is_old { None } else { t.views.last_render()? };
        let rendered = match rendered {
            Some(rendered) => rendered,
            None => t.views.render(photo, &t.cameras[photo], &t.model, &t.raster)?,
        };
        self.psnr[photo] = Some(self.photos.psnr(photo, &rendered));
        let known: Vec<f64> = self.psnr.iter().flatten().copied().collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let losses: Vec<f64> = self.recent.iter().map(|l| l.total).collect();
        let ssim: Vec<f64> = self.recent.iter().filter_map(|l| l.ssim).collect();
        let point = CurvePoint {
            step,
            loss: mean(&losses),
            ssim: (!ssim.is_empty()).then(|| mean(&ssim)),
            psnr: known.iter().sum::<f64>() / known.len().max(1) as f64,
            splats: t.model.count(),
        };
        self.recent.clear();
        self.curve.push(point);
        Ok(point)
    }

    fn is_measured_at(&self, step: usize) -> bool {
        step > 0 && (step.is_multiple_of(self.options.report_every.max(1)) || step == self.options.iterations)
    }

    fn grows_at(&self, step: usize) -> bool {
        self.density.as_ref().is_some_and(|density| density.is_due(step, self.options.iterations))
    }

    fn is_pruned_at(&self, step: usize) -> bool {
        let RgbOptions { prune_every: every, prune_from, .. } = *self.options;
        every > 0 && step >= prune_from && step.is_multiple_of(every)
    }

    /// Removes faint splats and clamps the others to the bounds.
    fn prune(&mut self, step: usize) -> Result<()> {
        if !self.is_pruned_at(step) {
            return Ok(());
        }
        let model = &mut self.trainer.model;
        let logits = model.values.opacity_logits.read_range(0..model.count())?;
        let rows = compact::kept(&logits, self.options.prune_opacity);
        if rows.is_empty() {
            return Err(Error::work(format!(
                "every splat faded away by step {step}: cameras and photos do not fit together"
            )));
        }
        if model.keep(&rows)? {
            self.forget_density()?;
        }
        self.clamp_to_bounds()
    }

    /// Lets splats grow where that is due.
    fn densify(&mut self, step: usize) -> Result<()> {
        let (is_due, t, extent) = (self.grows_at(step), &mut self.trainer, self.scale.extent);
        match &self.density {
            Some(density) if is_due => {
                density.grow(&mut t.model, extent, self.options.seed ^ (step as u64) << 32)?;
                self.forget_density()
            }
            _ => Ok(()),
        }
    }

    /// Drops the recordings, and the sums of rows that have moved.
    fn forget_density(&mut self) -> Result<()> {
        self.trainer.forget_recordings();
        let count = self.trainer.model.count();
        match &mut self.density {
            Some(density) => density.reset(&self.trainer.device, count),
            None => Ok(()),
        }
    }

    /// Clamps the splats to the bounds, if there are any.
    fn clamp_to_bounds(&mut self) -> Result<()> {
        if let Some(bounds) = &self.bounds
            && bounds.clamp_model_to_bounds(&mut self.trainer.model)?
        {
            self.trainer.forget_recordings();
        }
        Ok(())
    }

    /// Copies the results to the host and keeps the refined cameras only if they explain the photos
    /// better.
    fn finish(&mut self) -> Result<(Splats, Vec<Camera>, Vec<f64>, bool)> {
        self.clamp_to_bounds()?;
        let (t, photos) = (&mut self.trainer, self.photos);
        let initial = photos.cameras;
        let splats = t.model.splats()?;
        let mut score = |cameras: &[Camera]| -> Result<Vec<f64>> {
            let psnr = |i: usize| {
                let rendered = t.views.render(i, &cameras[i], &t.model, &t.raster)?;
                Ok(photos.psnr(i, &rendered))
            };
            (0..photos.images.len()).map(psnr).collect()
        };
        let refined = score(&t.cameras)?;
        if self.options.poses.is_none() {
            return Ok((splats, initial.to_vec(), refined, false));
        }
        let before = score(initial)?;
        let sum = |v: &[f64]| v.iter().sum::<f64>();
        if sum(&refined) > sum(&before) {
            Ok((splats, t.cameras[..initial.len()].to_vec(), refined, true))
        } else {
            Ok((splats, initial.to_vec(), before, false))
        }
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
        let size = self.photos.images.first().map_or(1, |i| i.data.len());
        self.trainer.model.hold_colours_below(self.options.colour_pixels, size);
        self.trainer.model.set_rates(&self.options.rates, 0.0, self.scale.extent, iteration)
    }

    fn record(&self, view: usize) -> Recorder {
        let Trainer { device, raster, model, views, .. } = &self.trainer;
        let (item, rasterizer) = (&views.list[view], &views.raster);
        let frame = rasterizer.frame();
        let mut rec = Recorder::new(device, "rgb step");
        rasterizer.record_projection(&mut rec, &model.values, raster);
        for band in item.bands.iter() {
            rasterizer.record_band(&mut rec, &model.values, &band);
            self.losses(view).record_image(&mut rec, views, item, &band);
            rasterizer.record_band_backward(&mut rec, &model.values, raster, &band);
        }
        if let Some(density) = &self.density {
            density.record(&mut rec, frame, model.count());
        }
        let needles = self.losses(view).ratio_penalty(model.count());
        model.record_update(&mut rec, rasterizer, raster, needles);
        rec.download(&frame.status);
        rec.download(&views.sums);
        if self.options.poses.is_some() {
            rec.download(&frame.camera_grad);
        }
        rec
    }

    fn read_back(&mut self, view: usize, iteration: usize) -> Result<()> {
        if view >= self.photos.cameras.len() {
            self.last.1 = true;
            return Ok(());
        }
        self.last = (view, false);
        let views = &self.trainer.views;
        let [l1, ssim, ..] = views.total(view)?;
        let loss = ImageLoss::of(&views.list[view].bands, [l1, ssim], views.list[view].covered);
        let losses = self.losses(view);
        let has_ssim = losses.dssim > 0.0;
        self.recent.push(StepLoss { total: losses.photos(&loss), ssim: has_ssim.then_some(loss.ssim) });
        self.move_camera(view, iteration)
    }

    fn review_is_due(&self, step: usize) -> bool {
        self.is_measured_at(step) || self.grows_at(step) || self.is_pruned_at(step)
    }

    fn review(&mut self, step: usize) -> Result<StepReport> {
        let mut report = StepReport::default();
        // Since the last point, all steps may have been on virtual views.
        if self.is_measured_at(step) && !self.recent.is_empty() {
            let CurvePoint { loss, ssim, psnr, splats, .. } = self.measure(step)?;
            report.note = Some(format!("loss {loss:.4}, PSNR {psnr:.1}, {splats} splats"));
            report.figures = vec![("loss", loss), ("psnr", psnr), ("splats", splats as f64)];
            report.figures.extend(ssim.map(|ssim| ("ssim", ssim)));
        }
        self.densify(step)?;
        self.prune(step)?;
        Ok(report)
    }

    fn stage_state(&self) -> Result<StageState> {
        let Run { poses, recent, last, psnr, curve, density, trainer, .. } = self;
        let sums = density.as_ref().map(|density| density.state(trainer.model.count()));
        Ok(StageState {
            poses: poses.clone(),
            recent: recent.clone(),
            last: *last,
            psnr: psnr.clone(),
            curve: curve.clone(),
            density: sums.transpose()?.unwrap_or_default(),
        })
    }

    fn set_stage_state(&mut self, kept: StageState) -> Result<()> {
        (self.poses, self.recent, self.last) = (kept.poses, kept.recent, kept.last);
        (self.psnr, self.curve) = (kept.psnr, kept.curve);
        match &mut self.density {
            Some(density) => density.restore(&self.trainer.device, &kept.density),
            None => Ok(()),
        }
    }
}
