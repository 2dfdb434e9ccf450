//! The tables of the paper's experiments, as data: each is a list of setups that differ in one thing.
use crate::language::Reducer;
use crate::run::method::{AUTOENCODER, LANGSPLAT, LEGAUSSIANS, LSM, METHODS, Recipe};
use crate::run::sources::{self, FeatureSources, MaskSources, SourceChoice};
use crate::synth::regions::InjectedErrors;
use serde::Serialize;
use std::path::PathBuf;

/// Column name, decimals.
pub(super) type Column = (&'static str, usize);

/// A table: what it varies, under which regions, and what it shows.
pub struct Table {
    /// As the command line spells it.
    pub name: &'static str,
    /// What it compares.
    pub about: &'static str,
    /// Figures beside mIoU and mAcc.
    pub(super) columns: &'static [Column],
    /// The regions under which it is run when the user does not say; one group of rows each.
    pub(super) regions: fn(u64, &Available) -> Vec<Regions>,
    /// The rows of a group.
    pub(super) rows: fn(&Group) -> Vec<TableRow>,
}

impl Serialize for Table {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name)
    }
}

/// Every table, in the order of `ablate all`.
pub static TABLES: [Table; 9] = [
    Table {
        name: "alignment",
        about: "None, step 1, steps 1 and 2, step 3, all three",
        columns: &[("SIM", 3), ("MSE", 4), ("codes", 0)],
        // What this is about is errors of masks and features; the built-in models make few on an easy scene.
        regions: |seed, _| vec![Regions::built_in(), Regions::flawed(seed)],
        rows: |group| {
            let paper = [
                ("none", [false, false, false], [0.496, 0.717, 0.952, 8.59e-3]),
                ("step 1", [true, false, false], [0.511, 0.763, 0.958, 6.05e-3]),
                ("steps 1, 2", [true, true, false], [0.515, 0.763, 0.960, 5.60e-3]),
                ("step 3", [false, false, true], [0.507, 0.746, 0.963, 6.02e-3]),
                ("steps 1, 2, 3", [true, true, true], [0.538, 0.786, 0.969, 4.99e-3]),
            ];
            let row = |(label, steps, p): (&str, [bool; 3], [f64; 4])| {
                let paper = [("mIoU", p[0]), ("mAcc", p[1]), ("SIM", p[2]), ("MSE", p[3])];
                group.recipe(label, Recipe { steps, ..group.base.recipe }, &paper)
            };
            paper.into_iter().map(row).collect()
        },
    },
    Table {
        name: "bijection",
        about: "Bijection, autoencoder, no reduction",
        columns: &[("SIM", 3), ("MB", 0)],
        regions: |seed, _| vec![Regions::built_in(), Regions::flawed(seed)],
        rows: |group| {
            let short = Recipe { feature_dim: 3, ..group.base.recipe };
            let published = Recipe { reducer: Reducer::Autoencoder { least_steps: 0 }, ..short };
            let longer = Recipe { reducer: AUTOENCODER, ..short };
            vec![
                group.row("bijection", group.base.clone(), &[("mIoU", 0.538), ("mAcc", 0.786)]),
                group.recipe("bijection, 3 dimensions", short, &[]),
                group.recipe("autoencoder, 100 epochs", published, &[("mIoU", 0.463), ("mAcc", 0.640)]),
                group.recipe("autoencoder, 2000 steps", longer, &[]),
                TableRow {
                    runs: RowWork::MemoryOnly(group.base.clone()),
                    note: "not trained: memory only".into(),
                    ..group.row("no reduction", group.base.clone(), &[])
                },
            ]
        },
    },
    Table {
        name: "methods",
        about: "This program's way and the baselines",
        columns: &[("SIM", 3), ("MB", 0)],
        regions: |seed, _| vec![Regions::built_in(), Regions::flawed(seed)],
        rows: |group| {
            let paper = |name: &str| -> &[(&'static str, f64)] {
                match name {
                    n if n == LANGSPLAT.name => &[("mIoU", 0.426), ("mAcc", 0.636)],
                    n if n == LEGAUSSIANS.name => &[("mIoU", 0.237), ("mAcc", 0.632)],
                    n if n == LSM.name => &[],
                    _ => &[("mIoU", 0.538), ("mAcc", 0.770)],
                }
            };
            METHODS.iter().map(|m| group.recipe(m.name, m.recipe, paper(m.name))).collect()
        },
    },
    Table {
        name: "dimension",
        about: "Codes of 3, 8 and 16 numbers",
        columns: &[("SIM", 3), ("MB", 0)],
        regions: |_, _| vec![Regions::built_in()],
        rows: |group| {
            let row =
                |d: usize| group.recipe(&d.to_string(), Recipe { feature_dim: d, ..group.base.recipe }, &[]);
            [3, 8, 16].map(row).into()
        },
    },
    Table {
        name: "image-loss",
        about: "Language training with and without the image loss",
        columns: &[("PSNR", 2), ("SIM", 3)],
        // Perfect regions leave geometry as the only cause of a difference.
        regions: |_, _| vec![Regions::EXACT],
        rows: |group| {
            // Longer than the other tables: geometry moves slowly at the rates of this stage, and it is geometry that the
            // image loss protects.
            let long =
                Setup { language_iterations: 3 * group.base.language_iterations, ..group.base.clone() };
            let without = Recipe { image_weight: 0.0, ..long.recipe };
            vec![
                group.row("with image loss", long.clone(), &[]),
                group.row("without", Setup { recipe: without, ..long }, &[]),
            ]
        },
    },
    Table {
        name: "features",
        about: "Masks and features: built-in, with injected errors, exact, of installed networks",
        columns: &[("SIM", 3), ("codes", 0)],
        regions: |seed, available| {
            let own = [Regions::built_in(), Regions::flawed(seed), Regions::EXACT];
            own.into_iter().chain(available.features.iter().map(|f| Regions::described_by(&f.name))).collect()
        },
        rows: |group| {
            let name = group.base.regions.name();
            let absent = group.available.features.iter().any(|f| f.name == name && !f.installed);
            vec![group.if_installed(&name, group.base.clone(), !absent)]
        },
    },
    Table {
        name: "points",
        about: "At most 50k, 500k, or all splats at the start",
        columns: &[("PSNR", 2), ("splats", 0)],
        regions: |_, _| vec![Regions::EXACT],
        rows: |group| {
            // Short codes: those of 16 numbers for a million splats are more than lavapipe binds to a shader.
            let recipe = Recipe { feature_dim: 3, ..group.base.recipe };
            let row = |(label, most, paper): (&str, usize, f64)| {
                let setup = Setup { max_points: Some(most), recipe, ..group.base.clone() };
                group.row(label, setup, &[("mIoU", paper)])
            };
            [("cap 50k", 50_000, 0.5358), ("cap 500k", 500_000, 0.6020), ("cap none", usize::MAX, 0.5967)]
                .map(row)
                .into()
        },
    },
    Table {
        name: "views",
        about: "2, 4 and 6 photos",
        columns: &[("PSNR", 2), ("splats", 0)],
        regions: |seed, _| vec![Regions::flawed(seed)],
        rows: |group| {
            let row = |(views, miou, acc): (usize, f64, f64)| {
                let setup = Setup { views, ..group.base.clone() };
                let row = group.row(&format!("{views} views"), setup, &[("mIoU", miou), ("mAcc", acc)]);
                if views <= group.available.views {
                    return row;
                }
                let note = format!("the data set has {} photos to spare", group.available.views);
                TableRow { runs: RowWork::Nothing, note, ..row }
            };
            [(2, 0.7341, 0.9), (4, 0.7264, 0.9), (6, 0.7313, 0.85)].map(row).into()
        },
    },
    Table {
        name: "initializer",
        about: "Cameras and points from photos alone, from the true cameras, or from installed networks",
        columns: &[("PSNR", 2), ("splats", 0)],
        regions: |_, _| vec![Regions::EXACT],
        rows: |group| {
            let from = |init: SourceChoice, true_cameras| Setup { init, true_cameras, ..group.base.clone() };
            let sfm = sources::default::<sources::GeometrySources>();
            let mut rows = vec![
                group.row(&sfm.name, from(sfm.clone(), false), &[]),
                group.row("true cameras", from(sfm, true), &[]),
            ];
            let networks = group.available.geometry.iter();
            rows.extend(networks.map(|f| {
                group.if_installed(&f.name, from(SourceChoice::named(&f.name), false), f.installed)
            }));
            rows
        },
    },
];

/// The table of a name.
pub fn table(name: &str) -> Option<&'static Table> {
    TABLES.iter().find(|t| t.name == name)
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
    /// True masks and synthetic features, with errors injected.
    Synthetic(InjectedErrors),
}

