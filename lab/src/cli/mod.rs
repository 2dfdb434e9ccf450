//! Command line of the laboratory: one file per command; parsing, reports and exit codes are those
//! of `splatvk`.
mod ablate;
mod alignment;
pub mod args;
mod ask;
mod curve;
mod eval;
mod figures;
mod generate;
mod ghosts;
mod mesh_accuracy;
mod object_accuracy;
mod study;

use crate::Result;
use args::{Command, Lab};
use splatvk::cli::args::LogFormat;
use splatvk::cli::{Program, start};
use std::process::ExitCode;

/// The command line of `splatlab`.
pub fn main() -> ExitCode {
    start::<Lab>()
}

impl Program for Lab {
    const NAME: &'static str = "splatlab";

    const UNUSED: &'static [(&'static str, &'static [&'static str])] = &[
        ("generate", &["provider", "log"]),
        ("ghosts", &["provider", "log"]),
        ("alignment", &["provider"]),
        ("mesh-accuracy", &["provider"]),
        ("object-accuracy", &["provider"]),
    ];

    fn log(&self) -> LogFormat {
        self.global.log
    }

    fn execute(self) -> Result<()> {
        match self.command {
            Command::Ablate(mut args) => {
                args.study.device.provider = self.global.provider;
                ablate::ablate(&args)
            }
            Command::Figures(mut args) => {
                args.study.device.provider = self.global.provider;
                figures::figures(&args)
            }
            Command::Curve(mut args) => {
                args.device.provider = self.global.provider;
                curve::curve(&args)
            }
            Command::Alignment(args) => alignment::alignment(&args),
            Command::Generate(args) => generate::generate(&args),
            Command::Ghosts(args) => ghosts::ghosts(&args),
            Command::Eval(mut args) => {
                args.device.provider = self.global.provider;
                eval::eval(&args)
            }
            Command::MeshAccuracy(args) => mesh_accuracy::mesh_accuracy(&args),
            Command::ObjectAccuracy(args) => object_accuracy::object_accuracy(&args),
            Command::Ask(mut args) => {
                args.device.provider = self.global.provider;
                ask::ask(&args)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn command_definitions_are_consistent() {
        Lab::command().debug_assert();
        let text =
            Lab::command().try_get_matches_from(["splatlab", "generate", "--out", "x", "--texture", "much"]);
        assert!(text.unwrap_err().to_string().contains("--texture"));
    }
}
