//! Command-line arguments.
use crate::ablate::{Layout, TABLES};
use crate::curve::Variant;
use crate::generate::{Flat, Spoil};
use crate::protocol::ProtocolKind;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, Subcommand, ValueEnum};
use splatvk::cli::args::{DeviceArgs, GlobalArgs, whole};
use splatvk::fit::Preset;
use splatvk::run::config::compat_names as compats;
use splatvk::run::paper::PaperSources;
use std::path::PathBuf;

/// Tables of the paper's experiments, and data with ground truth
#[derive(Debug, Parser)]
#[command(name = "splatlab", version, about, max_term_width = 100, arg_required_else_help = true)]
pub struct Lab {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// Options of every command
    #[command(flatten)]
    pub global: GlobalArgs,
}

/// One variant per command; each has its own file beside this one.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Data with ground truth → the tables of the paper's experiments
    Ablate(AblateArgs),
    /// Data with ground truth → the paper's pictures: masks, locations, alignment, failures
    Figures(FiguresArgs),
    /// Data with ground truth → quality of a training against its seconds
    Curve(CurveArgs),
    /// Generated scenes → which step of the alignment mends which error, without splats
    Alignment(AlignmentArgs),
    /// Synthetic scene with ground truth, as hard as asked
    Generate(GenerateArgs),
    /// Scene of data with a walker → error of its views where the walker was, and elsewhere
    Ghosts(GhostsArgs),
    /// Scene against the labels of LERF-OVS, 3D-OVS or ScanNet → figures of their protocols
    Eval(EvalArgs),
    /// Scene against polygons on its photos → how useful its answers are to a user
    Ask(AskArgs),
    /// Mesh of a scene against true depth → accuracy, precision, recall, F1
    MeshAccuracy(MeshAccuracyArgs),
    /// Things of scenes against the objects of held-out views → panoptic quality
    ObjectAccuracy(ObjectAccuracyArgs),
}

/// Published protocols.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ProtocolArg {
    /// LERF-OVS: a folder of frame_*.json, or ground_truth.json
    Lerf,
    /// 3D-OVS: a folder with segmentations/classes.txt, or ground_truth.json
    #[value(name = "3dovs")]
    Ovs,
    /// ScanNet: a scene with label-filt/ and pose/; eight labels
    Scannet,
}

impl ProtocolArg {
    /// The protocol of the library.
    pub fn kind(self) -> ProtocolKind {
        match self {
            ProtocolArg::Lerf => ProtocolKind::Lerf,
            ProtocolArg::Ovs => ProtocolKind::Ovs,
            ProtocolArg::Scannet => ProtocolKind::ScanNet,
        }
    }
}

/// `splatlab eval`
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// Folder of the labels, in the layout of the protocol
    #[arg(long, value_name = "DIR")]
    pub ground_truth: PathBuf,
    /// What is read and how it is scored
    #[arg(long, value_enum)]
    pub protocol: ProtocolArg,
    /// Cameras of the data set, to score labelled frames that the scene was not made from:
    /// transforms.json, a COLMAP model folder, or cameras.json
    #[arg(long, value_name = "FILE")]
    pub cameras: Option<PathBuf>,
    /// Write every rendered view and predicted mask here
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write over what is there: ordinary files of the same names
    #[arg(long)]
    pub force: bool,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatlab alignment`
#[derive(Debug, Args)]
pub struct AlignmentArgs {
    /// Number of scenes
    #[arg(long, default_value_t = 200)]
    pub scenes: u64,
    /// Seed of the first one
    #[arg(long, default_value_t = 2000)]
    pub first: u64,
    /// Compare feature spaces instead of steps: cosines of words, CLIP and SigLIP, and their ranks
    #[arg(long)]
    pub spaces: bool,
    /// Report as one line of JSON, with the figures of every scene
    #[arg(long)]
    pub json: bool,
}

/// `splatlab ask`
#[derive(Debug, Args)]
pub struct AskArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// Folder of label files as in LERF-OVS, one per photo, and texts.json
    #[arg(long, value_name = "DIR")]
    pub labels: PathBuf,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatlab ghosts`
#[derive(Debug, Args)]
pub struct GhostsArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// Folder of `splatlab generate --walker`
    #[arg(long, value_name = "DIR")]
    pub ground_truth: PathBuf,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatlab mesh-accuracy`
#[derive(Debug, Args)]
pub struct MeshAccuracyArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// Folder with ground_truth.json and depth
    #[arg(long, value_name = "DIR")]
    pub ground_truth: PathBuf,
    /// Most triangles
    #[arg(long, default_value_t = 100_000, value_name = "N")]
    pub triangles: usize,
    /// Side of a voxel, scene units [default: two pixels]
    #[arg(long, value_name = "LENGTH")]
    pub voxel: Option<f64>,
    /// Also surfaces that no photo shows
    #[arg(long)]
    pub fill_guessed: bool,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatlab object-accuracy`
