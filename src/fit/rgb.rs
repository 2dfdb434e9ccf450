//! The RGB stage: splats from points, fitted to the photos, cameras refined on the way (docs/method.md#splats).
use super::coarse::Halved;
use super::init::splats_from_points;
use super::model::{self, Model};
use super::options::RgbOptions;
use super::pose::PoseAdam;
use super::scale::SceneScale;
use super::schedule::ViewOrder;
use super::unseen::unseen_splats;
use super::views::Views;
use crate::checkpoint::Checkpoint;
use crate::gpu::{Device, Program, Recorder};
use crate::pass::metrics::psnr;
use crate::pass::options::{FeatureMode, RasterOptions};
use crate::pass::{compact, regularise, ssim_l1::ImageLoss};
use crate::progress::Progress;
use crate::scene::{Camera, DepthMap, PointCloud, RgbImage, Splats};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Photos of 8 bits cannot show more than their rounding noise, 10·log10(12·255²) = 58.9 dB: a render that happens to
/// match exactly must not outweigh all other views.
const MOST_PSNR: f64 = 60.0;
/// Scale ratios above this are penalised (docs/method.md#regularisers).
const RATIO_LIMIT: f32 = 8.0;

/// One point of the training curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// 1-based step.
    pub step: usize,
    /// Mean loss over the steps since the last point.
    pub loss: f64,
    /// Mean SSIM over the same steps.
    pub ssim: f64,
    /// Mean over the views of the PSNR when each was last looked at, dB. One view is looked at per point, which costs a
    /// copy of its render; until every view had its turn the mean is over those that had.
    pub psnr: f64,
    /// Number of splats.
    pub splats: usize,
}

/// What happened during a fit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct FitStats {
    /// The loss over time.
    pub curve: Vec<CurvePoint>,
    /// PSNR per training view with the returned cameras, dB.
    pub psnr: Vec<f64>,
    /// Splats at the start and at the end.
    pub splats: [usize; 2],
    /// Whether the refined cameras were kept.
    pub poses_refined: bool,
    /// Wall-clock time, seconds.
    pub seconds: f64,
}

impl FitStats {
    /// Mean PSNR over the training views, dB.
    pub fn mean_psnr(&self) -> f64 {
        self.psnr.iter().sum::<f64>() / self.psnr.len().max(1) as f64
    }
}

/// The result of the RGB stage.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Trained {
    /// Fitted splats.
    pub splats: Splats,
    /// Refined cameras; camera 0 as given.
    pub cameras: Vec<Camera>,
    /// How it went.
    pub stats: FitStats,
}

/// Fits splats to photos. `depths`, if given, regularises where a view's depth is confident. Deterministic for a seed
/// up to the order of float atomics on the device.
pub fn train_rgb(
    device: &Device,
    images: &[RgbImage],
    cameras: &[Camera],
    points: &PointCloud,
    depths: Option<&[DepthMap]>,
    options: &RgbOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    let mut start = splats_from_points(points, &options.init, options.seed)?;
    if let Some(depths) = depths.filter(|_| options.margin > 0.0) {
        let (reach, confidence) = (options.margin, options.min_confidence);
        start.append(unseen_splats(images, cameras, depths, reach, confidence, options.seed));
    }
    super::init::raise_sh_degree(&mut start, options.sh_degree);
    let scale = SceneScale::of(cameras, points);
    fit_rgb(device, images, cameras, start, scale, depths, options, progress)
}

