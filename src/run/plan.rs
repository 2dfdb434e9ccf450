//! A run: its inputs, configuration, machine and output, and the options of its stages.
use super::budget;
use super::config::ReconstructionConfig;
use super::sources::SourceChoice;
use crate::check;
use crate::fit::{LanguageOptions, Preset, RgbOptions, ViewDependentOptions};
use crate::gpu::{self, Device};
use crate::infer::installed::inventory;
use crate::infer::{Compute, Registry};
use crate::progress::Progress;
use crate::query::phrasing;
use crate::scene::GivenCamera;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::path::{Path, PathBuf};

/// Default of `checkpoint_seconds`. Training states are some ten megabytes for scenes of a few
/// photos, written in a fraction of a second.
pub const CHECKPOINT_SECONDS: u64 = 30;

/// A run from files to a scene directory.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct RunPlan {
    /// Files that the run reads, and texts of queries.
    #[serde(flatten)]
    pub inputs: Inputs,
    /// Settings that change the result.
    #[serde(flatten)]
    pub config: ReconstructionConfig,
    /// Device, models and providers.
    #[serde(flatten)]
    pub machine: Machine,
    /// Place of the scene.
    #[serde(flatten)]
    pub output: Destination,
}

/// Files that a run reads, and texts of queries.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Inputs {
    /// Photos, folders of photos, or a video.
    #[serde(rename = "inputs")]
    pub photos: Vec<PathBuf>,
    /// A scene directory that the photos join, instead of making a scene of their own.
    pub add: Option<PathBuf>,
    /// Number of photos to use; `None`: at most [`crate::photo::DEFAULT_VIEWS`], and for a scene
    /// without language all with a known camera that fit into memory, or
    /// [`crate::photo::DEFAULT_VIEWS_WITHOUT_LANGUAGE`].
    pub views: Option<usize>,
    /// Folder of a mask per photo; `None` = one beside the photos, where there is any.
    pub photo_masks: Option<PathBuf>,
    /// Points to start from (`.ply`, a COLMAP model folder or a data set that holds one), in the
    /// frame of the cameras of `init`, instead of those of stereo.
    pub points: Option<PathBuf>,
    /// A scene directory or a file of Gaussians whose splats get language, instead of splats that
    /// are trained on the photos.
    pub splats: Option<PathBuf>,
    /// Number of views that are rendered for `splats` without photos; `None` = a default where there
    /// are no photos and cameras.
    pub synthesize: Option<usize>,
    /// Texts to answer in the finished scene.
    pub queries: Vec<String>,
}

/// Inputs beside the photos of [`super::reconstruct`].
#[derive(Clone, Debug, Default)]
pub struct Extras {
    /// Known cameras, one per photo with its name, instead of those of `init`.
    pub cameras: Vec<GivenCamera>,
    /// Texts to answer.
    pub queries: Vec<String>,
}

/// Device, models and providers.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Machine {
    /// Vulkan device: `uuid:…`, `pci:…`, its number, or a part of its name.
    pub device: Option<String>,
    /// Folder of the models.
    pub models: Option<PathBuf>,
    /// Execution provider of the networks, one of [`crate::infer::provider::NAMES`]; `None` as in
    /// [`Compute::by`].
    pub provider: Option<String>,
    /// Device and models that are open already, instead of those above.
    #[serde(skip)]
    pub opened: Option<Opened>,
}

/// A device and models of a program that holds them open.
#[derive(Clone)]
pub struct Opened {
    /// The device.
    pub device: Device,
    /// The models.
    pub registry: Registry,
}

impl std::fmt::Debug for Opened {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("Opened").field("device", &self.device.info().name).finish_non_exhaustive()
    }
}

/// Place of the scene, and use of stages of an earlier run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Destination {
    /// Scene directory.
    pub out: PathBuf,
    /// Replace an existing scene.
    pub force: bool,
    /// Use the stages that an earlier run with the same photos and settings has finished.
    pub resume: bool,
    /// Seconds between states of training on disk.
    pub checkpoint_seconds: u64,
}

impl Default for Destination {
    fn default() -> Self {
        Destination {
            out: PathBuf::new(),
            force: false,
            resume: false,
            checkpoint_seconds: CHECKPOINT_SECONDS,
        }
    }
}

impl RunPlan {
    /// A plan from options by name, with the sources named: those of a [`ReconstructionConfig`] and
    /// the given `others`.
    ///
    /// # Errors
    /// Unknown options, values of the wrong type, and missing networks.
    pub fn with_options(options: &Map<String, Value>, others: &[&str]) -> Result<RunPlan> {
        let wrong = |e: serde_json::Error| Error::input(format!("options: {e}"));
        let known = serde_json::to_value(ReconstructionConfig::default()).map_err(wrong)?;
        let has = |key: &str| known.get(key).is_some() || others.contains(&key);
        if let Some(key) = options.keys().find(|key| !has(key)) {
            return Err(Error::input(format!(
                "there is no option {key}; the options are those of splatvk run, with underscores"
            )));
        }
        let plan: RunPlan = serde_json::from_value(Value::Object(options.clone())).map_err(wrong)?;
        let config = plan.config.resolved(&inventory(&plan.machine.registry()?))?;
        Ok(RunPlan { config, ..plan })
    }
}