#[derive(Debug, Args)]
pub struct ObjectAccuracyArgs {
    /// Scene directories; their segments are scored together
    #[arg(required = true)]
    pub scenes: Vec<PathBuf>,
    /// Folder with ground_truth.json and masks, one per scene
    #[arg(long, value_name = "DIR", required = true)]
    pub ground_truth: Vec<PathBuf>,
    /// Compare the sizes of things in the mesh with those of the truth that the photos show instead
    #[arg(long)]
    pub sizes: bool,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

fn tables() -> PossibleValuesParser {
    let all = PossibleValue::new("all").help("Every table, shared stages once");
    let each = TABLES.iter().map(|t| PossibleValue::new(t.name).help(t.about));
    PossibleValuesParser::new(std::iter::once(all).chain(each))
}

fn spoils() -> impl TypedValueParser<Value = Spoil> {
    one_of(&Spoil::ALL)
}

fn flats() -> impl TypedValueParser<Value = Flat> {
    one_of(&Flat::ALL)
}

/// Presets of cameras, stereo and training.
static PRESETS: [(Preset, &str, &str); 3] = [
    (Preset::Draft, "draft", "Fewer splats"),
    (Preset::Default, "default", "The preset of run on a GPU"),
    (Preset::Paper, "paper", "The paper's schedule"),
];

/// Parser of one of a list of (value, name, help text).
fn one_of<T: Copy + Send + Sync + 'static>(
    all: &'static [(T, &'static str, &'static str)],
) -> impl TypedValueParser<Value = T> {
    let each = all.iter().map(|(_, name, about)| PossibleValue::new(*name).help(*about));
    PossibleValuesParser::new(each).try_map(|given| {
        let known = all.iter().find(|(_, name, _)| *name == given);
        known.map(|(value, ..)| *value).ok_or("no such way")
    })
}

/// Layouts of data sets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LayoutArg {
    /// As what lies in the folder
    Auto,
    /// ground_truth.json: protocol field on held-out views
    Own,
    /// LERF-OVS: images/ in the folder, labels in ../label/NAME
    Lerf,
    /// 3D-OVS: images/ and segmentations/classes.txt
    #[value(name = "3dovs")]
    Ovs,
    /// ScanNet: color/, label-filt/, pose/, intrinsic/
    Scannet,
}

impl LayoutArg {
    /// Layout that the user chose; `None`: it is recognised from the folder.
    pub fn given(self) -> Option<Layout> {
        match self {
            LayoutArg::Auto => None,
            LayoutArg::Own => Some(Layout::Own),
            LayoutArg::Lerf => Some(Layout::Published(ProtocolKind::Lerf)),
            LayoutArg::Ovs => Some(Layout::Published(ProtocolKind::Ovs)),
            LayoutArg::Scannet => Some(Layout::Published(ProtocolKind::ScanNet)),
        }
    }
}

/// `splatlab ablate`
#[derive(Debug, Args)]
pub struct AblateArgs {
    /// Which tables
    #[arg(value_parser = tables(), required = true, value_name = "TABLE")]
    pub tables: Vec<String>,
    /// Folder for ablate.json and one text and one chart per table, renewed after every row
    /// [default: out/ablate-NAME, after the data]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write over what is there: ordinary files of the names of tables
    #[arg(long)]
    pub force: bool,
    /// Seeds of cameras, stereo, training and injected errors: a run for each
    #[arg(long, visible_alias = "seed", value_delimiter = ',', default_value = "0", value_name = "N,...", value_parser = whole::<u64>(0..))]
    pub seeds: Vec<u64>,
    /// Take the rows that an earlier run has left in --out, measured the same way, and go on from
    /// there
    #[arg(long)]
    pub resume: bool,
    /// Data and options of every row
    #[command(flatten)]
    pub study: StudyArgs,
}

/// `splatlab figures`
#[derive(Debug, Args)]
pub struct FiguresArgs {
    /// Folder for figures.html and its pictures
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Write over what is there: ordinary files of the same names
    #[arg(long)]
    pub force: bool,
    /// Methods beside each other, as of run
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "sparselgs,lift,langsplat,legaussians",
        value_name = "METHOD,..."
    )]
    pub methods: Vec<String>,
    /// Seed of cameras, stereo, training and injected errors
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<u64>(0..))]
    pub seed: u64,
    /// Data and options of every scene
    #[command(flatten)]
    pub study: StudyArgs,
}

