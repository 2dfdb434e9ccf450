//! Progress on standard error: a bar per stage with the time left on a terminal, one line per stage
//! elsewhere, or one JSON object per line for machines.
use super::args::LogFormat;
use super::line::one_line;
use crate::Error;
use crate::progress::{Overall, Progress};
use crate::sync::lock;
use indicatif::{HumanDuration, MultiProgress, ProgressBar, ProgressState, ProgressStyle};
use serde_json::{Value, json};
use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock, Mutex, OnceLock};
use std::time::{Duration, Instant};

/// Set by the first Ctrl-C; work checks it between steps.
static STOPPED: AtomicBool = AtomicBool::new(false);

/// Whether standard error carries JSON, and the start of its clock.
static JSON: AtomicBool = AtomicBool::new(false);
static STARTED: LazyLock<Instant> = LazyLock::new(Instant::now);

/// Name of the program, before its errors.
static NAME: OnceLock<&'static str> = OnceLock::new();

/// Sets the format of standard error, and the program name before errors.
pub fn set_format(name: &'static str, format: LogFormat) {
    LazyLock::force(&STARTED);
    NAME.get_or_init(|| name);
    JSON.store(format == LogFormat::Json, Ordering::SeqCst);
}

fn as_json() -> bool {
    JSON.load(Ordering::SeqCst)
}

/// Progress reporter of the commands.
pub fn reporter() -> Box<dyn Progress> {
    if as_json() { Box::new(JsonLines::default()) } else { Box::new(Terminal::new(true)) }
}

/// Whether the user requested a stop.
pub fn stopped() -> bool {
    STOPPED.load(Ordering::SeqCst)
}

/// Prints the error that ends the process; of two threads that end it the first wins. Unusable
/// input, a missing part or an unwritable place (exit codes 2 to 4) drops the lines held in the
/// first `HELD_FOR`: they concern work without a result.
pub fn print_error(error: &Error) {
    let message = match error {
        Error::Cancelled if !crate::files::nothing_finished() => {
            "stopped; what was finished is kept".to_owned()
        }
        error => error.to_string(),
    };
    let exit_code = error.exit_code();
    static PRINTED: AtomicBool = AtomicBool::new(false);
    if PRINTED.swap(true, Ordering::SeqCst) {
        return;
    }
    match exit_code {
        2..=4 => drop(lock(&HELD).take()),
        _ => release(),
    }
    let message = one_line(&message);
    match as_json() {
        true => {
            write_event("error", json!({ "message": message, "kind": error.kind(), "exit_code": exit_code }))
        }
        false => write_line(&format!("{}: {message}", NAME.get().unwrap_or(&"splatvk"))),
    }
}

pub fn print_warning(message: &str) {
    let message = one_line(message);
    match as_json() {
        true => write_event("warning", json!({ "message": message })),
        false => write_line(&format!("warning: {message}")),
    }
}

/// Time from the start of the process during which lines wait for the end of the checks. Photos
/// without overlap are refused last, after their features: within 4 s for two of 640 × 480 pixels
/// on two cores.
const HELD_FOR: Duration = Duration::from_secs(10);
/// Waiting lines; `None` after [`release`].
static HELD: Mutex<Option<Vec<String>>> = Mutex::new(Some(Vec::new()));

/// Prints a line, or holds it until the input is known to be usable.
fn print_held(line: &str) {
    let mut held = lock(&HELD);
    let Some(lines) = held.as_mut() else { return write_line(line) };
    if lines.is_empty() {
        std::thread::spawn(|| {
            std::thread::sleep(HELD_FOR.saturating_sub(STARTED.elapsed()));
            release();
        });
    }
    lines.push(line.to_owned());
}

/// Prints the held lines; later lines are no longer held.
pub fn release() {
    lock(&HELD).take().into_iter().flatten().for_each(|line| write_line(&line));
}

/// Explains a wait for the shader compiler of the driver.
pub fn report_compilation(device: &str) {
    let message =
        format!("the driver of {} compiles shaders; it takes long only in the first run", one_line(device));
    match as_json() {
        true => write_event("message", json!({ "message": message })),
        false => print(&message),
    }
}

