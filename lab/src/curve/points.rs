//! One curve: a training whose splats are copied and scored at some of its steps.
use super::Plan;
use crate::ablate::{Prepared, Runner};
use crate::{Error, Result};
use serde::Serialize;
use splatvk::eval::Split;
use splatvk::fit::{RgbOptions, Trained};
use splatvk::pipeline::{Context, Stage};
use splatvk::progress::Progress;
use splatvk::run::stages::TrainColour;
use splatvk::scene::{Camera, Splats};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Figures after some steps of a training.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Point {
    /// Completed steps.
    pub step: usize,
    /// Wall seconds of the training so far, without scoring.
    pub seconds: f64,
    /// Those, and the seconds of all stages before.
    pub whole: f64,
    /// Number of splats.
    pub splats: usize,
    /// Mean PSNR of held-out views, dB.
    pub held_out: Option<f64>,
    /// Mean PSNR of held-out views beside the photos over the surfaces that photos show, dB.
    pub beside: Option<f64>,
    /// Mean PSNR of the photos, dB.
    pub photos: Option<f64>,
    /// Mean over held-out views of the median relative depth error.
    pub depth: Option<f64>,
    /// Mean IoU in held-out views; `None` unless it is asked for.
    pub miou: Option<f64>,
}

/// Curve of one variant on one data set.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Curve {
    /// Name of the data set.
    pub data: String,
    /// Name of the variant.
    pub variant: String,
    /// Points in the order of the steps.
    pub points: Vec<Point>,
}

/// Copy of a training's state.
struct Sample {
    step: usize,
    seconds: f64,
    splats: Splats,
    cameras: Vec<Camera>,
}

/// Progress that copies the splats after some steps and stops the clock meanwhile.
struct Sampling<'a> {
    inner: &'a dyn Progress,
    began: Instant,
    at: Vec<usize>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    step: usize,
    /// Start of the copy under way.
    copying: Option<Instant>,
    /// Time of all copies.
    copied: Duration,
    samples: Vec<Sample>,
}

impl Sampling<'_> {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Progress for Sampling<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.inner.begin(stage, steps);
    }
    fn step(&self, done: u64, note: &str) {
        self.state().step = done as usize;
        self.inner.step(done, note);
    }
    fn end(&self) {
        self.inner.end();
    }
    fn warn(&self, message: &str) {
        self.inner.warn(message);
    }
    fn cancelled(&self) -> bool {
        self.inner.cancelled()
    }
    fn wants_splats(&self) -> bool {
        let mut state = self.state();
        let wanted = self.at.contains(&state.step);
        if wanted {
            state.copying = Some(Instant::now());
        }
        wanted
    }
    fn splats(&self, splats: Splats, cameras: &[Camera]) {
        let now = Instant::now();
        let mut state = self.state();
        let began = state.copying.take().unwrap_or(now);
        let seconds = (began - self.began).saturating_sub(state.copied).as_secs_f64();
        state.copied += now - began;
        let (step, cameras) = (state.step, cameras.to_vec());
        state.samples.push(Sample { step, seconds, splats, cameras });
    }
}

/// Trains with `options` and scores the samples.
pub(super) fn curve(
    plan: &Plan,
    runner: &Runner,
    prepared: &Prepared,
    options: &RgbOptions,
) -> Result<Curve> {
    let photos = prepared.placed.photos.len();
    let count = plan.points.max(1);
    let sampling = Sampling {
        inner: runner.progress(),
        began: Instant::now(),
        // The last sample is the finished scene itself.
        at: (1..count).map(|k| k * options.iterations / count).collect(),
        state: Mutex::default(),
    };
    let (device, registry) = runner.environment();
    let context = Context { device, registry, progress: &sampling };
    let train = TrainColour { options: options.clone(), preview: None };
    let trained = train.run((&prepared.placed, &prepared.geometry), &context)?;
    let State { copied, samples, .. } = sampling.state.into_inner().unwrap_or_else(PoisonError::into_inner);
    let whole = sampling.began.elapsed().saturating_sub(copied).as_secs_f64();
    let mut points = Vec::new();
    for Sample { step, seconds, splats, cameras } in samples {
        // Virtual views follow the photos.
        let cameras = cameras.get(..photos).ok_or_else(|| Error::work("a sample lacks cameras"))?.to_vec();
        let mut at_step = trained.clone();
        (at_step.splats, at_step.cameras) = (splats, cameras);
        points.push(point(plan, runner, prepared, (step, seconds), &at_step)?);
    }
    points.push(point(plan, runner, prepared, (options.iterations, whole), &trained)?);
    Ok(Curve { points, ..Curve::default() })
}

fn point(
    plan: &Plan,
    runner: &Runner,
    prepared: &Prepared,
    (step, seconds): (usize, f64),
    trained: &Trained,
) -> Result<Point> {
    let splats = trained.splats.len();
    let report = runner.scored(prepared, trained, plan.words)?;
    let of = |split: Split| report.summary.get(split.name());
    let (test, train, out) = (of(Split::Test), of(Split::Train), of(Split::Out));
    Ok(Point {
        step,
        seconds,
        whole: prepared.seconds + seconds,
        splats,
        held_out: test.and_then(|s| s.psnr),
        beside: out.and_then(|s| s.psnr_shown),
        photos: train.and_then(|s| s.psnr),
        depth: test.and_then(|s| s.depth_median_relative),
        miou: test.and_then(|s| s.miou),
    })
}

/// Mean of points; a figure that a point lacks is left out of its mean. `None` without points.
pub fn mean(points: &[&Point]) -> Option<Point> {
    if points.is_empty() {
        return None;
    }
    let whole =
        |value: &dyn Fn(&Point) -> usize| points.iter().map(|p| value(p)).sum::<usize>() / points.len();
    let known = |value: &dyn Fn(&Point) -> Option<f64>| {
        let all: Vec<f64> = points.iter().filter_map(|p| value(p)).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    };
    let number =
        |value: &dyn Fn(&Point) -> f64| points.iter().map(|p| value(p)).sum::<f64>() / points.len() as f64;
    Some(Point {
        step: whole(&|p| p.step),
        seconds: number(&|p| p.seconds),
        whole: number(&|p| p.whole),
        splats: whole(&|p| p.splats),
        held_out: known(&|p| p.held_out),
        beside: known(&|p| p.beside),
        photos: known(&|p| p.photos),
        depth: known(&|p| p.depth),
        miou: known(&|p| p.miou),
    })
}
