//! Options of several commands.
use super::number::whole;
use crate::Result;
use crate::infer::{Compute, Registry};
use crate::photo::SMALLEST_SIDE;
use crate::run::compat::{COMPATS, NONE};
use clap::builder::{PossibleValue, PossibleValuesParser};
use clap::{Args, ValueEnum};
use std::path::PathBuf;

/// What `--compat` takes.
pub fn compats() -> PossibleValuesParser {
    let own = PossibleValue::new(NONE).help("this program's own way");
    let all = COMPATS.iter().map(|c| PossibleValue::new(c.name).help(c.about));
    PossibleValuesParser::new(all.chain([own]))
}

/// What goes to standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Bars on a terminal, a line per stage elsewhere
    Text,
    /// One JSON object per line: begin, step, figures, end, message, warning, error
    Json,
}

/// How much time a run may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PresetArg {
    /// Minutes on a 2-core CPU
    Draft,
    /// Best quality for the time on a GPU
    Default,
    /// The paper's schedule and constants
    Paper,
}

/// Heading of the options that few need.
pub const EXPERTS: &str = "For experts";
/// Heading of the options about the machine.
pub const MACHINE: &str = "Device and networks";

/// Options of the commands that make scenes.
#[derive(Clone, Debug, Args)]
pub struct MakingArgs {
    /// Time against quality [default: draft on a CPU device, default on a GPU]
    #[arg(long, value_enum)]
    pub preset: Option<PresetArg>,
    /// Longer side of the working images in pixels; larger photos are scaled down, none is enlarged
    /// [default: 800 on a CPU device, 1600 on a GPU]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(SMALLEST_SIDE as u64..))]
    pub max_size: Option<usize>,
    /// Go on where an earlier command ended, or change a late option: stages with the same photos
    /// and settings are not run again
    #[arg(long)]
    pub resume: bool,
    /// Replace a scene that is already there
    #[arg(long)]
    pub force: bool,
    /// Folder of a mask per photo, x.png or x.jpg.png for x.jpg: black is not used [default: masks
    /// beside images]
    #[arg(long, value_name = "DIR")]
    pub photo_masks: Option<PathBuf>,
    /// Optimisation steps of the colour stage, instead of the preset's
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..), help_heading = EXPERTS)]
    pub iterations: Option<usize>,
    /// Spherical-harmonics degree of the colours, which then depend on the direction [default: what
    /// photos support that are left out for a test; 0 for fewer than four photos]
    #[arg(long, value_name = "0-3", value_parser = whole::<u32>(0..=3), help_heading = EXPERTS)]
    pub sh_degree: Option<u32>,
    /// Seed of everything random
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<u64>(0..), help_heading = EXPERTS)]
    pub seed: u64,
    /// Same bits on every run on one machine: training adds up gradients in a fixed order, about a
    /// tenth slower
    #[arg(long, help_heading = EXPERTS)]
    pub deterministic: bool,
    /// How often training keeps its state for --resume, seconds
    #[arg(long, default_value_t = crate::run::CHECKPOINT_SECONDS, value_name = "N", value_parser = whole::<u64>(0..), help_heading = EXPERTS)]
    pub checkpoint_seconds: u64,
}

/// Options that every command working on a device takes.
#[derive(Clone, Debug, Default, Args)]
pub struct DeviceArgs {
    /// Vulkan device: part of its name, or its number in `splatvk doctor`
    #[arg(long, value_name = "NAME|INDEX", help_heading = MACHINE)]
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
    /// The models.
    pub fn registry(&self) -> Result<Registry> {
        Registry::with(self.models.as_deref(), Compute::by(self.provider.as_deref()))
    }
}
