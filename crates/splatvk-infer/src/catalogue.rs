//! The networks that splatvk knows and does not ship, and where their files come from:
//! `catalogue.toml`, the one manifest of what `models list` names and `models fetch` gets.
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

/// What a model does in a run.
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
        }
    }
}

/// A network that splatvk knows and does not ship.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CatalogueEntry {
    /// Folder or beginning of the file names under which it is looked for.
    pub id: String,
    /// What people call it.
    pub name: String,
    /// What it does.
    #[serde(rename = "role")]
    pub task: Task,
    /// What it can do besides.
    #[serde(default, rename = "also")]
    pub other_tasks: Vec<Task>,
    /// What `--init`, `--matcher`, `--masks` or `--features` call it.
    pub family: String,
    /// "paper", "open".
    pub packs: Vec<String>,
    /// Of code and weights.
    pub licence: String,
    /// The licence forbids commercial use.
    #[serde(default)]
    pub non_commercial: bool,
    /// Size of its float32 files.
    pub megabytes: u32,
    /// Where it is from.
    pub source: String,
    /// What writes its ONNX files.
    pub export: String,
    /// Public ONNX files that fit as they are; none where there are none.
    #[serde(default)]
    pub files: Vec<Source>,
    /// How the export script makes the files where no public ones fit.
    pub recipe: Option<Recipe>,
}

/// A file to download.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// Its address.
    pub from: String,
    /// Its name where it is put.
    pub name: String,
    /// Its size, where it is known.
    pub bytes: Option<u64>,
    /// Its content, where it is known; otherwise the first download decides, which is kept in the
    /// model's adapter.
    pub sha256: Option<String>,
}

/// An export script with what it needs.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// File in `tools/export`.
    pub script: String,
    /// What it is told besides `--out`; it runs in the folder of the weights.
    #[serde(default)]
    pub arguments: Vec<String>,
    /// Checkpoints that it reads.
    pub weights: Vec<Source>,
    /// Python packages, beside those of every script ([`common_packages`]).
    #[serde(default)]
    pub packages: Vec<String>,
    /// Packages whose own requirements an export does without.
    #[serde(default)]
    pub bare_packages: Vec<String>,
    /// Git repository with the network's code, where no package holds it.
    pub code: Option<String>,
}

impl CatalogueEntry {
    /// The most bytes that a file of it may have where its size is not known: sizes above are of
    /// all files, as an export writes them, and a checkpoint may hold what training needed besides.
    pub fn ceiling(&self) -> u64 {
        u64::from(self.megabytes) * 2_000_000 + (64 << 20)
    }

    /// Whether it does this, mainly or besides.
    pub fn does(&self, task: Task) -> bool {
        self.task == task || self.other_tasks.contains(&task)
    }
}

/// The text of `catalogue.toml`.
#[derive(Default, Deserialize)]
struct Catalogue {
    common_packages: Vec<String>,
    model: Vec<CatalogueEntry>,
}

fn read() -> &'static Catalogue {
    static KNOWN: OnceLock<Catalogue> = OnceLock::new();
    KNOWN.get_or_init(|| {
        // A test reads the same text; a mistake in it cannot reach users.
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
