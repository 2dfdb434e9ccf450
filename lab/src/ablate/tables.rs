//! The tables of the paper's experiments, as data: each is a list of setups that differ in one
//! thing. The paper's own figures are in [`super::paper`].
use super::colmap::Views;
use super::setup::{Available, Group, Regions, Setup, Sources, TableRow};
use serde::Serialize;
use splatvk::language::Reducer;
use splatvk::run::method::{
    AUTOENCODER, LANGSPLAT, LEGAUSSIANS, LSM, LanguageFit, METHODS, Recipe, SPARSELGS,
};
use splatvk::run::sources::{FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice};

/// Column name, decimals.
pub(super) type Column = (&'static str, usize);

/// A table of experiments: its columns, its rows, and the regions under which they run.
pub struct Table {
    /// Name on the command line.
    pub name: &'static str,
    /// Help text: the compared setups.
    pub about: &'static str,
    /// Columns beside mIoU and mAcc.
    pub(super) columns: &'static [Column],
    /// Default regions; each makes one group of rows.
    pub(super) regions: fn(&Sources, &Available) -> Vec<Regions>,
    /// Rows of a group.
    pub(super) rows: fn(&Group) -> Vec<TableRow>,
}

impl Serialize for Table {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name)
    }
}

/// Regions of a table about errors of masks and features: found and with injected errors, as the
/// built-in models make few on an easy scene.
const WITH_ERRORS: fn(&Sources, &Available) -> Vec<Regions> = |own, _| vec![own.regions(), Regions::Flawed];
/// Regions of a table about anything else: exact ones cannot be the cause of a difference. On the
/// paper's data sets those of the paper's tables, found ones.
const PERFECT: fn(&Sources, &Available) -> Vec<Regions> =
    |own, available| vec![if available.published { own.regions() } else { Regions::Exact }];
/// Regions of a table about masks and features themselves: found ones.
const OWN: fn(&Sources, &Available) -> Vec<Regions> = |own, _| vec![own.regions()];

