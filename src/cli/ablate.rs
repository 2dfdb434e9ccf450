//! `splatvk ablate`
use super::args::AblateArgs;
use super::plan::existing;
use super::print::{print, print_json};
use super::progress;
use crate::ablate::{self, FinishedTable, Plan, Regions, Runner, TABLES, Table};
use crate::format::{create_folder, write_json};
use crate::gpu::Device;
use crate::query::eval::GroundTruth;
use crate::{Error, Result};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

pub fn ablate(args: &AblateArgs) -> Result<()> {
    let plan = plan(args)?;
    let truth = GroundTruth::read(&args.data)?;
    if truth.labels.is_empty() {
        return Err(Error::input(format!(
            "{}: no labels to ask for in ground_truth.json",
            args.data.display()
        )));
    }
    let out = args.out.clone().unwrap_or_else(|| default_out(&args.data));
    create_folder(&out).map_err(|e| Error::input(format!("{e}; choose another --out")))?;
    let registry = args.device.registry()?;
    let device = Device::open(args.device.device.as_deref())?;
    let (clock, name) = (Instant::now(), device.info().name.clone());
    let progress = progress::reporter();
    let mut lab = Runner::open(device, registry, truth, plan.seed, progress.as_ref());
    let mut tables: Vec<Value> = Vec::new();
    let mut report = Value::Null;
    for table in plan.tables.iter().copied() {
        let finished = ablate::run(&mut lab, &plan, table)?;
        tables.push(finished.json());
        report = json!({
            "program": format!("splatvk {}", env!("CARGO_PKG_VERSION")), "data": args.data, "device": name, "plan": plan,
            "seconds": clock.elapsed().as_secs_f64(), "tables": tables,
        });
        // Kept after every table: a long run that is stopped leaves what it has.
        write(&out, &finished, &report)?;
        if !args.device.json {
            print(&format!("{}\n", finished.text()))?;
        }
    }
    if args.device.json {
        return print_json(&report);
    }
    print(&format!("tables and charts are in {} ({:.0} s)\n", out.display(), clock.elapsed().as_secs_f64()))
}

fn write(out: &Path, finished: &FinishedTable, report: &Value) -> Result<()> {
    let file = |extension: &str| out.join(format!("{}.{extension}", finished.table.name));
    std::fs::write(file("txt"), finished.text()).map_err(Error::unwritable(file("txt")))?;
    std::fs::write(file("svg"), finished.svg()).map_err(Error::unwritable(file("svg")))?;
    write_json(&out.join("ablate.json"), report)
}

fn default_out(data: &Path) -> PathBuf {
    let folder = data.canonicalize().unwrap_or_else(|_| data.to_path_buf());
    let name = folder.file_name().map_or_else(|| "data".into(), |n| n.to_string_lossy().into_owned());
    Path::new("out").join(format!("ablate-{name}"))
}

fn plan(args: &AblateArgs) -> Result<Plan> {
    let default = Plan::default();
    for (flag, value) in
        [("--iterations", args.iterations), ("--language-iterations", args.language_iterations)]
    {
        if value == Some(0) {
            return Err(Error::input(format!("{flag} 0: give at least 1, or leave it out")));
        }
    }
    Ok(Plan {
        tables: args.tables.iter().flat_map(|t| tables(t)).collect(),
        regions: args.regions.as_deref().map(|s| regions(s, args.seed)).transpose()?,
        views: args.views,
        true_cameras: args.true_cameras,
        seed: args.seed,
        iterations: args.iterations.unwrap_or(default.iterations),
        language_iterations: args.language_iterations.unwrap_or(default.language_iterations),
    })
}

fn tables(name: &str) -> Vec<&'static Table> {
    TABLES.iter().filter(|t| name == "all" || t.name == name).collect()
}

fn regions(text: &str, seed: u64) -> Result<Regions> {
    match text.split_once(':') {
        Some(("dir", dir)) if !dir.is_empty() => Ok(Regions::given(existing("--regions", dir)?)),
        None if text == "built-in" => Ok(Regions::built_in()),
        None if text == "flawed" => Ok(Regions::flawed(seed)),
        None if text == "exact" => Ok(Regions::EXACT),
        _ => Err(Error::input(format!(
            "--regions {text}: unknown; use one of: built-in, flawed, exact, dir:DIR"
        ))),
    }
}
