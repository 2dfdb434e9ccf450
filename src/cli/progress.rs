//! Progress on standard error: a bar per stage with the time left on a terminal, one line per stage
//! elsewhere, or one JSON object per line for machines.
use super::args::LogFormat;
use super::line::one_line;
use crate::Error;
use crate::progress::Progress;
use crate::sync::lock;
use indicatif::{HumanDuration, MultiProgress, ProgressBar, ProgressState, ProgressStyle};
use serde_json::{Value, json};
use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{LazyLock, Mutex, OnceLock};
use std::time::{Duration, Instant};

/// Set by the first Ctrl-C of the process; work notices it between steps.
static STOPPED: AtomicBool = AtomicBool::new(false);

/// What this process writes to standard error, and when it began to.
static JSON: AtomicBool = AtomicBool::new(false);
static BEGAN: LazyLock<Instant> = LazyLock::new(Instant::now);

/// Name of the program, before its errors.
static NAME: OnceLock<&'static str> = OnceLock::new();

/// Chooses the format of everything that goes to standard error from now on, and the name before
/// errors.
pub fn set_format(name: &'static str, format: LogFormat) {
    LazyLock::force(&BEGAN);
    NAME.get_or_init(|| name);
    JSON.store(format == LogFormat::Json, Ordering::SeqCst);
}

fn as_json() -> bool {
    JSON.load(Ordering::SeqCst)
}

/// Where the commands of this process report to.
pub fn reporter() -> Box<dyn Progress> {
    if as_json() { Box::new(JsonLines::default()) } else { Box::new(Terminal::default()) }
}

/// True once the user wants the process to stop.
pub fn stopped() -> bool {
    STOPPED.load(Ordering::SeqCst)
}

