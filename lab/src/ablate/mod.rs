//! `splatlab ablate`: the tables of the paper's experiments on data sets with ground truth.
//!
//! A table is a list of setups ([`Setup`]) that differ in one thing. A [`Runner`] runs each on one
//! data set as a graph of stages over one store in memory: cameras, points and splats are made once
//! for most tables, and what no random number enters once for all seeds. What a row gave is a
//! [`Measurement`]; a [`FinishedTable`] is the means of all of them. Figures are those of protocol
//! `field` on held-out frames, or of the published protocol whose layout a data set has
//! ([`Layout`]).
mod data;
mod flat;
mod measure;
mod paper;
mod runner;
mod setup;
mod spread;
mod stages;
mod table;
mod tables;

pub use data::{DataSet, Layout};
pub use measure::Measurement;
pub use runner::{RowFigures, Runner, feature_bytes};
pub use setup::{Available, Network, Regions, RowWork, Setup, Sources, TableRow};
pub use spread::{Difference, Spread};
pub use stages::{EmbeddingAgreement, Scored};
pub use table::{FinishedRow, FinishedTable, PaperSet};
pub use tables::{TABLES, Table, table};

use crate::{Error, Result};
use data::Scope;
use setup::Group;
use splatvk::fit::{LanguageOptions, Preset, RgbOptions};
use splatvk::gpu::Device;
use splatvk::infer::Registry;
use splatvk::progress::Progress;
use splatvk::run::method::SPARSELGS;

/// What to run.
#[derive(Clone, serde::Serialize)]
pub struct Plan {
    /// In order.
    pub tables: Vec<&'static Table>,
    /// What rows take that do not vary it.
    pub sources: Sources,
    /// Masks and features for every table; none = what each table is about.
    pub regions: Option<Regions>,
    /// Photos of the default row; none = all train frames, at most as many as the paper takes.
    pub views: Option<usize>,
    /// Take the true cameras in every row, for photos that alone would give none.
    pub true_cameras: bool,
    /// Most stereo points that splats start from, in rows that do not vary it; none = the preset's.
    pub max_points: Option<usize>,
    /// Each a run of its own: of cameras, stereo, training and injected errors.
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
            sources: Sources::default(),
            regions: None,
            views: None,
            true_cameras: false,
            max_points: None,
            seeds: vec![0],
            iterations: RgbOptions::preset(Preset::Draft).iterations,
            // Three times draft's, whose features hardly leave their lifted start: methods differ
            // in where training takes them.
            language_iterations: 3 * LanguageOptions::preset(Preset::Draft).iterations,
        }
    }
}

/// What a run has got to: the measurements so far, and the table that is finished with the last of
/// them.
pub struct Finished<'m> {
    /// In the order in which they were made.
    pub measurements: &'m [Measurement],
    /// A table that no later measurement belongs to.
    pub table: Option<&'static Table>,
}

/// Runs the tables on every data set with every seed, one data set after the other, and drops what
/// was made of one before the next. `keep` is told after every row. Rows of `earlier` that were
/// measured the same way are taken from there. A row that cannot be measured says why and the
/// others go on; an error is what stopped every row, a lost device, or the user.
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
    for (at, set) in sets.into_iter().enumerate() {
        let name = set.name.clone();
        let mut lab = Runner::open(device, registry, set, progress);
        for (k, &seed) in plan.seeds.iter().enumerate() {
            progress.inform(&format!("{name}, seed {seed}"));
            lab.start_seed(seed);
            for table in plan.tables.iter().copied() {
                study.table(&mut lab, &name, seed, table)?;
                let finished = (at == last && k + 1 == plan.seeds.len()).then_some(table);
                (study.keep)(Finished { measurements: &study.measurements, table: finished })?;
            }
        }
    }
    match study.first_error {
        Some(error) if study.measurements.iter().all(|m| m.figures.is_empty()) => Err(error),
        _ => Ok(study.measurements),
    }
}

/// A run that is under way.
struct Study<'a> {
    plan: &'a Plan,
    earlier: &'a [Measurement],
    measurements: Vec<Measurement>,
    first_error: Option<Error>,
    keep: &'a mut dyn FnMut(Finished) -> Result<()>,
}

impl Study<'_> {
    /// Runs the rows of a table on one data set with one seed.
    fn table(&mut self, lab: &mut Runner, data: &str, seed: u64, table: &'static Table) -> Result<()> {
        let available = lab.available();
        let sources = &self.plan.sources;
        let given = self.plan.regions.clone().map(|regions| vec![regions]);
        let mut rows: Vec<(TableRow, bool)> = Vec::new();
        for regions in given.unwrap_or_else(|| (table.regions)(sources, &available)) {
            let base = self.base(lab, regions);
            let group = Group { base, sources, available: &available };
            let of_group = (table.rows)(&group);
            let is_base = |row: &TableRow| matches!(&row.runs, RowWork::Score(setup) if *setup == group.base);
            // The program's own way where the table has it, else the first row.
            let reference = of_group.iter().position(is_base).unwrap_or(0);
            rows.extend(of_group.into_iter().enumerate().map(|(k, row)| (row, k == reference)));
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

    fn base(&self, lab: &Runner, regions: Regions) -> Setup {
        let Plan { sources, views, true_cameras, max_points, iterations, language_iterations, .. } =
            self.plan;
        Setup {
            views: views.unwrap_or_else(|| lab.default_views()),
            init: sources.init.clone(),
            true_cameras: *true_cameras,
            matcher: sources.matcher.clone(),
            max_points: *max_points,
            regions,
            recipe: SPARSELGS.recipe,
            iterations: *iterations,
            language_iterations: *language_iterations,
        }
    }

    /// Runs a row. What stops it is a finding about it; the other rows still count.
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
            RowWork::Flat(features) => lab.flat(features).map(|scored| Measurement {
                figures: measure::scores(&scored, scope),
                iou: measure::iou(&scored, scope),
                ..begun.clone()
            }),
            RowWork::MemoryOnly(setup) => lab.unreduced_bytes(setup).map(|bytes| Measurement {
                figures: std::iter::once(("MB".to_owned(), bytes as f64 / 1e6)).collect(),
                ..begun.clone()
            }),
            RowWork::Nothing => Ok(begun.clone()),
        };
        match outcome {
            // Without its device no later row can be measured either.
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
    fn rows_that_failed_in_an_earlier_run_are_tried_again() {
        let (device, registry) = (splatvk::gpu::open(None).unwrap(), Registry::open(None).unwrap());
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/breakfast");
        // More photos than there are frames: every row fails before any work.
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
