//! The command line: parse, run, print one error, exit.
use std::process::ExitCode;

fn main() -> ExitCode {
    splatvk::cli::main()
}
