//! `splatlab ablate`: the tables of the paper's experiments on data sets with ground truth.
//!
//! A table is a list of setups ([`Setup`]) that differ in one thing. A [`Runner`] runs each on one
//! data set as a graph of stages over one store in memory: cameras, points and splats are made once
//! for most tables, and stages without random numbers once for all seeds. The result of a row is a
//! [`Measurement`]; a [`FinishedTable`] holds the means. Figures are those of protocol `field` on
//! held-out frames, or of the published protocol whose layout a data set has ([`Layout`]).
mod colmap;
mod consistency;
mod data;
mod flat;
mod measure;
mod paper;
mod runner;
mod setup;
mod shape;
mod spread;
mod stages;
mod table;
mod tables;

pub use colmap::Views;
pub use consistency::Consistency;
pub use data::{DataSet, Layout};
pub use measure::Measurement;
pub use runner::{MadeScene, Prepared, RowFigures, Runner, feature_bytes};
pub use setup::{Available, Flat, Network, Regime, Regions, RowWork, Setup, Sources, TableRow};
pub use shape::Shape;
pub use spread::{Difference, MARGIN, Spread, Verdict};
pub use stages::{EmbeddingAgreement, Scored};
pub use table::{FinishedRow, FinishedTable, PaperSet};
pub use tables::{TABLES, Table, table};

use crate::{Error, Result};
use data::Scope;
use setup::Group;
use splatvk::fit::RgbOptions;
use splatvk::gpu::Device;
use splatvk::infer::Registry;
use splatvk::progress::Progress;
use splatvk::run::method::SPARSELGS;

/// Tables to run, with the options of all rows.
#[derive(Clone, serde::Serialize)]
pub struct Plan {
    /// Tables in the order in which they run.
    pub tables: Vec<&'static Table>,
    /// Schedules and rules of all rows.
    pub regime: Regime,
    /// Sources of rows that do not vary them.
    pub sources: Sources,
    /// Masks and features of every table; `None`: those of [`Table`].
    pub regions: Option<Regions>,
    /// Photos of the default row; `None`: all train frames, at most the paper's number.
    pub views: Option<usize>,
    /// Whether every row takes the true cameras, for photos that cannot be registered.
    pub true_cameras: bool,
    /// Maximum of stereo points that splats start from, in rows that do not vary it; `None`: the
    /// preset's.
    pub max_points: Option<usize>,
    /// Seeds of cameras, stereo, training and injected errors; each is a run of its own.
    pub seeds: Vec<u64>,
    /// Steps of the colour stage.
    pub iterations: usize,
    /// Steps of the language stage.
    pub language_iterations: usize,
}

impl Default for Plan {
    fn default() -> Self {
        Plan {
            tables: TABLES.iter().collect(),
            regime: Regime::OWN,
            sources: Sources::default(),
            regions: None,
            views: None,
            true_cameras: false,
            max_points: None,
            seeds: vec![0],
            iterations: RgbOptions::preset(Regime::OWN.preset).iterations,
            language_iterations: Regime::OWN.language_iterations(),
        }
    }
}

impl Plan {
    /// Setup of rows that vary nothing.
    pub fn base(&self, lab: &Runner, regions: Regions) -> Setup {
        Setup {
            regime: self.regime,
            views: self.views.unwrap_or_else(|| lab.default_views()),
            init: self.sources.init.clone(),
            true_cameras: self.true_cameras,
            matcher: self.sources.matcher.clone(),
            points: None,
            max_points: self.max_points,
            regions,
            recipe: self.regime.recipe(SPARSELGS.recipe),
            iterations: self.iterations,
            language_iterations: self.language_iterations,
        }
    }
}

/// State of a run after a row: the measurements so far, and the table that the last of them
/// finishes.
pub struct Finished<'m> {
    /// Measurements in the order in which they were made.
    pub measurements: &'m [Measurement],
    /// A table without later measurements.
    pub table: Option<&'static Table>,
}

/// Runs the tables on every data set with every seed, one data set after the other; outputs of a
/// data set are dropped before the next. `keep` is called after every row. Rows of `earlier` with
/// the same setup are not measured again. A row that fails has a note with the reason, and the
/// others go on; the run fails where all rows fail, the device is lost, or the user stops it.
pub fn run(
    plan: &Plan,
    sets: Vec<DataSet>,
    (device, registry): (&Device, &Registry),
    earlier: &[Measurement],
    progress: &dyn Progress,
    keep: &mut dyn FnMut(Finished) -> Result<()>,
) -> Result<Vec<Measurement>> {
    let mut study = Study { plan, earlier, measurements: Vec::new(), first_error: None, keep };
    let last = sets.len().saturating_sub(1);
    for (index, set) in sets.into_iter().enumerate() {
        let name = set.name.clone();
        let mut lab = Runner::open(device, registry, set, progress);
        for (k, &seed) in plan.seeds.iter().enumerate() {
            progress.inform(&format!("{name}, seed {seed}"));
            lab.start_seed(seed);
            for table in plan.tables.iter().copied() {
                study.table(&mut lab, &name, seed, table)?;
                let finished = (index == last && k + 1 == plan.seeds.len()).then_some(table);
                (study.keep)(Finished { measurements: &study.measurements, table: finished })?;
            }
        }
    }
    match study.first_error {
        Some(error) if study.measurements.iter().all(|m| m.figures.is_empty()) => Err(error),
        _ => Ok(study.measurements),
    }
}

