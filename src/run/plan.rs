//! What to run, and what follows from it for the stages.
use super::budget;
use super::compat::Compat;
use super::method::{FEATURE_DIM, Method, Recipe};
use super::sources::{self, SourceChoice};
use crate::Result;
use crate::fit::{LanguageOptions, Preset, RgbOptions, ViewDependentOptions};
use crate::gpu::Device;
use crate::infer::{Compute, Registry};
use crate::language::sam::SamOptions;
use crate::scene::GivenCamera;
use std::path::{Path, PathBuf};

/// Training states are some ten megabytes for scenes of a few photos: written in a fraction of a
/// second.
pub const CHECKPOINT_SECONDS: u64 = 30;

/// What to do, with every default that does not depend on the machine resolved.
#[derive(Clone, Debug, serde::Serialize)]
pub struct RunPlan {
    /// Photos or folders of photos.
    pub inputs: Vec<PathBuf>,
    /// A scene directory that the photos join, instead of making a scene of their own.
    pub add: Option<PathBuf>,
    /// How many to use; `None` = as many as there are, at most [`photo::DEFAULT_VIEWS`].
    pub views: Option<usize>,
    /// Scene directory.
    pub out: PathBuf,
    /// Folder of a mask per photo; `None` = one beside the photos, where there is any.
    pub photo_masks: Option<PathBuf>,
    /// Replace an existing scene.
    pub force: bool,
    /// Use the stages that an earlier run with the same photos and settings has finished.
    pub resume: bool,
    /// Seconds between states of training on disk.
    pub checkpoint_seconds: u64,
    /// `None` = draft on a CPU device, default elsewhere.
    pub preset: Option<Preset>,
    /// Cameras and points.
    pub init: SourceChoice,
    /// Depth suggested where stereo finds none.
    pub depth_prior: SourceChoice,
    /// Known cameras in memory, one per photo with its name, instead of those of `init`.
    #[serde(skip)]
    pub cameras: Vec<GivenCamera>,
    /// Dense matches.
    pub matcher: SourceChoice,
    /// Masks.
    pub masks: SourceChoice,
    /// Prompts of a mask network.
    pub sam: SamOptions,
    /// Features.
    pub features: SourceChoice,
    /// Texts to answer once the scene is there.
    pub queries: Vec<String>,
    /// Seed of everything random.
    pub seed: u64,
    /// Steps of the colour stage instead of the preset's.
    pub iterations: Option<usize>,
    /// Steps of the language stage instead of the preset's.
    pub language_iterations: Option<usize>,
    /// SH degree of the colours, 0–3; `None` = what the photos support, and 0 in the paper's
    /// preset.
    pub sh_degree: Option<u32>,
    /// What gets language onto the splats; `None` = [`Method::by_default`].
    pub method: Option<&'static Method>,
    /// Length of the codes.
    pub feature_dim: usize,
    /// One model per level.
    pub per_level: bool,
    /// What is done as others do it; masks, code length and models of it stand in their own fields.
    pub compat: Option<&'static Compat>,
    /// Greatest side of the working images, pixels; `None` = [`photo::default_max_size`] of the
    /// device.
    pub max_size: Option<usize>,
    /// Vulkan device.
    pub device: Option<String>,
    /// The same bits on every run: see [`crate::gpu::Options`].
    pub deterministic: bool,
    /// Folder of the models.
    pub models: Option<PathBuf>,
    /// What computes the networks, one of [`crate::infer::provider::NAMES`]; `None` = see
    /// [`Compute::by`].
    pub provider: Option<String>,
}

impl Default for RunPlan {
    /// Built-in models, everything else as the device suggests; no inputs, and nowhere to write.
    fn default() -> Self {
        RunPlan {
            inputs: Vec::new(),
            add: None,
            views: None,
            out: PathBuf::new(),
            photo_masks: None,
            force: false,
            resume: false,
            checkpoint_seconds: CHECKPOINT_SECONDS,
            preset: None,
            init: sources::default::<sources::GeometrySources>(),
            depth_prior: sources::default::<sources::DepthSources>(),
            cameras: Vec::new(),
            matcher: sources::default::<sources::MatchSources>(),
            masks: sources::default::<sources::MaskSources>(),
            sam: SamOptions::default(),
            features: sources::default::<sources::FeatureSources>(),
            queries: Vec::new(),
            seed: 0,
            iterations: None,
            language_iterations: None,
            sh_degree: None,
            method: None,
            feature_dim: FEATURE_DIM,
            per_level: false,
            compat: None,
            max_size: None,
            device: None,
            deterministic: false,
            models: None,
            provider: None,
        }
    }
}

