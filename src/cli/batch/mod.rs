//! `splatvk batch`: many captures, a scene each, on the devices of this machine.
mod child;
mod manifest;
mod queue;
mod row;
mod shard;
mod store;
mod table;

use super::print::{print, print_json};
use super::progress;
use crate::gpu;
use crate::progress::Progress;
use crate::{Error, Result};
use child::Ending;
use clap::{Args, ValueEnum};
use manifest::{Manifest, Row};
use queue::{BatchDevice, Counts, Job, Limits, Queue};
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};
use row::RowKey;
pub use row::{BatchRowArgs, batch_row};
use serde_json::json;
use shard::Shard;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fmt::Write;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Duration;
use store::{Failure, FailureKind, Store};

/// Free space under which no batch begins, bytes: a scene with the states that its training keeps.
const LEAST_SPACE: u64 = 1 << 30;

/// `splatvk batch`
#[derive(Debug, Args)]
pub struct BatchArgs {
    /// Rows: .jsonl with id, input, options, queries and exports; .csv with id and input; a folder
    /// of folders of photos; - for lines on standard input
    #[arg(value_name = "CAPTURES")]
    pub manifest: PathBuf,
    /// Folder of the results: ID/_SUCCESS.json, ID/scene, ID/exports, summary.csv, index.html
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Machine, or cluster, that works; a cluster needs the Python package with its extra batch
    #[arg(long, value_enum, default_value = "local")]
    pub engine: Engine,
    /// Devices that work side by side: all GPUs, or a list as of --device, separated by commas
    /// [default: the best one]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub devices: Vec<String>,
    /// Rows that share a device
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = super::args::whole::<usize>(1..=64))]
    pub per_device: usize,
    /// Part of the rows for this machine: I/N with I from 0, or auto in an array job (Slurm, AWS
    /// and Google Batch; auto/N on Kubernetes)
    #[arg(long, value_name = "I/N")]
    pub shard: Option<Shard>,
    /// Longest time of a row, with s, m or h [default: none]
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub timeout: Option<Duration>,
    /// Further attempts after a lost device or a killed process
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = super::args::whole::<usize>(0..=20))]
    pub retries: usize,
    /// Start no further row after so many failed: a number, or a share of the rows with % [default:
    /// none]
    #[arg(long, value_name = "N|P%", value_parser = bound)]
    pub max_failures: Option<Bound>,
    /// Only rows whose last attempt failed, refused ones included
    #[arg(long, value_enum, value_name = "WHICH")]
    pub only: Option<Only>,
    /// Check every row and print the plan; make nothing
    #[arg(long)]
    pub dry_run: bool,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// Where a batch runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Engine {
    /// This machine
    Local,
    /// A Ray cluster
    Ray,
}

/// Choice of rows by their last attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Only {
    /// Those that failed
    Failed,
}

/// Largest number of failures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bound {
    /// Rows.
    Rows(usize),
    /// Share of the rows.
    Share(f64),
}

fn bound(text: &str) -> Result<Bound, String> {
    let wrong = || "give a number of rows, or a share such as 10%".to_owned();
    match text.strip_suffix('%') {
        None => text.parse().map(Bound::Rows).map_err(|_| wrong()),
        Some(share) => match share.parse::<f64>() {
            Ok(share) if (0.0..=100.0).contains(&share) => Ok(Bound::Share(share / 100.0)),
            _ => Err(wrong()),
        },
    }
}

fn time(text: &str) -> Result<Duration, String> {
    let units = [("s", 1.0), ("m", 60.0), ("h", 3600.0)];
    let (number, unit) =
        units.iter().find_map(|(u, s)| Some((text.strip_suffix(u)?, *s))).unwrap_or((text, 1.0));
    match number.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds < 1e7 => Ok(Duration::from_secs_f64(seconds * unit)),
        _ => Err("give a time such as 90s, 20m or 2h".to_owned()),
    }
}

