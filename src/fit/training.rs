//! What both training stages share: a step on the next view, repeated when its tile lists overflow;
//! reports; checkpoints.
use super::model::{self, Model};
use super::schedule::ViewOrder;
use super::views::Views;
use crate::checkpoint::Checkpoint;
use crate::gpu::{Device, Program, Recorder};
use crate::pass::rasterizer::{RasterOptions, Rasterizer, SplatBuffers};
use crate::progress::Progress;
use crate::scene::Camera;
use crate::{Error, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// What is trained, and on what.
pub(crate) struct Trainer {
    pub(super) device: Device,
    pub(super) raster: RasterOptions,
    pub(super) model: Model,
    pub(super) views: Views,
    pub(super) cameras: Vec<Camera>,
    order: ViewOrder,
    /// One recorded step per view; empty after anything that it binds has changed.
    programs: Vec<Option<Program>>,
    /// Index among the models that a stage trains one after the other.
    group: usize,
}

/// A training stage. What one of them adds to [`Trainer`] is its losses, its schedule and its
/// measurements.
pub(crate) trait Training {
    /// What steps change beside splats, moments, cameras and the order of the views.
    type StageState: Serialize + DeserializeOwned;

    fn trainer(&self) -> &Trainer;
    fn trainer_mut(&mut self) -> &mut Trainer;
    /// Sets what a step trains with: rates, SH bands, the size of the photos.
    fn schedule(&mut self, iteration: usize) -> Result<()>;
    /// Forward, losses, backward and Adam of one view.
    fn record(&self, view: usize) -> Recorder;
    /// Reads back what the host needs of a step on `view`.
    fn read_back(&mut self, view: usize, iteration: usize) -> Result<()>;
    /// Between steps, `step` of them done: measures when it is time to, and removes splats.
    fn review(&mut self, step: usize) -> Result<StepReport>;
    fn stage_state(&self) -> Self::StageState;
    fn set_stage_state(&mut self, figures: Self::StageState);

    /// One step on the next view.
    fn step(&mut self, iteration: usize) -> Result<()> {
        self.schedule(iteration)?;
        let trainer = self.trainer_mut();
        let view = trainer.order.draw();
        trainer.views.set_camera(view, &trainer.cameras[view])?;
        // A step whose tile lists were too short has changed nothing.
        loop {
            let program = match self.trainer_mut().programs[view].take() {
                Some(program) => program,
                None => self.record(view).compile()?,
            };
            program.run()?;
            let trainer = self.trainer_mut();
            trainer.programs[view] = Some(program);
            let raster = &mut trainer.views.stage_mut(view).raster;
            match raster.overflow()? {
                None => break,
                Some(needed) => {
                    raster.grow(needed)?;
                    trainer.forget_recordings();
                }
            }
        }
        self.read_back(view, iteration)
    }
}

/// What [`Training::review`] found; empty between measurements.
#[derive(Default)]
pub(crate) struct StepReport {
    /// Measurements by name, for [`Progress::figures`].
    pub(super) figures: Vec<(&'static str, f64)>,
    /// The same for people, if there is something new to say.
    pub(super) note: Option<String>,
    /// More steps would gain nothing.
    pub(super) finished: bool,
}

/// What a step renders with, for benchmarks.
pub(crate) struct Parts<'a> {
    pub raster: &'a Rasterizer,
    pub params: &'a SplatBuffers,
    pub gradients: &'a SplatBuffers,
    pub options: &'a RasterOptions,
}

/// A training under way, for going on after a kill. Of models trained one after the other only the
/// current one is kept; those before it are trained again.
#[derive(Serialize, Deserialize)]
struct State<F> {
    group: usize,
    /// Steps that are done.
    done: usize,
    model: model::State,
    cameras: Vec<Camera>,
    order: ViewOrder,
    figures: F,
}

impl Trainer {
    pub(super) fn new(
        device: &Device,
        raster: RasterOptions,
        model: Model,
        views: Views,
        cameras: &[Camera],
        seed: u64,
    ) -> Trainer {
        Trainer {
            device: device.clone(),
            raster,
            model,
            views,
            cameras: cameras.to_vec(),
            order: ViewOrder::new(cameras.len(), seed),
            programs: cameras.iter().map(|_| None).collect(),
            group: 0,
        }
    }

    /// After a change of buffers or of what recordings contain.
    pub(super) fn forget_recordings(&mut self) {
        self.programs.iter_mut().for_each(|p| *p = None);
    }

    /// What a step of view 0 renders with.
    pub(crate) fn parts(&self) -> Parts<'_> {
        Parts {
            raster: &self.views.stage(0).raster,
            params: &self.model.values,
            gradients: &self.model.gradients,
            options: &self.raster,
        }
    }
}

/// Trains model number `group` for `iterations` steps, or until a review ends it; goes on from the
/// checkpoint, if there is one. `progress` counts the steps of all groups.
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
        let StepReport { figures, note: news, finished } = run.review(step)?;
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
            save(run, iteration, progress)?;
            return Err(Error::Cancelled);
        }
        run.step(iteration)?;
        let step = iteration + 1;
        if review(run, step)? {
            break;
        }
        if progress.checkpoint().is_some_and(Checkpoint::due) {
            save(run, step, progress)?;
        }
    }
    run.trainer().model.check(iterations)
}