/// [`train_rgb`] from given splats instead of points.
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
    let clock = Instant::now();
    progress.begin("splats", options.iterations as u64);
    let coarse = (options.coarse * options.iterations as f64) as usize;
    let half = (coarse > 0).then(|| Halved::of(images, cameras, depths));
    let first = match &half {
        Some(half) => (half.images.as_slice(), half.cameras.as_slice(), half.depths.as_deref()),
        None => (images, cameras, depths),
    };
    let kept = progress.checkpoint().and_then(|c| c.load::<State>());
    let (done, from) = kept.as_ref().map_or((0, &start), |k| (k.done, &k.model.splats));
    let mut run = Run::new(device, first.0, first.1, from, scale, first.2, options)?;
    kept.map_or(Ok(()), |k| run.restore(k))?;
    let mut small = coarse > 0;
    for iteration in done..options.iterations {
        if progress.cancelled() {
            run.keep(iteration, progress)?;
            return Err(Error::Cancelled);
        }
        if small && iteration >= coarse {
            run.look_at(images, cameras, depths)?;
            small = false;
        }
        run.step(iteration)?;
        if let Some(point) = run.report(iteration)? {
            let note = format!("loss {:.4}, PSNR {:.1}, {} splats", point.loss, point.psnr, point.splats);
            progress.step(iteration as u64 + 1, &note);
            let splats = point.splats as f64;
            let figures =
                [("loss", point.loss), ("ssim", point.ssim), ("psnr", point.psnr), ("splats", splats)];
            progress.figures(point.step as u64, &figures);
        }
        run.prune(iteration)?;
        if progress.checkpoint().is_some_and(Checkpoint::due) {
            run.keep(iteration + 1, progress)?;
        }
    }
    progress.step(options.iterations as u64, "");
    run.model.check(options.iterations)?;
    let (splats, cameras, psnr, poses_refined) = run.finish(images, cameras)?;
    progress.end();
    let stats = FitStats {
        curve: run.curve,
        psnr,
        splats: [start.len(), splats.len()],
        poses_refined,
        seconds: clock.elapsed().as_secs_f64(),
    };
    Ok(Trained { splats, cameras, stats })
}

/// Depth and the confidence it needs, if it counts at all.
fn used<'d>(depths: Option<&'d [DepthMap]>, options: &RgbOptions) -> Option<(&'d [DepthMap], f32)> {
    depths.filter(|_| options.depth_weight > 0.0).map(|d| (d, options.min_confidence))
}

/// Everything of a [`Run`] that steps change, for going on after a kill.
#[derive(Serialize, Deserialize)]
struct State {
    /// Steps that are done.
    done: usize,
    model: model::State,
    cameras: Vec<Camera>,
    poses: Vec<PoseAdam>,
    order: ViewOrder,
    recent: Vec<ImageLoss>,
    last: usize,
    psnr: Vec<Option<f64>>,
    curve: Vec<CurvePoint>,
}

/// One fit.
pub(crate) struct Run<'a> {
    device: Device,
    options: &'a RgbOptions,
    scale: SceneScale,
    pub(super) raster: RasterOptions,
    pub(super) model: Model,
    pub(super) views: Views,
    cameras: Vec<Camera>,
    poses: Vec<PoseAdam>,
    order: ViewOrder,
    /// One recorded step per view; empty after anything they bind has changed.
    programs: Vec<Option<Program>>,
    recent: Vec<ImageLoss>,
    images: &'a [RgbImage],
    /// The view of the last step.
    last: usize,
    /// Per view its last PSNR, dB.
    psnr: Vec<Option<f64>>,
    curve: Vec<CurvePoint>,
}

impl<'a> Run<'a> {
    pub(crate) fn new(
        device: &Device,
        images: &'a [RgbImage],
        cameras: &[Camera],
        start: &Splats,
        scale: SceneScale,
        depths: Option<&[DepthMap]>,
        options: &'a RgbOptions,
    ) -> Result<Self> {
        Ok(Run {
            device: device.clone(),
            options,
            scale,
            raster: RasterOptions {
                sh_degree: 0,
                feature_mode: FeatureMode::Linear,
                features_move_geometry: true,
            },
            model: Model::new(device, start, 0)?,
            views: Views::new(device, images, cameras, used(depths, options), start.len(), 0, scale.near())?,
            cameras: cameras.to_vec(),
            poses: vec![PoseAdam::default(); cameras.len()],
            order: ViewOrder::new(cameras.len(), options.seed),
            programs: cameras.iter().map(|_| None).collect(),
            recent: Vec::new(),
            images,
            last: 0,
            psnr: vec![None; cameras.len()],
            curve: Vec::new(),
        })
    }