/// Use of a row in this batch.
enum Plan<'a> {
    /// Its result has this key.
    Kept(&'a Row),
    /// It was refused with this key before.
    Refused(Failure),
    /// It is unusable.
    Failed(Failure),
    /// It is to be made.
    Make(&'a Row, RowKey),
}

pub fn batch(args: &BatchArgs) -> Result<()> {
    if args.engine == Engine::Ray {
        // `hand_over` saw it before the options were parsed, unless it stands elsewhere.
        return Err(Error::input("--engine ray belongs behind batch: splatvk batch --engine ray ..."));
    }
    let manifest = Manifest::read(&args.manifest, &args.out)?;
    let rows = chosen_rows(args, &manifest);
    let devices = devices(&args.devices)?;
    let store = Store::at(&args.out)?;
    let progress = progress::reporter();
    let rows = only(args, rows, &store);
    let keys = check_rows(&manifest, &rows, progress.as_ref())?;
    let mut plans = Vec::with_capacity(rows.len());
    for (row, key) in rows.iter().zip(keys) {
        plans.push(plan(args, &store, row, key)?);
    }
    if args.dry_run {
        return report_plan(args, &store, &rows, &plans, &devices);
    }
    work(args, &manifest, &store, plans, &devices, progress.as_ref())
}

/// The rows of the shard.
fn chosen_rows<'a>(args: &BatchArgs, manifest: &'a Manifest) -> Vec<&'a Row> {
    let in_shard = |i: usize| args.shard.is_none_or(|shard| shard.has(i));
    manifest.rows.iter().enumerate().filter(|(i, _)| in_shard(*i)).map(|(_, row)| row).collect()
}

/// The rows that `--only` leaves.
fn only<'a>(args: &BatchArgs, rows: Vec<&'a Row>, store: &Store) -> Vec<&'a Row> {
    match args.only {
        None => rows,
        Some(Only::Failed) => rows.into_iter().filter(|row| store.failure(&row.id).is_some()).collect(),
    }
}

/// The devices of a list, each once.
fn devices(list: &[String]) -> Result<Vec<BatchDevice>> {
    let survey = |choice: Option<&str>| splatvk_gpu::survey(&gpu::options(choice)).map_err(Error::from);
    let all = survey(None)?;
    let usable: Vec<_> =
        all.devices.into_iter().enumerate().filter_map(|(i, d)| Some((i, d.info.ok()?))).collect();
    let of = |info: splatvk_gpu::DeviceInfo| {
        // Two drivers of one card report one UUID.
        let mut alike = usable.iter().filter(|(_, other)| other.uuid == info.uuid);
        let index = alike.clone().find(|(_, other)| other.driver == info.driver).map(|(i, _)| i.to_string());
        let is_unique = alike.nth(1).is_none();
        let choice = index.filter(|_| !is_unique).unwrap_or_else(|| format!("uuid:{}", info.uuid));
        BatchDevice { choice, name: info.name, is_cpu: info.is_cpu }
    };
    let found: Vec<BatchDevice> = if list.is_empty() {
        vec![of(all.chosen?)]
    } else if list == ["all"] {
        let gpus = usable.iter().map(|(_, info)| info).filter(|info| !info.is_cpu);
        let gpus: Vec<_> = gpus.cloned().map(of).collect();
        if gpus.is_empty() { vec![of(all.chosen?)] } else { gpus }
    } else {
        list.iter().map(|choice| Ok(of(survey(Some(choice))?.chosen?))).collect::<Result<_>>()?
    };
    let mut seen = BTreeSet::new();
    Ok(found.into_iter().filter(|device| seen.insert(device.choice.clone())).collect())
}

/// Keys of the rows, or why a row cannot be made; each row is read by a process of its own.
fn check_rows(
    manifest: &Manifest,
    rows: &[&Row],
    progress: &dyn Progress,
) -> Result<Vec<Result<RowKey, Ending>>> {
    let program = child::program()?;
    progress.begin("check", rows.len() as u64);
    let checked = rows.par_iter().map(|row| {
        progress.check()?;
        let command = child::command(&program, &manifest.base, &["--key"]);
        let (ending, output) = child::output(command, &json!(row).to_string())?;
        match ending {
            Ending::Done => serde_json::from_slice(&output)
                .map(Ok)
                .map_err(|e| Error::work(format!("batch-row --key: {e}"))),
            failed => Ok(Err(failed)),
        }
    });
    let checked = checked.collect();
    progress.end();
    checked
}

fn plan<'a>(args: &BatchArgs, store: &Store, row: &'a Row, key: Result<RowKey, Ending>) -> Result<Plan<'a>> {
    let key = match key {
        Ok(key) => key,
        Err(ending) => {
            return match Failure::of(&row.id, "", 0, &ending) {
                Some(failure) => Ok(Plan::Failed(failure)),
                None => Err(Error::Cancelled),
            };
        }
    };
    if let Err(error) = store.check_place(&row.id) {
        let failed = Ending::Failed {
            code: error.exit_code(),
            message: error.to_string(),
            kind: error.kind().to_owned(),
        };
        return Ok(Failure::of(&row.id, &key.key, 0, &failed).map_or(Plan::Kept(row), Plan::Failed));
    }
    if store.success(&row.id).is_some_and(|s| s["key"] == key.key) {
        return Ok(Plan::Kept(row));
    }
    let failure = store.failure(&row.id).filter(|f| f.key == key.key && f.kind == FailureKind::Refused);
    if let Some(failure) = failure.filter(|_| args.only.is_none()) {
        return Ok(Plan::Refused(failure));
    }
    Ok(Plan::Make(row, key))
}

