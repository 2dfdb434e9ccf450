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
mod kept;
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
mod usage;
mod view;
mod views;

use crate::{Result, gpu};
use args::Command;
use std::process::ExitCode;

/// Runs the command line of this process: one error line at most, and an exit code that says what
/// kind it was ([`Error::exit_code`]).
pub fn main() -> ExitCode {
    let cli = match usage::parse() {
        Ok(cli) => cli,
        Err(code) => return code,
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
