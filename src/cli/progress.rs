//! Progress on standard error: a bar per stage with the time left on a terminal, one line per stage elsewhere.
use crate::progress::Progress;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Set by the first Ctrl-C of the process; work notices it between steps.
static STOPPED: AtomicBool = AtomicBool::new(false);

/// Makes Ctrl-C (and a termination signal) ask for a clean stop; a second one ends the process at once.
pub fn stop_on_signal() {
    let outcome = ctrlc::set_handler(|| {
        if STOPPED.swap(true, Ordering::SeqCst) {
            crate::format::remove_unfinished();
            std::process::exit(130);
        }
        eprintln!("stopping; press Ctrl-C again to end at once");
    });
    if let Err(error) = outcome {
        eprintln!("warning: Ctrl-C cannot be caught: {error}");
    }
}

type Stage = (&'static str, Instant, ProgressBar);

/// The command line's [`Progress`].
pub struct Terminal {
    bars: bool,
    current: Mutex<Option<Stage>>,
}

impl Terminal {
    /// Bars when standard error is a terminal, lines otherwise.
    pub fn new() -> Self {
        Terminal { bars: std::io::stderr().is_terminal(), current: Mutex::default() }
    }
    fn lock(&self) -> std::sync::MutexGuard<'_, Option<Stage>> {
        // A panic while holding the lock leaves plain data behind, which stays usable.
        self.current.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

impl Default for Terminal {
    fn default() -> Self {
        Self::new()
    }
}

impl Progress for Terminal {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.end();
        let bar = if self.bars { ProgressBar::new(steps) } else { ProgressBar::hidden() };
        if let Ok(style) =
            ProgressStyle::with_template("{msg:>12} {wide_bar} {pos}/{len} {prefix} {eta} left")
        {
            bar.set_style(style);
        }
        bar.set_message(stage);
        bar.tick();
        *self.lock() = Some((stage, Instant::now(), bar));
    }
    fn step(&self, done: u64, note: &str) {
        if let Some((_, _, bar)) = self.lock().as_ref() {
            bar.set_position(done);
            bar.set_prefix(note.to_owned());
        }
    }
    fn end(&self) {
        let Some((name, start, bar)) = self.lock().take() else { return };
        let note = bar.prefix();
        bar.finish_and_clear();
        eprintln!("{name:>12}  {:6.1} s  {note}", start.elapsed().as_secs_f64());
    }
    fn warn(&self, message: &str) {
        match self.lock().as_ref() {
            Some((_, _, bar)) => bar.suspend(|| eprintln!("warning: {message}")),
            None => eprintln!("warning: {message}"),
        }
    }
    fn cancelled(&self) -> bool {
        STOPPED.load(Ordering::SeqCst)
    }
}