/// Makes the rows and writes the tables.
fn work(
    args: &BatchArgs,
    manifest: &Manifest,
    store: &Store,
    plans: Vec<Plan<'_>>,
    devices: &[BatchDevice],
    progress: &dyn Progress,
) -> Result<()> {
    let events =
        args.shard.map_or("events.jsonl".to_owned(), |s| format!("events-{}-of-{}.jsonl", s.index, s.count));
    store.open(&events)?;
    if store.free().is_some_and(|free| free < LEAST_SPACE) {
        let source = std::io::Error::from(std::io::ErrorKind::StorageFull);
        return Err(Error::Unwritable { path: args.out.clone(), source });
    }
    let total = plans.len();
    let (mut kept, mut refused, mut before) = (0, 0, 0);
    let mut jobs = Vec::new();
    for plan in plans {
        match plan {
            Plan::Kept(row) => {
                // Of a change that was taken back.
                store.forget_failure(&row.id)?;
                kept += 1;
            }
            Plan::Refused(_) => before += 1,
            Plan::Failed(failure) => {
                progress.warn(&format!("{}: {}: {}", failure.id, failure.kind.name(), failure.message));
                store.event("failed", json!({ "id": failure.id, "failure": failure }))?;
                store.fail(&failure, None)?;
                refused += 1;
            }
            Plan::Make(row, key) => jobs.push(Job { row, key }),
        }
    }
    let names = devices.iter().map(|d| d.name.as_str()).collect::<Vec<_>>().join(", ");
    progress.inform(&format!(
        "{total} captures: {kept} done before, {} refused, {} to make on {names}",
        refused + before,
        jobs.len()
    ));
    let most = match args.max_failures {
        None => usize::MAX,
        Some(Bound::Rows(rows)) => rows,
        Some(Bound::Share(share)) => (share * total as f64) as usize,
    };
    let limits = Limits {
        per_device: args.per_device,
        retries: args.retries,
        timeout: args.timeout,
        max_failures: most,
    };
    store.event("start", json!({ "rows": total, "make": jobs.len(), "devices": names }))?;
    let counts = Queue::new(manifest, store, &limits, jobs, refused)?.work(devices, progress);
    table::write(manifest, store)?;
    let Counts { done, failed, elsewhere, left } = counts?;
    let failed = failed + refused + before;
    store.event("end", json!({ "done": done, "failed": failed, "left": left }))?;
    let index = args.out.join("index.html");
    if args.json {
        print_json(&json!({
            "rows": total, "kept": kept, "done": done, "failed": failed, "elsewhere": elsewhere, "left": left,
            "index": index,
        }))?;
    } else {
        let mut text = format!("{done} made, {kept} kept, {failed} failed");
        if elsewhere > 0 {
            let _ = write!(text, ", {elsewhere} in another process");
        }
        if left > 0 {
            let _ = write!(text, ", {left} not made");
        }
        print(&format!("{text}\n{}\n", crate::report::shell_quoted(&index)))?;
    }
    progress.check()?;
    match failed + left {
        0 => Ok(()),
        _ if failed - before > most => Err(Error::work(format!(
            "stopped after {failed} failed rows (--max-failures); the reasons are in {}",
            args.out.join("summary.csv").display()
        ))),
        _ => Err(Error::work(format!(
            "{failed} rows failed; the reasons are in {}, and --only failed tries them again",
            args.out.join("summary.csv").display()
        ))),
    }
}

