//! Options of several commands.
use crate::Result;
use crate::infer::{Registry, provider};
use crate::run::config::{EXPERTS, whole};
use crate::run::{CHECKPOINT_SECONDS, Destination, Machine};
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};
use std::path::PathBuf;

/// Format of standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Bars on a terminal, a line per stage elsewhere
    Text,
    /// One JSON object per line: begin, step, figures, end, message, warning, error
    Json,
}

/// Heading of the options about the machine.
pub const MACHINE: &str = "Device and networks";

/// Options of every command of a program, before or after its name.
#[derive(Debug, Args)]
pub struct GlobalArgs {
    /// Progress and messages on standard error: for people, or one JSON object per line
    #[arg(long, global = true, value_enum, default_value = "text", value_name = "FORMAT")]
    pub log: LogFormat,
    /// What computes the networks, as far as the ONNX Runtime library can; auto: a GPU that
    /// answers, or else the CPU
    #[arg(long, global = true, value_parser = PossibleValuesParser::new(provider::NAMES), value_name = "NAME", help_heading = MACHINE)]
    pub provider: Option<String>,
}

/// Options of the commands that make scenes, about files.
#[derive(Clone, Debug, Args)]
pub struct SavingArgs {
    /// Go on where an earlier command ended, or change a late option: stages with the same photos
    /// and settings are not run again
    #[arg(long)]
    pub resume: bool,
    /// Replace a scene that is already there
    #[arg(long)]
    pub force: bool,
    /// Folder of a mask per photo, x.png or x.jpg.png for x.jpg: black is not used [default: masks
    /// beside images]
    #[arg(long, visible_alias = "mask-photos", value_name = "DIR")]
    pub photo_masks: Option<PathBuf>,
    /// How often training keeps its state for --resume, seconds
    #[arg(long, default_value_t = CHECKPOINT_SECONDS, value_name = "N", value_parser = whole::<u64>(0..), help_heading = EXPERTS)]
    pub checkpoint_seconds: u64,
}

impl SavingArgs {
    /// Scene directory, with the use of earlier runs.
    pub fn destination(&self, out: PathBuf) -> Destination {
        let SavingArgs { resume, force, checkpoint_seconds, .. } = *self;
        Destination { out, force, resume, checkpoint_seconds }
    }
}

/// Use of a scene's edits.
#[derive(Clone, Copy, Debug, Default, Args)]
pub struct EditUse {
    /// Take the scene as it was reconstructed, without the edits of splatvk edit
    #[arg(long)]
    pub ignore_edits: bool,
}

/// Options that every command working on a device takes.
#[derive(Clone, Debug, Default, Args)]
pub struct DeviceArgs {
    /// Vulkan device: uuid:…, pci:…, its number in `splatvk doctor`, or a part of its name
    #[arg(long, value_name = "DEVICE", help_heading = MACHINE)]
    pub device: Option<String>,
    /// Folder of the models
    #[arg(long, value_name = "DIR", help_heading = MACHINE)]
    pub models: Option<PathBuf>,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
    /// `--provider`, which stands before or after the command.
    #[arg(skip)]
    pub provider: Option<String>,
}

impl DeviceArgs {
    /// Device, models and provider of a run.
    pub fn machine(&self) -> Machine {
        let DeviceArgs { device, models, provider, .. } = self.clone();
        Machine { device, models, provider, ..Machine::default() }
    }

    /// Installed models.
    pub fn registry(&self) -> Result<Registry> {
        self.machine().registry()
    }
}
