//! Command-line arguments.
use crate::run::TrainingConfig;
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;

mod bench;
mod shared;

#[cfg(unix)]
pub use super::batch::{BatchArgs, BatchRowArgs};
pub use super::demo::DemoArgs;
pub use super::edit::EditArgs;
pub use super::export::ExportArgs;
pub use super::label::LabelArgs;
pub use super::measure::MeasureArgs;
pub use super::mesh::MeshArgs;
pub use super::objects::ObjectsArgs;
pub use super::run::RunArgs;
pub use crate::run::config::whole;
pub use crate::run::config::{EXPERTS, compat_names as compats};
pub use bench::{BenchArgs, BenchPart};
pub use shared::{DeviceArgs, EditUse, GlobalArgs, LogFormat, MACHINE, SavingArgs};

/// Photos in, a 3D scene that answers text queries out.
#[derive(Debug, Parser)]
#[command(name = "splatvk", version, about, max_term_width = 100, arg_required_else_help = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// Options of every command
    #[command(flatten)]
    pub global: GlobalArgs,
}

/// One variant per command; each has its own file in `cli/`.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Photos → scene directory: cameras, splats, language, report
    Run(Box<RunArgs>),
    /// Posed photos → scene without language
    Train(TrainArgs),
    /// Splats of any trainer → scene with language
    Label(LabelArgs),
    /// Scene + cameras → images
    Render(RenderArgs),
    /// Scene + texts → heat maps, masks, locations
    Query(QueryArgs),
    /// Scene → list of its things, with a file each
    Objects(ObjectsArgs),
    /// Look at a scene in the browser, and ask it
    View(ViewArgs),
    /// Lengths in a scene; one that is known gives the scene its scale
    Measure(MeasureArgs),
    /// Scene against ground truth → figures
    Eval(EvalArgs),
    /// Scene → another program's format
    Export(ExportArgs),
    /// Surfaces of a scene → triangles: .glb, .ply, .obj
    Mesh(MeshArgs),
    /// Delete, isolate, recolour, move things of a scene, and undo it
    Edit(EditArgs),
    /// The installed models
    Models(ModelsArgs),
    /// How fast this machine trains and renders
    Bench(BenchArgs),
    /// Many captures → a scene each, resumable, on all devices
    #[cfg(unix)]
    Batch(BatchArgs),
    /// One attempt at a row of a batch, which is on standard input
    #[cfg(unix)]
    #[command(hide = true)]
    BatchRow(BatchRowArgs),
    /// Four photos that come with the program → a scene, in the browser
    Demo(DemoArgs),
    /// What this machine has and what is missing
    Doctor(DoctorArgs),
    /// What earlier runs left to be used again: shows it, or frees it
    Clean(CleanArgs),
    /// Completions of a shell on standard output: bash, elvish, fish, powershell, zsh
    Completions(CompletionsArgs),
    /// Man pages into a folder
    Manuals(ManualsArgs),
    /// A command of splatlab
    #[command(hide = true, disable_help_flag = true)]
    Ablate(MovedArgs),
    /// A command of splatlab
    #[command(hide = true, disable_help_flag = true)]
    Generate(MovedArgs),
}

/// Arguments of a command that is elsewhere.
#[derive(Debug, Args)]
pub struct MovedArgs {
    /// Anything
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    pub rest: Vec<std::ffi::OsString>,
}

impl Command {
    /// Field `--provider` of commands that load networks.
    pub fn provider(&mut self) -> Option<&mut Option<String>> {
        let device = match self {
            Command::Run(args) => &mut args.device,
            Command::Train(args) => &mut args.device,
            Command::Label(args) => &mut args.device,
            Command::Query(args) => &mut args.device,
            Command::Objects(args) => &mut args.device,
            Command::Edit(args) => &mut args.device,
            Command::View(args) => &mut args.device,
            Command::Eval(args) => &mut args.device,
            Command::Models(args) => match &mut args.action {
                ModelsAction::List(device) | ModelsAction::Check(device) | ModelsAction::Path(device) => {
                    device
                }
                ModelsAction::Fetch(args) => &mut args.device,
            },
            Command::Demo(args) => &mut args.device,
            Command::Doctor(args) => &mut args.device,
            Command::Bench(args) => return Some(&mut args.provider),
            Command::Render(_)
            | Command::Ablate(_)
            | Command::Generate(_)
            | Command::Export(_)
            | Command::Mesh(_)
            | Command::Measure(_)
            | Command::Clean(_)
            | Command::Completions(_)
            | Command::Manuals(_) => return None,
            #[cfg(unix)]
            Command::Batch(_) | Command::BatchRow(_) => return None,
        };
        Some(&mut device.provider)
    }
}