/// Writes the state after `done` steps, if somebody keeps it.
fn save<T: Training>(run: &T, done: usize, progress: &dyn Progress) -> Result<()> {
    let Some(checkpoint) = progress.checkpoint() else { return Ok(()) };
    let Trainer { group, model, cameras, order, .. } = run.trainer();
    let (model, figures) = (model.state()?, run.stage_state());
    let state = State { group: *group, done, model, cameras: cameras.clone(), order: order.clone(), figures };
    checkpoint.save(done, &state)
}

/// Takes over the state of an earlier process, and says how many steps it has done.
fn restore<T: Training>(run: &mut T, progress: &dyn Progress) -> Result<usize> {
    let kept = progress.checkpoint().and_then(|c| c.load::<State<T::StageState>>());
    let Some(kept) = kept.filter(|k| k.group == run.trainer().group) else { return Ok(0) };
    let trainer = run.trainer_mut();
    trainer.model = Model::restored(&trainer.device, &kept.model)?;
    (trainer.cameras, trainer.order) = (kept.cameras, kept.order);
    run.set_stage_state(kept.figures);
    progress.checkpoint().iter().for_each(|c| c.went_on_from(kept.done));
    Ok(kept.done)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::{
        LanguageOptions, LanguageRun, Photos, Preset, RgbOptions, RgbRun, pose::PoseOptions,
        scale::SceneScale, schedule::Exponential,
    };
    use crate::gpu::{Device, Options, TestDevice};
    use crate::scene::seeded;
    use crate::scene::{Camera, Codebook, Image, LevelField, Pose, RgbImage, Splats};
    use glam::DVec3;
    use std::time::Duration;

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
        TestDevice::open(&Options { staging, deterministic: true, ..crate::gpu::options(None) }).unwrap()
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

    fn measure(device: &Device, run: &mut impl Training) -> Outcome {
        for iteration in 0..COUNTED {
            run.step(iteration).unwrap();
        }
        let before = (device.submissions(), device.memory().allocations);
        for iteration in COUNTED..2 * COUNTED {
            run.step(iteration).unwrap();
        }
        let submissions = (device.submissions() - before.0) as f64 / COUNTED as f64;
        let allocations = (device.memory().allocations - before.1) as f64 / COUNTED as f64;
        let parts = run.trainer().parts();
        let (splats, features) = parts.params.download().unwrap();
        let camera = parts.raster.camera().cast::<f32>().read().unwrap();
        Outcome { submissions, allocations, splats, features, camera }
    }

    fn colour_options() -> RgbOptions {
        let rate = Exponential { start: 1e-3, end: 1e-4, steps: 2 * COUNTED };
        RgbOptions { poses: Some(PoseOptions { start: 0, rate }), ..RgbOptions::preset(Preset::Draft) }
    }

    fn colour(device: &Device) -> Outcome {
        let (splats, cameras, images) = scene();
        let options = colour_options();
        let scale = SceneScale::measure(&cameras, &splats.means);
        let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
        let mut run = RgbRun::new(device, photos, &splats, scale, &options).unwrap();
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
            targets: (0..2).map(|v| Image { width: 75, height: 53, data: labels(v) }).collect(),
            ..LevelField::default()
        };
        let options = LanguageOptions::preset(Preset::Draft);
        let mut run = LanguageRun::new(
            device,
            Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] },
            &splats,
            &[(0, &level)],
            &options,
            &crate::progress::Silent,
        )
        .unwrap();
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

    /// Only keeps a state.
    struct Keeps(Checkpoint);

    impl Progress for Keeps {
        fn begin(&self, _: &'static str, _: u64) {}
        fn step(&self, _: u64, _: &str) {}
        fn end(&self) {}
        fn warn(&self, _: &str) {}
        fn checkpoint(&self) -> Option<&Checkpoint> {
            Some(&self.0)
        }
    }

    #[test]
    fn what_goes_on_from_a_kept_state_ends_with_the_same_bits() {
        let (device, options) = (device(false), colour_options());
        let (splats, cameras, images) = scene();
        let scale = SceneScale::measure(&cameras, &splats.means);
        let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
        let new = || RgbRun::new(&device, photos, &splats, scale, &options).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let keeps = Keeps(Checkpoint::new(folder.path().join("state"), Duration::ZERO, true));
        let (mut whole, mut resumed) = (new(), new());
        (0..COUNTED).for_each(|iteration| whole.step(iteration).unwrap());
        save(&whole, COUNTED, &keeps).unwrap();
        assert_eq!(restore(&mut resumed, &keeps).unwrap(), COUNTED);
        let [a, b] = [&mut whole, &mut resumed].map(|run| {
            (COUNTED..2 * COUNTED).for_each(|iteration| run.step(iteration).unwrap());
            (run.trainer().parts().params.download().unwrap(), run.trainer().cameras.clone())
        });
        assert!(a == b, "other bits");
    }
}
