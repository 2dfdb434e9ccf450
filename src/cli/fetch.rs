//! `splatvk models fetch`: lists sources and licences, asks once, then runs [`crate::fetch`].
use std::fmt::Write;
use std::io::IsTerminal;
use std::path::Path;

use serde_json::{Value, json};

use super::args::FetchArgs;
use super::print::{print, print_json};
use super::progress::reporter;
use crate::fetch::{self, Client, Present, Report};
use crate::infer::catalogue::{CatalogueEntry, Source};
use crate::infer::installed::inventory;
use crate::infer::{self, Registry};
use crate::run::sources;
use crate::{Error, Result};

/// A requested model.
struct Requested {
    entry: &'static CatalogueEntry,
    present: Present,
}

pub fn fetch(args: &FetchArgs) -> Result<()> {
    let places = Registry::places(args.device.models.as_deref())?;
    let folder = places.first().ok_or_else(|| Error::input("--models: names no folder"))?;
    let client = Client::from_environment()?;
    let all = fetch::chosen(&args.names)?
        .into_iter()
        .map(|entry| Ok(Requested { entry, present: fetch::present(entry, folder)? }))
        .collect::<Result<Vec<Requested>>>()?;
    if args.dry_run {
        return match args.device.json {
            true => print_json(&json!({
                "folder": folder,
                "models": all.iter().map(|w| model_json(w, folder, &client)).collect::<Vec<_>>(),
            })),
            false => print(&all.iter().map(|w| model_text(w, folder, &client)).collect::<String>()),
        };
    }
    let mut missing = Vec::new();
    for requested in &all {
        match &requested.present {
            _ if args.force => missing.push(requested.entry),
            Present::Absent => missing.push(requested.entry),
            Present::Changed(problem) => {
                return Err(Error::missing(format!("{problem}; --force fetches it again")));
            }
            Present::Sound => {}
        }
    }
    check_licences(&missing, &args.accept)?;
    // An export needs Python, which may be missing: before it comes everything that needs none.
    missing.sort_by_key(|entry| entry.recipe.is_some());
    if !args.device.json {
        print(&all.iter().map(|w| model_text(w, folder, &client)).collect::<String>())?;
    }
    let mut reports = Vec::new();
    if !missing.is_empty() {
        confirm(args, &missing)?;
        // The check at the end needs it; without it an hour of downloading would be lost.
        infer::runtime()?;
        std::fs::create_dir_all(folder).map_err(Error::unwritable(folder))?;
        let registry = args.device.registry()?;
        fetch::tidy(folder, &missing.iter().map(|k| k.id.as_str()).collect::<Vec<_>>())?;
        let progress = reporter();
        for entry in missing {
            let report = fetch::fetch(entry, &registry, folder, &client, progress.as_ref())?;
            if !args.device.json {
                print(&report_text(&report, entry))?;
            }
            reports.push(report);
        }
    }
    print_summary(args, &all, &reports)
}

/// Refuses models whose licence forbids uses unless it was accepted.
fn check_licences(missing: &[&CatalogueEntry], accept: &[String]) -> Result<()> {
    let open: Vec<_> =
        missing.iter().filter(|k| !accept.contains(&k.id)).filter_map(|k| Some((k, k.forbids()?))).collect();
    match open.first() {
        None => Ok(()),
        Some((first, uses)) => Err(Error::input(format!(
            "{}: {} forbids {uses} ({}); to fetch it all the same: {}",
            first.id,
            first.licence,
            first.source,
            open.iter().map(|(k, _)| format!("--accept {}", k.id)).collect::<Vec<_>>().join(" ")
        ))),
    }
}

/// Asks for confirmation once.
fn confirm(args: &FetchArgs, missing: &[&CatalogueEntry]) -> Result<()> {
    if args.yes {
        return Ok(());
    }
    let megabytes: f64 = missing.iter().map(|k| size(k)).sum();
    let plural = if missing.len() == 1 { "" } else { "s" };
    let summary = format!("{} model{plural}, {megabytes:.0} MB", missing.len());
    if !std::io::stdin().is_terminal() || !std::io::stderr().is_terminal() {
        return Err(Error::input(format!(
            "models fetch: {summary}: nobody can be asked; --yes agrees, --dry-run shows"
        )));
    }
    eprint!("Fetch {summary}? [y/N] ");
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer).map_err(Error::io("standard input"))?;
    match answer.trim().to_lowercase().as_str() {
        "y" | "yes" => Ok(()),
        _ => Err(Error::Cancelled),
    }
}

/// Size of the download, megabytes.
fn size(entry: &CatalogueEntry) -> f64 {
    let known: Option<u64> = fetch::sources(entry).iter().map(|s| s.bytes).sum();
    known.map_or(f64::from(entry.megabytes), |bytes| bytes as f64 / 1e6)
}

fn model_text(requested: &Requested, folder: &Path, client: &Client) -> String {
    let entry = requested.entry;
    let state = match (&requested.present, entry.forbids()) {
        (Present::Sound, _) => "; is there".to_owned(),
        (Present::Changed(problem), _) => format!("; {problem}"),
        (Present::Absent, Some(uses)) => format!("; not for {uses}, needs --accept {}", entry.id),
        (Present::Absent, None) => String::new(),
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

fn model_json(requested: &Requested, folder: &Path, client: &Client) -> Value {
    let entry = requested.entry;
    let file = |s: &Source| json!({ "from": s.from, "address": client.address(s), "name": s.name, "bytes": s.bytes, "sha256": s.sha256 });
    json!({
        "id": entry.id, "name": entry.name, "licence": entry.licence, "non_commercial": entry.non_commercial,
        "megabytes": size(entry), "source": entry.source, "to": folder.join(&entry.id), "present": requested.present,
        "files": fetch::sources(entry).iter().map(file).collect::<Vec<_>>(), "commands": commands(entry, folder),
    })
}

/// Text about an installed model, with its newly pinned checksums.
fn report_text(report: &Report, entry: &CatalogueEntry) -> String {
    let mut text = format!("{}: installed in {}\n", report.id, report.folder.display());
    for file in &report.files {
        let known = fetch::sources(entry).iter().any(|s| s.name == file.name && s.sha256.is_some());
        let pin = if known { "as the catalogue says" } else { "pinned from now on" };
        let _ = writeln!(text, "    {} {} bytes, sha256 {}, {pin}", file.name, file.bytes, file.sha256);
    }
    for step in &report.steps {
        let _ = writeln!(text, "    {}: {:.2} s", step.step, step.seconds);
        if let Some(warning) = &step.warning {
            let _ = writeln!(text, "    warning: {warning}");
        }
    }
    text
}

fn print_summary(args: &FetchArgs, all: &[Requested], reports: &[Report]) -> Result<()> {
    if args.device.json {
        let names: Vec<&str> = all.iter().map(|w| w.entry.id.as_str()).collect();
        return print_json(&json!({ "fetched": reports, "installed": names }));
    }
    let lines = sources::list(&inventory(&args.device.registry()?));
    print(&lines.iter().map(|(option, found)| format!("{option}: {found}\n")).collect::<String>())
}