/// `splatvk train`
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Folder of the photos
    #[arg(long, value_name = "DIR")]
    pub images: PathBuf,
    /// Cameras: transforms.json, cameras.json, a COLMAP model, or the folder of a data set with one
    /// of them; their lenses are taken out of the photos
    #[arg(long, value_name = "FILE")]
    pub cameras: PathBuf,
    /// How many of the photos with a camera are used [default: all
    /// that fit into memory]
    #[arg(long, value_name = "N")]
    pub views: Option<usize>,
    /// Start from the points of this .ply or COLMAP model instead of stereo
    #[arg(long, value_name = "FILE")]
    pub points: Option<PathBuf>,
    /// Scene directory to write
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Working size and training
    #[command(flatten)]
    pub training: TrainingConfig,
    /// Where the scene is written
    #[command(flatten)]
    pub saving: SavingArgs,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// A share from 0 to 1.
pub fn share(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "give a number from 0 to 1".to_owned())?;
    if (0.0..=1.0).contains(&value) { Ok(value) } else { Err("give a number from 0 to 1".to_owned()) }
}

/// Length of a film.
fn seconds(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|v| (0.1..=600.0).contains(v));
    value.ok_or_else(|| "give seconds, 0.1 to 600".to_owned())
}

/// Angle of an orbit.
fn degrees(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|v| (1.0..=360.0).contains(v));
    value.ok_or_else(|| "give degrees, 1 to 360".to_owned())
}

/// Views of `render --path`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum PathKind {
    /// The photos' cameras from left to right, with three views between neighbours
    Photos,
    /// A level circle around the middle of the scene, or a swing where photos show one side only
    Orbit,
    /// 10° and 20° to the left and right of the photos, 15° above and 10° below, nearer and further
    Beyond,
}

/// Outputs of `render`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Channel {
    /// Colour
    Rgb,
    /// Accumulated opacity
    Alpha,
    /// Expected depth, world units
    Depth,
    /// Semantic features of every level
    Features,
    /// Index of the decoded code per level, −1 = none
    Codes,
    /// Share of every pixel that is guessed: surfaces that no photo shows
    Unseen,
}

/// File formats of `render`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ImageFormat {
    /// 8-bit preview
    Png,
    /// Float, multi-channel
    Exr,
    /// NumPy array
    Npy,
}

/// `splatvk render`
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// Scene directory, or a file of Gaussians (.ply, .splat, .spz, .sog, .glb, .gltf)
    pub scene: PathBuf,
    /// Cameras: transforms.json, a COLMAP model folder, or cameras.json
    #[arg(long, value_name = "FILE", required_unless_present_any = ["path", "view"], conflicts_with = "path")]
    pub cameras: Option<PathBuf>,
    /// A named view of the scene, saved in splatvk view; may be given more than once
    #[arg(long, value_name = "NAME", conflicts_with_all = ["cameras", "path"])]
    pub view: Vec<String>,
    /// Height of the picture of a named view, pixels
    #[arg(long, value_name = "N", default_value_t = 720, requires = "view", value_parser = whole::<u32>(16..=8192))]
    pub height: u32,
    /// Views along a path instead of given cameras, with a sheet of all, their opacity and colours
    #[arg(long, value_enum)]
    pub path: Option<PathKind>,
    /// Also a video along the path: path.mp4
    #[arg(long, requires = "path")]
    pub video: bool,
    /// Length of a film, seconds
    #[arg(long, value_name = "S", default_value_t = 8.0, requires = "path", value_parser = seconds)]
    pub seconds: f64,
    /// Frames per second of a film
    #[arg(long, value_name = "N", default_value_t = 30, requires = "path", value_parser = whole::<u32>(1..=120))]
    pub fps: u32,
    /// Angle of an orbit; 360 goes around [default: as far as the photos are around the scene]
    #[arg(long, value_name = "D", requires = "path", value_parser = degrees)]
    pub degrees: Option<f64>,
    /// Folder for the images, or FILE.mp4 for a film along the path (needs ffmpeg)
    #[arg(long, value_name = "DIR|FILE.mp4")]
    pub out: PathBuf,
    /// What to write
    #[arg(long, value_enum, value_delimiter = ',', default_value = "rgb")]
    pub channels: Vec<Channel>,
    /// Write over what is there: ordinary files of the same names
    #[arg(long)]
    pub force: bool,
    /// How to write it
    #[arg(long = "format", value_enum, value_delimiter = ',', default_value = "png")]
    pub formats: Vec<ImageFormat>,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Device
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatvk query`
#[derive(Debug, Args)]
pub struct QueryArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// What to look for
    #[arg(required = true, value_name = "TEXT")]
    pub texts: Vec<String>,
    /// Folder for heat maps, masks and answers.json [default: only answers, nothing is written]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Views to answer in [default: the scene's own]
    #[arg(long, value_name = "FILE")]
    pub cameras: Option<PathBuf>,
    /// Write over what is there: ordinary files of the same names
    #[arg(long, requires = "out")]
    pub force: bool,
    /// Also write the splats that each text means, as TEXT/splats.ply
    #[arg(long, requires = "out")]
    pub splats: bool,
    /// Ask this network about every photo, instead of the scene's own language: sam3, or the name
    /// of an installed concept network
    #[arg(long, value_name = "NETWORK", conflicts_with = "compat")]
    pub concepts: Option<String>,
    /// Undistorted photos for --concepts, named like the cameras [default: those in the scene]
    #[arg(long, value_name = "DIR", requires = "concepts")]
    pub photos: Option<PathBuf>,
    /// Choose level, mask and location as others do [default: as the scene was made]
    #[arg(long, value_parser = compats(), value_name = "WHOSE", help_heading = EXPERTS)]
    pub compat: Option<String>,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatvk view`
