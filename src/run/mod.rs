//! The whole pipeline on one page: photos → cameras, depth and points → splats → language → scene directory.
pub mod ask;
pub mod budget;
pub mod encoder;
mod light;
mod list;
pub mod live;
mod method;
mod networks;
mod record;
pub mod refine;
pub mod score;
pub mod sources;
mod stages;
pub mod train;
pub mod view;

pub use method::{AUTOENCODER, FEATURE_DIM, Method, Recipe};
pub use record::{closing_table, run_record};

use crate::Result;
use crate::fit::{self, LanguageOptions, Preset, RgbOptions};
use crate::format::Workspace;
use crate::format::scene_dir::{self, Contents};
use crate::gpu::{self, Device};
use crate::infer::{Registry, home, provider};
use crate::language;
use crate::language::sam::SamOptions;
use crate::photo::{self, Photo};
use crate::pipeline::{Graph, Store};
use crate::pose::{self, Geometry};
use crate::progress::{Progress, Recorded, StageRecord};
use crate::query::QueryResult;
use crate::query::highlight::Highlight;
use crate::report::ModelUsed;
use crate::report::viewer::{Names, ShownAnswer};
use crate::scene::{Camera, LanguageField, Splats};
use networks::Networks;
use std::path::{Path, PathBuf};
use std::time::Duration;
use view::DecodedFrame;

/// Where cameras and points come from.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub enum InitSource {
    /// Structure from motion over the photos and stereo.
    Sfm,
    /// Known cameras from a file; stereo.
    Cameras(PathBuf),
    /// Known cameras, joined to the photos by name; stereo.
    Given(Vec<Camera>),
    /// Pointmaps of an installed network (DUSt3R, MASt3R, VGGT and others).
    Network(String),
}

/// Where dense matches between photos come from.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub enum MatchSource {
    /// XFeat descriptors along epipolar lines.
    Xfeat,
    /// An installed dense matcher (RoMa).
    Network(String),
}

/// Where masks come from.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub enum MaskSource {
    /// The built-in graph segmentation.
    Graph,
    /// Label maps `<stem>_s.npy` in a folder.
    Dir(PathBuf),
    /// An installed network that answers points (SAM and others).
    Network(String),
}

/// Where region features and text embeddings come from.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub enum FeatureSource {
    /// The built-in classifier and sentence encoder.
    Words,
    /// `<stem>_f.npy` and `text_embeddings.npz` in a folder.
    Dir(PathBuf),
    /// An installed pair of image and text towers (CLIP).
    Network(String),
}

/// What to do, with every default that does not depend on the machine resolved.
#[derive(Clone, Debug, serde::Serialize)]
pub struct RunPlan {
    /// Photos or folders of photos.
    pub inputs: Vec<PathBuf>,
    /// How many to use; `None` = as many as there are, at most [`photo::DEFAULT_VIEWS`].
    pub views: Option<usize>,
    /// Scene directory.
    pub out: PathBuf,
    /// Replace an existing scene.
    pub force: bool,
    /// Use the stages that an earlier run with the same photos and settings has finished.
    pub resume: bool,
    /// Seconds between states of training on disk.
    pub checkpoint_seconds: u64,
    /// `None` = draft on a CPU device, default elsewhere.
    pub preset: Option<Preset>,
    /// Cameras and points.
    pub init: InitSource,
    /// Dense matches.
    pub matcher: MatchSource,
    /// Masks.
    pub masks: MaskSource,
    /// How a mask network is asked.
    pub sam: SamOptions,
    /// Features.
    pub features: FeatureSource,
    /// Texts to answer once the scene is there.
    pub queries: Vec<String>,
    /// Seed of everything random.
    pub seed: u64,
    /// Steps of the colour stage instead of the preset's.
    pub iterations: Option<usize>,
    /// Steps of the language stage instead of the preset's.
    pub language_iterations: Option<usize>,
    /// The method compared, [`Method::SparseLgs`] unless a baseline is wanted.
    pub method: Method,
    /// Length of the codes.
    pub feature_dim: usize,
    /// One model per level.
    pub per_level: bool,
    /// Greatest side of the working images, pixels; `None` = [`photo::default_max_size`] of the device.
    pub max_size: Option<usize>,
    /// Vulkan device.
    pub device: Option<String>,
    /// The same bits on every run: see [`crate::gpu::Options`].
    pub deterministic: bool,
    /// Folder of the models.
    pub models: Option<PathBuf>,
}

