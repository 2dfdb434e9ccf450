//! The configuration of a reconstruction: every setting that changes its result, with its default.
//!
//! The command line flattens these structures into its options, the C structure maps to them once,
//! and `run.json` stores them. Photos, files and machine are apart from it (`run::plan`).
use super::compat::{self, Compat};
use super::ignored;
use super::method::{Method, Recipe};
use super::paper::{self, PaperSources};
use super::sources::{
    self, DepthSources, FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind,
};
#[cfg(feature = "cli")]
pub use super::whole::whole;
use crate::fit::Preset;
use crate::infer::installed::Inventory;
use crate::language::Reducer;
use crate::language::sam::SamOptions;
use crate::{Error, Result};
#[cfg(feature = "cli")]
pub use arguments::compat_names;
use serde::{Deserialize, Serialize};

/// Every setting that changes the result of a reconstruction. By default sources are built in, and
/// the device and the photos determine the rest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReconstructionConfig {
    /// Cameras, depth and points.
    #[serde(flatten)]
    pub geometry: GeometryConfig,
    /// Working size and training of the splats.
    #[serde(flatten)]
    pub training: TrainingConfig,
    /// Masks, features and codes; `None`: a scene of colours alone.
    #[serde(flatten, with = "optional_language")]
    pub language: Option<LanguageConfig>,
}

/// Sources of cameras, depth and points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::Args), command(next_help_heading = SOURCES))]
#[serde(default)]
pub struct GeometryConfig {
    /// Source of cameras, depth and points
    #[cfg_attr(feature = "cli", arg(long, default_value = AUTO, value_name = "SOURCE", help = sources::help::<GeometrySources>()))]
    pub init: SourceChoice,
    /// Source of depth where photos cannot be matched
    #[cfg_attr(feature = "cli", arg(long, default_value = AUTO, value_name = "SOURCE", help = sources::help::<DepthSources>()))]
    pub depth_prior: SourceChoice,
}

/// Use and working size of the photos, and training of the splats.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
#[serde(default)]
pub struct TrainingConfig {
    /// Time against quality [default: draft on a CPU device, default on a GPU]
    #[cfg_attr(feature = "cli", arg(long, value_parser = arguments::presets(), value_name = "PRESET"))]
    pub preset: Option<Preset>,
    /// Longer side of the working images in pixels; larger photos are scaled down, none is enlarged
    /// [default: 800 on a CPU device, 1600 on a GPU]
    #[cfg_attr(feature = "cli", arg(long, value_name = "N", value_parser = whole::<usize>(crate::photo::SMALLEST_SIDE as u64..)))]
    pub max_size: Option<usize>,
    /// Optimisation steps of the colour stage, instead of the preset's
    #[cfg_attr(feature = "cli", arg(long, value_name = "N", value_parser = whole::<usize>(1..), help_heading = EXPERTS))]
    pub iterations: Option<usize>,
    /// Spherical-harmonics degree of the colours, which then depend on the direction [default: what
    /// photos support that are left out for a test; 0 for fewer than four photos]
    #[cfg_attr(feature = "cli", arg(long, value_name = "0-3", value_parser = whole::<u32>(0..=3), help_heading = EXPERTS))]
    pub sh_degree: Option<u32>,
    /// Ignore a thing in all photos, as a mask does: what comes and goes, such as a person or a car;
    /// may be repeated
    #[cfg_attr(feature = "cli", arg(long, value_name = "TEXT"))]
    pub ignore: Vec<String>,
    /// Seed of everything random
    #[cfg_attr(feature = "cli", arg(long, default_value_t = 0, value_name = "N", value_parser = whole::<u64>(0..), help_heading = EXPERTS))]
    pub seed: u64,
    /// Same bits on every run on one machine: training adds up gradients in a fixed order, about a
    /// tenth slower
    #[cfg_attr(feature = "cli", arg(long, help_heading = EXPERTS))]
    pub deterministic: bool,
}

