//! `splatvk label`
use super::args::{DeviceArgs, SavingArgs, whole};
use super::kept::report_kept_stages;
use super::print::{ending, print, print_json};
use super::progress;
use crate::infer::installed::inventory;
use crate::run::config::MASK_POINTS;
use crate::run::sources::{self, FeatureSources, MaskSources, SourceChoice};
use crate::run::{self, Inputs, LanguageConfig, RunPlan};
use crate::{Error, Result, files, photo};
use clap::Args;
use std::path::{Path, PathBuf};

/// `splatvk label`
#[derive(Debug, Args)]
pub struct LabelArgs {
    /// A file of Gaussians of any trainer (.ply, .splat, .spz, .glb, .gltf), or a scene directory
    pub scene: PathBuf,
    /// Photos of the training; without them views are rendered from the splats
    #[arg(long, value_name = "DIR", requires = "cameras")]
    pub images: Option<PathBuf>,
    /// Cameras in the coordinates of the splats: transforms.json, cameras.json, a COLMAP model, or
    /// the folder of a data set; without --images the splats are rendered from them
    #[arg(long, value_name = "FILE")]
    pub cameras: Option<PathBuf>,
    /// How many of the photos or cameras are used: those that together show most of the splats
    /// [default: 16 photos, 24 cameras]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(2..), requires = "cameras")]
    pub views: Option<usize>,
    /// Render this many views from cameras in free space, at most [default: 24 where there are
    /// neither photos nor cameras]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..=200), conflicts_with = "cameras")]
    pub synthesize: Option<usize>,
    /// Scene directory to write [default: out/NAME, after the file; beside a scene under the next
    /// number]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Ask the finished scene; may be repeated
    #[arg(long = "query", value_name = "TEXT")]
    pub queries: Vec<String>,
    /// Longer side of the working images in pixels [default: 800 on a CPU device, 1600 on a GPU]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(photo::SMALLEST_SIDE as u64..))]
    pub max_size: Option<usize>,
    /// Source of masks
    #[arg(long, default_value = "auto", value_name = "SOURCE", help = sources::help::<MaskSources>())]
    pub masks: SourceChoice,
    /// Source of features
    #[arg(long, default_value = "auto", value_name = "SOURCE", help = sources::help::<FeatureSources>())]
    pub features: SourceChoice,
    /// Points along each side of a picture at which a mask network is asked
    #[arg(long, default_value_t = MASK_POINTS, value_name = "N", value_parser = whole::<usize>(1..=128))]
    pub mask_points: usize,
    /// Do not ask the mask network about four overlapping crops as well
    #[arg(long)]
    pub no_mask_crops: bool,
    /// Where the scene is written
    #[command(flatten)]
    pub saving: SavingArgs,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

pub fn label(args: &LabelArgs) -> Result<()> {
    let plan = plan(args)?;
    let progress = progress::reporter();
    let outcome = run::run(&plan, progress.as_ref())?;
    report_kept_stages(progress.as_ref());
    match args.device.json {
        true => {
            let record = serde_json::to_value(run::run_record(&outcome));
            print_json(&record.map_err(|e| Error::work(format!("run record: {e}")))?)
        }
        false => print(&(run::closing_table(&outcome) + &ending(&plan.output.out))),
    }
}

fn plan(args: &LabelArgs) -> Result<RunPlan> {
    let language = LanguageConfig {
        masks: args.masks.clone(),
        features: args.features.clone(),
        mask_points: args.mask_points,
        no_mask_crops: args.no_mask_crops,
        ..LanguageConfig::default()
    };
    let config = run::label::config(args.cameras.clone(), args.max_size, language);
    Ok(RunPlan {
        inputs: Inputs {
            photos: args.images.iter().cloned().collect(),
            views: args.views,
            photo_masks: args.saving.photo_masks.clone(),
            splats: Some(args.scene.clone()),
            synthesize: args.synthesize,
            queries: args.queries.clone(),
            ..Inputs::default()
        },
        config: config.resolved(&inventory(&args.device.registry()?))?,
        machine: args.device.machine(),
        output: args.saving.destination(args.out.clone().unwrap_or_else(|| default_out(&args.scene))),
    })
}

/// `out/<name>` for a file, the next free number beside a scene directory.
fn default_out(scene: &Path) -> PathBuf {
    if scene.is_dir() {
        return files::next_free(scene);
    }
    let name = scene.file_name().unwrap_or("scene".as_ref()).to_string_lossy();
    Path::new("out").join(photo::stem(&name))
}
