//! `splatvk models fetch`: what comes from where under which licence, one question, then the work
//! of [`crate::fetch`].
use std::fmt::Write;
use std::io::IsTerminal;
use std::path::Path;

use serde_json::{Value, json};

use super::args::FetchArgs;
use super::print::{print, print_json};
use super::progress::reporter;
use crate::fetch::{self, Client, Present, Report};
use crate::infer::catalogue::CatalogueEntry;
use crate::infer::installed::inventory;
use crate::infer::{self, Registry};
use crate::run::sources;
use crate::{Error, Result};

/// A model that was asked for.
struct Wanted {
    entry: &'static CatalogueEntry,
    present: Present,
}

pub fn fetch(args: &FetchArgs) -> Result<()> {
    let places = Registry::places(args.device.models.as_deref())?;
    let folder = places.first().ok_or_else(|| Error::input("--models: names no folder"))?;
    let client = Client::from_environment()?;
    let look = |entry| Ok(Wanted { entry, present: fetch::present(entry, folder)? });
    let all = fetch::chosen(&args.names)?.into_iter().map(look).collect::<Result<Vec<Wanted>>>()?;
    if args.dry_run {
        return match args.device.json {
            true => print_json(&json!({
                "folder": folder,
                "models": all.iter().map(|w| plan(w, folder, &client)).collect::<Vec<_>>(),
            })),
            false => print(&all.iter().map(|w| listed(w, folder, &client)).collect::<String>()),
        };
    }
    let mut missing = Vec::new();
    for wanted in &all {
        match &wanted.present {
            _ if args.force => missing.push(wanted.entry),
            Present::Absent => missing.push(wanted.entry),
            Present::Changed(why) => return Err(Error::missing(format!("{why}; --force fetches it again"))),
            Present::Sound => {}
        }
    }
    accepted(&missing, &args.accept)?;
    if !args.device.json {
        print(&all.iter().map(|w| listed(w, folder, &client)).collect::<String>())?;
    }
    let mut reports = Vec::new();
    if !missing.is_empty() {
        agreed(args, &missing)?;
        // The check at the end needs it; better said before an hour of downloading.
        infer::runtime()?;
        std::fs::create_dir_all(folder).map_err(Error::unwritable(folder))?;
        let registry = args.device.registry()?;
        fetch::tidy(folder, &missing.iter().map(|k| k.id.as_str()).collect::<Vec<_>>())?;
        let progress = reporter();
        for entry in missing {
            let report = fetch::fetch(entry, &registry, folder, &client, progress.as_ref())?;
            if !args.device.json {
                print(&installed(&report, entry))?;
            }
            reports.push(report);
        }
    }
    closing(args, &all, &reports)
}

/// Licences that forbid commercial use want a word of their own.
fn accepted(missing: &[&CatalogueEntry], accept: &[String]) -> Result<()> {
    let open: Vec<_> = missing.iter().filter(|k| k.non_commercial && !accept.contains(&k.id)).collect();
    match open.first() {
        None => Ok(()),
        Some(first) => Err(Error::input(format!(
            "{}: {} forbids commercial use ({}); to fetch it all the same: {}",
            first.id,
            first.licence,
            first.source,
            open.iter().map(|k| format!("--accept {}", k.id)).collect::<Vec<_>>().join(" ")
        ))),
    }
}

/// Asks once.
fn agreed(args: &FetchArgs, missing: &[&CatalogueEntry]) -> Result<()> {
    if args.yes {
        return Ok(());
    }
    let megabytes: f64 = missing.iter().map(|k| size(k)).sum();
    let plural = if missing.len() == 1 { "" } else { "s" };
    let what = format!("{} model{plural}, {megabytes:.0} MB", missing.len());
    if !std::io::stdin().is_terminal() || !std::io::stderr().is_terminal() {
        return Err(Error::input(format!(
            "models fetch: {what}: nobody can be asked; --yes agrees, --dry-run shows"
        )));
    }
    eprint!("Fetch {what}? [y/N] ");
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer).map_err(Error::io("standard input"))?;
    match answer.trim().to_lowercase().as_str() {
        "y" | "yes" => Ok(()),
        _ => Err(Error::Cancelled),
    }
}

