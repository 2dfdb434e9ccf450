//! What a row of a table takes: photos, sources, method, lengths of training.
use serde::Serialize;
use splatvk::run::method::Recipe;
use splatvk::run::sources::{
    self, FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind,
};
use std::path::PathBuf;

/// Where cameras, matches, masks and features come from in the rows that do not vary them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sources {
    /// Cameras and points, as `--init`.
    pub init: SourceChoice,
    /// Dense matches, as `--matcher`.
    pub matcher: SourceChoice,
    /// As `--masks`.
    pub masks: SourceChoice,
    /// As `--features`.
    pub features: SourceChoice,
}

impl Default for Sources {
    fn default() -> Self {
        Sources {
            init: sources::default::<GeometrySources>(),
            matcher: sources::default::<MatchSources>(),
            masks: sources::default::<MaskSources>(),
            features: sources::default::<FeatureSources>(),
        }
    }
}

impl Sources {
    /// What they find in the photos.
    pub fn regions(&self) -> Regions {
        Regions::Found { masks: self.masks.clone(), features: self.features.clone() }
    }
}

/// Where masks and features come from.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Regions {
    /// Found in the photos, or read from a folder.
    Found {
        /// As `--masks`.
        masks: SourceChoice,
        /// As `--features`.
        features: SourceChoice,
    },
    /// True masks and synthetic features.
    Exact,
    /// The same with the usual errors injected, drawn from the seed of the run.
    Flawed,
    /// True masks, each with the embedding of its own label by these features' text model.
    TrueSegmentation {
        /// As `--features`.
        features: SourceChoice,
    },
}

impl Regions {
    /// What `splatvk run` uses on its own.
    pub fn built_in() -> Regions {
        Sources::default().regions()
    }

    /// Masks and features from a folder.
    pub fn given(dir: PathBuf) -> Regions {
        Regions::Found { masks: SourceChoice::with("dir", &dir), features: SourceChoice::with("dir", dir) }
    }

    /// For the rows of a table.
    pub fn name(&self) -> String {
        match self {
            regions if *regions == Regions::built_in() => "built-in".into(),
            Regions::Exact => "exact".into(),
            Regions::Flawed => "flawed".into(),
            Regions::TrueSegmentation { .. } => "true segmentation".into(),
            Regions::Found { masks, features } if masks == features => features.to_string(),
            Regions::Found { masks, features } => format!("{masks} + {features}"),
        }
    }
}

/// Everything that a row decides.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Setup {
    /// Photos.
    pub views: usize,
    /// Cameras and points.
    pub init: SourceChoice,
    /// The true cameras of the data set, and stereo, instead of `init`.
    pub true_cameras: bool,
    /// Dense matches for the alignment.
    pub matcher: SourceChoice,
    /// Most stereo points that splats start from; none = the preset's.
    pub max_points: Option<usize>,
    /// Masks and features.
    pub regions: Regions,
    /// Method, or a variation of it.
    pub recipe: Recipe,
    /// Steps of the colour stage.
    pub iterations: usize,
    /// Steps of the language stage.
    pub language_iterations: usize,
}

/// What a row takes.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum RowWork {
    /// All of it, scored.
    Score(Setup),
    /// Nothing is trained: the bytes that features of full length would take are stated.
    MemoryOnly(Setup),
    /// No scene: every few pixels of the scored photos are described by these features and asked
    /// directly.
    Flat(SourceChoice),
    /// Nothing; the note says why.
    Nothing,
}

/// One row before it ran.
#[derive(Clone, Debug)]
pub struct TableRow {
    /// What this row is, within its group.
    pub label: String,
    /// Rows are compared within their group.
    pub group: String,
    /// What to run.
    pub runs: RowWork,
    /// What the reader should know about this row.
    pub note: String,
}

/// A network that a table compares.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    /// As the options call it: its own name where it is installed, else that of its family.
    pub name: String,
    /// What several networks of one kind share.
    pub family: String,
    /// What `splatvk models fetch` calls it, where no trained one of its family is on this machine.
    pub fetch: Option<String>,
}

/// What a machine and a data set have for the tables to compare.
#[derive(Clone, Debug, Default)]
pub struct Available {
    /// Frames that may be photos.
    pub views: usize,
    /// True cameras are known.
    pub cameras: bool,
    /// Every installed network, and every known family of which none is.
    pub geometry: Vec<Network>,
    /// The same for dense matches.
    pub matchers: Vec<Network>,
    /// The same for masks.
    pub masks: Vec<Network>,
    /// The same for features.
    pub features: Vec<Network>,
}

/// Rows under the same regions.
pub(super) struct Group<'a> {
    /// The default of the rows.
    pub(super) base: Setup,
    pub(super) sources: &'a Sources,
    pub(super) available: &'a Available,
}

impl Group<'_> {
    pub(super) fn row(&self, label: &str, setup: Setup) -> TableRow {
        TableRow {
            label: label.to_owned(),
            group: self.base.regions.name(),
            runs: RowWork::Score(setup),
            note: String::new(),
        }
    }

    pub(super) fn recipe(&self, label: &str, recipe: Recipe) -> TableRow {
        self.row(label, Setup { recipe, ..self.base.clone() })
    }

    /// A row for the source that needs no network, one for every network that is installed, and one
    /// that says how to get it for every other.
    pub(super) fn each<K: SourceKind>(
        &self,
        networks: &[Network],
        setup: impl Fn(SourceChoice) -> Setup,
    ) -> Vec<TableRow> {
        let own = sources::default::<K>();
        let mut rows = vec![self.row(&own.name, setup(own.clone()))];
        rows.extend(networks.iter().map(|network| {
            let row = self.row(&network.name, setup(SourceChoice::named(&network.name)));
            self.if_installed(row, network)
        }));
        rows
    }

    /// A network has a row also where it is not, which says so.
    pub(super) fn if_installed(&self, row: TableRow, network: &Network) -> TableRow {
        match &network.fetch {
            None => row,
            Some(id) => {
                let note = format!("not installed: splatvk models fetch {id}");
                TableRow { runs: RowWork::Nothing, note, ..row }
            }
        }
    }

    /// The same with the reason why it cannot run here.
    pub(super) fn impossible(row: TableRow, note: String) -> TableRow {
        TableRow { runs: RowWork::Nothing, note, ..row }
    }
}
