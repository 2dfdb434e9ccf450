//! Setups of the rows of a table: photos, sources, method, steps of training.
use super::colmap::Views;
use serde::Serialize;
use splatvk::fit::{LanguageOptions, Preset};
use splatvk::language::sam::SamOptions;
use splatvk::run::Compat;
use splatvk::run::method::Recipe;
use splatvk::run::sources::{
    self, FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind,
};
use std::path::PathBuf;

/// Sources of cameras, matches, masks and features of the rows that do not vary them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sources {
    /// Cameras and points, as of `--init`.
    pub init: SourceChoice,
    /// Dense matches, as of `--matcher`.
    pub matcher: SourceChoice,
    /// Masks, as of `--masks`.
    pub masks: SourceChoice,
    /// Features, as of `--features`.
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
    /// Regions of these sources of masks and features.
    pub fn regions(&self) -> Regions {
        Regions::Found { masks: self.masks.clone(), features: self.features.clone() }
    }
}

/// Masks and features of a setup.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Regions {
    /// Found in the photos, or read from a folder.
    Found {
        /// Masks, as of `--masks`.
        masks: SourceChoice,
        /// Features, as of `--features`.
        features: SourceChoice,
    },
    /// True masks and synthetic features.
    Exact,
    /// True masks and synthetic features with errors at the default rates, drawn from the run's
    /// seed.
    Flawed,
    /// True masks, each with the embedding of its label by the text model of these features.
    TrueSegmentation {
        /// Features, as of `--features`.
        features: SourceChoice,
    },
}

impl Regions {
    /// Default masks and features of `splatvk run`.
    pub fn built_in() -> Regions {
        Sources::default().regions()
    }

    /// Masks and features of a folder.
    pub fn given(dir: PathBuf) -> Regions {
        Regions::Found { masks: SourceChoice::with("dir", &dir), features: SourceChoice::with("dir", dir) }
    }

    /// Name as the group of a table's rows.
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

/// Schedules and rules of all rows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Regime {
    /// Preset of cameras, stereo and training.
    pub preset: Preset,
    /// Choices of another implementation, as of `--compat`.
    pub compat: Option<&'static Compat>,
    /// Whether this is the paper's method with the paper's networks, so that the paper's figures
    /// measure the same.
    pub published: bool,
}

impl Regime {
    /// The draft preset with this program's own rules.
    pub const OWN: Regime = Regime { preset: Preset::Draft, compat: None, published: false };

    /// A recipe with the alignment, code length and storage of the regime.
    pub fn recipe(&self, recipe: Recipe) -> Recipe {
        match self.compat {
            None => recipe,
            Some(compat) => compat.recipe(recipe),
        }
    }

    /// Steps of the language stage. Those of draft hardly leave their lifted start, and methods
    /// differ in the result of training: three times as many.
    pub fn language_iterations(&self) -> usize {
        let steps = LanguageOptions::preset(self.preset).iterations;
        if self.preset == Preset::Draft { 3 * steps } else { steps }
    }

    /// Steps where the image loss is the subject. It protects the geometry, which moves slowly at
    /// the learning rates of this stage: a draft is three times as long, the paper's schedule is
    /// long enough.
    pub fn long_language(&self, iterations: usize) -> usize {
        if self.preset == Preset::Draft { 3 * iterations } else { iterations }
    }

    /// Options of the language stage; all rows train for the same number of steps.
    pub fn language(&self, iterations: usize, seed: u64) -> LanguageOptions {
        let preset = LanguageOptions::preset(self.preset);
        let per_level = preset.per_level || self.compat.is_some_and(|compat| compat.per_level);
        LanguageOptions { iterations, seed, check_every: 0, per_level, ..preset }
    }

    /// Prompts of a mask network.
    pub fn sam(&self) -> SamOptions {
        let paint_in_order = self.compat.is_some_and(|compat| compat.paint_in_order);
        SamOptions { paint_in_order, ..SamOptions::default() }
    }
}

/// Options of a row.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Setup {
    /// Schedules and rules.
    pub regime: Regime,
    /// Number of photos.
    pub views: usize,
    /// Source of cameras and points.
    pub init: SourceChoice,
    /// Whether the true cameras of the data set, with stereo, replace `init`.
    pub true_cameras: bool,
    /// Source of dense matches for the alignment.
    pub matcher: SourceChoice,
    /// Folder of a COLMAP model whose points splats start from; `None`: dense stereo.
    pub points: Option<PathBuf>,
    /// Maximum of points that splats start from; `None`: the preset's.
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

