//! `splatlab ablate`
use super::args::{AblateArgs, LayoutArg};
use crate::ablate::{
    self, DataSet, Finished, FinishedTable, Layout, Measurement, PaperSet, Plan, Regime, Regions, Sources,
    TABLES, Table,
};
use crate::{Error, Result};
use serde_json::{Value, json};
use splatvk::cli::outputs::WrittenFile;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::progress;
use splatvk::fit::RgbOptions;
use splatvk::format::write_json;
use splatvk::gpu;
use splatvk::infer::Registry;
use splatvk::infer::installed::{Inventory, inventory};
use splatvk::run::paper::PaperSources;
use splatvk::run::sources::{
    FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind, choose,
};
use splatvk::run::{Compat, GeometryConfig, LanguageConfig, ReconstructionConfig, TrainingConfig};
use splatvk_types::files;
use splatvk_types::files::{Kind, Partial, check_place};
use std::path::{Path, PathBuf};
use std::time::Instant;

pub fn ablate(args: &AblateArgs) -> Result<()> {
    let registry = args.device.registry()?;
    let plan = plan(args, &registry)?;
    let sets = data_sets(&args.data, args.layout)?;
    let layout = one_layout(&sets)?;
    let paper = PaperSet::of(layout, sets.iter(), plan.regime);
    let out = args.out.clone().unwrap_or_else(|| default_out(&sets));
    // With --resume, a folder that holds a report is not in the way.
    check_place(&out, Kind::Folder, args.force || (args.resume && out.join(REPORT).is_file()))?;
    // Reserves the folder: no other command writes there meanwhile.
    let _reserved = Partial::inside(&out)?;
    check_place(&out.join(REPORT), Kind::File, true)?;
    let earlier = if args.resume { earlier(&out.join(REPORT))? } else { Vec::new() };
    let device = gpu::open(args.device.device.as_deref())?;
    let (clock, progress) = (Instant::now(), progress::reporter());
    let head = || {
        json!({
            "program": format!("splatvk {}", env!("CARGO_PKG_VERSION")), "data": args.data,
            "layout": layout, "device": device.info().name, "plan": plan, "seconds": clock.elapsed().as_secs_f64(),
        })
    };
    // Written after every row, so that a stopped run keeps its finished rows.
    let mut write_report = |done: Finished| {
        let report = Report { all: done.measurements, plan: &plan, paper: &paper, head: head() };
        report.write(&out)?;
        match done.table {
            Some(table) if !args.device.json => print(&format!("{}\n", report.table(table).text())),
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
    if args.device.json {
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

/// Opens data sets. Their names are the last components of their paths, as many as make all names
/// distinct.
pub(super) fn data_sets(folders: &[PathBuf], layout: LayoutArg) -> Result<Vec<DataSet>> {
    let absolute = |f: &PathBuf| f.canonicalize().unwrap_or_else(|_| f.clone());
    let parts: Vec<Vec<String>> = folders
        .iter()
        .map(|f| absolute(f).components().map(|c| c.as_os_str().to_string_lossy().into_owned()).collect())
        .collect();
    let longest = parts.iter().map(Vec::len).max().unwrap_or(1);
    let Some(n) = (1..=longest).find(|n| are_distinct(&parts, *n)) else {
        return Err(Error::input("--data: the same folder twice; give each once"));
    };
    let open = |(folder, parts): (&PathBuf, &Vec<String>)| {
        DataSet::open(last_components(parts, n), folder, layout.given())
    };
    folders.iter().zip(&parts).map(open).collect()
}

/// Whether the last `n` components of every path make a name of its own.
fn are_distinct(parts: &[Vec<String>], n: usize) -> bool {
    let mut names: Vec<String> = parts.iter().map(|p| last_components(p, n)).collect();
    names.sort();
    names.windows(2).all(|w| w[0] != w[1])
}

fn last_components(parts: &[String], n: usize) -> String {
    parts[parts.len().saturating_sub(n)..].join("/")
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
    for (flag, value) in
        [("--iterations", args.iterations), ("--language-iterations", args.language_iterations)]
    {
        if value == Some(0) {
            return Err(Error::input(format!("{flag} 0: give at least 1, or leave it out")));
        }
    }
    let mut seeds = args.seeds.clone();
    seeds.sort_unstable();
    if seeds.windows(2).any(|w| w[0] == w[1]) {
        return Err(Error::input("--seeds: the same seed twice; give each once"));
    }
    let (regime, sources) = regime(args, sources(args, registry)?, registry)?;
    Ok(Plan {
        regime,
        tables: TABLES
            .iter()
            .filter(|t| args.tables.iter().any(|name| name == "all" || t.name == name))
            .collect(),
        regions: args.regions.as_deref().map(|s| regions(s, &sources)).transpose()?,
        sources,
        views: args.views,
        true_cameras: args.true_cameras,
        max_points: args.max_points,
        seeds: args.seeds.clone(),
        iterations: args.iterations.unwrap_or_else(|| RgbOptions::preset(regime.preset).iterations),
        language_iterations: args.language_iterations.unwrap_or_else(|| regime.language_iterations()),
    })
}

/// Schedules and rules of every row, and with --paper the paper's networks.
fn regime(args: &AblateArgs, sources: Sources, registry: &Registry) -> Result<(Regime, Sources)> {
    if !args.paper {
        let compat = args.compat.as_deref().map_or(Ok(None), Compat::named)?;
        return Ok((Regime { preset: args.preset, compat, published: false }, sources));
    }
    let named = |source: &Option<String>, own: SourceChoice| match source {
        Some(_) => own,
        None => SourceChoice::named("auto"),
    };
    let config = ReconstructionConfig {
        geometry: GeometryConfig { init: named(&args.init, sources.init), ..GeometryConfig::default() },
        training: TrainingConfig::default(),
        language: Some(LanguageConfig {
            paper: true,
            paper_sources: args.paper_sources,
            matcher: named(&args.matcher, sources.matcher),
            masks: named(&args.masks, sources.masks),
            features: named(&args.features, sources.features),
            ..LanguageConfig::default()
        }),
    };
    let config = config.resolved(&inventory(registry))?;
    let language = config.language.unwrap_or_default();
    let regime = Regime {
        preset: config.training.preset.unwrap_or(Regime::OWN.preset),
        compat: language.compat,
        published: args.paper_sources == PaperSources::Own,
    };
    let LanguageConfig { matcher, masks, features, .. } = language;
    Ok((regime, Sources { init: config.geometry.init, matcher, masks, features }))
}

/// Sources of every row. Options that are not given default to the built-in sources, so that tables
/// of different machines are comparable.
fn sources(args: &AblateArgs, registry: &Registry) -> Result<Sources> {
    let (networks, own) = (inventory(registry), Sources::default());
    Ok(Sources {
        init: choose_or::<GeometrySources>(&args.init, own.init, &networks)?,
        matcher: choose_or::<MatchSources>(&args.matcher, own.matcher, &networks)?,
        masks: choose_or::<MaskSources>(&args.masks, own.masks, &networks)?,
        features: choose_or::<FeatureSources>(&args.features, own.features, &networks)?,
    })
}

fn choose_or<K: SourceKind>(
    text: &Option<String>,
    default: SourceChoice,
    networks: &Inventory,
) -> Result<SourceChoice> {
    text.as_deref().map_or(Ok(default), |text| choose::<K>(text, networks))
}

fn regions(text: &str, own: &Sources) -> Result<Regions> {
    match text.split_once(':') {
        Some(("dir", dir)) if !dir.is_empty() => Ok(Regions::given(existing("--regions", dir)?)),
        None if text == "built-in" => Ok(own.regions()),
        None if text == "flawed" => Ok(Regions::Flawed),
        None if text == "exact" => Ok(Regions::Exact),
        _ => Err(Error::input(format!(
            "--regions {text}: unknown; use one of: built-in, flawed, exact, dir:DIR"
        ))),
    }
}

fn existing(flag: &str, path: &str) -> Result<PathBuf> {
    let path = PathBuf::from(path);
    if path.exists() {
        return Ok(path);
    }
    Err(Error::input(format!("{flag}: {} does not exist; check the path", path.display())))
}