/// Prints the plan of `--dry-run`.
fn report_plan(
    args: &BatchArgs,
    store: &Store,
    rows: &[&Row],
    plans: &[Plan<'_>],
    devices: &[BatchDevice],
) -> Result<()> {
    let mut table = vec![["row".to_owned(), "photos".to_owned(), "MB".to_owned(), "plan".to_owned()]];
    let mut make = 0;
    let mut lines = Vec::new();
    for (row, plan) in rows.iter().zip(plans) {
        let (size, text) = match plan {
            Plan::Kept(_) => (None, "done".to_owned()),
            Plan::Refused(f) | Plan::Failed(f) => (None, format!("{}: {}", f.kind.name(), f.message)),
            Plan::Make(_, key) => {
                make += 1;
                let bytes: u64 = key.inputs.iter().map(|i| i.bytes).sum();
                (Some((key.photos, bytes as f64 / 1e6)), "make".to_owned())
            }
        };
        let (photos, megabytes) =
            size.map_or_else(Default::default, |(n, mb)| (n.to_string(), format!("{mb:.1}")));
        lines.push(json!({ "id": row.id, "plan": text }));
        table.push([row.id.clone(), photos, megabytes, text]);
    }
    let seconds = typical_seconds(store, rows);
    let places = devices.len() * args.per_device;
    let estimate = seconds.map(|s| s * make as f64 / places as f64);
    let names: Vec<&str> = devices.iter().map(|d| d.name.as_str()).collect();
    if args.json {
        print_json(&json!({ "rows": lines, "make": make, "devices": names, "seconds": estimate }))?;
        return check_plans(plans);
    }
    let mut text = columns(&table);
    let time = match estimate {
        Some(seconds) => format!("about {}", crate::report::duration(seconds)),
        None => "no time is known before the first row is done".to_owned(),
    };
    let _ = writeln!(text, "\n{make} of {} rows to make on {}; {time}", rows.len(), names.join(", "));
    print(&text)?;
    check_plans(plans)
}

/// An error where a row is refused: a script is to notice.
fn check_plans(plans: &[Plan<'_>]) -> Result<()> {
    let refused = plans.iter().filter(|plan| matches!(plan, Plan::Refused(_) | Plan::Failed(_))).count();
    if refused == 0 {
        return Ok(());
    }
    Err(Error::input(format!("{refused} of {} rows are refused; see the plan", plans.len())))
}

/// Median seconds of the finished rows.
fn typical_seconds(store: &Store, rows: &[&Row]) -> Option<f64> {
    let mut all: Vec<f64> =
        rows.iter().filter_map(|row| store.success(&row.id)?["seconds"].as_f64()).collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied()
}

/// Rows of text with aligned columns.
fn columns<const N: usize>(rows: &[[String; N]]) -> String {
    let width = |i: usize| rows.iter().map(|row| row[i].chars().count()).max().unwrap_or(0);
    let widths: [usize; N] = std::array::from_fn(width);
    let mut text = String::new();
    for row in rows {
        let cells: Vec<String> =
            row.iter().zip(widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        let _ = writeln!(text, "{}", cells.join("  ").trim_end());
    }
    text
}

/// Hands a command line `splatvk batch ... --engine ray ...` over to the Python package, whose
/// engine has options of its own; returns only where that fails, or is not asked for.
///
/// # Errors
/// No Python.
pub fn hand_over(arguments: &[OsString]) -> Result<()> {
    let Some(at) = arguments.iter().position(|a| a == "batch") else { return Ok(()) };
    let rest = &arguments[at + 1..];
    let joined = rest.iter().any(|a| a == "--engine=ray");
    let apart = rest.windows(2).any(|pair| pair[0] == "--engine" && pair[1] == "ray");
    // Another command may have an argument of this name.
    if at > 3 || !(joined || apart) {
        return Ok(());
    }
    let python = std::env::var_os("SPLATVK_PYTHON").unwrap_or_else(|| "python3".into());
    let missing = |why: &str| {
        let python = python.to_string_lossy();
        Error::missing(format!("--engine ray needs Python with the package splatvk[batch]; {python} {why}"))
    };
    let cannot_run = |e: std::io::Error| missing(&format!("cannot be run: {}", crate::error::words(&e)));
    let mut probe = Command::new(&python);
    let found =
        probe.args(["-c", "import splatvk.batch, ray"]).stderr(Stdio::null()).status().map_err(cannot_run)?;
    if !found.success() {
        return Err(missing("has no such package; pip install 'splatvk[batch]' brings it"));
    }
    Err(cannot_run(Command::new(&python).args(["-m", "splatvk.batch"]).args(rest).exec()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_and_bounds_have_units() {
        assert_eq!(time("90"), Ok(Duration::from_secs(90)));
        assert_eq!(time("1.5m"), Ok(Duration::from_secs(90)));
        assert_eq!(time("2h"), Ok(Duration::from_secs(7200)));
        assert!(["", "m", "-1s", "1d", "nan"].iter().all(|t| time(t).is_err()));
        assert_eq!((bound("3"), bound("12.5%")), (Ok(Bound::Rows(3)), Ok(Bound::Share(0.125))));
        assert!(["", "%", "-1", "101%"].iter().all(|t| bound(t).is_err()));
    }
}
