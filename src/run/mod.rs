//! The whole pipeline on one page: photos → cameras, depth and points → splats → language → scene directory.
pub mod ask;
pub mod budget;
mod describe;
pub mod encoder;
mod light;
pub mod live;
mod method;
mod networks;
mod record;
pub mod refine;
pub mod score;
pub mod sources;
pub mod train;
pub mod view;

pub use method::{AUTOENCODER, FEATURE_DIM, Method, Recipe};
pub use record::{closing_table, run_record};

use crate::fit::{self, LanguageOptions, Preset, RgbOptions};
use crate::format::scene_dir::{self, Contents};
use crate::format::{Workspace, cameras};
use crate::gpu::{self, Device};
use crate::infer::{Registry, provider};
use crate::language;
use crate::language::sam::SamOptions;
use crate::photo::{self, Photo};
use crate::pose::stereo::StereoOptions;
use crate::pose::{self, Geometry, Placed, SparseModel};
use crate::progress::{Progress, Recorded, StageRecord};
use crate::query::{Highlight, QueryOptions, QueryResult};
use crate::report::ModelUsed;
use crate::report::viewer::{Names, ShownAnswer};
use crate::scene::{Camera, LanguageField, RgbImage, Splats};
use crate::{Error, Result};
use describe::{Described, Describer, both};
use networks::Networks;
use std::path::{Path, PathBuf};
use std::sync::{OnceLock, mpsc};
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
    let outcome = Outcome { choice, ..work(plan, &device, photos, progress)? };
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
    work(plan, device, photos, &Recorded::new(progress))
}

/// Writes what [`reconstruct`] made as a scene directory, whole or not at all; `force` replaces a scene.
pub fn save(outcome: &mut Outcome, out: &Path, force: bool, progress: &dyn Progress) -> Result<()> {
    let workspace = Workspace::create(out, force)?;
    outcome.plan.out = out.to_path_buf();
    write(workspace, outcome, progress)
}

fn work(plan: &RunPlan, device: &Device, photos: Vec<Photo>, progress: &Recorded) -> Result<Outcome> {
    let registry = Registry::open(plan.models.as_deref())?;
    // Whatever can be refused is read before the long work, not after it.
    provider::report(progress)?;
    let networks = Networks::of(plan, &registry)?;
    networks.warn_untrained(progress);
    let known = match &plan.init {
        InitSource::Sfm | InitSource::Network(_) => None,
        InitSource::Cameras(file) => Some(cameras::read(file)?),
        InitSource::Given(cameras) => Some(cameras.clone()),
    };
    let given = sources::given_masks(&plan.masks, &plan.features, &photos)?;
    let encoder = sources::encoder(&plan.features, &registry)?;

    let preset = preset_of(plan, device);
    let start = match &networks.geometry {
        Some(model) => networks::geometry_of(model, &photos, progress)?,
        None => None,
    };
    // Placed photos are without lens distortion and in one light: what comes after sees them so.
    let (photos, start) = match start {
        Some(geometry) => (photos, Start::Geometry(geometry)),
        None => {
            let Placed { photos, model, method } =
                pose::place(photos, known.as_deref(), &registry, progress)?;
            (photos, Start::Cameras(model, method))
        }
    };
    // Masks from a folder belong to the photos as they were read.
    let given = match photos.iter().any(|p| p.straightened.is_some()) {
        true => sources::given_masks(&plan.masks, &plan.features, &photos)?,
        false => given,
    };
    let images: Vec<RgbImage> = photos.iter().map(|p| p.image.clone()).collect();
    let describer = Describer {
        plan,
        photos: &photos,
        images: &images,
        registry: &registry,
        networks: &networks,
        given,
        encoder,
    };
    let stereo = StereoOptions::preset(preset);
    let reconstruct = || match start {
        Start::Geometry(geometry) => Ok(geometry),
        Start::Cameras(model, method) => pose::dense(device, &photos, model, method, &stereo, progress),
    };
    let train = |geometry: &Geometry| {
        fit::train_rgb(
            device,
            &images,
            &geometry.cameras,
            &geometry.points,
            Some(&geometry.depths),
            &rgb_options(plan, preset, device, images.len()),
            progress,
        )
    };
    let (geometry, trained, described) = side_by_side(reconstruct, train, describer, progress)?;
    let Described { queries, language: built, names } = described;
    let spoken = plan.recipe().speak(
        device,
        &images,
        &trained.cameras,
        &trained.splats,
        built.field,
        language_options(plan, preset),
        progress,
    )?;
    provider::report(progress)?;

    progress.begin("query", 1);
    let frames = view::decode_all(device, &spoken.splats, &spoken.field, &trained.cameras)?;
    let answer = |query| ask::answers(&frames, &spoken.field, query, &QueryOptions::default());
    let answers = queries.iter().map(answer).collect::<Result<Vec<_>>>()?;
    progress.end();
    Ok(Outcome {
        plan: plan.clone(),
        preset,
        device: device.info().clone(),
        choice: None,
        photos,
        geometry,
        cameras: trained.cameras,
        splats: spoken.splats,
        rgb: trained.stats,
        field: spoken.field,
        alignment: built.alignment,
        language_curve: spoken.curve,
        frames,
        answers,
        names,
        models: registry.status(),
        networks: networks.used()?,
        stages: progress.stages(),
        seconds: progress.seconds(),
        warnings: progress.warnings(),
    })
}

/// What is known of the cameras before the two lanes part.
enum Start {
    /// Cameras and sparse points, and how they were found; depth is still to come.
    Cameras(SparseModel, String),
    /// All of it, from a network.
    Geometry(Geometry),
}

/// Geometry and splats on this thread; masks, features and alignment beside them on another. The first error stops both.
fn side_by_side(
    reconstruct: impl FnOnce() -> Result<Geometry>,
    train: impl FnOnce(&Geometry) -> Result<fit::Trained>,
    describer: Describer,
    progress: &Recorded,
) -> Result<(Geometry, fit::Trained, Described)> {
    let geometry = OnceLock::new();
    let (ready, wait) = mpsc::channel();
    let ended = || Error::Cancelled;
    let (trained, described) = std::thread::scope(|scope| {
        let beside = progress.beside();
        let geometry = &geometry;
        let other = scope.spawn(move || {
            let known = || wait.recv().ok().and_then(|()| geometry.get()).ok_or_else(ended);
            describer.run(known, beside.as_ref()).inspect_err(|_| progress.stop())
        });
        let front = reconstruct().and_then(|found| {
            let found = geometry.get_or_init(|| found);
            // The receiver is gone only when the other lane has failed, which the training then notices.
            let _ = ready.send(());
            train(found)
        });
        drop(ready);
        if front.is_err() {
            progress.stop();
        }
        // A panic over there goes on here, as if there had been one thread.
        let described = other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        both(front, described)
    })?;
    let geometry = geometry.into_inner().ok_or_else(ended)?;
    Ok((geometry, trained, described))
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