/// Writes `{"event", "time", …}` as one line; `time` is in seconds since the start of the process.
fn write_event(event: &str, mut fields: Value) {
    fields["event"] = event.into();
    fields["time"] = ((STARTED.elapsed().as_secs_f64() * 1e3).round() / 1e3).into();
    write_line(&fields.to_string());
}

/// Errors are ignored: standard error may be closed together with the terminal.
fn write_line(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}

/// One JSON object per line.
#[derive(Default)]
struct JsonLines {
    current: Mutex<Option<(&'static str, u64, Instant)>>,
    overall: Mutex<Option<Overall>>,
}

impl JsonLines {
    /// Adds the place in the whole work to an event, where it is known.
    fn placed(&self, mut fields: Value) -> Value {
        if let Some(overall) = *lock(&self.overall) {
            fields["stage_number"] = overall.stage.into();
            fields["stages"] = overall.stages.into();
            fields["seconds_left"] = json!(overall.seconds_left.map(f64::round));
        }
        fields
    }
}

impl Progress for JsonLines {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.end();
        write_event("begin", self.placed(json!({ "stage": stage, "steps": steps })));
        *lock(&self.current) = Some((stage, steps, Instant::now()));
    }
    fn step(&self, done: u64, note: &str) {
        if let Some((stage, steps, _)) = *lock(&self.current) {
            let fields = json!({ "stage": stage, "done": done, "steps": steps, "note": note });
            write_event("step", self.placed(fields));
        }
    }
    fn overall(&self, overall: Overall) {
        *lock(&self.overall) = Some(overall);
    }
    fn figures(&self, step: u64, figures: &[(&str, f64)]) {
        let stage = lock(&self.current).map(|(stage, _, _)| stage);
        let mut fields = json!({ "stage": stage, "step": step });
        figures.iter().for_each(|(name, value)| fields[*name] = (*value).into());
        write_event("figures", fields);
    }
    fn end(&self) {
        if let Some((stage, _, start)) = lock(&self.current).take() {
            write_event("end", json!({ "stage": stage, "seconds": start.elapsed().as_secs_f64() }));
        }
    }
    fn warn(&self, message: &str) {
        print_warning(message);
    }
    fn inform(&self, message: &str) {
        write_event("message", json!({ "message": one_line(message) }));
    }
    fn cancelled(&self) -> bool {
        stopped()
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        Box::new(JsonLines::default())
    }
}

/// Time from a request to stop until the process ends regardless of its work. Calls of a network or
/// a driver cannot be interrupted, and some take longer than a user waits. The process is to end
/// within 2 s; on a busy machine the kernel needs part of them.
const GRACE: Duration = Duration::from_millis(1000);

/// Makes Ctrl-C, a termination signal and a closed terminal request a clean stop. A second one, or
/// `GRACE`, ends the process at once; unfinished files are removed in either case.
pub fn stop_on_signal() {
    let outcome = ctrlc::set_handler(|| {
        if STOPPED.swap(true, Ordering::SeqCst) {
            exit_stopped();
        }
        if !as_json() {
            write_line("stopping; press Ctrl-C again to end at once");
        }
        std::thread::spawn(|| {
            std::thread::sleep(GRACE);
            exit_stopped();
        });
    });
    if let Err(error) = outcome {
        print_warning(&format!("Ctrl-C cannot be caught: {error}"));
    }
}

/// Whether the process serves until it is stopped.
static SERVES: AtomicBool = AtomicBool::new(false);

/// From now on a stop ends the process with exit code 0 and without a message.
pub fn stop_without_error() {
    SERVES.store(true, Ordering::SeqCst);
}

/// Ends the process as [`Error::Cancelled`] does, regardless of its threads.
fn exit_stopped() -> ! {
    crate::files::remove_unfinished();
    let serves = SERVES.load(Ordering::SeqCst);
    let code = if serves { 0 } else { Error::Cancelled.exit_code() };
    if !serves {
        print_error(&Error::Cancelled);
    }
    // Exit handlers would unload libraries that threads are running in.
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: ends the process; no state is used afterwards.
    unsafe {
        libc::_exit(code.into())
    }
    #[cfg(not(all(target_os = "linux", target_env = "gnu")))]
    std::process::exit(code.into())
}

