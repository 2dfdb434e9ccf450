//! Command line: [`args`] = arguments, `plan` = the plan that they describe, one file per command.
mod ablate;
pub mod args;
mod bench;
mod clean;
mod doctor;
mod eval;
mod export;
mod fetch;
mod generate;
mod line;
mod measure;
mod models;
mod outputs;
mod plan;
mod print;
mod progress;
mod query;
mod render;
mod run;
mod scene;
mod serve;
mod shell;
mod train;
mod view;
mod views;

use crate::{Result, gpu};
use args::{Cli, Command};
use clap::Parser;
use clap::error::ErrorKind;
use line::one_line;
use std::process::ExitCode;

/// Runs the command line of this process: one error line at most, and an exit code that says what kind it was
/// ([`Error::exit_code`]).
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return print_usage_error(&error),
    };
    progress::set_format(cli.log);
    progress::stop_on_signal();
    gpu::on_long_compilation(progress::tell_of_compilation);
    let mut command = cli.command;
    if let Some(provider) = command.provider() {
        *provider = cli.provider;
    }
    match execute(command) {
        Ok(()) => {
            progress::release();
            ExitCode::SUCCESS
        }
        Err(error) => {
            progress::print_error(&error.to_string(), error.exit_code());
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
        Command::Measure(args) => measure::measure(&args),
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
fn print_usage_error(error: &clap::Error) -> ExitCode {
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
