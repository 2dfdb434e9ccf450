//! Progress and cancellation of long work.
use crate::checkpoint::Checkpoint;
use crate::scene::{Camera, Splats};
use crate::sync::lock;
use crate::{Error, Result};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Place of a stage in the whole work, with an estimate of the rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Overall {
    /// Number of the current stage, from 1.
    pub stage: usize,
    /// Number of stages; a run may skip some.
    pub stages: usize,
    /// Estimated seconds until the work is done; `None` where nothing is known.
    pub seconds_left: Option<f64>,
}

/// Receives progress from any thread. The command line draws bars, hosts may forward it, tests use
/// [`Silent`].
pub trait Progress: Send + Sync {
    /// A stage starts; `steps` is its length in whatever unit it counts.
    fn begin(&self, stage: &'static str, steps: u64);
    /// `done` of the current stage's steps are finished; `note` is a short live figure ("PSNR
    /// 28.1").
    fn step(&self, done: u64, note: &str);
    /// Measurements of the current stage at a step, by name: loss, PSNR in dB, counts.
    fn figures(&self, _step: u64, _figures: &[(&str, f64)]) {}
    /// Place in the whole work; precedes every `begin`, `step` and `end` of the first lane where it
    /// is known.
    fn overall(&self, _overall: Overall) {}
    /// The current stage is over.
    fn end(&self);
    /// A warning for the user, one line.
    fn warn(&self, message: &str);
    /// A decision that was made for the user and needs no action, one line. Hosts that keep this
    /// default receive it as a warning.
    fn inform(&self, message: &str) {
        self.warn(message);
    }
    /// True once the caller has requested a stop.
    fn cancelled(&self) -> bool {
        false
    }
    /// `Err(Error::Cancelled)` once the caller has requested a stop.
    fn check(&self) -> Result<()> {
        if self.cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }
    /// Checkpoint of long work, if its state is saved.
    fn checkpoint(&self) -> Option<&Checkpoint> {
        None
    }
    /// Whether the splats of the training so far are of use now; reading them from the device takes
    /// time.
    fn wants_splats(&self) -> bool {
        false
    }
    /// Splats and cameras of the training so far.
    fn splats(&self, _splats: Splats, _cameras: &[Camera]) {}
    /// Progress of work in a second lane, parallel to this one: stages of the two lanes do not end
    /// each other. Hosts that show one stage at a time keep this default, which ignores the second
    /// lane.
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        Box::new(Silent)
    }
}

/// Ignores everything.
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _: &'static str, _: u64) {}
    fn step(&self, _: u64, _: &str) {}
    fn end(&self) {}
    fn warn(&self, _: &str) {}
}

/// Time and memory of one stage.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct StageRecord {
    /// Stage name.
    pub name: String,
    /// Start, wall seconds since the start of the run. Stages may overlap.
    pub start: f64,
    /// Wall seconds.
    pub seconds: f64,
    /// Peak resident memory of the process up to the end of the stage, bytes; 0 on systems without
    /// that figure.
    pub peak_memory: u64,
}

/// Forwards all progress and records for run.json: times and memory per stage, and the warnings.
/// Stages, figures and messages are events of `tracing` as well (target `splatvk`).
pub struct Recorded<'a> {
    inner: &'a dyn Progress,
    began: Instant,
    stopped: AtomicBool,
    stages: Mutex<Vec<StageRecord>>,
    warnings: Mutex<Vec<String>>,
    lane: Current,
}

/// Target of the events of `tracing`.
const TARGET: &str = "splatvk";

/// Current stage of a lane.
#[derive(Default)]
struct Current(Mutex<Option<(&'static str, Instant)>>);

impl<'a> Recorded<'a> {
    /// Records on the way to `inner`; the run starts now.
    pub fn new(inner: &'a dyn Progress) -> Self {
        Recorded {
            inner,
            began: Instant::now(),
            stopped: AtomicBool::new(false),
            stages: Mutex::default(),
            warnings: Mutex::default(),
            lane: Current::default(),
        }
    }
    /// Finished stages, in the order in which they began.
    pub fn stages(&self) -> Vec<StageRecord> {
        let mut stages = lock(&self.stages).clone();
        stages.sort_by(|a, b| a.start.total_cmp(&b.start));
        stages
    }
    /// Wall seconds since the run began.
    pub fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }
    /// Warnings so far.
    pub fn warnings(&self) -> Vec<String> {
        lock(&self.warnings).clone()
    }
    /// Warns with a message that precedes all earlier warnings in the record.
    pub fn warn_first(&self, message: &str) {
        tracing::warn!(target: TARGET, "{message}");
        lock(&self.warnings).insert(0, message.to_owned());
        self.inner.warn(message);
    }
    /// Stops all work that reports here, because a part of it has failed.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::SeqCst);
    }
    fn open(&self, lane: &Current, stage: &'static str) {
        self.close(lane);
        tracing::info!(target: TARGET, stage, "begin");
        *lock(&lane.0) = Some((stage, Instant::now()));
    }
    fn close(&self, lane: &Current) {
        let Some((name, start)) = lock(&lane.0).take() else { return };
        let seconds = start.elapsed().as_secs_f64();
        tracing::info!(target: TARGET, stage = name, seconds, "end");
        lock(&self.stages).push(StageRecord {
            name: name.to_owned(),
            start: start.duration_since(self.began).as_secs_f64(),
            seconds,
            peak_memory: peak_memory(),
        });
    }
}