/// The error that ends the process; of two threads that end it the first has its say. Input that
/// cannot be used gets this one line: what was said in the first [`HELD_FOR`] is about work that
/// nobody will see.
pub fn print_error(message: &str, exit_code: u8) {
    static SAID: AtomicBool = AtomicBool::new(false);
    if SAID.swap(true, Ordering::SeqCst) {
        return;
    }
    match exit_code {
        2 => drop(lock(&HELD).take()),
        _ => release(),
    }
    let message = one_line(message);
    match as_json() {
        true => write_event("error", json!({ "message": message, "exit_code": exit_code })),
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

/// How long after the start of the process lines wait for the end of the checks. Photos that do not
/// overlap are refused last, after their features: within 4 s for two of 640 × 480 pixels on two
/// cores.
const HELD_FOR: Duration = Duration::from_secs(10);
/// Lines that wait; `None` once they do not any more.
static HELD: Mutex<Option<Vec<String>>> = Mutex::new(Some(Vec::new()));

/// Prints a line, not before it is known that the input can be used.
fn print_held(line: &str) {
    let mut held = lock(&HELD);
    let Some(lines) = held.as_mut() else { return write_line(line) };
    if lines.is_empty() {
        std::thread::spawn(|| {
            std::thread::sleep(HELD_FOR.saturating_sub(BEGAN.elapsed()));
            release();
        });
    }
    lines.push(line.to_owned());
}

/// Prints what was held back; from now on nothing is.
pub fn release() {
    lock(&HELD).take().into_iter().flatten().for_each(|line| write_line(&line));
}

/// What to wait for while nothing moves.
pub fn tell_of_compilation(device: &str) {
    let message =
        format!("the driver of {} compiles shaders; it takes long only in the first run", one_line(device));
    match as_json() {
        true => write_event("message", json!({ "message": message })),
        false => print(&message),
    }
}

/// Writes `{"event", "time", …}` as one line; `time` is in seconds since the process began.
fn write_event(event: &str, mut fields: Value) {
    fields["event"] = event.into();
    fields["time"] = ((BEGAN.elapsed().as_secs_f64() * 1e3).round() / 1e3).into();
    write_line(&fields.to_string());
}

/// There is nothing to do when standard error is closed, as it is once the terminal is.
fn write_line(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}

/// One JSON object per line.
#[derive(Default)]
struct JsonLines {
    current: Mutex<Option<(&'static str, u64, Instant)>>,
}

impl Progress for JsonLines {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.end();
        write_event("begin", json!({ "stage": stage, "steps": steps }));
        *lock(&self.current) = Some((stage, steps, Instant::now()));
    }
    fn step(&self, done: u64, note: &str) {
        if let Some((stage, steps, _)) = *lock(&self.current) {
            write_event("step", json!({ "stage": stage, "done": done, "steps": steps, "note": note }));
        }
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

/// How long after a request to stop the work may go on to its next check. Nothing that is asked of
/// a network or a driver can be cut short, and some of it takes longer than anyone waits. A process
/// is to be done after 2 s; its end takes the kernel of a busy machine some time, too.
const GRACE: Duration = Duration::from_millis(1000);

/// Makes Ctrl-C, a termination signal and a closed terminal ask for a clean stop. A second one, and
/// [`GRACE`], end the process at once; what is unfinished is removed in either case.
pub fn stop_on_signal() {
    let outcome = ctrlc::set_handler(|| {
        if STOPPED.swap(true, Ordering::SeqCst) {
            end();
        }
        if !as_json() {
            write_line("stopping; press Ctrl-C again to end at once");
        }
        std::thread::spawn(|| {
            std::thread::sleep(GRACE);
            end();
        });
    });
    if let Err(error) = outcome {
        print_warning(&format!("Ctrl-C cannot be caught: {error}"));
    }
}

/// Whether the process does what only ends by being stopped.
static SERVES: AtomicBool = AtomicBool::new(false);

/// From now on a stop ends the process with 0 and without a word.
pub fn stopping_is_no_failure() {
    SERVES.store(true, Ordering::SeqCst);
}

/// Ends the process as [`Error::Cancelled`] does, whatever its threads are doing.
fn end() -> ! {
    let nothing = crate::files::remove_unfinished();
    let kept = "stopped; what was finished is kept".to_owned();
    let serves = SERVES.load(Ordering::SeqCst);
    let code = if serves { 0 } else { Error::Cancelled.exit_code() };
    if !serves {
        print_error(&if nothing { Error::Cancelled.to_string() } else { kept }, code);
    }
    // Exit handlers would take apart the libraries that those threads are in.
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: ends the process; nothing of it is used afterwards.
    unsafe {
        libc::_exit(code.into())
    }
    #[cfg(not(all(target_os = "linux", target_env = "gnu")))]
    std::process::exit(code.into())
}

type Stage = (&'static str, Instant, ProgressBar);

/// All bars of the process, below each other; `None` where standard error is no terminal.
static BARS: LazyLock<Option<MultiProgress>> =
    LazyLock::new(|| std::io::stderr().is_terminal().then(MultiProgress::new));

/// Prints a line above the bars.
fn print(line: &str) {
    match &*BARS {
        Some(bars) => bars.suspend(|| write_line(line)),
        None => print_held(line),
    }
}

/// The time left, once a step says how long one takes: before, the bar knows none.
fn time_left(state: &ProgressState, text: &mut dyn std::fmt::Write) {
    if state.pos() > 0 {
        let _ = write!(text, "{:#} left", HumanDuration(state.eta()));
    }
}

/// The command line's [`Progress`] for people: bars when standard error is a terminal, lines
/// otherwise.
#[derive(Default)]
struct Terminal {
    current: Mutex<Option<Stage>>,
}

impl Progress for Terminal {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.end();
        let bar = match &*BARS {
            Some(bars) => bars.add(ProgressBar::new(steps)),
            None => ProgressBar::hidden(),
        };
        if let Ok(style) = ProgressStyle::with_template("{msg:>12} {wide_bar} {pos}/{len} {prefix} {left}") {
            bar.set_style(style.with_key("left", time_left));
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
    fn end(&self) {
        let Some((name, start, bar)) = lock(&self.current).take() else { return };
        let note = bar.prefix();
        bar.finish_and_clear();
        print(&format!("{name:>12}  {:6.1} s  {note}", start.elapsed().as_secs_f64()));
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
        Box::new(Terminal::default())
    }
}
