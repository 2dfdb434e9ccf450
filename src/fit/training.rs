//! Training loop of both stages: a step on the next view, repeated when its tile lists overflow;
//! reports; checkpoints.
use super::model::{self, Model};
use super::schedule::ViewOrder;
use super::views::Views;
use crate::checkpoint::Checkpoint;
use crate::gpu::{Buffer, Device, Program, Recorder, Running};
use crate::pass::rasterizer::{RasterOptions, Rasterizer, SplatBuffers};
use crate::pass::view_buffers::ViewBuffers;
use crate::progress::Progress;
use crate::scene::Camera;
use crate::{Error, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Model, views and cameras of a training.
pub(crate) struct Trainer {
    pub(super) device: Device,
    pub(super) raster: RasterOptions,
    pub(super) model: Model,
    pub(super) views: Views,
    pub(super) cameras: Vec<Camera>,
    order: ViewOrder,
    /// One recorded step per view; `None` after a change of its buffers.
    programs: Vec<Option<Program>>,
    buffers: Vec<StepBuffers>,
    /// The step that the device may still work on.
    in_flight: Option<Flight>,
    /// Whether a step starts before the one before it has ended: the host has work between steps,
    /// and a GPU would wait for it.
    overlaps: bool,
    /// Number of the model: a stage with a model per level trains several in turn.
    group: usize,
}

/// Buffers of one view that the host writes before its step and reads after it.
struct StepBuffers {
    view: ViewBuffers,
    sums: Buffer<f32>,
    rates: Buffer<f32>,
}

/// A started step.
struct Flight {
    view: usize,
    iteration: usize,
    running: Running,
}

/// Training stage: the losses, schedule and measurements that it adds to [`Trainer`].
pub(crate) trait Training {
    /// State that steps change besides splats, moments, cameras and the order of the views.
    type StageState: Serialize + DeserializeOwned;

    fn trainer(&self) -> &Trainer;
    fn trainer_mut(&mut self) -> &mut Trainer;
    /// Sets rates and photo resolution of a step.
    fn schedule(&mut self, iteration: usize) -> Result<()>;
    /// Records forward pass, losses, backward pass and Adam of one view.
    fn record(&self, view: usize) -> Recorder;
    /// Reads the results of a step on `view` that the host needs. The device may work on the next
    /// step already.
    fn read_back(&mut self, view: usize, iteration: usize) -> Result<()>;
    /// Whether [`Training::review`] has work after `step` steps.
    fn review_is_due(&self, step: usize) -> bool;
    /// Measures and prunes after `step` steps, where that is due. No step is in flight.
    fn review(&mut self, step: usize) -> Result<StepReport>;
    fn stage_state(&self) -> Result<Self::StageState>;
    fn set_stage_state(&mut self, state: Self::StageState) -> Result<()>;

    /// Starts a step on the next view and ends the one before it.
    fn step(&mut self, iteration: usize) -> Result<()> {
        let view = self.trainer_mut().order.draw();
        if self.trainer().in_flight.as_ref().is_some_and(|flight| flight.view == view) {
            // Its end moves the camera of the view.
            self.finish_step()?;
        }
        self.trainer_mut().select(view)?;
        self.schedule(iteration)?;
        let trainer = self.trainer_mut();
        trainer.views.set_camera(view, &trainer.cameras[view])?;
        let running = recorded(self, view)?.start()?;
        let earlier = self.trainer_mut().in_flight.replace(Flight { view, iteration, running });
        if let Some(earlier) = earlier {
            end(self, earlier)?;
        }
        if self.trainer().overlaps { Ok(()) } else { self.finish_step() }
    }

    /// Waits for the step in flight.
    fn finish_step(&mut self) -> Result<()> {
        match self.trainer_mut().in_flight.take() {
            Some(flight) => end(self, flight),
            None => Ok(()),
        }
    }
}

/// The recorded step of a view, for which the view is selected.
fn recorded<T: Training + ?Sized>(run: &mut T, view: usize) -> Result<Program> {
    match run.trainer_mut().programs[view].take() {
        Some(program) => Ok(program),
        None => Ok(run.record(view).compile()?),
    }
}

/// Waits for a step and reads its results.
fn end<T: Training + ?Sized>(run: &mut T, Flight { view, iteration, running }: Flight) -> Result<()> {
    run.trainer_mut().programs[view] = Some(running.wait()?);
    read_results(run, view, iteration)
}

/// Reads the results of a step that has ended; first repeats it where its tile lists were too
/// short, since it has then changed nothing.
fn read_results<T: Training + ?Sized>(run: &mut T, view: usize, iteration: usize) -> Result<()> {
    run.trainer_mut().select(view)?;
    let mut later = None;
    while let Some(needed) = run.trainer().views.raster.overflow()? {
        let trainer = run.trainer_mut();
        if let Some(flight) = trainer.in_flight.take() {
            // It uses the lists that are about to grow.
            flight.running.wait()?;
            later = Some((flight.view, flight.iteration));
        }
        trainer.views.raster.grow(needed)?;
        trainer.forget_recordings();
        let program = recorded(run, view)?;
        program.run()?;
        run.trainer_mut().programs[view] = Some(program);
    }
    run.read_back(view, iteration)?;
    match later {
        Some((view, iteration)) => read_results(run, view, iteration),
        None => Ok(()),
    }
}

/// Result of [`Training::review`]; empty between measurements.
#[derive(Default)]
pub(crate) struct StepReport {
    /// Measurements by name, for [`Progress::figures`].
    pub(super) figures: Vec<(&'static str, f64)>,
    /// New text for the progress line, if any.
    pub(super) note: Option<String>,
    /// True where more steps would gain nothing.
    pub(super) finished: bool,
}

/// Rasteriser, buffers and options of a step, for benchmarks.
pub(crate) struct StepResources<'a> {
    pub raster: &'a Rasterizer,
    pub params: &'a SplatBuffers,
    pub options: &'a RasterOptions,
}

/// Checkpoint of a training. Of models trained one after the other it holds the current one; those
/// before it are trained again.
#[derive(Serialize, Deserialize)]
struct State<F> {
    group: usize,
    /// Completed steps.
    done: usize,
    model: model::State,
    cameras: Vec<Camera>,
    order: ViewOrder,
    stage: F,
}

impl Trainer {
    pub(super) fn new(
        device: &Device,
        raster: RasterOptions,
        model: Model,
        views: Views,
        cameras: Vec<Camera>,
        order: ViewOrder,
    ) -> Result<Trainer> {
        let one = || {
            let view = ViewBuffers::new(device)?;
            let sums = device.buffer::<f32>("loss sums", views.sums.len())?;
            Ok(StepBuffers { view, sums, rates: model.schedule.new_rates(device)? })
        };
        let buffers = cameras.iter().map(|_| one()).collect::<Result<_>>()?;
        Ok(Trainer {
            device: device.clone(),
            raster,
            model,
            views,
            order,
            programs: cameras.iter().map(|_| None).collect(),
            buffers,
            in_flight: None,
            overlaps: !device.info().is_cpu,
            cameras,
            group: 0,
        })
    }

    /// Prepares recordings, runs and reads of a view.
    fn select(&mut self, view: usize) -> Result<()> {
        let StepBuffers { view: buffers, sums, rates } = &self.buffers[view];
        self.views.raster.use_buffers(buffers);
        self.views.sums = sums.clone();
        self.model.schedule.use_rates(rates);
        self.views.raster.set_size(self.views.list[view].size)
    }

    /// Drops all recordings, after a change of their buffers or contents.
    pub(super) fn forget_recordings(&mut self) {
        self.programs.iter_mut().for_each(|p| *p = None);
    }

    /// Resources of the last step.
    pub(crate) fn step_resources(&self) -> StepResources<'_> {
        StepResources { raster: &self.views.raster, params: &self.model.values, options: &self.raster }
    }
}