/// Every table, in the order of `ablate all`.
pub static TABLES: [Table; 14] = [
    Table {
        name: "alignment",
        about: "None, step 1, steps 1 and 2, step 3, all three",
        columns: &[("SIM", 3), ("MSE", 4), ("codes", 0), ("equal", 3), ("cosine", 3), ("equal decoded", 3)],
        regions: WITH_ERRORS,
        rows: |group| {
            let row = |(label, steps): (&str, [bool; 3])| {
                group.recipe(label, Recipe { steps, ..group.base.recipe })
            };
            [
                ("none", [false, false, false]),
                ("step 1", [true, false, false]),
                ("steps 1, 2", [true, true, false]),
                ("step 3", [false, false, true]),
                ("steps 1, 2, 3", [true, true, true]),
            ]
            .map(row)
            .into()
        },
    },
    Table {
        name: "bijection",
        about: "Bijection, autoencoder, no reduction",
        columns: &[("SIM", 3), ("MB", 0)],
        regions: WITH_ERRORS,
        rows: |group| {
            let short = Recipe { feature_dim: 3, ..group.base.recipe };
            let published = Recipe { reducer: Reducer::Autoencoder { least_steps: 0 }, ..short };
            let longer = Recipe { reducer: AUTOENCODER, ..short };
            let unreduced = Recipe { reducer: Reducer::Unreduced, ..group.base.recipe };
            vec![
                group.row("bijection", group.base.clone()),
                group.recipe("bijection, 3 dimensions", short),
                group.recipe("autoencoder, 100 epochs", published),
                group.recipe("autoencoder, 2000 steps", longer),
                group.recipe("no reduction", unreduced),
            ]
        },
    },
    Table {
        name: "methods",
        about: "This program's way and the baselines",
        columns: &[("PSNR", 2), ("SIM", 3), ("MB", 0)],
        regions: WITH_ERRORS,
        rows: |group| {
            METHODS.iter().map(|m| group.recipe(m.name, group.base.regime.recipe(m.recipe))).collect()
        },
    },
    Table {
        name: "colmap",
        about: "Methods on cameras and points of COLMAP, from all photos or from those of the rows",
        columns: &[("PSNR", 2), ("splats", 0)],
        regions: OWN,
        rows: |group| {
            let mut rows = vec![group.row(SPARSELGS.name, group.base.clone())];
            for views in Views::ALL {
                for method in [&LANGSPLAT, &LEGAUSSIANS, &SPARSELGS] {
                    let label = format!("{}, {} COLMAP", method.name, views.name());
                    rows.push(group.on_model(&label, views, group.base.regime.recipe(method.recipe)));
                }
            }
            rows
        },
    },
    Table {
        name: "dimension",
        about: "Codes of 3, 8 and 16 numbers",
        columns: &[("SIM", 3), ("MB", 0)],
        regions: OWN,
        rows: |group| {
            let row = |d: usize| group.recipe(&d.to_string(), Recipe { feature_dim: d, ..group.base.recipe });
            [3, 8, 16].map(row).into()
        },
    },
    Table {
        name: "image-loss",
        about: "Language training with and without the image loss, and features that are not trained",
        columns: &[
            ("PSNR", 2),
            ("AbsRel", 4),
            ("SIM", 3),
            ("needles", 4),
            ("growth", 3),
            ("growth unseen", 3),
        ],
        regions: PERFECT,
        rows: |group| {
            let long = Setup {
                language_iterations: group.base.regime.long_language(group.base.language_iterations),
                ..group.base.clone()
            };
            let without = Recipe { image_weight: 0.0, ..long.recipe };
            let lifted = Recipe { language: LanguageFit::Lift, ..long.recipe };
            vec![
                group.row("with image loss", long.clone()),
                group.row("without", Setup { recipe: without, ..long.clone() }),
                group.row("lifted", Setup { recipe: lifted, ..long }),
            ]
        },
    },
    Table {
        name: "regions",
        about: "Masks and features as found, with injected errors, exact",
        columns: &[("SIM", 3), ("codes", 0)],
        regions: |own, _| vec![own.regions(), Regions::Flawed, Regions::Exact],
        rows: |group| vec![group.row(&group.base.regions.name(), group.base.clone())],
    },
    Table {
        name: "masks",
        about: "Masks of the built-in graph, or of installed networks",
        columns: &[("SIM", 3), ("codes", 0)],
        regions: OWN,
        rows: |group| {
            let features = &group.sources.features;
            group.each::<MaskSources>(&group.available.masks, |masks| Setup {
                regions: Regions::Found { masks, features: features.clone() },
                ..group.base.clone()
            })
        },
    },
    Table {
        name: "features",
        about: "Features of the built-in words, or of installed networks",
        columns: &[("SIM", 3), ("codes", 0)],
        regions: OWN,
        rows: |group| {
            let masks = &group.sources.masks;
            group.each::<FeatureSources>(&group.available.features, |features| Setup {
                regions: Regions::Found { masks: masks.clone(), features },
                ..group.base.clone()
            })
        },
    },
    Table {
        name: "matcher",
        about: "Dense matches of the built-in descriptors, or of installed networks",
        columns: &[("SIM", 3), ("codes", 0)],
        regions: WITH_ERRORS,
        rows: |group| {
            // Without step 3, which finds links that the matches have missed, the result depends on
            // the matches alone.
            let recipe = Recipe { steps: [true, true, false], ..group.base.recipe };
            group.each::<MatchSources>(&group.available.matchers, |matcher| Setup {
                matcher,
                recipe,
                ..group.base.clone()
            })
        },
    },
    Table {
        name: "points",
        about: "At most 50k, 500k, or all splats at the start",
        columns: &[("PSNR", 2), ("splats", 0)],
        regions: PERFECT,
        rows: |group| {
            // Short codes: features of 16 numbers for a million splats exceed the largest buffer
            // that lavapipe binds.
            let recipe = Recipe { feature_dim: 3, ..group.base.recipe };
            let row = |(label, most): (&str, usize)| {
                group.row(label, Setup { max_points: Some(most), recipe, ..group.base.clone() })
            };
            [("cap 50k", 50_000), ("cap 500k", 500_000), ("cap none", usize::MAX)].map(row).into()
        },
    },
    Table {
        name: "views",
        about: "2, 4 and 6 photos",
        columns: &[("PSNR", 2), ("splats", 0)],
        regions: |own, available| vec![if available.published { own.regions() } else { Regions::Flawed }],
        rows: |group| {
            let views_row = |views: usize| {
                let row = group.row(&format!("{views} views"), Setup { views, ..group.base.clone() });
                if views <= group.available.views {
                    return row;
                }
                Group::impossible(row, format!("the data set has {} photos to spare", group.available.views))
            };
            [2, 4, 6].map(views_row).into()
        },
    },
    Table {
        name: "initializer",
        about: "Cameras and points from photos alone, from the true cameras, or from installed networks",
        columns: &[("PSNR", 2), ("splats", 0)],
        regions: PERFECT,
        rows: |group| {
            let from = |init: SourceChoice| Setup { init, true_cameras: false, ..group.base.clone() };
            let mut rows = group.each::<GeometrySources>(&group.available.geometry, from);
            let known = group.row("true cameras", Setup { true_cameras: true, ..group.base.clone() });
            let known = match group.available.cameras {
                true => known,
                false => Group::impossible(known, "the data set states no cameras".to_owned()),
            };
            rows.insert(1, known);
            rows
        },
    },
    Table {
        name: "feed-forward",
        about: "In the manner of LSM, beside features of LSeg in space and in 2D, and true masks",
        columns: &[("SIM", 3)],
        regions: OWN,
        rows: |group| {
            let Sources { masks, features, .. } = group.sources;
            let base = &group.base;
            let mut rows = vec![
                group.recipe(LSM.name, base.regime.recipe(LSM.recipe)),
                group.row(SPARSELGS.name, base.clone()),
            ];
            if let Some(network) = group.available.features.iter().find(|n| n.family == "lseg") {
                let features = SourceChoice::named(&network.name);
                let regions = Regions::Found { masks: masks.clone(), features: features.clone() };
                let lifted = group.row("features of lseg", Setup { regions, ..base.clone() });
                let in_cells = group.flat("lseg in 2D", None, &features);
                let in_masks = group.flat("lseg in 2D, per mask", Some(masks), &features);
                rows.extend([lifted, in_cells, in_masks].map(|row| group.if_installed(row, network)));
            }
            rows.push(group.flat("in 2D, per mask", Some(masks), features));
            let regions = Regions::TrueSegmentation { features: features.clone() };
            rows.push(group.row("true segmentation", Setup { regions, ..base.clone() }));
            rows
        },
    },
];