/// Data sets, and the options of all scenes that are made from them.
#[derive(Debug, Args)]
pub struct StudyArgs {
    /// Folders with ground_truth.json, photos and masks, or scenes of LERF-OVS, 3D-OVS or ScanNet:
    /// figures are means over them, with their spread
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    pub data: Vec<PathBuf>,
    /// How the data lies, and by which protocol it is scored
    #[arg(long, value_enum, default_value = "auto")]
    pub layout: LayoutArg,
    /// Masks and features for every row: built-in, flawed (true masks, errors injected), exact, or
    /// dir:DIR [default: those that each table is about]
    #[arg(long, value_name = "SOURCE")]
    pub regions: Option<String>,
    /// Photos of the default row [default: all train frames, at most 4]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..))]
    pub views: Option<usize>,
    /// Take the true cameras in every row, for photos that alone would give none
    #[arg(long)]
    pub true_cameras: bool,
    /// Most stereo points that splats start from, in rows that do not vary it [default: draft's]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..))]
    pub max_points: Option<usize>,
    /// Cameras and points of every row that does not vary them, as of run [default: sfm]
    #[arg(long, value_name = "SOURCE")]
    pub init: Option<String>,
    /// The same for dense matches [default: xfeat]
    #[arg(long, value_name = "SOURCE")]
    pub matcher: Option<String>,
    /// The same for masks [default: graph]
    #[arg(long, value_name = "SOURCE")]
    pub masks: Option<String>,
    /// The same for features [default: words]
    #[arg(long, value_name = "SOURCE")]
    pub features: Option<String>,
    /// Preset of cameras, stereo and training
    #[arg(long, value_parser = one_of(&PRESETS), default_value = "draft", value_name = "PRESET")]
    pub preset: Preset,
    /// Choices of every row, as of run: paper, authors or langsplat
    #[arg(long, value_parser = compats(), value_name = "WHOSE")]
    pub compat: Option<String>,
    /// The paper's method in every row, as of run: its schedules, rules and networks. The paper's
    /// figures stand beside those on its data sets
    #[arg(long, conflicts_with_all = ["preset", "compat"])]
    pub paper: bool,
    /// Networks with --paper; with any, the paper's figures are left out
    #[arg(
        long,
        value_enum,
        default_value_t,
        hide_default_value = true,
        requires = "paper",
        value_name = "WHICH"
    )]
    pub paper_sources: PaperSources,
    /// Optimisation steps of the colour stage, instead of the preset's
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..))]
    pub iterations: Option<usize>,
    /// Optimisation steps of the language stage [default: the preset's; draft: 30]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..))]
    pub language_iterations: Option<usize>,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatlab curve`
#[derive(Debug, Args)]
pub struct CurveArgs {
    /// Folders with ground_truth.json, photos and masks
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    pub data: Vec<PathBuf>,
    /// Trainings to compare, each the preset with some options changed, as steps=200,opacity=0.5;
    /// `preset` changes none [default: preset]
    #[arg(long, value_name = "NAME=VALUE,...", num_args = 1..)]
    pub variant: Vec<Variant>,
    /// Preset of cameras, stereo and training
    #[arg(long, value_parser = one_of(&PRESETS), default_value = "draft", value_name = "PRESET")]
    pub preset: Preset,
    /// Points of a curve; the last is the end of the training
    #[arg(long, default_value_t = 8, value_name = "N", value_parser = whole::<usize>(1..))]
    pub points: usize,
    /// Lift language at every point and score it: true masks, synthetic features
    #[arg(long)]
    pub words: bool,
    /// Photos [default: all train frames, at most 4]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..))]
    pub views: Option<usize>,
    /// Take the true cameras
    #[arg(long)]
    pub true_cameras: bool,
    /// Seed of cameras, stereo and training
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<u64>(0..))]
    pub seed: u64,
    /// Folder that keeps cameras, depth and masks of every data set: later calls, also of other
    /// revisions, train on the same
    #[arg(long, value_name = "DIR")]
    pub inputs: Option<PathBuf>,
    /// File for all curves, as JSON
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Write over the file of --out
    #[arg(long)]
    pub force: bool,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// `splatlab generate`
#[derive(Debug, Args)]
pub struct GenerateArgs {
    /// Folder to write: photos, held-out views, depth, masks, cameras, regions
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace data that an earlier call made; a folder of anything else is never replaced
    #[arg(long)]
    pub force: bool,
    /// Make no scene: only regions_exact/ and regions_flawed/ for this data set with masks
    #[arg(long, value_name = "DIR")]
    pub from: Option<PathBuf>,
    /// Everything random
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<u64>(0..))]
    pub seed: u64,
    /// Photos
    #[arg(long, default_value_t = 4, value_name = "N", value_parser = whole::<usize>(0..))]
    pub views: usize,
    /// Held-out views
    #[arg(long, default_value_t = 6, value_name = "N", value_parser = whole::<usize>(0..))]
    pub held_out: usize,
    /// Also eight held-out views beside the photos, as those of `splatvk render --path beyond`
    #[arg(long)]
    pub beyond: bool,
    /// Picture size, pixels
    #[arg(long, default_value = "640x480", value_name = "WxH")]
    pub size: String,
    /// Objects on the table, 1 to 12
    #[arg(long, default_value_t = 8, value_name = "N", value_parser = whole::<usize>(0..=12))]
    pub objects: usize,
    /// Angle between neighbouring photos, degrees
    #[arg(long, default_value_t = 20.0, value_name = "DEG")]
    pub baseline: f64,
    /// Contrast of surfaces: 1 = plenty to match, 0 = bare
    #[arg(long, default_value_t = 1.0, value_name = "0-1")]
    pub texture: f64,
    /// Highlights that move with the camera: 1 = up to full white, 0 = none
    #[arg(long, default_value_t = 0.0, value_name = "0-1")]
    pub gloss: f64,
    /// Thin poles
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<usize>(0..))]
    pub thin: usize,
    /// Objects close together and behind each other
    #[arg(long, default_value_t = 0.3, value_name = "0-1")]
    pub occlusion: f64,
    /// Objects that look like another one
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<usize>(0..))]
    pub similar: usize,
    /// Out of doors, ten times as large: the ground begins at the feet, behind a house stands the
    /// sky
    #[arg(long)]
    pub outdoor: bool,
    /// Everything on one plane instead of a table
    #[arg(long, value_name = "WAY", value_parser = flats())]
    pub flat: Option<Flat>,
    /// Cameras at even steps of --baseline on one circle; otherwise each is up to 2 degrees off
    /// along it and 4 above or below it
    #[arg(long)]
    pub steady: bool,
    /// Focal length of the last photo over that of the first; between them it grows from photo to
    /// photo
    #[arg(long, default_value_t = 1.0, value_name = "RATIO")]
    pub zoom: f64,
    /// Error of the starting cameras in cameras_noisy.json, degrees
    #[arg(long, default_value_t = 0.1, value_name = "DEG")]
    pub pose_noise: f64,
    /// Noise of the photos, share of full white [default: 0.005; 0 with --sensor-noise]
    #[arg(long, value_name = "SHARE")]
    pub photo_noise: Option<f64>,
    /// Photos as a phone takes them: --focal --lens --centre --light --sensor-noise --jpeg 82;
    /// held-out views stay clean, and depth and masks are those of the undistorted photo
    #[arg(long)]
    pub phone: bool,
    /// Focal length drawn from 0.7 to 1.2 widths, one for all views [default: 1.025 widths]
    #[arg(long)]
    pub focal: bool,
    /// Radial distortion of the photos, one lens for all: k1 within ±0.15, k2 within a third of k1
    #[arg(long)]
    pub lens: bool,
    /// Principal point of the photos off the middle, up to 1 % of the width along x and along y
    #[arg(long)]
    pub centre: bool,
    /// Light of the photos: exposure within ±0.35 stops and white balance within ±6 % per photo, up
    /// to 35 % lost in the corners
    #[arg(long)]
    pub light: bool,
    /// Shot and read noise of a small sensor near ISO 200: 3000 electrons at full white, 4
    /// electrons read noise
    #[arg(long)]
    pub sensor_noise: bool,
    /// JPEG quality of the photos [default: 95; 82 with --phone]
    #[arg(long, value_name = "1-100", value_parser = whole::<u8>(1..=100))]
    pub jpeg: Option<u8>,
    /// Every other photo by a second camera: focal length, lens, principal point and vignetting of
    /// its own, where the other options ask for them
    #[arg(long)]
    pub two_cameras: bool,
    /// A person walks through while the photos are taken: a figure in all photos but one, each time
    /// elsewhere. clean/ has the photos without it, used/ its masks for --photo-masks; held-out
    /// views, depth, masks and regions are those without it
    #[arg(long)]
    pub walker: bool,
    /// Photos of which no right scene, or only part of one, can be made
    #[arg(long, value_name = "WAY", value_parser = spoils())]
    pub spoil: Option<Spoil>,
    /// regions_flawed/: rate of masks cut in two
    #[arg(long, default_value_t = 0.2, value_name = "RATE")]
    pub split: f64,
    /// regions_flawed/: rate of objects swallowed by a neighbour's mask
    #[arg(long, default_value_t = 0.05, value_name = "RATE")]
    pub merge: f64,
    /// regions_flawed/: rate of features of another object
    #[arg(long, default_value_t = 0.2, value_name = "RATE")]
    pub wrong: f64,
    /// regions_flawed/: random part of every feature
    #[arg(long, default_value_t = 0.35, value_name = "LENGTH")]
    pub noise: f64,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}
