//! `splatvk ablate`: the tables of the paper's experiments on a data set with ground truth.
//!
//! A table is a list of setups ([`Setup`]) that differ in one thing. The [`Runner`] runs each as a graph of stages over one
//! store in memory: cameras, points and splats are made once for most tables. Figures are those of protocol `field` on
//! held-out frames.
mod runner;
mod stages;
mod table;
mod tables;

pub use runner::{RowFigures, Runner, feature_bytes};
pub use stages::{EmbeddingAgreement, Scored};
pub use table::{FinishedRow, FinishedTable, figures};
pub use tables::{Available, NetworkFamily, Regions, RowWork, Setup, TABLES, Table, TableRow, table};

use crate::fit::{LanguageOptions, Preset, RgbOptions};
use crate::query::eval::Split;
use crate::run::{method::SPARSELGS, sources};
use crate::{Error, Result};

/// What to run.
#[derive(Clone, serde::Serialize)]
pub struct Plan {
    /// In order.
    pub tables: Vec<&'static Table>,
    /// Masks and features for every table; none = what each table is about.
    pub regions: Option<Regions>,
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
            tables: TABLES.iter().collect(),
            regions: None,
            views: None,
            true_cameras: false,
            seed: 0,
            iterations: RgbOptions::preset(Preset::Draft).iterations,
            // Three times draft's, whose features hardly leave their lifted start: methods differ in where training takes them.
            language_iterations: 3 * LanguageOptions::preset(Preset::Draft).iterations,
        }
    }
}

/// Runs one table.
pub fn run(lab: &mut Runner, plan: &Plan, table: &'static Table) -> Result<FinishedTable> {
    let count = |split| lab.truth.frames.iter().filter(|f| f.split == split).count();
    let (train, test) = (count(Split::Train), count(Split::Test));
    if train < 2 || test == 0 {
        return Err(Error::input(format!(
            "{}: {train} train and {test} test frames; ablate needs at least 2 and 1",
            lab.truth.folder.display()
        )));
    }
    let available = lab.available();
    let given = plan.regions.clone().map(|regions| vec![regions]);
    let mut finished = FinishedTable { table, seen: Vec::new(), rows: Vec::new() };
    for regions in given.unwrap_or_else(|| (table.regions)(plan.seed, &available)) {
        let base = Setup {
            views: plan.views.unwrap_or(train.min(crate::photo::DEFAULT_VIEWS)),
            init: sources::default::<sources::GeometrySources>(),
            true_cameras: plan.true_cameras,
            max_points: None,
            regions,
            recipe: SPARSELGS.recipe,
            iterations: plan.iterations,
            language_iterations: plan.language_iterations,
        };
        let group = tables::Group { base, available: &available };
        for row in (table.rows)(&group) {
            finished.rows.push(done(lab, row, &mut finished.seen)?);
        }
    }
    finished.seen.sort();
    finished.seen.dedup();
    Ok(finished)
}

/// Runs a row; `seen` collects held-out frames that it has seen as photos.
fn done(lab: &mut Runner, mut row: TableRow, seen: &mut Vec<String>) -> Result<FinishedRow> {
    let setup = match &row.runs {
        RowWork::Score(setup) => setup,
        RowWork::MemoryOnly(setup) => {
            let bytes = Some(lab.unreduced_bytes(setup)?);
            return Ok(FinishedRow { bytes, outcome: None, row });
        }
        RowWork::Nothing => return Ok(FinishedRow { bytes: None, outcome: None, row }),
    };
    let photos = lab.frames(setup.views)?.into_iter();
    seen.extend(photos.filter(|f| f.split == Split::Test).map(|f| f.stem));
    match lab.outcome(setup) {
        Ok(outcome) => Ok(FinishedRow { bytes: Some(outcome.feature_bytes), outcome: Some(outcome), row }),
        // What a device cannot hold is a finding about it; the other rows still count.
        Err(e @ (Error::Gpu { .. } | Error::OutOfDeviceMemory { .. })) => {
            row.note = e.to_string();
            Ok(FinishedRow { bytes: None, outcome: None, row })
        }
        Err(e) => Err(e),
    }
}
