//! Long work in a thread of its own, while the calling thread passes events to Python and listens
//! for Ctrl-C.
use crate::errors;
use pyo3::prelude::*;
use splatvk::Result;
use splatvk::progress::{Overall, Progress};
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

/// Longest time in which Ctrl-C is not noticed.
const LISTEN: Duration = Duration::from_millis(50);
/// Events that may wait for Python before the work waits for it.
const WAITING: usize = 4096;

/// Something that happens in long work. `kind` is "begin", "step", "figures", "overall", "end",
/// "warning" or "info"; fields of other kinds are empty.
#[pyclass(module = "splatvk", frozen, get_all)]
#[derive(Default)]
pub struct Event {
    /// Kind of the event.
    kind: &'static str,
    /// The stage that begins.
    stage: Option<&'static str>,
    /// Finished steps of the stage.
    done: u64,
    /// Steps of the stage that begins.
    total: u64,
    /// A short live figure, or the text of a warning or information.
    text: String,
    /// Measurements by name.
    figures: HashMap<String, f64>,
    /// Number of the stage, from 1, and number of stages.
    number: Option<(usize, usize)>,
    /// Estimated seconds until the work is done.
    seconds_left: Option<f64>,
}

#[pymethods]
impl Event {
    fn __repr__(&self) -> String {
        format!("Event({:?}, stage={:?}, done={}, text={:?})", self.kind, self.stage, self.done, self.text)
    }
}

/// Sends progress to the calling thread.
struct Sent<'a> {
    to: SyncSender<Event>,
    stop: &'a AtomicBool,
}

impl Sent<'_> {
    fn send(&self, event: Event) {
        // A receiver that is gone has stopped the work.
        let _ = self.to.send(event);
    }
}

impl Progress for Sent<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.send(Event { kind: "begin", stage: Some(stage), total: steps, ..Event::default() });
    }
    fn step(&self, done: u64, note: &str) {
        self.send(Event { kind: "step", done, text: note.to_owned(), ..Event::default() });
    }
    fn figures(&self, step: u64, figures: &[(&str, f64)]) {
        let figures = figures.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect();
        self.send(Event { kind: "figures", done: step, figures, ..Event::default() });
    }
    fn overall(&self, overall: Overall) {
        self.send(Event {
            kind: "overall",
            number: Some((overall.stage, overall.stages)),
            seconds_left: overall.seconds_left,
            ..Event::default()
        });
    }
    fn end(&self) {
        self.send(Event { kind: "end", ..Event::default() });
    }
    fn warn(&self, message: &str) {
        self.send(Event { kind: "warning", text: message.to_owned(), ..Event::default() });
    }
    fn inform(&self, message: &str) {
        self.send(Event { kind: "info", text: message.to_owned(), ..Event::default() });
    }
    fn cancelled(&self) -> bool {
        self.stop.load(Ordering::SeqCst)
    }
}

/// Runs `body` without the GIL. `observer` is called with every [`Event`]; an exception of it, or
/// Ctrl-C, stops the work and is raised.
pub fn observed<T: Send>(
    py: Python<'_>,
    observer: &Py<PyAny>,
    body: impl FnOnce(&dyn Progress) -> Result<T> + Send,
) -> PyResult<T> {
    let stop = AtomicBool::new(false);
    let (ended, raised) = py.detach(|| {
        let (to, from) = sync_channel(WAITING);
        let sent = Sent { to, stop: &stop };
        std::thread::scope(|scope| {
            // `sent` moves into the thread, so that the channel closes when the work ends.
            let worker = scope.spawn(move || catch_unwind(AssertUnwindSafe(|| body(&sent))));
            let mut raised: Option<PyErr> = None;
            loop {
                let event = match from.recv_timeout(LISTEN) {
                    Ok(event) => Some(event),
                    Err(RecvTimeoutError::Timeout) => None,
                    Err(RecvTimeoutError::Disconnected) => break,
                };
                let heard = Python::attach(|py| {
                    py.check_signals()?;
                    match event {
                        Some(event) if raised.is_none() => observer.call1(py, (event,)).map(drop),
                        _ => Ok(()),
                    }
                });
                if let Err(error) = heard {
                    stop.store(true, Ordering::SeqCst);
                    raised.get_or_insert(error);
                }
            }
            (worker.join(), raised)
        })
    });
    match (raised, ended) {
        (Some(error), _) => Err(error),
        (None, Ok(Ok(result))) => result.map_err(|e| errors::exception(py, &e)),
        (None, Ok(Err(panic)) | Err(panic)) => Err(errors::internal(py, panic.as_ref())),
    }
}

/// Runs a short call without the GIL.
pub fn unobserved<T: Send>(py: Python<'_>, body: impl FnOnce() -> Result<T> + Send) -> PyResult<T> {
    match py.detach(|| catch_unwind(AssertUnwindSafe(body))) {
        Ok(result) => result.map_err(|e| errors::exception(py, &e)),
        Err(panic) => Err(errors::internal(py, panic.as_ref())),
    }
}