/// Megabytes to download.
fn size(entry: &CatalogueEntry) -> f64 {
    let known: Option<u64> = fetch::sources(entry).iter().map(|s| s.bytes).sum();
    known.map_or(f64::from(entry.megabytes), |bytes| bytes as f64 / 1e6)
}

fn listed(wanted: &Wanted, folder: &Path, client: &Client) -> String {
    let entry = wanted.entry;
    let state = match (&wanted.present, entry.non_commercial) {
        (Present::Sound, _) => "; is there".to_owned(),
        (Present::Changed(why), _) => format!("; {why}"),
        (Present::Absent, true) => format!("; not for commercial use, needs --accept {}", entry.id),
        (Present::Absent, false) => String::new(),
    };
    let to = folder.join(&entry.id);
    let mut text = format!(
        "{}: {}, {}, {:.0} MB, to {}{state}\n",
        entry.id,
        entry.name,
        entry.licence,
        size(entry),
        to.display()
    );
    for source in fetch::sources(entry) {
        let bytes = source.bytes.map_or("size unknown".to_owned(), |b| format!("{b} bytes"));
        let pin =
            source.sha256.as_ref().map_or("pinned at first fetch".to_owned(), |s| format!("sha256 {s}"));
        // Writing to a string cannot fail.
        let _ = writeln!(text, "    {} → {}, {bytes}, {pin}", client.address(source), source.name);
    }
    commands(entry, folder).iter().for_each(|c| {
        let _ = writeln!(text, "    $ {c}");
    });
    text
}

fn commands(entry: &CatalogueEntry, folder: &Path) -> Vec<String> {
    let work = fetch::work_folder(folder, &entry.id);
    fetch::recipe(entry).map_or(Vec::new(), |r| fetch::commands(r, &work, &work.with_file_name(&entry.id)))
}

fn plan(wanted: &Wanted, folder: &Path, client: &Client) -> Value {
    let entry = wanted.entry;
    let file = |s: &crate::infer::catalogue::Source| json!({ "from": s.from, "address": client.address(s), "name": s.name, "bytes": s.bytes, "sha256": s.sha256 });
    json!({
        "id": entry.id, "name": entry.name, "licence": entry.licence, "non_commercial": entry.non_commercial,
        "megabytes": size(entry), "source": entry.source, "to": folder.join(&entry.id), "present": wanted.present,
        "files": fetch::sources(entry).iter().map(file).collect::<Vec<_>>(), "commands": commands(entry, folder),
    })
}

/// What came, with the checksums that are pinned from now on.
fn installed(report: &Report, entry: &CatalogueEntry) -> String {
    let mut text = format!("{}: installed in {}\n", report.id, report.folder.display());
    for file in &report.files {
        let known = fetch::sources(entry).iter().any(|s| s.name == file.name && s.sha256.is_some());
        let pin = if known { "as the catalogue says" } else { "pinned from now on" };
        let _ = writeln!(text, "    {} {} bytes, sha256 {}, {pin}", file.name, file.bytes, file.sha256);
    }
    for step in &report.steps {
        let _ = writeln!(text, "    {}: {:.2} s", step.step, step.seconds);
    }
    text
}

fn closing(args: &FetchArgs, all: &[Wanted], reports: &[Report]) -> Result<()> {
    if args.device.json {
        let there: Vec<&str> = all.iter().map(|w| w.entry.id.as_str()).collect();
        return print_json(&json!({ "fetched": reports, "installed": there }));
    }
    let lines = sources::list(&inventory(&args.device.registry()?));
    print(&lines.iter().map(|(option, found)| format!("{option}: {found}\n")).collect::<String>())
}