/// Masks, features and codes of the language on the splats.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::Args), command(next_help_heading = SOURCES))]
#[serde(default)]
pub struct LanguageConfig {
    /// Source of dense matches
    #[cfg_attr(feature = "cli", arg(long, default_value = AUTO, value_name = "SOURCE", help = sources::help::<MatchSources>()))]
    pub matcher: SourceChoice,
    /// Source of masks
    #[cfg_attr(feature = "cli", arg(long, default_value = AUTO, value_name = "SOURCE", help = sources::help::<MaskSources>()))]
    pub masks: SourceChoice,
    /// Source of features
    #[cfg_attr(feature = "cli", arg(long, default_value = AUTO, value_name = "SOURCE", help = sources::help::<FeatureSources>()))]
    pub features: SourceChoice,
    /// Points along each side of a photo at which a mask network is asked
    #[cfg_attr(feature = "cli", arg(long, default_value_t = MASK_POINTS, value_name = "N", value_parser = whole::<usize>(1..=128)))]
    pub mask_points: usize,
    /// Do not ask the mask network about four overlapping crops as well: five times faster, misses
    /// small things
    #[cfg_attr(feature = "cli", arg(long))]
    pub no_mask_crops: bool,
    /// Optimisation steps of the language stage, instead of the preset's
    #[cfg_attr(feature = "cli", arg(long, value_name = "N", value_parser = whole::<usize>(1..), help_heading = EXPERTS))]
    pub language_iterations: Option<usize>,
    /// Length of the codes that splats carry: 3, 8 or 16 [default: 16; --compat and langsplat 3,
    /// legaussians 8]
    #[cfg_attr(feature = "cli", arg(long, value_name = "D", value_parser = whole::<usize>(3..=16), help_heading = EXPERTS))]
    pub feature_dim: Option<usize>,
    /// How language gets onto the splats: this program's ways, or a baseline on the same geometry
    /// to compare with [default: lift; sparselgs with --preset paper, --language-iterations,
    /// --per-level or --compat]
    #[cfg_attr(feature = "cli", arg(long, value_parser = arguments::methods(), value_name = "METHOD", help_heading = EXPERTS))]
    pub method: Option<&'static Method>,
    /// One model per level as in the paper, instead of one geometry for all three
    #[cfg_attr(feature = "cli", arg(long, help_heading = EXPERTS))]
    pub per_level: bool,
    /// Do what can be done in several ways as the paper, its authors' code or LangSplat: area score
    /// and conditions of the alignment, order of masks, one model per level, 3 numbers per code,
    /// level and mask of answers
    #[cfg_attr(feature = "cli", arg(long, value_parser = arguments::compat(), default_value = compat::NONE, hide_default_value = true, value_name = "WHOSE", help_heading = EXPERTS))]
    pub compat: CompatChoice,
    /// The paper's method as published: --preset paper (1000 steps with pruning and density control,
    /// then 1000 per level from zero), --compat paper, and only the paper's networks
    #[cfg_attr(feature = "cli", arg(long, conflicts_with_all = ["method", "feature_dim", "iterations", "language_iterations"], help_heading = EXPERTS))]
    pub paper: bool,
    /// Networks with --paper
    #[cfg_attr(feature = "cli", arg(long, value_enum, default_value_t, hide_default_value = true, requires = "paper", value_name = "WHICH", help_heading = EXPERTS))]
    pub paper_sources: PaperSources,
}

/// The choices of another implementation that are reproduced, if any.
pub type CompatChoice = Option<&'static Compat>;

/// Heading of the options about sources of data.
#[cfg(feature = "cli")]
const SOURCES: &str = "Sources and networks";
/// Heading of the options that few need.
#[cfg(feature = "cli")]
pub const EXPERTS: &str = "For experts";
/// The best installed network, else the first built-in source.
const AUTO: &str = "auto";
/// Points along each side of a photo at which a mask network is asked.
pub const MASK_POINTS: usize = 32;

