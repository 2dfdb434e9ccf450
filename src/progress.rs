//! How long work tells its caller where it is, and learns that it should stop.
use crate::{Error, Result};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Receives progress from any thread. The command line draws bars, hosts may forward it, tests use [`Silent`].
pub trait Progress: Send + Sync {
    /// A stage starts; `steps` is its length in whatever unit it counts.
    fn begin(&self, stage: &'static str, steps: u64);
    /// `done` of the current stage's steps are finished; `note` is a short live figure ("PSNR 28.1").
    fn step(&self, done: u64, note: &str);
    /// The current stage is over.
    fn end(&self);
    /// Something the user should know, one line.
    fn warn(&self, message: &str);
    /// True once the caller wants the work to stop.
    fn cancelled(&self) -> bool {
        false
    }
    /// `Err(Error::Cancelled)` once the caller wants the work to stop.
    fn check(&self) -> Result<()> {
        if self.cancelled() { Err(Error::Cancelled) } else { Ok(()) }
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

/// What one stage took.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct StageRecord {
    /// Stage name; a stage that ran several times is one record.
    pub name: String,
    /// Wall seconds.
    pub seconds: f64,
    /// Peak resident memory of the process up to the end of the stage, bytes; 0 where the system does not tell.
    pub peak_memory: u64,
}

#[derive(Default)]
struct Log {
    current: Option<(&'static str, Instant)>,
    stages: Vec<StageRecord>,
    warnings: Vec<String>,
}

/// Passes everything on and keeps what run.json reports: seconds and memory per stage, and the warnings.
pub struct Recorded<'a> {
    inner: &'a dyn Progress,
    log: Mutex<Log>,
}

impl<'a> Recorded<'a> {
    /// Records on the way to `inner`.
    pub fn new(inner: &'a dyn Progress) -> Self {
        Recorded { inner, log: Mutex::default() }
    }
    /// Finished stages, in the order in which they first ended.
    pub fn stages(&self) -> Vec<StageRecord> {
        self.lock().stages.clone()
    }
    /// Warnings so far.
    pub fn warnings(&self) -> Vec<String> {
        self.lock().warnings.clone()
    }
    fn lock(&self) -> MutexGuard<'_, Log> {
        // A panic while holding the lock leaves plain data behind, which stays usable.
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }
    fn close(&self) {
        let mut log = self.lock();
        let Some((name, start)) = log.current.take() else { return };
        let (seconds, peak_memory) = (start.elapsed().as_secs_f64(), peak_memory());
        match log.stages.iter_mut().find(|s| s.name == name) {
            Some(stage) => {
                stage.seconds += seconds;
                stage.peak_memory = peak_memory;
            }
            None => log.stages.push(StageRecord { name: name.to_owned(), seconds, peak_memory }),
        }
    }
}

impl Progress for Recorded<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.close();
        self.lock().current = Some((stage, Instant::now()));
        self.inner.begin(stage, steps);
    }
    fn step(&self, done: u64, note: &str) {
        self.inner.step(done, note);
    }
    fn end(&self) {
        self.close();
        self.inner.end();
    }
    fn warn(&self, message: &str) {
        self.lock().warnings.push(message.to_owned());
        self.inner.warn(message);
    }
    fn cancelled(&self) -> bool {
        self.inner.cancelled()
    }
}

/// Peak resident memory of this process, bytes (`VmHWM` of Linux); 0 elsewhere.
fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|l| l.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) * 1024
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_add_up_and_warnings_are_kept() {
        let recorded = Recorded::new(&Silent);
        for _ in 0..2 {
            recorded.begin("train", 10);
            recorded.step(5, "PSNR 20.0");
            recorded.end();
        }
        recorded.begin("align", 1);
        recorded.warn("few matches");
        recorded.begin("write", 1);
        recorded.end();
        let names: Vec<_> = recorded.stages().into_iter().map(|s| s.name).collect();
        assert_eq!(names, ["train", "align", "write"]);
        assert_eq!(recorded.warnings(), ["few matches"]);
        assert!(recorded.stages().iter().all(|s| s.seconds >= 0.0));
        if cfg!(target_os = "linux") {
            assert!(recorded.stages()[0].peak_memory > 1 << 20);
        }
    }
}
