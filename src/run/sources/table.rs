//! Tables of sources, and their lookup.
use crate::infer::installed::{Installed, Inventory, Task, catalogue};
use crate::infer::{PackFileKind, Registry};
use crate::language::sam::SamOptions;
use crate::photo::Photo;
use crate::pipeline::{Graph, Output};
use crate::preset::Preset;
use crate::run::config::{LanguageConfig, ReconstructionConfig};
use crate::run::stages::PlacedPhotos;
use crate::{Error, Result, pose};
use std::fmt;
use std::path::{Path, PathBuf};

/// A source as users write it: `NAME`, or `NAME:ARGUMENT`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceChoice {
    /// Name of an entry of the table, or of an installed network or its family.
    pub name: String,
    /// The file or folder, for entries that take one.
    pub argument: Option<PathBuf>,
}

impl SourceChoice {
    /// Choice without argument.
    pub fn named(name: &str) -> SourceChoice {
        SourceChoice { name: name.to_owned(), argument: None }
    }

    /// Choice with its file or folder.
    pub fn with(name: &str, argument: impl Into<PathBuf>) -> SourceChoice {
        SourceChoice { name: name.to_owned(), argument: Some(argument.into()) }
    }

    fn path(&self) -> &Path {
        self.argument.as_deref().unwrap_or(Path::new(""))
    }
}

impl fmt::Display for SourceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.argument {
            Some(argument) => write!(f, "{}:{}", self.name, argument.display()),
            None => f.write_str(&self.name),
        }
    }
}

impl From<&str> for SourceChoice {
    fn from(text: &str) -> SourceChoice {
        match text.split_once(':') {
            Some((name, argument)) => SourceChoice::with(name, argument),
            None => SourceChoice::named(text),
        }
    }
}

impl<'de> serde::Deserialize<'de> for SourceChoice {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> std::result::Result<SourceChoice, D::Error> {
        Ok(String::deserialize(from)?.as_str().into())
    }
}

impl serde::Serialize for SourceChoice {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// A kind of data with several sources: a command-line option, and the table behind it.
pub trait SourceKind: 'static {
    /// Name of the option, without dashes.
    const OPTION: &'static str;
    /// Subject of the option, for `--help`.
    const ABOUT: &'static str;
    /// Task of a network that can be a source.
    const TASK: Task;
    /// Sources that need no network of the user; `auto` takes the first if none is installed.
    const SOURCES: &'static [Source<Self>];
    /// Input of a source.
    type Input<'i>;
    /// Output of a source: a loaded model, or stages that are added to the graph.
    type Output;
    /// Makes the output with an installed network.
    fn network(model: Installed, input: Self::Input<'_>) -> Result<Self::Output>;
}

/// An entry of a table.
pub struct Source<K: SourceKind + ?Sized> {
    /// Name on the command line.
    pub name: &'static str,
    /// Placeholder of the argument for `--help`; `None` for a source without argument.
    pub argument: Option<&'static str>,
    /// Explanation beside the name; may be empty.
    pub about: &'static str,
    /// Required models of the default pack.
    pub needs: &'static [PackFileKind],
    /// Validates the argument before any work.
    pub check: fn(&Path, &Given) -> Result<()>,
    /// Makes the output; the path is the argument.
    pub make: fn(&Path, K::Input<'_>) -> Result<K::Output>,
}

/// Check of sources that have nothing to validate.
pub(super) const NO_CHECK: fn(&Path, &Given) -> Result<()> = |_, _| Ok(());

/// Data for checks before any work.
pub struct Given<'a> {
    /// Photos of the run.
    pub photos: &'a [Photo],
    /// The chosen source of masks.
    pub masks: &'a SourceChoice,
    /// The chosen source of features.
    pub features: &'a SourceChoice,
}

/// A graph that sources add their stages to.
pub struct GraphBuilder {
    /// The stages so far.
    pub graph: Graph<'static>,
    /// Installed models.
    pub registry: Registry,
    /// Prompts of a mask network.
    pub sam: SamOptions,
    /// Whether features are read with the masks.
    pub given_features: bool,
    /// Source of depth priors for stereo.
    pub depth_prior: SourceChoice,
    /// Trade-off of time and quality.
    pub preset: Preset,
    /// Seed of cameras and depth.
    pub seed: u64,
}

impl GraphBuilder {
    /// An empty graph for a configuration.
    pub fn new(config: &ReconstructionConfig, preset: Preset, registry: &Registry) -> GraphBuilder {
        let language = config.language.as_ref();
        GraphBuilder {
            graph: Graph::default(),
            registry: registry.clone(),
            sam: language.map_or_else(SamOptions::default, LanguageConfig::sam),
            given_features: language.is_some_and(|l| l.features.argument.is_some()),
            depth_prior: config.geometry.depth_prior.clone(),
            preset,
            seed: config.training.seed,
        }
    }
}

/// Photos with their geometry, as stages of a graph.
#[derive(Clone, Copy)]
pub struct PosedPhotos {
    /// Photos without distortion, in one light.
    pub placed: Output<PlacedPhotos>,
    /// Cameras, depth and points.
    pub geometry: Output<pose::Geometry>,
}

fn built_in<K: SourceKind>(choice: &SourceChoice) -> Option<&'static Source<K>> {
    K::SOURCES.iter().find(|s| s.name == choice.name)
}

