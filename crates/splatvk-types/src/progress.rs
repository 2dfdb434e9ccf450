//! Progress of long work, and the request that it should stop.
use crate::checkpoint::Checkpoint;
use crate::sync::lock;
use crate::{Error, Result};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

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
    /// The current stage is over.
    fn end(&self);
    /// Something the user should know, one line.
    fn warn(&self, message: &str);
    /// What was decided for the user and is as it should be, one line. Hosts that keep this default
    /// get it as a warning.
    fn inform(&self, message: &str) {
        self.warn(message);
    }
    /// True once the caller has requested that the work stops.
    fn cancelled(&self) -> bool {
        false
    }
    /// `Err(Error::Cancelled)` once the caller has requested that the work stops.
    fn check(&self) -> Result<()> {
        if self.cancelled() { Err(Error::Cancelled) } else { Ok(()) }
    }
    /// Where long work keeps its state, if it is kept at all.
    fn checkpoint(&self) -> Option<&Checkpoint> {
        None
    }
    /// Progress of work that goes on in parallel to this one: stages of the two lanes do not end
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
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct StageRecord {
    /// Stage name.
    pub name: String,
    /// When it began, wall seconds since the run did. Stages overlap where they can.
    pub start: f64,
    /// Wall seconds.
    pub seconds: f64,
    /// Peak resident memory of the process up to the end of the stage, bytes; 0 where the system
    /// does not tell.
    pub peak_memory: u64,
}

/// Passes everything on and keeps what run.json reports: times and memory per stage, and the
/// warnings.
pub struct Recorded<'a> {
    inner: &'a dyn Progress,
    began: Instant,
    stopped: AtomicBool,
    stages: Mutex<Vec<StageRecord>>,
    warnings: Mutex<Vec<String>>,
    lane: Current,
}

/// The stage that one lane of work is in.
#[derive(Default)]
struct Current(Mutex<Option<(&'static str, Instant)>>);

impl<'a> Recorded<'a> {
    /// Records on the way to `inner`; the run begins now.
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
    /// Warns of what matters more than all that was said before: it stands first among the
    /// warnings.
    pub fn warn_first(&self, message: &str) {
        lock(&self.warnings).insert(0, message.to_owned());
        self.inner.warn(message);
    }
    /// Makes all work that reports here stop, because a part of it has failed.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::SeqCst);
    }
    fn open(&self, lane: &Current, stage: &'static str) {
        self.close(lane);
        *lock(&lane.0) = Some((stage, Instant::now()));
    }
    fn close(&self, lane: &Current) {
        let Some((name, start)) = lock(&lane.0).take() else { return };
        lock(&self.stages).push(StageRecord {
            name: name.to_owned(),
            start: start.duration_since(self.began).as_secs_f64(),
            seconds: start.elapsed().as_secs_f64(),
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
        self.inner.figures(step, figures);
    }
    fn end(&self) {
        self.close(&self.lane);
        self.inner.end();
    }
    fn warn(&self, message: &str) {
        lock(&self.warnings).push(message.to_owned());
        self.inner.warn(message);
    }
    fn inform(&self, message: &str) {
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

/// Starts [`peak_memory`] afresh from what is resident now, where the system can.
pub fn reset_peak_memory() {
    // "5" resets the high-water mark (proc(5)); elsewhere the peak stays that of the whole process.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_are_recorded_in_order_and_warnings_are_kept() {
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
    fn lanes_overlap_and_a_failure_of_one_stops_both() {
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
