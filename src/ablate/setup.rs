//! What the tables compare: a table is a list of setups that differ in one thing.
use crate::language::Reducer;
use crate::run::{AUTOENCODER, Method, Recipe};
use crate::synth::regions::Flaws;
use serde::Serialize;
use std::path::PathBuf;

/// The tables of the paper's experiments.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Table {
    /// Bijection, autoencoder, or no reduction.
    Bijection,
    /// The three alignment steps.
    Alignment,
    /// 2, 4 and 6 photos.
    Views,
    /// Splats at the start.
    Points,
    /// Where cameras and points come from.
    Initializer,
    /// Language training with and without the image loss.
    ImageLoss,
    /// Where masks and features come from.
    Features,
    /// Length of the codes.
    Dimension,
    /// The default and the baselines.
    Methods,
}

impl Table {
    /// All of them, in the order of `ablate all`.
    pub const ALL: [Table; 9] = [
        Table::Alignment,
        Table::Bijection,
        Table::Methods,
        Table::Dimension,
        Table::ImageLoss,
        Table::Features,
        Table::Points,
        Table::Views,
        Table::Initializer,
    ];

    /// As the command line spells it.
    pub fn name(self) -> &'static str {
        match self {
            Table::Bijection => "bijection",
            Table::Alignment => "alignment",
            Table::Views => "views",
            Table::Points => "points",
            Table::Initializer => "initializer",
            Table::ImageLoss => "image-loss",
            Table::Features => "features",
            Table::Dimension => "dimension",
            Table::Methods => "methods",
        }
    }
}

/// Where cameras and points come from.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Init {
    /// Structure from motion and stereo.
    Sfm,
    /// The true cameras of the data set and stereo.
    TrueCameras,
    /// An installed network's pointmaps.
    Network(String),
}

/// Where masks and features come from.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// What `splatvk run` uses on its own: graph masks, `words` features.
    BuiltIn,
    /// True masks and synthetic features with errors injected.
    Flawed(Flaws),
    /// True masks, synthetic features without errors.
    Exact,
    /// A `dir:` folder.
    Dir(PathBuf),
    /// Built-in masks, features of an installed network.
    Network(String),
}

impl Source {
    /// For the rows of a table.
    pub fn name(&self) -> String {
        match self {
            Source::BuiltIn => "built-in".into(),
            Source::Flawed(f) => format!("flawed, seed {}", f.seed),
            Source::Exact => "exact".into(),
            Source::Dir(dir) => format!("dir:{}", dir.display()),
            Source::Network(name) => name.clone(),
        }
    }
}

/// Everything that a row decides.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Setup {
    /// Photos.
    pub views: usize,
    /// Cameras and points.
    pub init: Init,
    /// Most splats at the start; none = the preset's.
    pub max_points: Option<usize>,
    /// Masks and features.
    pub source: Source,
    /// Method, or a variation of it.
    pub recipe: Recipe,
    /// Steps of the colour stage.
    pub iterations: usize,
    /// Steps of the language stage.
    pub language_iterations: usize,
}

