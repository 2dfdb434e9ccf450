//! Attempts at the rows on the devices of one machine: one thread per place for a process.
use super::child::{self, Ending};
use super::manifest::{Manifest, Row};
use super::row::RowKey;
use super::store::{Claim, Failure, FailureKind, Store};
use crate::cli::progress::stopped;
use crate::photo;
use crate::progress::Progress;
use crate::sync::lock;
use crate::{Error, Result};
use serde_json::json;
use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Pause before the second attempt; each later one waits twice as long.
const FIRST_PAUSE: Duration = Duration::from_secs(2);
/// How often an idle place looks for work.
const POLL: Duration = Duration::from_millis(100);
/// Side of the images of the attempt after one that ran out of memory, as a share.
const SMALLER: f64 = 0.7;

/// A device that rows run on.
#[derive(Clone, Debug)]
pub struct BatchDevice {
    /// `--device` of its processes.
    pub choice: String,
    /// As the driver reports it.
    pub name: String,
    /// A software device.
    pub is_cpu: bool,
}

/// Bounds of a batch.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Processes per device.
    pub per_device: usize,
    /// Further attempts after transient failures.
    pub retries: usize,
    /// Longest time of an attempt.
    pub timeout: Option<Duration>,
    /// Failed rows after which no further row starts.
    pub max_failures: usize,
}

/// A row to be made.
pub struct Job<'a> {
    /// Row.
    pub row: &'a Row,
    /// Its key.
    pub key: RowKey,
}

/// A job with the attempts so far.
struct Waiting<'a> {
    job: Job<'a>,
    /// From the first attempt on.
    claim: Option<Claim>,
    attempts: usize,
    /// Side of the images after a failure for want of memory.
    max_size: Option<usize>,
    not_before: Instant,
}

/// Counts at the end of the queue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Rows that were finished.
    pub done: usize,
    /// Rows that failed.
    pub failed: usize,
    /// Rows that another process works on, or has made meanwhile.
    pub elsewhere: usize,
    /// Rows that were not started or were stopped.
    pub left: usize,
}

/// The work on a list of jobs.
pub struct Queue<'a> {
    manifest: &'a Manifest,
    store: &'a Store,
    limits: &'a Limits,
    program: PathBuf,
    waiting: Mutex<VecDeque<Waiting<'a>>>,
    running: AtomicUsize,
    done: AtomicUsize,
    failed: AtomicUsize,
    elsewhere: AtomicUsize,
    /// Failures before the queue: rows that were refused unread.
    failed_before: usize,
    /// The error that ends the batch.
    error: Mutex<Option<Error>>,
}