impl Inputs {
    /// Refuses texts that are no queries.
    pub fn check(&self) -> Result<()> {
        self.queries
            .iter()
            .try_for_each(|text| phrasing::check(text).map_err(|e| Error::input(format!("--query: {e}"))))
    }
}

impl Machine {
    /// An open device with open models.
    pub fn of(device: Device, registry: Registry) -> Machine {
        Machine { opened: Some(Opened { device, registry }), ..Machine::default() }
    }

    /// The installed models.
    pub fn registry(&self) -> Result<Registry> {
        match &self.opened {
            Some(opened) => Ok(opened.registry.clone()),
            None => Registry::with(self.models.as_deref(), Compute::by(self.provider.as_deref())),
        }
    }

    /// The device.
    pub fn gpu(&self) -> Result<Device> {
        match &self.opened {
            Some(opened) => Ok(opened.device.clone()),
            None => gpu::open(self.device.as_deref()),
        }
    }

    /// The device for training, with the kernels that are fastest there ([`check::open`]); one that
    /// is open already is as deterministic as it was opened.
    pub(super) fn open(&self, deterministic: bool, progress: &dyn Progress) -> Result<Device> {
        match &self.opened {
            Some(opened) => Ok(opened.device.clone()),
            None => {
                let options = gpu::Options { deterministic, ..gpu::options(self.device.as_deref()) };
                check::open(&options, progress)
            }
        }
    }
}

impl RunPlan {
    /// The files and folders that the run reads.
    pub fn read(&self) -> impl Iterator<Item = &Path> {
        let Inputs { photos, add, photo_masks, points, splats, .. } = &self.inputs;
        let folders = [add, photo_masks, points, splats, &self.machine.models].into_iter().flatten();
        let arguments = self.config.sources().filter_map(|s: &SourceChoice| s.argument.as_ref());
        photos.iter().chain(arguments).chain(folders).map(PathBuf::as_path)
    }
}

/// Options of the stages on a device.
impl ReconstructionConfig {
    /// The preset, or the device's.
    pub(super) fn preset_on(&self, device: &Device) -> Preset {
        self.training.preset.unwrap_or(if device.info().is_cpu { Preset::Draft } else { Preset::Default })
    }

    /// Refuses photos of these (width, height) where the machine lacks the memory.
    pub(super) fn check_budget(
        &self,
        device: &Device,
        sizes: &[(usize, usize)],
        max_size: usize,
    ) -> Result<()> {
        let work = |photos| self.memory_demand(self.preset_on(device), photos);
        budget::check(&budget::Limits::now(device.info()), sizes, max_size, work)
    }

    /// Number of photos of these (width, height) for which the machine has the memory.
    pub(super) fn most_photos(&self, device: &Device, sizes: &[(usize, usize)], max_size: usize) -> usize {
        let work = |photos| self.memory_demand(self.preset_on(device), photos);
        budget::most_photos(&budget::Limits::now(device.info()), sizes, max_size, work)
    }

    fn memory_demand(&self, preset: Preset, photos: usize) -> budget::MemoryDemand {
        match &self.language {
            Some(language) => budget::MemoryDemand::language(
                language.feature_dim(self.training.preset),
                language.per_level(),
                preset,
                photos,
            ),
            None => budget::MemoryDemand::colour(preset, photos),
        }
    }

    /// The colour stage.
    pub(super) fn rgb_options(&self, preset: Preset, device: &Device, photos: usize) -> RgbOptions {
        let mut options = budget::rgb_options(preset, photos);
        let demand = self.memory_demand(preset, photos);
        options.limit_splats(budget::most_splats(device.info(), demand.features));
        options.seed = self.training.seed;
        if let Some(n) = self.training.iterations {
            options = options.with_iterations(n);
        }
        self.trained_colours(options)
    }

    /// Colours that depend on the direction. A method that trains no colours has none.
    pub(super) fn view_dependent_options(&self, preset: Preset) -> ViewDependentOptions {
        let trains = self.trained_colours(RgbOptions::preset(preset)).iterations > 0;
        let degree = if trains { self.training.sh_degree } else { Some(0) };
        ViewDependentOptions::preset(preset, degree, self.training.seed)
    }

    /// The options with the steps of the language method; some methods train no colours.
    fn trained_colours(&self, options: RgbOptions) -> RgbOptions {
        match &self.language {
            Some(language) => language.recipe(self.training.preset).rgb(options),
            None => options,
        }
    }

    /// The language stage; `None` without language.
    pub(super) fn language_options(&self, preset: Preset) -> Option<LanguageOptions> {
        let language = self.language.as_ref()?;
        let mut options = LanguageOptions::preset(preset);
        options.seed = self.training.seed;
        options.per_level |= language.per_level();
        options.iterations = language.language_iterations.unwrap_or(options.iterations);
        Some(options)
    }
}