#[derive(Debug, Args)]
pub struct ViewArgs {
    /// Scene directory, also one that a run is making, or a file of Gaussians (.ply, .splat,
    /// .spz, .sog, .glb, .gltf)
    pub scene: PathBuf,
    /// Port on 127.0.0.1; 0 takes a free one
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<u16>(0..=65_535))]
    pub port: u16,
    /// Most splats that the page shows: of more, those that cover most; the page states both numbers
    #[arg(long, default_value_t = 1_000_000, value_name = "N", value_parser = whole::<usize>(1..=100_000_000))]
    pub budget: usize,
    /// Mesh of this scene to show over the splats (splatvk mesh SCENE FILE.glb)
    #[arg(long, value_name = "FILE")]
    pub mesh: Option<PathBuf>,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatvk eval`
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// Folder with ground_truth.json
    #[arg(long, value_name = "DIR")]
    pub ground_truth: PathBuf,
    /// Another scene in the coordinates of this one, whose views are the train frames: for scenes
    /// of splatvk label, whose own views may be renders
    #[arg(long, value_name = "SCENE")]
    pub cameras_of: Option<PathBuf>,
    /// Write every rendered view and predicted mask here
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write over what is there: ordinary files of the same names
    #[arg(long)]
    pub force: bool,
    /// For the published protocols, in splatlab
    #[arg(long, value_name = "FILE", hide = true)]
    pub cameras: Option<PathBuf>,
    /// `field`; the published protocols are in splatlab
    #[arg(long, value_name = "NAME", hide = true)]
    pub protocol: Option<String>,
    /// Score held-out frames a second time, from cameras moved until the frozen scene fits their
    /// photos best: `refined`
    #[arg(long)]
    pub refine_views: bool,
    /// Choose level, mask and location as others do [default: as the scene was made]
    #[arg(long, value_parser = compats(), value_name = "WHOSE")]
    pub compat: Option<String>,
    /// Print a short table instead of JSON; --out DIR keeps eval.json
    #[arg(long, conflicts_with = "json")]
    pub text: bool,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatvk models`
#[derive(Debug, Args)]
pub struct ModelsArgs {
    /// What to do
    #[command(subcommand)]
    pub action: ModelsAction,
}

/// What `splatvk models` does.
#[derive(Debug, Subcommand)]
pub enum ModelsAction {
    /// Every known model: role, licence, size, source, installed or not
    List(DeviceArgs),
    /// Verify the built-in files; run every installed network on a built-in input and hold it to
    /// its contract
    Check(DeviceArgs),
    /// Download networks, hold them to their contract and install them
    Fetch(FetchArgs),
    /// Where models are looked for
    Path(DeviceArgs),
}

/// `splatvk models fetch`
#[derive(Debug, Args)]
pub struct FetchArgs {
    /// Packs (open, paper) and names of `splatvk models list`
    #[arg(required = true, value_name = "NAME")]
    pub names: Vec<String>,
    /// Do not ask
    #[arg(long)]
    pub yes: bool,
    /// Accept the licence of this model, which forbids commercial use; once for each
    #[arg(long, value_name = "NAME")]
    pub accept: Vec<String>,
    /// Print every address, file and command, and do nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Replace what is installed
    #[arg(long)]
    pub force: bool,
    /// Where models are; they go into the first folder
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatvk doctor`
#[derive(Debug, Args)]
pub struct DoctorArgs {
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
    /// Run every GPU pass on the device and compare it with the same computation on the CPU: a
    /// table for bug reports. What gives wrong results there and can be replaced is not used on
    /// this device and driver from then on. Of kernels that replace each other the faster ones are
    /// used
    #[arg(long)]
    pub check: bool,
}

/// `splatvk clean`
#[derive(Debug, Args)]
pub struct CleanArgs {
    /// Folders in which, and in whose folders, commands that were killed may have left files they
    /// did not finish; looked into besides the current folder and out/
    #[arg(value_name = "DIR")]
    pub folders: Vec<PathBuf>,
    /// Folder of the models
    #[arg(long, value_name = "DIR")]
    pub models: Option<PathBuf>,
    /// Delete it
    #[arg(long)]
    pub delete: bool,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// `splatvk completions`
#[derive(Debug, Args)]
pub struct CompletionsArgs {
    /// Which shell
    #[arg(value_enum)]
    pub shell: clap_complete::Shell,
}

/// `splatvk manuals`
#[derive(Debug, Args)]
pub struct ManualsArgs {
    /// Folder for splatvk.1, splatvk-run.1, ...
    pub out: PathBuf,
    /// Write over what is there: ordinary files of the same names
    #[arg(long)]
    pub force: bool,
}