    /// Writes the state after `done` steps, if somebody keeps it.
    fn keep(&self, done: usize, progress: &dyn Progress) -> Result<()> {
        let Some(checkpoint) = progress.checkpoint() else { return Ok(()) };
        checkpoint.save(&State {
            done,
            model: self.model.state()?,
            cameras: self.cameras.clone(),
            poses: self.poses.clone(),
            order: self.order.clone(),
            recent: self.recent.clone(),
            last: self.last,
            psnr: self.psnr.clone(),
            curve: self.curve.clone(),
        })
    }

    /// Takes over a state; the run was made for its splats.
    fn restore(&mut self, kept: State) -> Result<()> {
        self.model = Model::restored(&self.device, &kept.model)?;
        let State { cameras, poses, order, recent, last, psnr, curve, .. } = kept;
        (self.cameras, self.poses, self.order) = (cameras, poses, order);
        (self.recent, self.last, self.psnr, self.curve) = (recent, last, psnr, curve);
        Ok(())
    }

    /// Goes on with the same photos at another size; the poses found so far stay.
    fn look_at(
        &mut self,
        images: &'a [RgbImage],
        cameras: &[Camera],
        depths: Option<&[DepthMap]>,
    ) -> Result<()> {
        let (depths, near) = (used(depths, self.options), self.scale.near());
        self.views = Views::new(&self.device, images, cameras, depths, self.model.count(), 0, near)?;
        self.images = images;
        for (own, camera) in self.cameras.iter_mut().zip(cameras) {
            *own = Camera { pose: own.pose, ..camera.clone() };
        }
        self.forget_recordings();
        Ok(())
    }

    /// One step on the next view; repeated with longer tile lists if they overflowed.
    pub(super) fn step(&mut self, iteration: usize) -> Result<()> {
        // One more SH band per 1000 steps (Kerbl et al. 2023), so that the low bands settle first.
        let degree = self.options.sh_degree.min((iteration / 1000) as u32);
        if degree != self.raster.sh_degree {
            self.raster.sh_degree = degree;
            self.forget_recordings();
        }
        let view = self.order.draw();
        self.last = view;
        self.model.set_rates(&self.options.rates, 0.0, self.scale.extent, iteration)?;
        self.views.set_camera(view, &self.cameras[view])?;
        loop {
            let program = match self.programs[view].take() {
                Some(program) => program,
                None => self.record(view).compile()?,
            };
            program.run()?;
            self.programs[view] = Some(program);
            let at = self.views.list[view].stage;
            match self.views.stages[at].raster.overflow()? {
                None => break,
                Some(needed) => {
                    self.views.stages[at].raster.grow(needed)?;
                    self.forget_recordings();
                }
            }
        }
        let stage = self.views.stage(view);
        let [l1, ssim, ..] = stage.total()?;
        self.recent.push(stage.loss.loss([l1, ssim]));
        self.move_camera(view, iteration)
    }

    fn forget_recordings(&mut self) {
        self.programs.iter_mut().for_each(|p| *p = None);
    }

    /// Forward, losses, backward and Adam of one view.
    pub(super) fn record(&self, view: usize) -> Recorder {
        let (item, stage) = (&self.views.list[view], self.views.stage(view));
        let frame = stage.raster.frame();
        let mut rec = Recorder::new(&self.device, "rgb step");
        stage.raster.record_projection(&mut rec, &self.model.values, &self.raster);
        let weights = [self.options.l1_weight, self.options.dssim_weight];
        for band in frame.bands.iter() {
            stage.raster.record_band(&mut rec, &self.model.values, &band);
            let (target, sums) = (&item.target[band.index], (&stage.sums, stage.slot(&band)));
            stage.loss.record(&mut rec, &band, &frame.planes, target, &frame.planes_grad, weights, sums);
            // Without depth of its own, a view clears what another of its size may have left.
            let (reference, pixels) = match &item.depth {
                Some((references, count)) => (Some(&references[band.index]), *count as f64),
                None => (None, 1.0),
            };
            regularise::record_depth(&mut rec, frame, reference, self.options.depth_weight / pixels);
            stage.raster.record_band_backward(&mut rec, &self.model.values, &self.raster, &band);
        }
        stage.raster.record_gradients(&mut rec, &self.model.values, &self.raster, &self.model.gradients);
        if self.options.ratio_weight > 0.0 {
            let count = self.model.count();
            let (values, gradients) = (&self.model.values.log_scales, &self.model.gradients.log_scales);
            let weight = self.options.ratio_weight / count as f64;
            regularise::record_ratio(&mut rec, values, gradients, count, weight, RATIO_LIMIT);
        }
        self.model.record_step(&mut rec, &frame.status);
        rec.download(&frame.status);
        rec.download(&stage.sums);
        if self.options.poses.is_some() {
            rec.download(&frame.camera_grad);
        }
        rec
    }

