//! What goes to standard output.
use super::line::lines;
use crate::{Error, Result};
use std::io::Write;

/// Prints text for people to standard output, without control characters.
pub(super) fn print(text: &str) -> Result<()> {
    put(&lines(text))
}

/// Writes to standard output. A reader that closed the pipe (`| head`) ends the process quietly.
fn put(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => std::process::exit(0),
        outcome => outcome.map_err(Error::io("standard output")),
    }
}

/// Prints one JSON object on a line of its own.
pub(super) fn print_json(value: &serde_json::Value) -> Result<()> {
    // As it is: JSON escapes control characters itself, and names must stay what they are.
    put(&format!("{value}\n"))
}

/// Names the files that a command wrote.
pub(super) fn listing(files: &[std::path::PathBuf], as_json: bool) -> Result<()> {
    if as_json {
        return print_json(&serde_json::json!({ "files": files }));
    }
    print(&files.iter().map(|f| format!("{}\n", f.display())).collect::<String>())
}