impl Progress for Recorded<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.open(&self.lane, stage);
        self.inner.begin(stage, steps);
    }
    fn step(&self, done: u64, note: &str) {
        self.inner.step(done, note);
    }
    fn figures(&self, step: u64, figures: &[(&str, f64)]) {
        tracing::debug!(target: TARGET, step, ?figures);
        self.inner.figures(step, figures);
    }
    fn end(&self) {
        self.close(&self.lane);
        self.inner.end();
    }
    fn warn(&self, message: &str) {
        tracing::warn!(target: TARGET, "{message}");
        lock(&self.warnings).push(message.to_owned());
        self.inner.warn(message);
    }
    fn inform(&self, message: &str) {
        tracing::info!(target: TARGET, "{message}");
        self.inner.inform(message);
    }
    fn cancelled(&self) -> bool {
        self.stopped.load(Ordering::SeqCst) || self.inner.cancelled()
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        Box::new(SecondLane { owner: self, inner: self.inner.second_lane(), lane: Current::default() })
    }
}

/// A further lane of a [`Recorded`].
struct SecondLane<'a> {
    owner: &'a Recorded<'a>,
    inner: Box<dyn Progress + 'a>,
    lane: Current,
}

impl Progress for SecondLane<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.owner.open(&self.lane, stage);
        self.inner.begin(stage, steps);
    }
    fn step(&self, done: u64, note: &str) {
        self.inner.step(done, note);
    }
    fn figures(&self, step: u64, figures: &[(&str, f64)]) {
        tracing::debug!(target: TARGET, step, ?figures);
        self.inner.figures(step, figures);
    }
    fn end(&self) {
        self.owner.close(&self.lane);
        self.inner.end();
    }
    fn warn(&self, message: &str) {
        self.owner.warn(message);
    }
    fn inform(&self, message: &str) {
        tracing::info!(target: TARGET, "{message}");
        self.inner.inform(message);
    }
    fn cancelled(&self) -> bool {
        self.owner.cancelled()
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        self.owner.second_lane()
    }
}

/// Peak resident memory of this process, bytes (`VmHWM` of Linux); 0 elsewhere.
pub fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|l| l.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) * 1024
}

/// Resets [`peak_memory`] to the current resident memory, where the system can.
pub fn reset_peak_memory() {
    // "5" resets the high-water mark (proc(5)); elsewhere the peak stays that of the whole process.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recorded_keeps_stages_and_warnings() {
        let recorded = Recorded::new(&Silent);
        recorded.begin("train", 10);
        recorded.step(5, "PSNR 20.0");
        recorded.end();
        recorded.begin("align", 1);
        recorded.warn("few matches");
        recorded.inform("two of three photos");
        recorded.begin("write", 1);
        recorded.end();
        let stages = recorded.stages();
        let names: Vec<_> = stages.iter().map(|s| s.name.as_str()).collect();
        assert_eq!(names, ["train", "align", "write"]);
        assert_eq!(recorded.warnings(), ["few matches"]);
        recorded.warn_first("a bad scene");
        assert_eq!(recorded.warnings(), ["a bad scene", "few matches"]);
        for pair in stages.windows(2) {
            assert!(pair[0].start + pair[0].seconds <= pair[1].start, "one after the other");
        }
        if cfg!(target_os = "linux") {
            assert!(stages[0].peak_memory > 1 << 20);
        }
    }

    #[test]
    fn stop_of_recorded_reaches_both_lanes() {
        let recorded = Recorded::new(&Silent);
        let second = recorded.second_lane();
        recorded.begin("splats", 1);
        second.begin("masks", 1);
        recorded.end();
        recorded.begin("language", 1);
        second.warn("no masks");
        second.end();
        recorded.end();
        let stages = recorded.stages();
        let names: Vec<_> = stages.iter().map(|s| s.name.as_str()).collect();
        assert_eq!(names, ["splats", "masks", "language"]);
        assert!(stages[1].start + stages[1].seconds >= stages[2].start, "masks end after language begins");
        assert_eq!(recorded.warnings(), ["no masks"]);
        assert!(second.check().is_ok());
        recorded.stop();
        assert!(second.check().is_err() && recorded.check().is_err());
    }
}