/// The network behind a choice, `None` for a built-in source.
pub fn installed<K: SourceKind>(choice: &SourceChoice, registry: &Registry) -> Result<Option<Installed>> {
    match built_in::<K>(choice) {
        Some(_) => Ok(None),
        None => registry.installed(K::TASK, &choice.name).map(Some),
    }
}

/// Validates the chosen source before any work.
pub fn check<K: SourceKind>(choice: &SourceChoice, given: &Given, registry: &Registry) -> Result<()> {
    let Some(source) = built_in::<K>(choice) else { return Ok(()) };
    source.needs.iter().try_for_each(|role| registry.path(*role).map(drop))?;
    (source.check)(choice.path(), given)
}

/// Makes the output of the chosen source.
pub fn make<K: SourceKind>(
    choice: &SourceChoice,
    registry: &Registry,
    input: K::Input<'_>,
) -> Result<K::Output> {
    match built_in::<K>(choice) {
        Some(source) => (source.make)(choice.path(), input),
        None => K::network(registry.installed(K::TASK, &choice.name)?, input),
    }
}

/// Choice without an option and without a network: the first of the table.
pub fn default<K: SourceKind>() -> SourceChoice {
    K::SOURCES.first().map_or_else(|| SourceChoice::named(""), |s| SourceChoice::named(s.name))
}

/// Parses a choice: `auto`, an entry of the table, the name of an installed network, or the name or
/// family of one of the catalogue. Files and folders must exist.
pub fn choose<K: SourceKind>(text: &str, networks: &Inventory) -> Result<SourceChoice> {
    if text == "auto" {
        let best = networks.best(K::TASK).map(|model| SourceChoice::named(&model.name));
        return Ok(best.unwrap_or_else(default::<K>));
    }
    let (name, argument) = text.split_once(':').map_or((text, None), |(name, path)| (name, Some(path)));
    let source = K::SOURCES.iter().find(|s| s.name == name);
    let is_installed = || networks.models.iter().any(|m| m.tasks.contains(&K::TASK) && m.name == name);
    let is_known = || catalogue().iter().any(|k| k.does(K::TASK) && (k.family == name || k.id == name));
    match (source.map(|s| s.argument), argument) {
        (Some(None), None) => Ok(SourceChoice::named(name)),
        (Some(Some(_)), Some(path)) if !path.is_empty() && Path::new(path).exists() => {
            Ok(SourceChoice::with(name, path))
        }
        (Some(Some(_)), Some(path)) if !path.is_empty() => {
            Err(Error::input(format!("--{}: {path} does not exist; check the path", K::OPTION)))
        }
        (None, None) if is_known() || is_installed() => Ok(SourceChoice::named(name)),
        _ => {
            let own = K::SOURCES.iter().map(Source::syntax);
            let choices: Vec<String> = std::iter::once("auto".to_owned()).chain(own).collect();
            let families = families(K::TASK).into_iter().filter(|f| K::SOURCES.iter().all(|s| s.name != *f));
            let choices =
                choices.into_iter().chain(families.map(str::to_owned)).collect::<Vec<_>>().join(", ");
            Err(Error::input(format!("--{} {text}: unknown; use one of: {choices}", K::OPTION)))
        }
    }
}

/// Help text of the option.
pub fn help<K: SourceKind>() -> String {
    let first = K::SOURCES.first().map_or("", |s| s.name);
    let own = K::SOURCES.iter().map(|s| match s.about {
        "" => s.syntax(),
        about => format!("{} ({about})", s.syntax()),
    });
    format!(
        "{}: auto (the best network installed, else {first}), {}, or an installed network: {}",
        K::ABOUT,
        own.collect::<Vec<_>>().join(", "),
        families(K::TASK).join(", ")
    )
}

/// Line of an option for `splatvk doctor`: (option, choice of `auto` and all choices).
pub(super) fn listed<K: SourceKind>(networks: &Inventory) -> (String, String) {
    let auto = networks.best(K::TASK).map_or(K::SOURCES.first().map_or("", |s| s.name), |m| &m.name);
    let own = K::SOURCES.iter().map(Source::syntax);
    let brought = networks.models.iter().filter(|m| m.tasks.contains(&K::TASK)).map(|m| m.name.clone());
    let all = own.chain(brought).collect::<Vec<_>>().join(", ");
    (format!("--{}", K::OPTION), format!("auto takes {auto} · there are {all}"))
}

fn families(task: Task) -> Vec<&'static str> {
    let mut all: Vec<&str> = Vec::new();
    for model in catalogue().iter().filter(|k| k.does(task)) {
        if !all.contains(&model.family.as_str()) {
            all.push(&model.family);
        }
    }
    all
}

impl<K: SourceKind> Source<K> {
    /// Name with the placeholder of the argument.
    pub fn syntax(&self) -> String {
        self.argument.map_or_else(|| self.name.to_owned(), |argument| format!("{}:{argument}", self.name))
    }
}
