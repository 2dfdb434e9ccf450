//! `splatlab ablate`
use super::args::AblateArgs;
use super::study;
use crate::ablate::{
    self, DataSet, Finished, FinishedTable, Layout, Measurement, PaperSet, Plan, TABLES, Table,
};
use crate::{Error, Result};
use serde_json::{Value, json};
use splatvk::cli::print::{print, print_json};
use splatvk::cli::progress;
use splatvk::format::write_json;
use splatvk::gpu;
use splatvk::infer::Registry;
use splatvk::run::outputs::WrittenFile;
use splatvk_types::files;
use splatvk_types::files::{Kind, Partial, check_place};
use std::path::{Path, PathBuf};
use std::time::Instant;

pub fn ablate(args: &AblateArgs) -> Result<()> {
    let registry = args.study.device.registry()?;
    let plan = plan(args, &registry)?;
    let sets = study::data_sets(&args.study.data, args.study.layout)?;
    let layout = one_layout(&sets)?;
    let paper = PaperSet::of(layout, sets.iter(), plan.regime);
    let out = args.out.clone().unwrap_or_else(|| default_out(&sets));
    // With --resume, a folder that holds a report is not in the way.
    check_place(&out, Kind::Folder, args.force || (args.resume && out.join(REPORT).is_file()))?;
    // Reserves the folder: no other command writes there meanwhile.
    let _reserved = Partial::inside(&out)?;
    check_place(&out.join(REPORT), Kind::File, true)?;
    let earlier = if args.resume { earlier(&out.join(REPORT))? } else { Vec::new() };
    let device = gpu::open(args.study.device.device.as_deref())?;
    let (clock, progress) = (Instant::now(), progress::reporter());
    let head = || {
        json!({
            "program": format!("splatvk {}", env!("CARGO_PKG_VERSION")), "data": args.study.data,
            "layout": layout, "device": device.info().name, "plan": plan, "seconds": clock.elapsed().as_secs_f64(),
        })
    };
    // Written after every row, so that a stopped run keeps its finished rows.
    let mut write_report = |done: Finished| {
        let report = Report { all: done.measurements, plan: &plan, paper: &paper, head: head() };
        report.write(&out)?;
        match done.table {
            Some(table) if !args.study.device.json => print(&format!("{}\n", report.table(table).text())),
            _ => Ok(()),
        }
    };
    let all = ablate::run(&plan, sets, (&device, &registry), &earlier, progress.as_ref(), &mut write_report);
    if let Err(Error::Cancelled | Error::DeviceLost { .. }) = all {
        let place = out.display();
        progress.inform(&format!(
            "finished rows are in {place}; the same command with --resume goes on from there"
        ));
    }
    let all = all?;
    if args.study.device.json {
        return print_json(&Report { all: &all, plan: &plan, paper: &paper, head: head() }.json());
    }
    print(&format!("tables and charts are in {} ({:.0} s)\n", out.display(), clock.elapsed().as_secs_f64()))
}

/// Name of the report in the output folder.
const REPORT: &str = "ablate.json";

/// Measurements of a run so far.
struct Report<'a> {
    all: &'a [Measurement],
    plan: &'a Plan,
    paper: &'a PaperSet,
    head: Value,
}

impl Report<'_> {
    fn table(&self, table: &'static Table) -> FinishedTable {
        FinishedTable::of(table, self.all, self.paper)
    }

    /// Tables with at least one measurement.
    fn started_tables(&self) -> impl Iterator<Item = FinishedTable> {
        let has_rows = |table: &&'static Table| self.all.iter().any(|m| m.table == table.name);
        self.plan.tables.iter().copied().filter(has_rows).map(|table| self.table(table))
    }

    fn json(&self) -> Value {
        let mut report = self.head.clone();
        report["tables"] = self.started_tables().map(|table| table.json()).collect();
        report["measurements"] = json!(self.all);
        report
    }

    fn write(&self, out: &Path) -> Result<()> {
        for table in self.started_tables() {
            let file = |extension: &str| out.join(format!("{}.{extension}", table.table.name));
            write_text(&file("txt"), table.text())?;
            write_text(&file("svg"), table.svg())?;
        }
        WrittenFile::open(&out.join(REPORT), true, &[])?.keep(|file| write_json(file, &self.json()))
    }
}

fn write_text(file: &Path, text: String) -> Result<()> {
    let write = |partial: &Path| std::fs::write(partial, text).map_err(Error::unwritable(file));
    WrittenFile::open(file, true, &[])?.keep(write)
}

/// Measurements in the report of an earlier run; empty without a report.
fn earlier(path: &Path) -> Result<Vec<Measurement>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let mut report: Value = files::read_json(path, "not a report of ablate, leave out --resume")?;
    serde_json::from_value(report["measurements"].take()).map_err(|e| {
        Error::input(format!("{}: not a report of ablate: {e}; leave out --resume", path.display()))
    })
}

/// Layout that all data sets have; an error where they differ, as figures of different protocols
/// have no common mean.
fn one_layout(sets: &[DataSet]) -> Result<Layout> {
    let first = sets.first().map_or(Layout::Own, |s| s.layout);
    match sets.iter().find(|s| s.layout != first) {
        None => Ok(first),
        Some(other) => Err(Error::input(format!(
            "--data: {} lies in another layout than {}; give them to runs of their own",
            other.name, sets[0].name
        ))),
    }
}

fn default_out(sets: &[DataSet]) -> PathBuf {
    let name = match sets {
        [one] => one.name.replace('/', "-"),
        several => format!("{}-sets", several.len()),
    };
    Path::new("out").join(format!("ablate-{name}"))
}

fn plan(args: &AblateArgs, registry: &Registry) -> Result<Plan> {
    let mut seeds = args.seeds.clone();
    seeds.sort_unstable();
    if seeds.windows(2).any(|w| w[0] == w[1]) {
        return Err(Error::input("--seeds: the same seed twice; give each once"));
    }
    let is_named = |t: &&Table| args.tables.iter().any(|name| name == "all" || t.name == name);
    let tables = TABLES.iter().filter(is_named).collect();
    Ok(Plan { tables, seeds: args.seeds.clone(), ..study::plan(&args.study, registry)? })
}
