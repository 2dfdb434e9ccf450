//! Progress on standard error: a bar per stage with the time left on a terminal, one line per stage elsewhere.
use crate::progress::Progress;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
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
    /// All bars, below each other; `None` where standard error is no terminal.
    bars: Option<MultiProgress>,
    current: Mutex<Option<Stage>>,
}

impl Terminal {
    /// Bars when standard error is a terminal, lines otherwise.
    pub fn new() -> Self {
        let bars = std::io::stderr().is_terminal().then(MultiProgress::new);
        Terminal { bars, current: Mutex::default() }
    }
    fn lock(&self) -> std::sync::MutexGuard<'_, Option<Stage>> {
        // A panic while holding the lock leaves plain data behind, which stays usable.
        self.current.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
    /// Prints a line above the bars.
    fn print(&self, line: &str) {
        match &self.bars {
            Some(bars) => bars.suspend(|| eprintln!("{line}")),
            None => eprintln!("{line}"),
        }
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
        let bar = match &self.bars {
            Some(bars) => bars.add(ProgressBar::new(steps)),
            None => ProgressBar::hidden(),
        };
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
        self.print(&format!("{name:>12}  {:6.1} s  {note}", start.elapsed().as_secs_f64()));
    }
    fn warn(&self, message: &str) {
        self.print(&format!("warning: {message}"));
    }
    fn cancelled(&self) -> bool {
        STOPPED.load(Ordering::SeqCst)
    }
    fn beside(&self) -> Box<dyn Progress + '_> {
        Box::new(Terminal { bars: self.bars.clone(), current: Mutex::default() })
    }
}
