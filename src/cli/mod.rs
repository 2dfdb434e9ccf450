//! Command line: arguments in [`args`], one file per command.
pub mod args;
#[cfg(unix)]
mod batch;
mod bench;
mod clean;
mod demo;
mod doctor;
mod edit;
pub mod eval;
mod export;
mod fetch;
mod film;
mod kept;
mod label;
mod line;
mod measure;
mod mesh;
mod models;
mod objects;
mod path;
pub mod print;
pub mod progress;
mod query;
mod render;
mod run;
pub mod scene;
mod serve;
mod shell;
mod train;
mod usage;
mod view;
pub mod views;

use crate::{Error, Result, gpu};
use args::{Cli, Command, LogFormat};
use clap::{CommandFactory, FromArgMatches};
use std::ffi::OsString;
use std::process::ExitCode;

/// A program of commands that share parsing, reporting and exit codes. The laboratory has a second
/// one.
pub trait Program: CommandFactory + FromArgMatches {
    /// Name of the program.
    const NAME: &'static str;

    /// Options that a command inherits but does not use, hidden in its help: (command, options).
    const UNUSED: &'static [(&'static str, &'static [&'static str])];

    /// Format of standard error.
    fn log(&self) -> LogFormat;

    /// Runs the command.
    fn execute(self) -> Result<()>;
}

/// The command line of `splatvk`.
pub fn main() -> ExitCode {
    ExitCode::from(run_with(std::env::args_os().collect()))
}

/// The command line of `splatvk` with the given arguments, of which the first is the name of the
/// program. Returns the exit code.
pub fn run_with(arguments: Vec<OsString>) -> u8 {
    #[cfg(unix)]
    if let Err(error) = batch::hand_over(&arguments) {
        progress::set_format(Cli::NAME, LogFormat::Text);
        progress::print_error(&error);
        return error.exit_code();
    }
    start_with::<Cli>(arguments)
}

/// Runs the command line of this process.
pub fn start<P: Program>() -> ExitCode {
    ExitCode::from(start_with::<P>(std::env::args_os().collect()))
}

/// Runs a command line: at most one error line, and an exit code by the kind of the error
/// ([`Error::exit_code`]).
fn start_with<P: Program>(arguments: Vec<OsString>) -> u8 {
    let program = match usage::parse::<P>(arguments) {
        Ok(program) => program,
        Err(code) => return code,
    };
    progress::set_format(P::NAME, program.log());
    progress::stop_on_signal();
    gpu::on_long_compilation(progress::report_compilation);
    match program.execute() {
        Ok(()) => {
            progress::release();
            0
        }
        Err(error) => {
            progress::print_error(&error);
            error.exit_code()
        }
    }
}

impl Program for Cli {
    const NAME: &'static str = "splatvk";

    const UNUSED: &'static [(&'static str, &'static [&'static str])] = &[
        ("render", &["provider"]),
        ("measure", &["provider", "log"]),
        ("export", &["provider", "log"]),
        ("mesh", &["provider"]),
        ("batch", &["provider"]),
        ("clean", &["provider", "log"]),
        ("completions", &["provider", "log"]),
        ("manuals", &["provider", "log"]),
        ("models list", &["provider", "log", "device"]),
        ("models path", &["provider", "log", "device"]),
    ];

    fn log(&self) -> LogFormat {
        self.global.log
    }

    fn execute(mut self) -> Result<()> {
        if let Some(provider) = self.command.provider() {
            *provider = self.global.provider;
        }
        match self.command {
            Command::Run(args) => run::run(&args),
            Command::Train(args) => train::train(&args),
            Command::Label(args) => label::label(&args),
            Command::Render(args) => render::render(&args),
            Command::Query(args) => query::query(&args),
            Command::Objects(args) => objects::objects(&args),
            Command::View(args) => view::view(&args),
            Command::Eval(args) => eval::eval(&args),
            Command::Measure(args) => measure::measure(&args),
            Command::Export(args) => export::export(&args),
            Command::Mesh(args) => mesh::mesh(&args),
            Command::Edit(args) => edit::edit(&args),
            Command::Models(args) => models::models(&args),
            Command::Bench(args) => bench::bench(&args),
            #[cfg(unix)]
            Command::Batch(args) => batch::batch(&args),
            #[cfg(unix)]
            Command::BatchRow(args) => batch::batch_row(&args),
            Command::Clean(args) => clean::clean(&args),
            Command::Demo(args) => demo::demo(&args),
            Command::Doctor(args) => doctor::doctor(&args),
            Command::Completions(args) => shell::completions(&args),
            Command::Manuals(args) => shell::manuals(&args),
            Command::Ablate(_) => Err(moved("ablate")),
            Command::Generate(_) => Err(moved("generate")),
        }
    }
}

/// Error of a command that moved to splatlab.
fn moved(command: &str) -> Error {
    Error::input(format!(
        "{command} is a command of splatlab, which nothing installs: in a clone of {}, run `cargo run --release -p splatlab -- {command}`",
        env!("CARGO_PKG_REPOSITORY")
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[test]
    fn moved_commands_name_splatlab() {
        for line in [
            &["ablate", "all", "--data", "x", "--help"][..],
            &["generate", "--out", "x"],
            &["eval", "scene", "--ground-truth", "x", "--protocol", "lerf"],
        ] {
            let error = Cli::try_parse_from([&["splatvk"], line].concat()).unwrap().execute().unwrap_err();
            let says = format!("-p splatlab -- {}", line[0]);
            assert!(error.exit_code() == 2 && error.to_string().contains(&says), "{error}");
        }
    }
}