impl RunPlan {
    /// The plan with what a `compat` decides beside the length of the codes
    /// ([`super::compat::feature_dim`]).
    pub fn compatible(self, compat: Option<&'static Compat>) -> RunPlan {
        RunPlan {
            per_level: self.per_level || compat.is_some_and(|c| c.per_level),
            sam: SamOptions { paint_in_order: compat.is_some_and(|c| c.paint_in_order), ..self.sam },
            compat,
            ..self
        }
    }

    /// The files and folders that the run reads.
    pub fn read(&self) -> impl Iterator<Item = &Path> {
        let sources = [&self.init, &self.depth_prior, &self.matcher, &self.masks, &self.features];
        let arguments = sources.into_iter().filter_map(|s| s.argument.as_deref());
        let folders = [&self.add, &self.models, &self.photo_masks].into_iter().flatten();
        self.inputs.iter().map(PathBuf::as_path).chain(arguments).chain(folders.map(PathBuf::as_path))
    }

    /// The method that is asked for, or else the one that suits the plan.
    pub fn method(&self) -> &'static Method {
        let suiting = || Method::by_default(self.preset, self.language_iterations, self.per_level);
        self.method.unwrap_or_else(suiting)
    }

    /// What the method does, with the plan's code length.
    pub fn recipe(&self) -> Recipe {
        let recipe = self.method().recipe;
        let align = self.compat.map_or(recipe.align, |c| c.align);
        Recipe { feature_dim: self.feature_dim, align, ..recipe }
    }

    /// The models that the plan names.
    pub fn registry(&self) -> Result<Registry> {
        Registry::with(self.models.as_deref(), Compute::by(self.provider.as_deref()))
    }

    /// The preset, or the device's.
    pub(super) fn preset_on(&self, device: &Device) -> Preset {
        self.preset.unwrap_or(if device.info().is_cpu { Preset::Draft } else { Preset::Default })
    }

    /// Refuses photos of these (width, height) where they cannot be worked with at that size.
    pub(super) fn check_budget(
        &self,
        device: &Device,
        sizes: &[(usize, usize)],
        max_size: usize,
    ) -> Result<()> {
        let work = self.work(self.preset_on(device), sizes.len());
        budget::check(&budget::Limits::now(device.info()), sizes, max_size, &work)
    }

    fn work(&self, preset: Preset, photos: usize) -> budget::MemoryDemand {
        budget::MemoryDemand::language(self.feature_dim, self.per_level, preset, photos)
    }

    /// The colour stage.
    pub(super) fn rgb_options(&self, preset: Preset, device: &Device, photos: usize) -> RgbOptions {
        let mut options = RgbOptions::preset(preset);
        let work = self.work(preset, photos);
        options.limit_splats(budget::most_splats(device.info(), work.features), work.splats);
        options.seed = self.seed;
        if let Some(n) = self.iterations {
            options = options.with_iterations(n);
        }
        self.recipe().rgb(options)
    }

    /// Colours that depend on the direction. A method that trains no colours has none.
    pub(super) fn view_dependent_options(&self, preset: Preset) -> ViewDependentOptions {
        let trains = self.recipe().rgb(RgbOptions::preset(preset)).iterations > 0;
        let degree = if trains { self.sh_degree } else { Some(0) };
        ViewDependentOptions::preset(preset, degree, self.seed)
    }

    /// The language stage.
    pub(super) fn language_options(&self, preset: Preset) -> LanguageOptions {
        let mut options = LanguageOptions::preset(preset);
        options.seed = self.seed;
        options.per_level |= self.per_level;
        options.iterations = self.language_iterations.unwrap_or(options.iterations);
        options
    }
}