impl Default for ReconstructionConfig {
    fn default() -> Self {
        ReconstructionConfig {
            geometry: GeometryConfig::default(),
            training: TrainingConfig::default(),
            language: Some(LanguageConfig::default()),
        }
    }
}

impl Default for GeometryConfig {
    fn default() -> Self {
        GeometryConfig {
            init: sources::default::<GeometrySources>(),
            depth_prior: sources::default::<DepthSources>(),
        }
    }
}

impl Default for LanguageConfig {
    fn default() -> Self {
        LanguageConfig {
            matcher: sources::default::<MatchSources>(),
            masks: sources::default::<MaskSources>(),
            features: sources::default::<FeatureSources>(),
            mask_points: MASK_POINTS,
            no_mask_crops: false,
            language_iterations: None,
            feature_dim: None,
            method: None,
            per_level: false,
            compat: None,
            paper: false,
            paper_sources: PaperSources::Own,
        }
    }
}

impl ReconstructionConfig {
    /// The configuration with every source named: `auto` becomes the best installed network, or
    /// else the first built-in source.
    ///
    /// # Errors
    /// Unknown sources, files that do not exist, and settings that contradict each other.
    pub fn resolved(mut self, installed: &Inventory) -> Result<ReconstructionConfig> {
        if let Some(language) = self.language.as_mut().filter(|language| language.paper) {
            paper::apply(&mut self.geometry, &mut self.training, language, installed)?;
        }
        let GeometryConfig { init, depth_prior } = &mut self.geometry;
        resolve::<GeometrySources>(init, installed)?;
        // A geometry network gives depth itself.
        let by_stereo = GeometrySources::SOURCES.iter().any(|s| s.name == init.name);
        if *depth_prior == SourceChoice::named(AUTO) && !by_stereo {
            *depth_prior = sources::default::<DepthSources>();
        }
        resolve::<DepthSources>(depth_prior, installed)?;
        if let Some(language) = &mut self.language {
            resolve::<MatchSources>(&mut language.matcher, installed)?;
            resolve::<MaskSources>(&mut language.masks, installed)?;
            resolve::<FeatureSources>(&mut language.features, installed)?;
            let preset = self.training.preset;
            language.method = Some(language.method(preset));
            language.feature_dim = Some(language.feature_dim(preset));
            language.per_level = language.per_level();
        }
        self.check()?;
        Ok(self)
    }

    /// Refuses values out of range, and settings that contradict each other.
    ///
    /// # Errors
    /// A setting, with the values that can be given.
    pub fn check(&self) -> Result<()> {
        ignored::check(&self.training.ignore)?;
        match &self.language {
            Some(language) => language.check(self.training.preset),
            None => Ok(()),
        }
    }

    /// Every source that is chosen.
    pub fn sources(&self) -> impl Iterator<Item = &SourceChoice> {
        let language = self.language.iter().flat_map(|l| [&l.matcher, &l.masks, &l.features]);
        [&self.geometry.init, &self.geometry.depth_prior].into_iter().chain(language)
    }
}

fn resolve<K: SourceKind>(choice: &mut SourceChoice, installed: &Inventory) -> Result<()> {
    *choice = sources::choose::<K>(&choice.to_string(), installed)?;
    Ok(())
}

