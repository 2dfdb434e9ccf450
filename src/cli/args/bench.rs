//! `splatvk bench`: parts to measure, and their data.
use super::whole;
use crate::Result;
use crate::infer::{Compute, Registry};
use crate::photo::SMALLEST_SIDE;
use clap::{Args, ValueEnum};
use std::path::PathBuf;

/// Parts that `bench` measures beside the roofline.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BenchPart {
    /// Every pass of a training step and the whole, on colour and with features
    Training,
    /// The radix sort of --keys keys
    Sort,
    /// A text query in all views of --scene
    Query,
    /// Every step of every installed network: seconds and peak memory
    Models,
    /// The limits of the device
    Roofline,
    /// Photos to cameras on every --data folder: errors, and whether the stated focal uncertainty
    /// is right
    Cameras,
    /// Photos to masks on every --data folder with true masks, without cameras: IoU of the best
    /// mask with each object
    Masks,
}

/// `splatvk bench`
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// What to measure
    #[arg(value_enum, default_value = "training", value_name = "WHAT")]
    pub parts: Vec<BenchPart>,
    /// Gaussian .ply with its camera beside it, or a scene directory [default: a seeded scene]
    #[arg(long, value_name = "PATH")]
    pub scene: Option<PathBuf>,
    /// Camera of the scene: pinhole .json as --write-scene writes it, transforms.json or
    /// cameras.json
    #[arg(long, value_name = "FILE", requires = "scene")]
    pub camera: Option<PathBuf>,
    /// Splats of the seeded scene
    #[arg(long, default_value_t = 100_000, value_name = "N", value_parser = whole::<usize>(1..), conflicts_with = "scene")]
    pub splats: usize,
    /// Image width of the seeded scene, pixels
    #[arg(long, default_value_t = 640, value_name = "PIXELS", value_parser = whole::<u32>(1..=u32::MAX as u64), conflicts_with = "scene")]
    pub width: u32,
    /// Image height of the seeded scene, pixels
    #[arg(long, default_value_t = 480, value_name = "PIXELS", value_parser = whole::<u32>(1..=u32::MAX as u64), conflicts_with = "scene")]
    pub height: u32,
    /// Seed of the seeded scene
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<u64>(0..), conflicts_with = "scene")]
    pub seed: u64,
    /// Spherical-harmonics degree [default: 0, or the scene's own]
    #[arg(long, value_parser = whole::<u32>(0..=3), value_name = "0-3")]
    pub sh_degree: Option<u32>,
    /// Feature channels of the second step: 0 = leave it out, 1 to 16, 32, 48
    #[arg(long, default_value_t = 16, value_name = "D", value_parser = whole::<usize>(0..=48))]
    pub features: usize,
    /// Then the training step of seeded scenes with so many splats each
    #[arg(long, value_delimiter = ',', value_name = "N,N,...", value_parser = whole::<usize>(1..))]
    pub sweep: Vec<usize>,
    /// sort: how many keys
    #[arg(long, default_value_t = 10_000_000, value_name = "N", value_parser = whole::<usize>(1..))]
    pub keys: usize,
    /// query: what to look for
    #[arg(long, default_value = "a cup", value_name = "TEXT")]
    pub query: String,
    /// cameras, masks: folders with ground_truth.json and photos
    #[arg(long, num_args = 1.., value_name = "DIR")]
    pub data: Vec<PathBuf>,
    /// cameras, masks: longer side of the working image, pixels
    #[arg(long, default_value_t = crate::photo::MAX_SIZE_CPU, value_name = "N", value_parser = whole::<usize>(SMALLEST_SIDE as u64..))]
    pub max_size: usize,
    /// cameras: use copies of the photos of that size, not the photos themselves
    #[arg(long)]
    pub copies: bool,
    /// cameras: every two photos of a folder by themselves
    #[arg(long)]
    pub pairs: bool,
    /// query, models, cameras, masks: folder of the models
    #[arg(long, value_name = "DIR")]
    pub models: Option<PathBuf>,
    /// Repeat each measurement for this long
    #[arg(long, default_value_t = 2.0, value_name = "S")]
    pub seconds: f64,
    /// Repeat each measurement so often instead
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..), conflicts_with = "seconds")]
    pub repeats: Option<usize>,
    /// Also write the figures to this file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write over what is there: an ordinary file, or those of the same names in a folder
    #[arg(long)]
    pub force: bool,
    /// Measure nothing: print the ratios B / A of two files of --json
    #[arg(long, num_args = 2, value_names = ["A", "B"], conflicts_with_all = ["scene", "json", "write_scene"])]
    pub compare: Option<Vec<PathBuf>>,
    /// Measure nothing: write scene.ply, scene.json and render.npy of the workload for other
    /// programs
    #[arg(long, value_name = "DIR", conflicts_with = "json")]
    pub write_scene: Option<PathBuf>,
    /// Vulkan device: uuid:…, pci:…, its number in `splatvk doctor`, or a part of its name
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<String>,
    /// `--provider`, which stands before or after the command.
    #[arg(skip)]
    pub provider: Option<String>,
}

impl BenchArgs {
    /// Installed models.
    pub fn registry(&self) -> Result<Registry> {
        Registry::with(self.models.as_deref(), Compute::by(self.provider.as_deref()))
    }
}