/// One row before it ran.
#[derive(Clone, Debug)]
pub struct Row {
    /// What this row is, within its group.
    pub label: String,
    /// Rows are compared within their group.
    pub group: String,
    /// What to run; none: the row only states a figure or why it cannot run.
    pub setup: Option<Setup>,
    /// What the reader should know about this row.
    pub note: String,
    /// The paper's figures for this row, by column.
    pub paper: Vec<(&'static str, f64)>,
}

/// What a machine and a data set have for the tables to compare.
#[derive(Clone, Debug, Default)]
pub struct Means {
    /// Frames that may be photos.
    pub views: usize,
    /// Known families of geometry networks, and whether one is installed.
    pub geometry: Vec<(String, bool)>,
    /// The same for features.
    pub features: Vec<(String, bool)>,
}

/// The rows of a table. `base` is the default setup; `sources` those to compare under (one group each).
pub fn rows(table: Table, base: &Setup, sources: &[Source], means: &Means) -> Vec<Row> {
    let most_views = means.views;
    let mut out = Vec::new();
    // A network has a row of its own, which says so where there is none.
    let optional = |group: String, name: &str, there: bool, setup: Setup| Row {
        label: name.to_owned(),
        group,
        setup: there.then_some(setup),
        note: if there { String::new() } else { "not installed (splatvk models list)".to_owned() },
        paper: Vec::new(),
    };
    for source in sources {
        let base = Setup { source: source.clone(), ..base.clone() };
        let row = |label: &str, setup: Setup, paper: &[(&'static str, f64)]| Row {
            label: label.to_owned(),
            group: source.name(),
            setup: Some(setup),
            note: String::new(),
            paper: paper.to_vec(),
        };
        let with = |recipe: Recipe| Setup { recipe, ..base.clone() };
        match table {
            Table::Methods => {
                let ours = [("mIoU", 0.538), ("mAcc", 0.770)];
                out.push(row("sparselgs", with(Method::SparseLgs.recipe()), &ours));
                let paper = [("mIoU", 0.426), ("mAcc", 0.636)];
                out.push(row("langsplat", with(Method::LangSplat.recipe()), &paper));
                let paper = [("mIoU", 0.237), ("mAcc", 0.632)];
                out.push(row("legaussians", with(Method::LeGaussians.recipe()), &paper));
                out.push(row("lsm", with(Method::Lsm.recipe()), &[]));
            }
            Table::Alignment => {
                let paper = [
                    ("none", [false, false, false], [0.496, 0.717, 0.952, 8.59e-3]),
                    ("step 1", [true, false, false], [0.511, 0.763, 0.958, 6.05e-3]),
                    ("steps 1, 2", [true, true, false], [0.515, 0.763, 0.960, 5.60e-3]),
                    ("step 3", [false, false, true], [0.507, 0.746, 0.963, 6.02e-3]),
                    ("steps 1, 2, 3", [true, true, true], [0.538, 0.786, 0.969, 4.99e-3]),
                ];
                for (label, steps, p) in paper {
                    let paper = [("mIoU", p[0]), ("mAcc", p[1]), ("SIM", p[2]), ("MSE", p[3])];
                    out.push(row(label, with(Recipe { steps, ..base.recipe }), &paper));
                }
            }
            Table::Bijection => {
                out.push(row("bijection", base.clone(), &[("mIoU", 0.538), ("mAcc", 0.786)]));
                let setup = with(Recipe { feature_dim: 3, ..base.recipe });
                out.push(row("bijection, 3 dimensions", setup, &[]));
                let published = Reducer::Autoencoder { least_steps: 0 };
                let setup = with(Recipe { reducer: published, feature_dim: 3, ..base.recipe });
                out.push(row("autoencoder, 100 epochs", setup, &[("mIoU", 0.463), ("mAcc", 0.640)]));
                let setup = with(Recipe { reducer: AUTOENCODER, feature_dim: 3, ..base.recipe });
                out.push(row("autoencoder, 2000 steps", setup, &[]));
                out.push(Row {
                    setup: None,
                    note: "not trained: memory only".into(),
                    ..row("no reduction", base.clone(), &[])
                });
            }
            Table::Dimension => {
                for d in [3, 8, 16] {
                    out.push(row(&format!("{d}"), with(Recipe { feature_dim: d, ..base.recipe }), &[]));
                }
            }
            Table::ImageLoss => {
                // Longer than the other tables: geometry moves slowly at the rates of this stage, and it is geometry that
                // the image loss protects.
                let long = Setup { language_iterations: 3 * base.language_iterations, ..base.clone() };
                out.push(row("with image loss", long.clone(), &[]));
                out.push(row(
                    "without",
                    Setup { recipe: Recipe { image_weight: 0.0, ..base.recipe }, ..long },
                    &[],
                ));
            }
            Table::Features => {
                out.push(row(&source.name(), base.clone(), &[]));
            }
            Table::Points => {
                for (label, cap, paper) in
                    [("50k", 50_000, 0.5358), ("500k", 500_000, 0.6020), ("none", usize::MAX, 0.5967)]
                {
                    // Short codes: those of 16 numbers for a million splats are more than lavapipe binds to a shader.
                    let recipe = Recipe { feature_dim: 3, ..base.recipe };
                    let setup = Setup { max_points: Some(cap), recipe, ..base.clone() };
                    out.push(row(&format!("cap {label}"), setup, &[("mIoU", paper)]));
                }
            }
            Table::Views => {
                for (views, miou, acc) in [(2, 0.7341, 0.9), (4, 0.7264, 0.9), (6, 0.7313, 0.85)] {
                    let mut one = row(
                        &format!("{views} views"),
                        Setup { views, ..base.clone() },
                        &[("mIoU", miou), ("mAcc", acc)],
                    );
                    if views > most_views {
                        one.setup = None;
                        one.note = format!("the data set has {most_views} photos to spare");
                    }
                    out.push(one);
                }
            }
            Table::Initializer => {
                out.push(row("sfm", Setup { init: Init::Sfm, ..base.clone() }, &[]));
                out.push(row("true cameras", Setup { init: Init::TrueCameras, ..base.clone() }, &[]));
                for (name, there) in &means.geometry {
                    let setup = Setup { init: Init::Network(name.clone()), ..base.clone() };
                    out.push(optional(source.name(), name, *there, setup));
                }
            }
        }
    }
    if table == Table::Features {
        for (name, there) in &means.features {
            let setup = Setup { source: Source::Network(name.clone()), ..base.clone() };
            out.push(optional(name.clone(), name, *there, setup));
        }
    }
    out
}