impl LanguageConfig {
    /// The method, or else the one that suits the other settings.
    pub fn method(&self, preset: Option<Preset>) -> &'static Method {
        self.method.unwrap_or_else(|| Method::by_default(preset, self.language_iterations, self.per_level()))
    }

    /// Length of the codes.
    pub fn feature_dim(&self, preset: Option<Preset>) -> usize {
        self.feature_dim.unwrap_or_else(|| compat::feature_dim(self.compat, &self.method(preset).recipe))
    }

    /// Whether every level has a model of its own.
    pub fn per_level(&self) -> bool {
        self.per_level || self.compat.is_some_and(|c| c.per_level)
    }

    /// The choices of the method, with the code length and the alignment of this configuration.
    pub fn recipe(&self, preset: Option<Preset>) -> Recipe {
        let recipe = self.method(preset).recipe;
        let recipe = self.compat.map_or(recipe, |compat| compat.recipe(recipe));
        Recipe { feature_dim: self.feature_dim(preset), ..recipe }
    }

    /// Prompts of a mask network.
    pub fn sam(&self) -> SamOptions {
        SamOptions {
            points: self.mask_points,
            crops: !self.no_mask_crops,
            paint_in_order: self.compat.is_some_and(|c| c.paint_in_order),
            ..SamOptions::default()
        }
    }

    fn check(&self, preset: Option<Preset>) -> Result<()> {
        let dim = self.feature_dim(preset);
        if ![3, 8, 16].contains(&dim) {
            return Err(Error::input(format!("--feature-dim {dim}: choose 3, 8 or 16")));
        }
        if matches!(self.method(preset).recipe.reducer, Reducer::Autoencoder { .. }) && dim != 3 {
            return Err(Error::input(format!(
                "--feature-dim {dim}: the autoencoder of --method langsplat has 3 dimensions; leave it out"
            )));
        }
        Ok(())
    }
}

/// Language beside the other keys of a record: the method `none` states that there is none.
mod optional_language {
    use super::LanguageConfig;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    #[derive(Serialize)]
    struct NoLanguage {
        method: &'static str,
    }

    pub fn serialize<S: Serializer>(language: &Option<LanguageConfig>, to: S) -> Result<S::Ok, S::Error> {
        match language {
            Some(language) => language.serialize(to),
            None => NoLanguage { method: "none" }.serialize(to),
        }
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<LanguageConfig>, D::Error> {
        #[derive(Deserialize)]
        struct Record {
            method: Option<String>,
            #[serde(flatten)]
            rest: serde_json::Map<String, serde_json::Value>,
        }
        let Record { method, mut rest } = Record::deserialize(from)?;
        if method.as_deref() == Some("none") {
            return Ok(None);
        }
        rest.insert("method".to_owned(), method.into());
        LanguageConfig::deserialize(serde_json::Value::Object(rest))
            .map(Some)
            .map_err(serde::de::Error::custom)
    }
}

/// Parsers of options.
#[cfg(feature = "cli")]
mod arguments {
    use super::CompatChoice;
    use crate::fit::Preset;
    use crate::run::compat::{COMPATS, Compat, NONE};
    use crate::run::method::{METHODS, Method};
    use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

    const PRESETS: [(&str, &str, Preset); 3] = [
        ("draft", "Minutes on a 2-core CPU", Preset::Draft),
        ("default", "Best quality for the time on a GPU", Preset::Default),
        ("paper", "The paper's schedule and constants", Preset::Paper),
    ];

    pub fn presets() -> impl TypedValueParser<Value = Preset> {
        let values = PRESETS.map(|(name, about, _)| PossibleValue::new(name).help(about));
        PossibleValuesParser::new(values)
            .try_map(|given| PRESETS.iter().find(|p| p.0 == given).map(|p| p.2).ok_or("unknown preset"))
    }

    pub fn methods() -> impl TypedValueParser<Value = &'static Method> {
        PossibleValuesParser::new(METHODS.map(|m| PossibleValue::new(m.name).help(m.about)))
            .try_map(|given| Method::named(&given))
    }

    /// Names of other implementations, and `none`.
    pub fn compat_names() -> PossibleValuesParser {
        let own = PossibleValue::new(NONE).help("this program's own way");
        let all = COMPATS.iter().map(|c| PossibleValue::new(c.name).help(c.about));
        PossibleValuesParser::new(all.chain([own]))
    }

    pub fn compat() -> impl TypedValueParser<Value = CompatChoice> {
        compat_names().try_map(|given| Compat::named(&given))
    }
}
