//! Progress of a download.
use std::time::{Duration, Instant};

use crate::infer::catalogue::Source;
use crate::progress::Progress;

/// Time between two reports: a bar moves smoothly, a log stays short.
const INTERVAL: Duration = Duration::from_millis(200);

/// Reports a download in megabytes.
pub(super) struct Meter<'a> {
    pub progress: &'a dyn Progress,
    name: &'a str,
    started: Instant,
    reported: Instant,
    start: u64,
    total: Option<u64>,
}

impl<'a> Meter<'a> {
    pub fn new(source: &'a Source, progress: &'a dyn Progress) -> Self {
        let now = Instant::now();
        Meter { progress, name: &source.name, started: now, reported: now, start: 0, total: None }
    }

    /// Begins a report with `start` bytes already present.
    pub fn begin(&mut self, start: u64, total: Option<u64>) {
        (self.start, self.total, self.started, self.reported) =
            (start, total, Instant::now(), Instant::now());
        self.progress.begin("download", megabytes(total.unwrap_or(0)));
        self.report(start);
    }

    /// Reports `done` bytes in total.
    pub fn step(&mut self, done: u64) {
        if self.reported.elapsed() >= INTERVAL || Some(done) == self.total {
            self.reported = Instant::now();
            self.report(done);
        }
    }

    pub fn end(&self) {
        self.progress.end();
    }

    fn report(&self, done: u64) {
        let of = self.total.map(|t| format!(" of {:.1}", t as f64 / 1e6)).unwrap_or_default();
        let seconds = self.started.elapsed().as_secs_f64().max(1e-3);
        let speed = (done - self.start) as f64 / 1e6 / seconds;
        let note = format!("{} {:.1}{of} MB, {speed:.1} MB/s", self.name, done as f64 / 1e6);
        self.progress.step(megabytes(done), &note);
    }
}

fn megabytes(bytes: u64) -> u64 {
    bytes.div_ceil(1_000_000)
}