impl Default for RunPlan {
    /// Built-in models, everything else as the device suggests; no inputs, and nowhere to write.
    fn default() -> Self {
        RunPlan {
            inputs: Vec::new(),
            views: None,
            out: PathBuf::new(),
            force: false,
            resume: false,
            checkpoint_seconds: CHECKPOINT_SECONDS,
            preset: None,
            init: InitSource::Sfm,
            matcher: MatchSource::Xfeat,
            masks: MaskSource::Graph,
            sam: SamOptions::default(),
            features: FeatureSource::Words,
            queries: Vec::new(),
            seed: 0,
            iterations: None,
            language_iterations: None,
            method: Method::default(),
            feature_dim: FEATURE_DIM,
            per_level: false,
            max_size: None,
            device: None,
            deterministic: false,
            models: None,
        }
    }
}

/// The answers to one text, one per photo.
#[derive(Clone, Debug)]
pub struct Answers {
    /// What was asked.
    pub text: String,
    /// Per photo.
    pub views: Vec<QueryResult>,
    /// For the scene as a whole.
    pub highlight: Highlight,
}

impl Answers {
    /// For the interactive view.
    pub fn shown(&self) -> ShownAnswer<'_> {
        ShownAnswer {
            text: &self.text,
            found: self.found(),
            views: self.views.len(),
            highlight: &self.highlight,
        }
    }

    /// Photos in which the text was found.
    pub fn found(&self) -> usize {
        self.views.iter().filter(|v| v.found).count()
    }
}

/// Everything a finished run knows; [`crate::report`] turns it into run.json, report.html and the summary.
pub struct Outcome {
    /// What was asked for.
    pub plan: RunPlan,
    /// The preset that was used.
    pub preset: Preset,
    /// The device that was used.
    pub device: crate::gpu::DeviceInfo,
    /// Which photos were used and why, where there were more than wanted.
    pub choice: Option<pose::choose::Choice>,
    /// Photos at working resolution.
    pub photos: Vec<Photo>,
    /// Geometry before training.
    pub geometry: Geometry,
    /// Refined cameras.
    pub cameras: Vec<Camera>,
    /// The scene.
    pub splats: Splats,
    /// Figures of the colour stage.
    pub rgb: fit::FitStats,
    /// The scene's language.
    pub field: LanguageField,
    /// Masks, edges and components behind it.
    pub alignment: language::align::Alignment,
    /// Decode accuracy over the language stage.
    pub language_curve: Vec<fit::LanguagePoint>,
    /// The trained scene seen from every photo's camera.
    pub frames: Vec<DecodedFrame>,
    /// One per query of the plan.
    pub answers: Vec<Answers>,
    /// The text model's own phrases per level and code.
    pub names: Names,
    /// Built-in models.
    pub models: Vec<crate::infer::ModelStatus>,
    /// Files of the networks that were used.
    pub networks: Vec<ModelUsed>,
    /// Times and memory per stage, up to the writing of the scene.
    pub stages: Vec<StageRecord>,
    /// Wall seconds up to there; less than the stages together, since some overlap.
    pub seconds: f64,
    /// What the user was warned of.
    pub warnings: Vec<String>,
}

/// Runs the plan and writes the scene directory, whole or not at all.
pub fn run(plan: &RunPlan, progress: &dyn Progress) -> Result<Outcome> {
    let progress = &Recorded::new(progress);
    let workspace = Workspace::create(&plan.out, plan.force)?;
    // The device comes first: it says how large the photos may be.
    let device = Device::with(&gpu::Options {
        deterministic: plan.deterministic,
        ..gpu::Options::from_env(plan.device.as_deref())
    })?;
    let max_size = plan.max_size.unwrap_or(photo::default_max_size(device.info().is_cpu));
    let (chosen, choice) = pose::choose::photos(&plan.inputs, plan.views, progress)?;
    budget(plan, &device, &photo::sizes_of(&chosen), max_size)?;
    let photos = photo::load_each(&chosen, max_size, progress)?;
    let store = store(plan.resume, plan.checkpoint_seconds);
    let outcome = Outcome { choice, ..work(plan, &device, photos, &store, progress)? };
    write(workspace, &outcome, progress)?;
    Ok(outcome)
}

/// The run without its files, for programs that hold photos and device themselves. Of the plan, everything about inputs,
/// output and device goes unread.
pub fn reconstruct(
    plan: &RunPlan,
    device: &Device,
    photos: Vec<Photo>,
    progress: &dyn Progress,
) -> Result<Outcome> {
    photo::check_set(&photos)?;
    let sizes: Vec<_> = photos.iter().map(|p| (p.image.width, p.image.height)).collect();
    budget(plan, device, &sizes, usize::MAX)?;
    work(plan, device, photos, &Store::none(), &Recorded::new(progress))
}