/// State of a run.
struct Study<'a> {
    plan: &'a Plan,
    earlier: &'a [Measurement],
    measurements: Vec<Measurement>,
    first_error: Option<Error>,
    keep: &'a mut dyn FnMut(Finished) -> Result<()>,
}

impl Study<'_> {
    /// Measures the rows of a table on one data set with one seed.
    fn table(&mut self, lab: &mut Runner, data: &str, seed: u64, table: &'static Table) -> Result<()> {
        let available = lab.available();
        let sources = &self.plan.sources;
        let given = self.plan.regions.clone().map(|regions| vec![regions]);
        let mut rows: Vec<(TableRow, bool)> = Vec::new();
        for regions in given.unwrap_or_else(|| (table.regions)(sources, &available)) {
            let base = self.plan.base(lab, regions);
            let group = Group { base, sources, available: &available };
            let group_rows = (table.rows)(&group);
            let is_base =
                |row: &TableRow| matches!(&row.runs, RowWork::Score(setup) if **setup == group.base);
            // The default setup where the table has it, else the first row.
            let reference = group_rows.iter().position(is_base).unwrap_or(0);
            rows.extend(group_rows.into_iter().enumerate().map(|(k, row)| (row, k == reference)));
        }
        let scope = lab.scope(rows.iter().map(|r| &r.0));
        for (row, reference) in &rows {
            let begun = Measurement { reference: *reference, ..Measurement::begun(table, row, data, seed) };
            let known = self.earlier.iter().find(|m| m.repeats(&begun) && !m.failed);
            let done = match known {
                Some(known) => known.clone(),
                None => self.measured(lab, row, begun, &scope)?,
            };
            self.measurements.push(done);
            (self.keep)(Finished { measurements: &self.measurements, table: None })?;
        }
        Ok(())
    }

    /// Measures a row. A failure becomes its note; a lost device and the user's stop are errors.
    fn measured(
        &mut self,
        lab: &mut Runner,
        row: &TableRow,
        begun: Measurement,
        scope: &Scope,
    ) -> Result<Measurement> {
        let outcome = match &row.runs {
            RowWork::Score(setup) => lab.outcome(setup).map(|o| Measurement {
                figures: measure::figures(&o, scope),
                iou: measure::iou(&o.scored, scope),
                ..begun.clone()
            }),
            RowWork::Flat(flat) => lab.flat(flat).map(|scored| Measurement {
                figures: measure::scores(&scored, scope),
                iou: measure::iou(&scored, scope),
                ..begun.clone()
            }),
            RowWork::Nothing => Ok(begun.clone()),
        };
        match outcome {
            // No later row can be measured without the device.
            Err(error @ (Error::Cancelled | Error::DeviceLost { .. })) => Err(error),
            Err(error) => {
                let note = error.to_string();
                self.first_error.get_or_insert(error);
                Ok(Measurement { note, failed: true, ..begun })
            }
            done => done,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk::progress::Silent;

    #[test]
    fn run_retries_failed_rows() {
        let (device, registry) = (splatvk::gpu::open(None).unwrap(), Registry::open(None).unwrap());
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/breakfast");
        // With more photos than frames every row fails before any work.
        let plan = Plan {
            tables: vec![table("alignment").unwrap()],
            regions: Some(Regions::Exact),
            views: Some(99),
            ..Plan::default()
        };
        let rows = |earlier: &[Measurement]| {
            let mut kept = Vec::new();
            let data = DataSet::open("breakfast".into(), folder.as_ref(), None).unwrap();
            run(&plan, vec![data], (&device, &registry), earlier, &Silent, &mut |f| {
                kept = f.measurements.to_vec();
                Ok(())
            })
            .unwrap_err();
            kept
        };
        let first = rows(&[]);
        assert!(first.len() == 5 && first.iter().all(|m| m.failed && m.note.contains("99 views")));
        let noted = |m: &Measurement| Measurement { note: "earlier".into(), ..m.clone() };
        assert_eq!(rows(&first.iter().map(noted).collect::<Vec<_>>()), first);
    }
}
