//! A process per attempt: what it leaves in memory, on the device or by a crash ends with it.
use crate::cli::progress::stopped;
use crate::{Error, Result};
use serde_json::Value;
use std::fs::File;
use std::io::Write;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// How often a process is looked at.
const POLL: Duration = Duration::from_millis(50);
/// Time between the request to end and the end by force.
const GRACE: Duration = Duration::from_secs(5);
/// Such a time after Ctrl-C: this process itself ends a second later, and the tables come before.
const STOP_GRACE: Duration = Duration::from_millis(400);

/// Variables with paths, which may be relative to the current folder of this process.
const PATHS: [&str; 6] = [
    "SPLATVK_HOME",
    "SPLATVK_MODELS",
    "ORT_DYLIB_PATH",
    "SPLATVK_LIBHEIF",
    "VK_DRIVER_FILES",
    "VK_ICD_FILENAMES",
];

/// End of an attempt.
#[derive(Clone, Debug, PartialEq)]
pub enum Ending {
    /// Exit code 0.
    Done,
    /// Exit code and the error that the process reported.
    Failed {
        /// Exit code ([`Error::exit_code`]).
        code: u8,
        /// Message of the error.
        message: String,
        /// Kind of the error ([`Error::kind`]).
        kind: String,
    },
    /// A signal ended it: another user, the kernel without memory, a crash.
    Killed(i32),
    /// It ran longer than allowed.
    TimedOut,
    /// The user stopped the batch.
    Stopped,
}

/// The program that runs rows: this one, or the command of the Python package that this library is
/// in, which states its path.
pub fn program() -> Result<PathBuf> {
    match std::env::var_os("SPLATVK_PROGRAM").filter(|p| !p.is_empty()) {
        Some(path) => std::path::absolute(&path).map_err(Error::io(PathBuf::from(path))),
        None => std::env::current_exe().map_err(Error::io("the path of this program")),
    }
}

/// A command of a row in the folder of the manifest.
pub fn command(program: &Path, base: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(program);
    command.args(["batch-row", "--log", "json"]).args(arguments).current_dir(base);
    for name in PATHS {
        let Some(value) = std::env::var_os(name).filter(|v| !v.is_empty()) else { continue };
        let absolute = std::env::split_paths(&value).map(std::path::absolute);
        // A list that was read from a variable can be joined again.
        if let Ok(joined) = std::env::join_paths(absolute.filter_map(std::io::Result::ok)) {
            command.env(name, joined);
        }
    }
    // Ctrl-C reaches this process, which ends its children; they end with it in any case.
    command.process_group(0);
    #[cfg(target_os = "linux")]
    // SAFETY: between fork and exec the closure makes one system call and allocates nothing.
    unsafe {
        command.pre_exec(|| {
            rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::KILL))?;
            Ok(())
        });
    }
    command
}

/// Starts a command with `row` on its standard input. The death signal belongs to this thread,
/// which must wait for the child.
fn start(command: &mut Command, row: &str) -> Result<Child> {
    let name = command.get_program().to_string_lossy().into_owned();
    let mut child = command.stdin(Stdio::piped()).spawn().map_err(Error::io(&name))?;
    if let Some(mut stdin) = child.stdin.take() {
        // A process that ends early has reported its reason.
        let _ = stdin.write_all(row.as_bytes());
    }
    Ok(child)
}

/// Output of a command that works for seconds.
pub fn output(mut command: Command, row: &str) -> Result<(Ending, Vec<u8>)> {
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let child = start(&mut command, row)?;
    let output = child.wait_with_output().map_err(Error::io("batch-row"))?;
    let ending = ending(output.status, &String::from_utf8_lossy(&output.stderr));
    Ok((ending, output.stdout))
}

