//! `splatvk ablate`: the tables of the paper's experiments on a data set with ground truth.
//!
//! A table is a list of setups ([`Setup`]) that differ in one thing. The [`Lab`] runs them and shares every stage that two
//! setups have in common: cameras, points and splats are made once for most tables. Figures are those of protocol `field`
//! on held-out frames.
mod lab;
mod setup;
mod table;

pub use lab::{Lab, Meaning, Outcome, feature_bytes};
pub use setup::{Init, Row, Setup, Source, Table, rows};
pub use table::{Done, Finished, figures};

use crate::fit::{LanguageOptions, Preset, RgbOptions};
use crate::query::eval::Split;
use crate::run::Method;
use crate::synth::regions::Flaws;
use crate::{Error, Result};

/// What to run.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Plan {
    /// In order.
    pub tables: Vec<Table>,
    /// Masks and features for every table; none = what each table is about.
    pub source: Option<Source>,
    /// Photos of the default row; none = all train frames, at most [`crate::photo::DEFAULT_VIEWS`].
    pub views: Option<usize>,
    /// Take the true cameras in every row, for photos that alone would give none.
    pub true_cameras: bool,
    /// Seed of training and of injected errors.
    pub seed: u64,
    /// Steps of the colour stage.
    pub iterations: usize,
    /// Steps of the language stage.
    pub language_iterations: usize,
}

impl Default for Plan {
    fn default() -> Self {
        Plan {
            tables: Table::ALL.to_vec(),
            source: None,
            views: None,
            true_cameras: false,
            seed: 0,
            iterations: RgbOptions::preset(Preset::Draft).iterations,
            // Three times draft's, whose features hardly leave their lifted start: methods differ in where training takes them.
            language_iterations: 3 * LanguageOptions::preset(Preset::Draft).iterations,
        }
    }
}

/// Masks and features that a table is run with when the user does not say.
fn sources(table: Table, seed: u64) -> Vec<Source> {
    let flawed = Source::Flawed(Flaws::usual(seed));
    match table {
        // What these are about is errors of masks and features; the built-in models make few on an easy scene.
        Table::Alignment | Table::Bijection | Table::Methods => vec![Source::BuiltIn, flawed],
        Table::Features => vec![Source::BuiltIn, flawed, Source::Exact],
        Table::Dimension => vec![Source::BuiltIn],
        // Perfect regions leave geometry as the only cause of a difference.
        Table::ImageLoss | Table::Points | Table::Initializer => vec![Source::Exact],
        Table::Views => vec![flawed],
    }
}

/// Runs one table.
pub fn run(lab: &mut Lab, plan: &Plan, table: Table) -> Result<Finished> {
    let count = |split| lab.truth.frames.iter().filter(|f| f.split == split).count();
    let (train, test) = (count(Split::Train), count(Split::Test));
    if train < 2 || test == 0 {
        return Err(Error::input(format!(
            "{}: {train} train and {test} test frames; ablate needs at least 2 and 1",
            lab.truth.folder.display()
        )));
    }
    let base = Setup {
        views: plan.views.unwrap_or(train.min(crate::photo::DEFAULT_VIEWS)),
        init: if plan.true_cameras { Init::TrueCameras } else { Init::Sfm },
        max_points: None,
        source: Source::BuiltIn,
        recipe: Method::SparseLgs.recipe(),
        iterations: plan.iterations,
        language_iterations: plan.language_iterations,
    };
    let sources = plan.source.clone().map_or_else(|| sources(table, plan.seed), |s| vec![s]);
    let rows = rows(table, &base, &sources, &lab.means());
    let mut finished = Finished { table, seen: Vec::new(), rows: Vec::new() };
    for mut row in rows {
        let done = match &row.setup {
            Some(setup) => {
                for frame in lab.frames(setup.views)?.into_iter().filter(|f| f.split == Split::Test) {
                    finished.seen.push(frame.stem);
                }
                match lab.outcome(setup) {
                    Ok(outcome) => Done { bytes: Some(outcome.feature_bytes), outcome: Some(outcome), row },
                    // What a device cannot hold is a finding about it; the other rows still count.
                    Err(Error::Gpu(why)) => {
                        row.note = why;
                        Done { bytes: None, outcome: None, row }
                    }
                    Err(e) => return Err(e),
                }
            }
            None if table == Table::Bijection => {
                let setup = Setup { source: find(&sources, &row.group), ..base.clone() };
                let (splats, pixels, dim) = lab.sizes(&setup)?;
                Done { bytes: Some(feature_bytes(splats, 3 * dim, pixels)), outcome: None, row }
            }
            None => Done { bytes: None, outcome: None, row },
        };
        finished.rows.push(done);
    }
    finished.seen.sort();
    finished.seen.dedup();
    Ok(finished)
}

fn find(sources: &[Source], name: &str) -> Source {
    sources.iter().find(|s| s.name() == name).cloned().unwrap_or(Source::BuiltIn)
}