/// Writes what [`reconstruct`] made as a scene directory, whole or not at all; `force` replaces a scene.
pub fn save(outcome: &mut Outcome, out: &Path, force: bool, progress: &dyn Progress) -> Result<()> {
    let workspace = Workspace::create(out, force)?;
    outcome.plan.out = out.to_path_buf();
    write(workspace, outcome, progress)
}

fn work(
    plan: &RunPlan,
    device: &Device,
    photos: Vec<Photo>,
    store: &Store,
    progress: &Recorded,
) -> Result<Outcome> {
    let registry = Registry::open(plan.models.as_deref())?;
    // Whatever can be refused is read before the long work, not after it.
    provider::report(progress)?;
    let networks = Networks::of(plan, &registry)?;
    networks.warn_untrained(progress);
    sources::given_masks(&plan.masks, &plan.features, &photos)?;
    let preset = preset_of(plan, device);
    let mut graph = Graph::default();
    let scene = list::scene(&mut graph, plan, preset, device, photos, &networks, &registry)?;
    let mut made = graph.run(&scene.targets(), device, &registry, store, progress)?;
    provider::report(progress)?;
    let (trained, language) = (made.take(scene.trained)?, made.take(scene.language)?);
    Ok(Outcome {
        plan: plan.clone(),
        preset,
        device: device.info().clone(),
        choice: None,
        photos: made.take(scene.placed)?.photos,
        geometry: made.take(scene.geometry)?,
        cameras: trained.cameras,
        splats: language.splats,
        rgb: trained.stats,
        field: language.field,
        alignment: made.take(scene.aligned)?.alignment,
        language_curve: language.curve,
        frames: made.take(scene.frames)?,
        answers: made.take(scene.answers)?,
        names: made.take(scene.names)?,
        models: registry.status(),
        networks: networks.used()?,
        stages: progress.stages(),
        seconds: progress.seconds(),
        warnings: progress.warnings(),
    })
}

/// Training states are some ten megabytes for scenes of a few photos: written in a fraction of a second.
pub const CHECKPOINT_SECONDS: u64 = 30;

/// What stages made, on disk.
fn store(resume: bool, checkpoint_seconds: u64) -> Store {
    Store::at(stage_folder(), resume, Duration::from_secs(checkpoint_seconds))
}

/// Where runs keep what their stages made.
pub fn stage_folder() -> PathBuf {
    home().join("stages")
}

impl RunPlan {
    /// What the method does, with the plan's code length.
    pub fn recipe(&self) -> Recipe {
        Recipe { feature_dim: self.feature_dim, ..self.method.recipe() }
    }
}

fn preset_of(plan: &RunPlan, device: &Device) -> Preset {
    plan.preset.unwrap_or(if device.info().is_cpu { Preset::Draft } else { Preset::Default })
}

/// Refuses photos of these (width, height) where they cannot be worked with at that size.
fn budget(plan: &RunPlan, device: &Device, sizes: &[(usize, usize)], max_size: usize) -> Result<()> {
    let work = budget::Work::language(plan.feature_dim, plan.per_level, preset_of(plan, device), sizes.len());
    budget::check(&budget::Limits::now(device.info()), sizes, max_size, &work)
}

fn rgb_options(plan: &RunPlan, preset: Preset, device: &Device, photos: usize) -> RgbOptions {
    let mut options = RgbOptions::preset(preset);
    let work = budget::Work::language(plan.feature_dim, plan.per_level, preset, photos);
    options.limit_splats(budget::most_splats(device.info(), work.features), work.splats);
    options.seed = plan.seed;
    if let Some(n) = plan.iterations {
        options = options.with_iterations(n);
    }
    plan.recipe().rgb(options)
}

fn language_options(plan: &RunPlan, preset: Preset) -> LanguageOptions {
    let mut options = LanguageOptions::preset(preset);
    options.seed = plan.seed;
    options.per_level |= plan.per_level;
    options.iterations = plan.language_iterations.unwrap_or(options.iterations);
    options
}

fn write(workspace: Workspace, outcome: &Outcome, progress: &dyn Progress) -> Result<()> {
    progress.begin("write", 2);
    progress.check()?;
    let table = match &outcome.plan.features {
        FeatureSource::Dir(dir) => Some(dir.join(sources::TEXT_TABLE)),
        FeatureSource::Words | FeatureSource::Network(_) => None,
    };
    let contents = Contents {
        splats: &outcome.splats,
        cameras: &outcome.cameras,
        photos: &outcome.photos,
        points: Some(&outcome.geometry.points),
        language: Some(&outcome.field),
        text_embeddings: table.as_deref(),
    };
    scene_dir::write(workspace.path(), &contents)?;
    progress.step(1, "");
    record::write(workspace.path(), outcome)?;
    progress.check()?;
    workspace.commit()?;
    progress.end();
    Ok(())
}