impl<'a> Queue<'a> {
    /// A queue of jobs; `failed_before` counts to the bound of failures.
    pub fn new(
        manifest: &'a Manifest,
        store: &'a Store,
        limits: &'a Limits,
        jobs: Vec<Job<'a>>,
        failed_before: usize,
    ) -> Result<Queue<'a>> {
        let now = Instant::now();
        let wait = |job| Waiting { job, claim: None, attempts: 0, max_size: None, not_before: now };
        Ok(Queue {
            manifest,
            store,
            limits,
            program: child::program()?,
            waiting: Mutex::new(jobs.into_iter().map(wait).collect()),
            running: AtomicUsize::new(0),
            done: AtomicUsize::new(0),
            failed: AtomicUsize::new(0),
            elsewhere: AtomicUsize::new(0),
            failed_before,
            error: Mutex::new(None),
        })
    }

    /// Works until no job is left or the batch ends early.
    ///
    /// # Errors
    /// A place that cannot be written.
    pub fn work(self, devices: &[BatchDevice], progress: &dyn Progress) -> Result<Counts> {
        let total = lock(&self.waiting).len();
        progress.begin("captures", total as u64);
        std::thread::scope(|scope| {
            for device in devices {
                for _ in 0..self.limits.per_device {
                    scope.spawn(|| self.serve(device, progress));
                }
            }
        });
        progress.end();
        let [done, failed, elsewhere] =
            [&self.done, &self.failed, &self.elsewhere].map(|counter| counter.load(Ordering::SeqCst));
        match self.error.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner) {
            Some(error) => Err(error),
            None => Ok(Counts { done, failed, elsewhere, left: total - done - failed - elsewhere }),
        }
    }

    fn ended(&self) -> bool {
        let failures = self.failed.load(Ordering::SeqCst) + self.failed_before;
        stopped() || failures > self.limits.max_failures || lock(&self.error).is_some()
    }

    /// Takes jobs for one place until none is left that may come back.
    fn serve(&self, device: &BatchDevice, progress: &dyn Progress) {
        loop {
            if self.ended() {
                return;
            }
            let next = {
                let mut waiting = lock(&self.waiting);
                let now = Instant::now();
                let ready = waiting.iter().position(|w| w.not_before <= now);
                let next = ready.and_then(|i| waiting.remove(i));
                // Counted before the lock opens: another place would take the queue for empty.
                if next.is_some() {
                    self.running.fetch_add(1, Ordering::SeqCst);
                } else if waiting.is_empty() && self.running.load(Ordering::SeqCst) == 0 {
                    return;
                }
                next
            };
            let Some(waiting) = next else {
                std::thread::sleep(POLL);
                continue;
            };
            let outcome = self.attempt(waiting, device, progress);
            self.running.fetch_sub(1, Ordering::SeqCst);
            match outcome {
                Ok(true) => {}
                Ok(false) => return,
                Err(error) => {
                    lock(&self.error).get_or_insert(error);
                    return;
                }
            }
        }
    }

    /// One attempt at a row; `false` if the user stopped it.
    fn attempt(
        &self,
        mut waiting: Waiting<'a>,
        device: &BatchDevice,
        progress: &dyn Progress,
    ) -> Result<bool> {
        if waiting.claim.is_none() && !self.claim(&mut waiting)? {
            self.count(&self.elsewhere, &waiting.job.row.id, progress);
            return Ok(true);
        }
        waiting.attempts += 1;
        let (id, key) = (&waiting.job.row.id, &waiting.job.key.key);
        let (folder, log) = self.store.attempt(id, key, waiting.attempts);
        let fields = json!({ "id": id, "attempt": waiting.attempts, "device": device.name });
        self.store.event("begin", fields)?;
        let size = waiting.max_size.map(|n| n.to_string());
        let place = folder.to_string_lossy();
        let mut arguments = vec!["--out", &place, "--device", &device.choice];
        if let Some(size) = &size {
            arguments.extend(["--max-size", size]);
        }
        let command = child::command(&self.program, &self.manifest.base, &arguments);
        let row = json!(waiting.job.row).to_string();
        let started = Instant::now();
        let ending = child::run(command, &row, &log, self.limits.timeout)?;
        let seconds = (started.elapsed().as_secs_f64() * 10.0).round() / 10.0;
        let Some(failure) = Failure::of(id, key, waiting.attempts, &ending) else {
            if ending == Ending::Stopped {
                super::store::remove(&folder)?;
                super::store::remove(&log)?;
                return Ok(false);
            }
            self.store.publish(id, &folder, &log)?;
            self.store
                .event("done", json!({ "id": id, "seconds": seconds, "attempts": waiting.attempts }))?;
            self.count(&self.done, id, progress);
            return Ok(true);
        };
        let again = self.again(&waiting, &failure, device);
        let name = match again {
            Some(_) => "retry",
            None => "failed",
        };
        let mut fields = json!({ "id": id, "seconds": seconds });
        fields["failure"] = json!(failure);
        self.store.event(name, fields)?;
        self.store.fail(&failure, Some((&folder, &log)))?;
        if failure.kind == FailureKind::Unwritable {
            // The message without the words that the caller repeats.
            let words = failure.message.rsplit(": cannot be written: ").next().unwrap_or_default();
            let words = words.split(';').next().unwrap_or_default();
            let source = std::io::Error::other(words.to_owned());
            return Err(Error::Unwritable { path: self.store.place(id), source });
        }
        match again {
            Some(max_size) => {
                waiting.max_size = max_size;
                let doublings = u32::try_from(waiting.attempts - 1).unwrap_or(0).min(8);
                waiting.not_before = Instant::now() + FIRST_PAUSE * 2u32.pow(doublings);
                lock(&self.waiting).push_back(waiting);
            }
            None => {
                progress.warn(&format!("{id}: {}: {}", failure.kind.name(), failure.message));
                self.count(&self.failed, id, progress);
            }
        }
        Ok(true)
    }

    /// Locks a row; `false` if another process works on it, or has made it since it was checked.
    fn claim(&self, waiting: &mut Waiting<'a>) -> Result<bool> {
        let Job { row, key } = &waiting.job;
        waiting.claim = self.store.claim(&row.id)?;
        let made = self.store.success(&row.id).is_some_and(|s| s["key"] == key.key);
        Ok(waiting.claim.is_some() && !made)
    }

    /// The size of the images of another attempt, if there is to be one.
    fn again(&self, waiting: &Waiting<'a>, failure: &Failure, device: &BatchDevice) -> Option<Option<usize>> {
        match failure.kind {
            FailureKind::Transient => (waiting.attempts <= self.limits.retries).then_some(waiting.max_size),
            FailureKind::Memory if waiting.max_size.is_none() => {
                let own = waiting.job.row.options.get("max_size").and_then(serde_json::Value::as_u64);
                let size = own.map_or_else(|| photo::default_max_size(device.is_cpu), |n| n as usize);
                Some(Some(((size as f64 * SMALLER) as usize).max(photo::SMALLEST_SIDE)))
            }
            _ => None,
        }
    }

    fn count(&self, counter: &AtomicUsize, id: &str, progress: &dyn Progress) {
        counter.fetch_add(1, Ordering::SeqCst);
        let [done, failed, elsewhere] =
            [&self.done, &self.failed, &self.elsewhere].map(|counter| counter.load(Ordering::SeqCst));
        let note = if failed > 0 { format!("{id}; {failed} failed") } else { id.to_owned() };
        progress.step((done + failed + elsewhere) as u64, &note);
    }
}