impl Regions {
    /// Without an error.
    pub const EXACT: Regions = Regions::Synthetic(InjectedErrors::NONE);

    /// What `splatvk run` uses on its own.
    pub fn built_in() -> Regions {
        Regions::Found {
            masks: sources::default::<MaskSources>(),
            features: sources::default::<FeatureSources>(),
        }
    }

    /// With the usual errors.
    pub fn flawed(seed: u64) -> Regions {
        Regions::Synthetic(InjectedErrors::default_rates(seed))
    }

    /// Masks and features from a folder.
    pub fn given(dir: PathBuf) -> Regions {
        Regions::Found { masks: SourceChoice::with("dir", &dir), features: SourceChoice::with("dir", dir) }
    }

    /// Built-in masks, features of an installed network.
    pub fn described_by(network: &str) -> Regions {
        Regions::Found { masks: sources::default::<MaskSources>(), features: SourceChoice::named(network) }
    }

    /// For the rows of a table.
    pub fn name(&self) -> String {
        match self {
            regions if *regions == Regions::built_in() => "built-in".into(),
            regions if *regions == Regions::EXACT => "exact".into(),
            Regions::Synthetic(flaws) => format!("flawed, seed {}", flaws.seed),
            Regions::Found { features, .. } => features.to_string(),
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
    /// Most splats at the start; none = the preset's.
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
    /// The paper's figures for this row, by column.
    pub paper: Vec<(&'static str, f64)>,
}

/// A family of networks.
#[derive(Clone, Debug)]
pub struct NetworkFamily {
    /// As the options call it.
    pub name: String,
    /// A trained one is on this machine.
    pub installed: bool,
}

/// What a machine and a data set have for the tables to compare.
#[derive(Clone, Debug, Default)]
pub struct Available {
    /// Frames that may be photos.
    pub views: usize,
    /// Known families of geometry networks.
    pub geometry: Vec<NetworkFamily>,
    /// The same for features.
    pub features: Vec<NetworkFamily>,
}

/// Rows under the same regions.
pub(super) struct Group<'a> {
    /// The default of the rows.
    pub(super) base: Setup,
    pub(super) available: &'a Available,
}

impl Group<'_> {
    fn row(&self, label: &str, setup: Setup, paper: &[(&'static str, f64)]) -> TableRow {
        TableRow {
            label: label.to_owned(),
            group: self.base.regions.name(),
            runs: RowWork::Score(setup),
            note: String::new(),
            paper: paper.to_vec(),
        }
    }

    fn recipe(&self, label: &str, recipe: Recipe, paper: &[(&'static str, f64)]) -> TableRow {
        self.row(label, Setup { recipe, ..self.base.clone() }, paper)
    }

    /// A network has a row also where it is not, which says so.
    fn if_installed(&self, name: &str, setup: Setup, there: bool) -> TableRow {
        let row = self.row(name, setup, &[]);
        if there {
            return row;
        }
        TableRow { runs: RowWork::Nothing, note: "not installed (splatvk models list)".to_owned(), ..row }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::method::SPARSELGS;

    #[test]
    fn rows_differ_in_what_their_table_is_about() {
        let base = Setup {
            views: 4,
            init: sources::default::<sources::GeometrySources>(),
            true_cameras: false,
            max_points: None,
            regions: Regions::EXACT,
            recipe: SPARSELGS.recipe,
            iterations: 10,
            language_iterations: 2,
        };
        let family = |name: &str, installed| NetworkFamily { name: name.into(), installed };
        let available = Available {
            views: 4,
            geometry: vec![family("there", true), family("not", false)],
            features: vec![family("absent", false)],
        };
        for table in &TABLES {
            for regions in (table.regions)(1, &available) {
                let group = Group { base: Setup { regions, ..base.clone() }, available: &available };
                let rows = (table.rows)(&group);
                let setups: Vec<&Setup> = rows
                    .iter()
                    .filter_map(|r| match &r.runs {
                        RowWork::Score(setup) => Some(setup),
                        RowWork::MemoryOnly(_) | RowWork::Nothing => None,
                    })
                    .collect();
                for (i, a) in setups.iter().enumerate() {
                    assert!(setups[..i].iter().all(|b| a != b), "{}: two rows of one setup", table.name);
                }
                for row in rows.iter().filter(|r| !matches!(r.runs, RowWork::Score(_))) {
                    assert!(!row.note.is_empty(), "{}: {} says not why", table.name, row.label);
                }
                for (column, _) in rows.iter().flat_map(|r| &r.paper) {
                    let own = table.columns.iter().any(|c| c.0 == *column);
                    assert!(own || ["mIoU", "mAcc"].contains(column), "{}: no column {column}", table.name);
                }
            }
        }
    }
}
