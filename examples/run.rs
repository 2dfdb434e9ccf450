//! Photos to a scene directory: `cargo run --release --example run -- out/kitchen my-photos
//! [TEXT...]`.
use splatvk::progress::Progress;
use splatvk::run::{self, Destination, Inputs, RunOutcome, RunPlan};
use splatvk::{Error, Result};
use std::process::ExitCode;

/// A line on standard error for everything that a person waits for.
struct Lines;

impl Progress for Lines {
    fn begin(&self, stage: &'static str, _steps: u64) {
        eprintln!("{stage} ...");
    }
    fn step(&self, done: u64, note: &str) {
        if !note.is_empty() {
            eprintln!("  {done}: {note}");
        }
    }
    fn end(&self) {}
    fn warn(&self, message: &str) {
        eprintln!("warning: {message}");
    }
    fn inform(&self, message: &str) {
        eprintln!("{message}");
    }
}

/// Runs, and once more where a driver was reset and finished stages are kept.
fn reconstruct(plan: &RunPlan) -> Result<RunOutcome> {
    match run::run(plan, &Lines) {
        Err(error @ Error::DeviceLost { kept: Some(_), .. }) => {
            eprintln!("{error}");
            let output = Destination { resume: true, ..plan.output.clone() };
            run::run(&RunPlan { output, ..plan.clone() }, &Lines)
        }
        other => other,
    }
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let (Some(out), Some(photos)) = (arguments.next(), arguments.next()) else {
        eprintln!("usage: run OUT PHOTOS [TEXT...]");
        return ExitCode::from(2);
    };
    let plan = RunPlan {
        inputs: Inputs {
            photos: vec![photos.into()],
            views: Some(4),
            queries: arguments.collect(),
            ..Inputs::default()
        },
        output: Destination { out: out.into(), ..Destination::default() },
        ..RunPlan::default()
    };
    match reconstruct(&plan) {
        Ok(made) => {
            println!("{} splats, {:.1} dB on the photos", made.splats.len(), made.rgb.mean_psnr());
            for answer in made.language.iter().flat_map(|l| &l.answers) {
                println!("{}: in {} of {} photos", answer.text, answer.found(), answer.views.len());
            }
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(error.exit_code())
        }
    }
}