/// Features in 2D, without a scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Flat {
    /// Features, as of `--features`.
    pub features: SourceChoice,
    /// Masks that have the features, as of `--masks`; `None`: the cells of a grid.
    pub masks: Option<SourceChoice>,
}

/// Work of a row.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum RowWork {
    /// Makes the scene of a setup and scores it.
    Score(Box<Setup>),
    /// Makes no scene; scores features of labelled photos.
    Flat(Flat),
    /// No work; the note gives the reason.
    Nothing,
}

/// A row of a table before it runs.
#[derive(Clone, Debug)]
pub struct TableRow {
    /// Name of the row in its group.
    pub label: String,
    /// Group; rows are compared within their group.
    pub group: String,
    /// Work of the row.
    pub runs: RowWork,
    /// Remark for the reader.
    pub note: String,
}

/// A network that a table compares.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    /// Name on the command line: its own where it is installed, else that of its family.
    pub name: String,
    /// Family of networks.
    pub family: String,
    /// Id for `splatvk models fetch` where no trained network of the family is installed.
    pub fetch: Option<String>,
}

/// Data and networks that the tables can compare. Each list of networks holds the installed ones,
/// and one entry for every known family without an installed network.
#[derive(Clone, Debug, Default)]
pub struct Available {
    /// Number of frames that may be photos.
    pub views: usize,
    /// Whether true cameras are known.
    pub cameras: bool,
    /// Whether the data set is a published one, on which the paper's tables take found masks and
    /// features.
    pub published: bool,
    /// COLMAP models with points.
    pub models: Vec<(Views, PathBuf)>,
    /// Networks for geometry.
    pub geometry: Vec<Network>,
    /// Networks for dense matches.
    pub matchers: Vec<Network>,
    /// Networks for masks.
    pub masks: Vec<Network>,
    /// Networks for features.
    pub features: Vec<Network>,
}

/// Rows under the same regions.
pub(super) struct Group<'a> {
    /// Default setup of the rows.
    pub(super) base: Setup,
    pub(super) sources: &'a Sources,
    pub(super) available: &'a Available,
}

impl Group<'_> {
    /// A row that scores a setup.
    pub(super) fn row(&self, label: &str, setup: Setup) -> TableRow {
        TableRow {
            label: label.to_owned(),
            group: self.base.regions.name(),
            runs: RowWork::Score(Box::new(setup)),
            note: String::new(),
        }
    }

    /// A row that scores the default setup with another recipe.
    pub(super) fn recipe(&self, label: &str, recipe: Recipe) -> TableRow {
        self.row(label, Setup { recipe, ..self.base.clone() })
    }

    /// Rows of the default source and of every network; those of networks that are not installed
    /// have a note with the command that installs them.
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

    /// A row with the cameras and points of a COLMAP model, where the data set has one.
    pub(super) fn on_model(&self, label: &str, views: Views, recipe: Recipe) -> TableRow {
        match self.available.models.iter().find(|(v, _)| *v == views) {
            Some((_, model)) => {
                let init = SourceChoice::with("cameras", model);
                let (true_cameras, points) = (false, Some(model.clone()));
                self.row(label, Setup { init, true_cameras, points, recipe, ..self.base.clone() })
            }
            None => {
                let note = format!("no COLMAP model with points in {}/0", views.folder());
                Group::impossible(self.row(label, self.base.clone()), note)
            }
        }
    }

    /// A row of features in 2D, of masks or of the cells of a grid.
    pub(super) fn flat(
        &self,
        label: &str,
        masks: Option<&SourceChoice>,
        features: &SourceChoice,
    ) -> TableRow {
        let flat = Flat { features: features.clone(), masks: masks.cloned() };
        TableRow { runs: RowWork::Flat(flat), ..self.row(label, self.base.clone()) }
    }

    /// Returns the row, or a row without work and with an installation note where the network is
    /// not installed.
    pub(super) fn if_installed(&self, row: TableRow, network: &Network) -> TableRow {
        match &network.fetch {
            None => row,
            Some(id) => {
                let note = format!("not installed: splatvk models fetch {id}");
                TableRow { runs: RowWork::Nothing, note, ..row }
            }
        }
    }

    /// Returns the row without work; its note is the reason.
    pub(super) fn impossible(row: TableRow, note: String) -> TableRow {
        TableRow { runs: RowWork::Nothing, note, ..row }
    }
}
