//! Command line: [`args`] = what the user typed, `plan` = what it means, one file per command.
mod ablate;
pub mod args;
mod bench;
mod clean;
mod doctor;
mod eval;
mod export;
mod generate;
mod models;
mod outputs;
mod plan;
mod progress;
mod query;
mod render;
mod run;
mod shell;
mod train;
mod view;
mod views;

use crate::{Error, Result};
use args::{Cli, Command};
use clap::Parser;
use clap::error::ErrorKind;
use std::io::Write;
use std::process::ExitCode;

/// Runs the command line of this process: one error line at most, and an exit code that says what kind it was
/// ([`Error::exit_code`]).
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return usage(&error),
    };
    progress::set_format(cli.log);
    progress::stop_on_signal();
    let mut command = cli.command;
    if let Some(provider) = command.provider() {
        *provider = cli.provider;
    }
    match execute(command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            progress::failed(&one_line(&error.to_string()), error.exit_code());
            ExitCode::from(error.exit_code())
        }
    }
}

fn execute(command: Command) -> Result<()> {
    match command {
        Command::Run(args) => run::run(&args),
        Command::Train(args) => train::train(&args),
        Command::Render(args) => render::render(&args),
        Command::Query(args) => query::query(&args),
        Command::View(args) => view::view(&args),
        Command::Eval(args) => eval::eval(&args),
        Command::Ablate(args) => ablate::ablate(&args),
        Command::Generate(args) => generate::generate(&args),
        Command::Export(args) => export::export(&args),
        Command::Models(args) => models::models(&args),
        Command::Bench(args) => bench::bench(&args),
        Command::Clean(args) => clean::clean(&args),
        Command::Doctor(args) => doctor::doctor(&args),
        Command::Completions(args) => shell::completions(&args),
        Command::Manuals(args) => shell::manuals(&args),
    }
}

/// Help and version go to standard output; what cannot be parsed is one line like every other error, exit code 2.
fn usage(error: &clap::Error) -> ExitCode {
    let help = matches!(
        error.kind(),
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand | ErrorKind::MissingSubcommand
    );
    let asked = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
    if asked || help {
        // A closed pipe while printing help is the reader's choice, not a failure.
        let _ = error.print();
        return if asked { ExitCode::SUCCESS } else { ExitCode::from(2) };
    }
    // The message may go on over several lines, to list what is missing, before the usage.
    let text = error.to_string();
    let message = text.split("\n\n").next().unwrap_or(&text);
    eprintln!("splatvk: {}; see splatvk --help", one_line(message.trim_start_matches("error: ")));
    ExitCode::from(2)
}

fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Prints to standard output. A reader that closed the pipe (`| head`) ends the process quietly.
fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => std::process::exit(0),
        outcome => outcome.map_err(Error::io("standard output")),
    }
}

/// Prints one JSON object on a line of its own.
fn print_json(value: &serde_json::Value) -> Result<()> {
    print(&format!("{value}\n"))
}

/// Names the files that a command wrote.
fn listing(files: &[std::path::PathBuf], as_json: bool) -> Result<()> {
    if as_json {
        return print_json(&serde_json::json!({ "files": files }));
    }
    print(&files.iter().map(|f| format!("{}\n", f.display())).collect::<String>())
}