type Stage = (&'static str, Instant, ProgressBar);

/// All bars of the process; `None` if standard error is no terminal.
static BARS: LazyLock<Option<MultiProgress>> =
    LazyLock::new(|| std::io::stderr().is_terminal().then(MultiProgress::new));

/// Prints a line above the bars.
fn print(line: &str) {
    match &*BARS {
        Some(bars) => bars.suspend(|| write_line(line)),
        None => print_held(line),
    }
}

/// Writes the remaining time of a stage; nothing before the first step.
fn time_left(state: &ProgressState, text: &mut dyn std::fmt::Write) {
    if state.pos() > 0 {
        let _ = write!(text, "{:#} left", HumanDuration(state.eta()));
    }
}

/// Place in the whole work in words: "stage 4 of 13, about 5 min left in all".
fn place_text(overall: &Overall) -> String {
    let left = match overall.seconds_left {
        None => String::new(),
        Some(s) if s < 45.0 => ", less than a minute left in all".to_owned(),
        Some(s) if s < 3570.0 => format!(", about {:.0} min left in all", (s / 60.0).max(1.0)),
        Some(s) => format!(", about {:.1} h left in all", s / 3600.0),
    };
    format!("stage {} of {}{left}", overall.stage, overall.stages)
}

/// [`Progress`] for people: bars if standard error is a terminal, else lines.
struct Terminal {
    current: Mutex<Option<Stage>>,
    /// Place in the whole work, for the bar and for lines.
    place: Arc<Mutex<String>>,
    /// Whether it is the first lane: the time left of another would read as that of the whole.
    first: bool,
}

impl Terminal {
    fn new(first: bool) -> Terminal {
        Terminal { current: Mutex::default(), place: Arc::default(), first }
    }
}

impl Progress for Terminal {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.end();
        let bar = match &*BARS {
            Some(bars) => bars.add(ProgressBar::new(steps)),
            None => ProgressBar::hidden(),
        };
        if let Ok(style) = ProgressStyle::with_template("{msg:>15} {wide_bar} {pos}/{len} {prefix} {left}") {
            let (place, first) = (self.place.clone(), self.first);
            let left = move |state: &ProgressState, text: &mut dyn std::fmt::Write| {
                let place = lock(&place);
                match place.is_empty() {
                    // Writing to a String cannot fail.
                    false => drop(text.write_str(&place)),
                    true if first => time_left(state, text),
                    true => {}
                }
            };
            bar.set_style(style.with_key("left", left));
        }
        bar.set_message(stage);
        bar.tick();
        *lock(&self.current) = Some((stage, Instant::now(), bar));
    }
    fn step(&self, done: u64, note: &str) {
        if let Some((_, _, bar)) = lock(&self.current).as_ref() {
            bar.set_position(done);
            bar.set_prefix(one_line(note));
        }
    }
    fn overall(&self, overall: Overall) {
        *lock(&self.place) = place_text(&overall);
    }
    fn end(&self) {
        let Some((name, start, bar)) = lock(&self.current).take() else { return };
        let note = bar.prefix();
        bar.finish_and_clear();
        let place = lock(&self.place).clone();
        let parts = [note, place];
        let rest: Vec<&str> = parts.iter().map(String::as_str).filter(|p| !p.is_empty()).collect();
        let line = format!("{name:>15}  {:6.1} s  {}", start.elapsed().as_secs_f64(), rest.join("; "));
        print(line.trim_end());
    }
    fn warn(&self, message: &str) {
        print(&format!("warning: {}", one_line(message)));
    }
    fn inform(&self, message: &str) {
        print(&one_line(message));
    }
    fn cancelled(&self) -> bool {
        stopped()
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        Box::new(Terminal::new(false))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn place_text_rounds_to_minutes() {
        let text = |seconds_left| place_text(&Overall { stage: 4, stages: 13, seconds_left });
        assert_eq!(text(None), "stage 4 of 13");
        assert_eq!(text(Some(20.0)), "stage 4 of 13, less than a minute left in all");
        assert_eq!(text(Some(50.0)), "stage 4 of 13, about 1 min left in all");
        assert_eq!(text(Some(290.0)), "stage 4 of 13, about 5 min left in all");
        assert_eq!(text(Some(5400.0)), "stage 4 of 13, about 1.5 h left in all");
    }
}
