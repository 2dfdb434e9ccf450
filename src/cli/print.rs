//! Standard output.
use super::line::lines;
use crate::report::shell_quoted;
use crate::{Error, Result};
use std::io::Write;
use std::path::Path;

/// Prints text for people to standard output, without control characters.
pub fn print(text: &str) -> Result<()> {
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
pub fn print_json(value: &serde_json::Value) -> Result<()> {
    // Unfiltered: JSON escapes control characters itself, and names must stay exact.
    put(&format!("{value}\n"))
}

/// Last two lines after a scene was made, to copy whole: path of its report, and the command that
/// shows it.
pub fn ending(scene: &Path) -> String {
    format!("{}\nsplatvk view {}\n", shell_quoted(&scene.join("report.html")), shell_quoted(scene))
}

/// Names the files that a command wrote.
pub fn listing(files: &[std::path::PathBuf], as_json: bool) -> Result<()> {
    if as_json {
        return print_json(&serde_json::json!({ "files": files }));
    }
    print(&files.iter().map(|f| format!("{}\n", f.display())).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ending_quotes_paths_for_shell() {
        assert_eq!(ending(Path::new("out/tree")), "out/tree/report.html\nsplatvk view out/tree\n");
        assert_eq!(
            ending(Path::new("it's a tree")),
            "'it'\\''s a tree/report.html'\nsplatvk view 'it'\\''s a tree'\n"
        );
    }
}
