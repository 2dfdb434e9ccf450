//! Catalogue of the networks that splatvk supports and does not ship, with the sources of their
//! files: `catalogue.toml`, read by `models list` and `models fetch`.
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

/// Task of a model in a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Task {
    /// Cameras, depth and points.
    Geometry,
    /// Dense matches between photos.
    Matcher,
    /// Masks on three levels.
    Masks,
    /// Features of image regions.
    Features,
    /// Embeddings of texts.
    Text,
    /// Depth of each photo up to scale and shift.
    Depth,
    /// Masks of all instances of a text.
    Concepts,
}

impl Task {
    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Task::Geometry => "geometry",
            Task::Matcher => "matcher",
            Task::Masks => "masks",
            Task::Features => "features",
            Task::Text => "text",
            Task::Depth => "depth",
            Task::Concepts => "concepts",
        }
    }
}

/// A network that splatvk supports and does not ship.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CatalogueEntry {
    /// Name of its folder, or prefix of its file names.
    pub id: String,
    /// Its common name.
    pub name: String,
    /// Its main task.
    #[serde(rename = "role")]
    pub task: Task,
    /// Its other tasks.
    #[serde(default, rename = "also")]
    pub other_tasks: Vec<Task>,
    /// Its name in `--init`, `--matcher`, `--masks`, `--features` or `--concepts`.
    pub family: String,
    /// "paper", "open".
    pub packs: Vec<String>,
    /// Licence of code and weights.
    pub licence: String,
    /// The licence forbids commercial use.
    #[serde(default)]
    pub non_commercial: bool,
    /// Uses that the licence forbids, if these are not the commercial ones.
    pub forbidden: Option<String>,
    /// Size of its float32 files.
    pub megabytes: u32,
    /// Address of its project.
    pub source: String,
    /// Script or address that gives its ONNX files.
    pub export: String,
    /// Public ONNX files that fit unchanged; may be empty.
    #[serde(default)]
    pub files: Vec<Source>,
    /// Export of the files, if no public ones fit.
    pub recipe: Option<Recipe>,
}

/// A file to download.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// Its address.
    pub from: String,
    /// Its local file name.
    pub name: String,
    /// Its size, if known.
    pub bytes: Option<u64>,
    /// Its sha256, if known; else that of the first download is pinned in the model's adapter.
    pub sha256: Option<String>,
}

/// An export script with its requirements.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// File in `tools/export`.
    pub script: String,
    /// Its arguments besides `--out`; it runs in the folder of the weights.
    #[serde(default)]
    pub arguments: Vec<String>,
    /// Checkpoints that it reads.
    pub weights: Vec<Source>,
    /// Python packages, beside those of every script ([`common_packages`]).
    #[serde(default)]
    pub packages: Vec<String>,
    /// Packages that are installed without their requirements.
    #[serde(default)]
    pub bare_packages: Vec<String>,
    /// Git repository with the network's code, if no package has it.
    pub code: Option<String>,
}

impl CatalogueEntry {
    /// Largest size of a file of unknown size, bytes: `megabytes` counts the exported files, and a
    /// checkpoint may also contain the state of training.
    pub fn ceiling(&self) -> u64 {
        u64::from(self.megabytes) * 2_000_000 + (64 << 20)
    }

    /// Uses that its licence forbids; such a model is fetched only where its licence was accepted.
    pub fn forbids(&self) -> Option<&str> {
        if self.non_commercial { Some("commercial use") } else { self.forbidden.as_deref() }
    }

    /// Whether `task` is its main task or one of the others.
    pub fn does(&self, task: Task) -> bool {
        self.task == task || self.other_tasks.contains(&task)
    }
}

/// Contents of `catalogue.toml`.
#[derive(Default, Deserialize)]
struct Catalogue {
    common_packages: Vec<String>,
    model: Vec<CatalogueEntry>,
}

fn read() -> &'static Catalogue {
    static KNOWN: OnceLock<Catalogue> = OnceLock::new();
    KNOWN.get_or_init(|| {
        // A test parses the same text, so an error cannot reach users.
        toml::from_str(include_str!("catalogue.toml")).unwrap_or_default()
    })
}

/// The known networks, in order of preference within a family.
pub fn catalogue() -> &'static [CatalogueEntry] {
    &read().model
}

/// The Python packages that every export script needs.
pub fn common_packages() -> &'static [String] {
    &read().common_packages
}
