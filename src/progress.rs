//! How long work tells its caller where it is, and learns that it should stop.
use crate::{Error, Result};

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
