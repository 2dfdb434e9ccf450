//! `splatlab ablate`
use super::args::{AblateArgs, LayoutArg};
use crate::ablate::{
    self, DataSet, Finished, FinishedTable, Layout, Measurement, PaperSet, Plan, Regions, Sources, TABLES,
    Table,
};
use crate::{Error, Result};
use serde_json::{Value, json};
use splatvk::cli::outputs::WrittenFile;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::progress;
use splatvk::format::write_json;
use splatvk::gpu;
use splatvk::infer::Registry;
use splatvk::infer::installed::{Inventory, inventory};
use splatvk::run::sources::{
    FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind, choose,
};
use splatvk_types::files;
use splatvk_types::files::{Kind, Partial, check_place};
use std::path::{Path, PathBuf};
use std::time::Instant;

pub fn ablate(args: &AblateArgs) -> Result<()> {
    let registry = args.device.registry()?;
    let plan = plan(args, &registry)?;
    let sets = data_sets(&args.data, args.layout)?;
    let layout = one_layout(&sets)?;
    let paper = PaperSet::of(layout, sets.iter());
    let out = args.out.clone().unwrap_or_else(|| default_out(&sets));
    // What a report says of an earlier run is its own to go on with.
    check_place(&out, Kind::Folder, args.force || (args.resume && out.join(REPORT).is_file()))?;
    // As long as it works, no other command writes there.
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
    // Kept after every row: a long run that is stopped leaves what it has.
    let mut keep = |done: Finished| {
        let report = Report { all: done.measurements, plan: &plan, paper: &paper, head: head() };
        report.write(&out)?;
        match done.table {
            Some(table) if !args.device.json => print(&format!("{}\n", report.table(table).text())),
            _ => Ok(()),
        }
    };
    let all = ablate::run(&plan, sets, (&device, &registry), &earlier, progress.as_ref(), &mut keep);
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

/// What a run has measured so far.
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

    fn begun(&self) -> impl Iterator<Item = FinishedTable> {
        let begun = |table: &&'static Table| self.all.iter().any(|m| m.table == table.name);
        self.plan.tables.iter().copied().filter(begun).map(|table| self.table(table))
    }

    fn json(&self) -> Value {
        let mut report = self.head.clone();
        report["tables"] = self.begun().map(|table| table.json()).collect();
        report["measurements"] = json!(self.all);
        report
    }

    fn write(&self, out: &Path) -> Result<()> {
        let text = |file: &Path, text: String| {
            let write = |partial: &Path| std::fs::write(partial, text).map_err(Error::unwritable(file));
            WrittenFile::open(file, true, &[])?.keep(write)
        };
        for table in self.begun() {
            let file = |extension: &str| out.join(format!("{}.{extension}", table.table.name));
            text(&file("txt"), table.text())?;
            text(&file("svg"), table.svg())?;
        }
        WrittenFile::open(&out.join(REPORT), true, &[])?.keep(|file| write_json(file, &self.json()))
    }
}

/// The measurements of a report that an earlier run left; none where there is no report.
fn earlier(path: &Path) -> Result<Vec<Measurement>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let bad = |e: serde_json::Error| {
        Error::input(format!("{}: not a report of ablate: {e}; leave out --resume", path.display()))
    };
    let mut report: Value = files::read_json(path, "not a report of ablate, leave out --resume")?;
    serde_json::from_value(report["measurements"].take()).map_err(bad)
}

/// Data sets under the names of their folders, with as many of the folders above as tell them
/// apart.
fn data_sets(folders: &[PathBuf], layout: LayoutArg) -> Result<Vec<DataSet>> {
    let whole = |f: &PathBuf| f.canonicalize().unwrap_or_else(|_| f.clone());
    let parts: Vec<Vec<String>> = folders
        .iter()
        .map(|f| whole(f).components().map(|c| c.as_os_str().to_string_lossy().into_owned()).collect())
        .collect();
    let last = |parts: &Vec<String>, n: usize| parts[parts.len().saturating_sub(n)..].join("/");
    let distinct = |n: usize| {
        let mut names: Vec<String> = parts.iter().map(|p| last(p, n)).collect();
        names.sort();
        names.windows(2).all(|w| w[0] != w[1])
    };
    let longest = parts.iter().map(Vec::len).max().unwrap_or(1);
    let Some(n) = (1..=longest).find(|n| distinct(*n)) else {
        return Err(Error::input("--data: the same folder twice; give each once"));
    };
    let open = |(folder, parts): (&PathBuf, _)| DataSet::open(last(parts, n), folder, layout.given());
    folders.iter().zip(&parts).map(open).collect()
}

/// Figures of different protocols have no mean.
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
    let default = Plan::default();
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
    let sources = sources(args, registry)?;
    Ok(Plan {
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
        iterations: args.iterations.unwrap_or(default.iterations),
        language_iterations: args.language_iterations.unwrap_or(default.language_iterations),
    })
}

/// The sources of every row; the built-in ones where nothing is said, so that tables of different
/// machines compare.
fn sources(args: &AblateArgs, registry: &Registry) -> Result<Sources> {
    let (networks, own) = (inventory(registry), Sources::default());
    fn of<K: SourceKind>(
        text: &Option<String>,
        own: SourceChoice,
        networks: &Inventory,
    ) -> Result<SourceChoice> {
        text.as_deref().map_or(Ok(own), |text| choose::<K>(text, networks))
    }
    Ok(Sources {
        init: of::<GeometrySources>(&args.init, own.init, &networks)?,
        matcher: of::<MatchSources>(&args.matcher, own.matcher, &networks)?,
        masks: of::<MaskSources>(&args.masks, own.masks, &networks)?,
        features: of::<FeatureSources>(&args.features, own.features, &networks)?,
    })
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