    /// Pose refinement; camera 0 fixes the world frame.
    fn move_camera(&mut self, view: usize, iteration: usize) -> Result<()> {
        let Some(poses) = self.options.poses.filter(|p| view > 0 && iteration >= p.start) else {
            return Ok(());
        };
        let g = self.views.stage(view).raster.frame().camera_grad.read::<f32>()?;
        let twist = [g[0], g[1], g[2], g[3], g[4], g[5]].map(f64::from);
        let rate = poses.rate.at(iteration);
        let pose = &mut self.cameras[view].pose;
        *pose = self.poses[view].update(pose, twist, rate, self.scale.median_depth);
        Ok(())
    }

    /// A point of the loss curve now and then, and with it the check for broken numbers.
    fn report(&mut self, iteration: usize) -> Result<Option<CurvePoint>> {
        let step = iteration + 1;
        if !step.is_multiple_of(self.options.report_every.max(1)) && step != self.options.iterations {
            return Ok(None);
        }
        self.model.check(step)?;
        let shown = match self.views.shown(self.last)? {
            Some(shown) => shown,
            None => {
                let camera = self.cameras[self.last].clone();
                self.views.render(self.last, &camera, &self.model, &self.raster)?
            }
        };
        self.psnr[self.last] = Some(psnr(&shown, &self.images[self.last]).min(MOST_PSNR));
        let known: Vec<f64> = self.psnr.iter().flatten().copied().collect();
        let n = self.recent.len().max(1) as f64;
        let total = |l: &ImageLoss| l.total(self.options.l1_weight, self.options.dssim_weight);
        let point = CurvePoint {
            step,
            loss: self.recent.iter().map(total).sum::<f64>() / n,
            ssim: self.recent.iter().map(|l| l.ssim).sum::<f64>() / n,
            psnr: known.iter().sum::<f64>() / known.len().max(1) as f64,
            splats: self.model.count(),
        };
        self.recent.clear();
        self.curve.push(point);
        Ok(Some(point))
    }

    fn prune(&mut self, iteration: usize) -> Result<()> {
        let (step, every) = (iteration + 1, self.options.prune_every);
        if every == 0 || step < self.options.prune_from || !step.is_multiple_of(every) {
            return Ok(());
        }
        let logits = self.model.values.opacity_logits.read_range::<f32>(0..self.model.count())?;
        let rows = compact::kept(&logits, self.options.prune_opacity);
        if rows.is_empty() {
            return Err(Error::work(format!(
                "every splat faded away by step {step}: cameras and photos do not fit together"
            )));
        }
        if rows.len() < self.model.count() {
            self.model.keep(&rows)?;
            self.forget_recordings();
        }
        Ok(())
    }

    /// Reads everything back and keeps the refined cameras only if they explain the photos better.
    fn finish(
        &mut self,
        images: &[RgbImage],
        initial: &[Camera],
    ) -> Result<(Splats, Vec<Camera>, Vec<f64>, bool)> {
        let splats = self.model.splats()?;
        let mut score = |cameras: &[Camera]| -> Result<Vec<f64>> {
            (0..images.len())
                .map(|i| {
                    let rendered = self.views.render(i, &cameras[i], &self.model, &self.raster)?;
                    Ok(psnr(&rendered, &images[i]).min(MOST_PSNR))
                })
                .collect()
        };
        let refined = score(&self.cameras)?;
        if self.options.poses.is_none() {
            return Ok((splats, initial.to_vec(), refined, false));
        }
        let before = score(initial)?;
        let sum = |v: &[f64]| v.iter().sum::<f64>();
        if sum(&refined) > sum(&before) {
            Ok((splats, self.cameras.clone(), refined, true))
        } else {
            Ok((splats, initial.to_vec(), before, false))
        }
    }
}