/// Runs a command to its end, with its log in a file.
pub fn run(mut command: Command, row: &str, log: &Path, timeout: Option<Duration>) -> Result<Ending> {
    let file = File::create(log).map_err(Error::unwritable(log))?;
    command.stdout(Stdio::null()).stderr(file);
    let mut child = start(&mut command, row)?;
    let started = Instant::now();
    let stop = loop {
        match child.try_wait().map_err(Error::io("batch-row"))? {
            Some(status) => return Ok(ending(status, &std::fs::read_to_string(log).unwrap_or_default())),
            None if stopped() => break Ending::Stopped,
            None if timeout.is_some_and(|limit| started.elapsed() > limit) => break Ending::TimedOut,
            None => std::thread::sleep(POLL),
        }
    };
    end(&mut child, if stop == Ending::Stopped { STOP_GRACE } else { GRACE });
    Ok(stop)
}

/// Ends a process and those that it started.
fn end(child: &mut Child, grace: Duration) {
    use rustix::process::{Pid, Signal, kill_process_group};
    let group = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
    let signal = |signal| {
        if let Some(group) = group {
            // It may have ended by itself.
            let _ = kill_process_group(group, signal);
        }
    };
    signal(Signal::TERM);
    let asked = Instant::now();
    while asked.elapsed() < grace && matches!(child.try_wait(), Ok(None)) {
        std::thread::sleep(POLL);
    }
    signal(Signal::KILL);
    let _ = child.wait();
}

/// The ending of a process from its status and the last error of its log.
fn ending(status: std::process::ExitStatus, log: &str) -> Ending {
    match (status.code(), status.signal()) {
        (Some(0), _) => Ending::Done,
        (Some(code), _) => {
            let events = log.lines().rev().filter_map(|line| serde_json::from_str::<Value>(line).ok());
            let error = events.into_iter().find(|e| e["event"] == "error").unwrap_or_default();
            let text = |field: &str| error[field].as_str().map(str::to_owned);
            // A panic has no event: its last line is all that is known.
            let last = || log.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("no message").to_owned();
            Ending::Failed {
                code: u8::try_from(code).unwrap_or(1),
                message: text("message").unwrap_or_else(last),
                kind: text("kind").unwrap_or_default(),
            }
        }
        (None, signal) => Ending::Killed(signal.unwrap_or(0)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str, timeout: Option<Duration>) -> (Ending, String) {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log");
        let mut command = Command::new("sh");
        command.args(["-c", script]).process_group(0);
        let ending = run(command, "row\n", &log, timeout).unwrap();
        (ending, std::fs::read_to_string(log).unwrap())
    }

    #[test]
    fn endings_carry_their_reason() {
        let (done, log) = shell("cat >&2", None);
        assert_eq!((done, log.as_str()), (Ending::Done, "row\n"));
        let error = r#"{"event":"error","kind":"memory","message":"full","exit_code":5}"#;
        let failed = |code, message: &str, kind: &str| Ending::Failed {
            code,
            message: message.into(),
            kind: kind.into(),
        };
        assert_eq!(shell(&format!("echo '{error}' >&2; exit 5"), None).0, failed(5, "full", "memory"));
        assert_eq!(shell("echo panicked >&2; exit 101", None).0, failed(101, "panicked", ""));
        assert_eq!(shell("kill -9 $$", None).0, Ending::Killed(9));
    }

    #[test]
    fn late_process_ends_with_those_it_started() {
        let script = "sleep 60 & echo $! >&2; wait";
        let started = Instant::now();
        let (ending, log) = shell(script, Some(Duration::from_millis(200)));
        assert!(ending == Ending::TimedOut && started.elapsed() < Duration::from_secs(20));
        let child = log.trim();
        let gone =
            || std::fs::read_to_string(format!("/proc/{child}/stat")).map_or(true, |s| s.contains(") Z "));
        while !gone() {
            assert!(started.elapsed() < Duration::from_secs(20), "process {child} is alive");
            std::thread::sleep(POLL);
        }
    }
}