/// Trains model number `group` for `iterations` steps or until a review ends it, from its
/// checkpoint if there is one. `progress` counts the steps of all groups.
pub(super) fn train<T: Training>(
    run: &mut T,
    group: usize,
    iterations: usize,
    progress: &dyn Progress,
) -> Result<()> {
    run.trainer_mut().group = group;
    let done = restore(run, progress)?;
    let first = (group * iterations) as u64;
    let mut note = String::new();
    let mut review = |run: &mut T, step: usize| {
        let mut report = StepReport::default();
        if run.review_is_due(step) {
            run.finish_step()?;
            report = run.review(step)?;
        }
        let StepReport { figures, note: news, finished } = report;
        if !figures.is_empty() {
            progress.figures(first + step as u64, &figures);
        }
        note = news.unwrap_or_else(|| std::mem::take(&mut note));
        if step > 0 {
            progress.step(first + step as u64, &note);
        }
        Ok::<_, Error>(finished)
    };
    if done == 0 {
        review(run, 0)?;
    }
    for iteration in done..iterations {
        if progress.cancelled() {
            run.finish_step()?;
            save(run, iteration, progress)?;
            return Err(Error::Cancelled);
        }
        run.step(iteration)?;
        let step = iteration + 1;
        if review(run, step)? {
            break;
        }
        if progress.checkpoint().is_some_and(Checkpoint::due) {
            run.finish_step()?;
            save(run, step, progress)?;
        }
        if progress.wants_splats() {
            run.finish_step()?;
            let Trainer { model, cameras, .. } = run.trainer();
            progress.splats(model.splats()?, cameras);
        }
    }
    run.finish_step()?;
    run.trainer().model.check(iterations)
}

/// Writes a checkpoint after `done` steps, if `progress` keeps checkpoints.
fn save<T: Training>(run: &T, done: usize, progress: &dyn Progress) -> Result<()> {
    let Some(checkpoint) = progress.checkpoint() else { return Ok(()) };
    let Trainer { group, model, cameras, order, .. } = run.trainer();
    let (model, stage) = (model.state()?, run.stage_state()?);
    let state = State { group: *group, done, model, cameras: cameras.clone(), order: order.clone(), stage };
    checkpoint.save(done, &state)
}

/// Restores the checkpoint of an earlier process; returns its completed steps.
fn restore<T: Training>(run: &mut T, progress: &dyn Progress) -> Result<usize> {
    let kept = progress.checkpoint().and_then(|c| c.load::<State<T::StageState>>());
    let Some(kept) = kept.filter(|k| k.group == run.trainer().group) else { return Ok(0) };
    let trainer = run.trainer_mut();
    trainer.model = Model::restored(&trainer.device, &kept.model)?;
    (trainer.cameras, trainer.order) = (kept.cameras, kept.order);
    run.set_stage_state(kept.stage)?;
    progress.checkpoint().iter().for_each(|c| c.went_on_from(kept.done));
    Ok(kept.done)
}

#[cfg(test)]
mod tests;