/// Returns the table of a name.
pub fn table(name: &str) -> Option<&'static Table> {
    TABLES.iter().find(|t| t.name == name)
}

#[cfg(test)]
mod tests {
    use super::super::setup::{Network, Regime, RowWork};
    use super::*;

    fn network(name: &str, fetch: Option<&str>) -> Network {
        Network { name: name.into(), family: name.into(), fetch: fetch.map(str::to_owned) }
    }

    #[test]
    fn tables_have_distinct_setups() {
        let sources = Sources::default();
        let base = Setup {
            regime: Regime::OWN,
            views: 4,
            init: sources.init.clone(),
            true_cameras: false,
            matcher: sources.matcher.clone(),
            points: None,
            max_points: None,
            regions: Regions::Exact,
            recipe: SPARSELGS.recipe,
            iterations: 10,
            language_iterations: 2,
        };
        let networks = || vec![network("there", None), network("not", Some("not_b"))];
        let available = Available {
            views: 4,
            cameras: true,
            published: false,
            models: vec![(Views::Dense, "model".into())],
            geometry: networks(),
            matchers: networks(),
            masks: networks(),
            features: networks(),
        };
        for table in &TABLES {
            let mut setups: Vec<Setup> = Vec::new();
            let mut rows = Vec::new();
            for regions in (table.regions)(&sources, &available) {
                let base = Setup { regions, ..base.clone() };
                rows.extend((table.rows)(&Group { base, sources: &sources, available: &available }));
            }
            for row in &rows {
                match &row.runs {
                    RowWork::Score(setup) => {
                        assert!(!setups.contains(&**setup), "{}: two rows of one setup", table.name);
                        setups.push((**setup).clone());
                    }
                    RowWork::Flat(_) => {}
                    RowWork::Nothing => {
                        assert!(!row.note.is_empty(), "{}: {} has no note", table.name, row.label);
                    }
                }
            }
            if ["masks", "features", "matcher", "initializer"].contains(&table.name) {
                let note = |name: &str| rows.iter().find(|r| r.label == name).map(|r| r.note.as_str());
                assert_eq!(note("there"), Some(""), "{}", table.name);
                assert_eq!(note("not"), Some("not installed: splatvk models fetch not_b"), "{}", table.name);
            }
        }
    }
}
