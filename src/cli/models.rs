//! `splatvk models list|check|path`; `fetch` has a file of its own.
use super::args::{ModelsAction, ModelsArgs};
use super::fetch::fetch;
use super::print::{print, print_json};
use crate::infer::check::{Measured, check};
use crate::infer::graph::GraphFile;
use crate::infer::installed::{CatalogueEntry, Installed, Inventory, catalogue, inventory};
use crate::infer::{ModelStatus, Registry};
use crate::{Error, Result};
use serde_json::json;
use std::fmt::Write;

pub fn models(args: &ModelsArgs) -> Result<()> {
    match &args.action {
        ModelsAction::List(device) => {
            let registry = device.registry()?;
            list(&registry, &inventory(&registry), device.json)
        }
        ModelsAction::Check(device) => {
            let registry = device.registry()?;
            check_all(&registry.uncached(), device.json)
        }
        ModelsAction::Fetch(args) => fetch(args),
        ModelsAction::Path(device) => {
            let registry = device.registry()?;
            let paths: Vec<String> = registry.folders().iter().map(|f| f.display().to_string()).collect();
            if device.json {
                print_json(&json!({ "path": paths.first(), "paths": paths }))
            } else {
                print(&format!("{}\n", paths.join("\n")))
            }
        }
    }
}

fn list(registry: &Registry, found: &Inventory, as_json: bool) -> Result<()> {
    let status = registry.status();
    if as_json {
        return print_json(&json!({
            "models": status.iter().map(to_json).collect::<Vec<_>>(),
            "known": catalogue().iter().map(|k| known_json(k, registry, found)).collect::<Vec<_>>(),
            "networks": found.models.iter().map(installed_json).collect::<Vec<_>>(),
            "broken": found.broken.iter().map(|b| json!({ "file": b.path, "fix": b.reason })).collect::<Vec<_>>(),
        }));
    }
    let mut text = String::from("Built-in pack: what splatvk uses unless told otherwise\n");
    status.iter().for_each(|m| write_built_in(&mut text, m));
    let packs = [
        ("paper", "Paper pack: the networks of the paper (splatvk models fetch paper)"),
        ("open", "Open pack: every licence permits commercial use (splatvk models fetch open)"),
        ("", "Others that splatvk can use"),
    ];
    for (pack, title) in packs {
        let _ = writeln!(text, "\n{title}");
        let of_pack = |k: &&CatalogueEntry| {
            if pack.is_empty() { k.packs.is_empty() } else { k.packs.iter().any(|p| p == pack) }
        };
        catalogue().iter().filter(of_pack).for_each(|k| write_entry(&mut text, k, registry, found));
    }
    let unlisted: Vec<&Installed> = found.models.iter().filter(|m| m.catalogue_entry().is_none()).collect();
    if !unlisted.is_empty() {
        text.push_str("\nInstalled, not in the catalogue\n");
        unlisted.iter().for_each(|m| write_installed(&mut text, m));
    }
    if !found.broken.is_empty() {
        text.push_str("\nNot usable\n");
        found.broken.iter().for_each(|b| {
            let _ = writeln!(text, "  → {}", b.reason);
        });
    }
    text.push_str("\nsplatvk models list --json also has the checksums\n");
    print(&text)
}

fn write_built_in(text: &mut String, m: &ModelStatus) {
    let kind = format!("{:?}", m.kind).to_lowercase();
    let state = if m.installed { "installed" } else { "MISSING" };
    let size = m.bytes as f64 / 1e6;
    // Writing to a String cannot fail.
    let _ =
        writeln!(text, "{kind:<10} {:<40} {state:<9} {size:7.1} MB  {:<28} {}", m.name, m.licence, m.source);
    if let Some(fix) = &m.fix {
        let _ = writeln!(text, "{:10} → {fix}", "");
    }
}

fn write_entry(text: &mut String, k: &CatalogueEntry, registry: &Registry, found: &Inventory) {
    let model = installed_entry(k, found);
    let state = if model.is_some() { "installed" } else { "-" };
    let (task, size) = (k.task.name(), f64::from(k.megabytes));
    let _ =
        writeln!(text, "{task:<10} {:<40} {state:<9} {size:7.1} MB  {:<28} {}", k.name, k.licence, k.source);
    match model {
        Some(m) => write_installed(text, m),
        None => {
            let how = match crate::fetch::sources(k).is_empty() {
                true => k.export.clone(),
                false => format!("splatvk models fetch {}, or {}", k.id, k.export),
            };
            let _ = writeln!(text, "{:10} looked for in {}; from {how}", "", expected_folder(k, registry));
        }
    }
}

fn write_installed(text: &mut String, m: &Installed) {
    let tasks: Vec<&str> = m.tasks.iter().map(|d| d.name()).collect();
    let untrained = if m.untrained() { ", UNTRAINED weights" } else { "" };
    let _ = writeln!(text, "{:10} {} in {}: {}{untrained}", "", m.name, m.folder.display(), tasks.join(", "));
    for graph in m.graphs.values() {
        let (millions, size) = (graph.parameters as f64 / 1e6, graph.bytes() as f64 / 1e6);
        let part = graph.binding.part.name();
        let _ = writeln!(
            text,
            "{:10}   {part:<15} {millions:7.1} M weights {size:8.1} MB  {}",
            "",
            graph.path.display()
        );
    }
    write_unused(text, m);
}

/// Lists graphs beside a complete model, such as CLIP's two towers in one file: harmless, but
/// possibly meant for use.
fn write_unused(text: &mut String, m: &Installed) {
    for reason in &m.unused {
        let _ = writeln!(text, "{:10}   not used: {reason}", "");
    }
}

fn installed_entry<'f>(k: &CatalogueEntry, found: &'f Inventory) -> Option<&'f Installed> {
    found.models.iter().find(|m| m.catalogue_entry().is_some_and(|known| known.id == k.id))
}

fn expected_folder(k: &CatalogueEntry, registry: &Registry) -> String {
    registry.folders().first().map_or(k.id.clone(), |f| f.join(&k.id).display().to_string())
}

fn check_all(registry: &Registry, as_json: bool) -> Result<()> {
    let found = inventory(registry);
    let status = registry.status();
    let mut problems: Vec<String> = status.iter().filter_map(|m| m.fix.clone()).collect();
    problems.extend(found.broken.iter().map(|b| b.reason.clone()));
    let mut results = Vec::new();
    if !as_json {
        let mut text = String::new();
        status.iter().for_each(|m| write_built_in(&mut text, m));
        if !found.models.is_empty() {
            let _ = writeln!(text, "\nNetworks, computed by provider {}", registry.compute().name()?);
        }
        print(&text)?;
    }
    for model in &found.models {
        let result = check(model);
        if let Err(e) = &result {
            problems.push(e.to_string());
        }
        if !as_json {
            print(&check_text(model, result.as_deref().ok()))?;
        }
        results.push(json!({
            "name": model.name, "untrained": model.untrained(), "steps": result.as_ref().ok(),
            "fix": result.as_ref().err().map(|e| e.to_string()),
        }));
    }
    if as_json {
        let models: Vec<_> = status.iter().map(to_json).collect();
        print_json(
            &json!({ "models": models, "provider": registry.compute().name().ok(), "networks": results, "problems": problems }),
        )?;
    }
    match problems.into_iter().next() {
        Some(first) => Err(Error::missing(first)),
        None => Ok(()),
    }
}

/// Seconds, memory, error and figures of a model's steps, and their warnings.
pub fn check_text(model: &Installed, steps: Option<&[Measured]>) -> String {
    let state = if steps.is_some() { "sound" } else { "NOT USABLE" };
    let untrained = if model.untrained() { " (untrained weights)" } else { "" };
    let mut text = format!("{}{untrained}: {state}\n", model.name);
    for s in steps.unwrap_or_default() {
        let error = s.error.map(|e| format!("  relative error {e:.1e}")).unwrap_or_default();
        let memory = s.peak_memory as f64 / 1e9;
        let figures: Vec<String> =
            s.figures.iter().map(|f| format!("{} {:.3}{}{}", f.name, f.value, gap(f.unit), f.unit)).collect();
        let figures = if figures.is_empty() { String::new() } else { format!("  {}", figures.join(", ")) };
        let _ = writeln!(text, "  {:<44} {:8.2} s {memory:6.2} GB{error}{figures}", s.step, s.seconds);
        if let Some(warning) = &s.warning {
            let _ = writeln!(text, "    warning: {warning}");
        }
    }
    write_unused(&mut text, model);
    text
}

/// Space before a unit; degrees have none.
fn gap(unit: &str) -> &'static str {
    if unit.is_empty() || unit == "°" { "" } else { " " }
}

/// JSON of a built-in model for `models list --json`, `doctor --json` and `run.json`.
pub fn to_json(m: &ModelStatus) -> serde_json::Value {
    json!({
        "role": format!("{:?}", m.kind).to_lowercase(), "name": m.name, "file": m.file, "installed": m.installed,
        "bytes": m.bytes, "sha256": m.sha256, "actual_sha256": m.actual_sha256, "licence": m.licence,
        "source": m.source, "fix": m.fix, "pack": "built-in",
    })
}

fn known_json(k: &CatalogueEntry, registry: &Registry, found: &Inventory) -> serde_json::Value {
    json!({
        "role": k.task, "id": k.id, "name": k.name, "family": k.family, "packs": k.packs, "licence": k.licence,
        "non_commercial": k.non_commercial, "megabytes": k.megabytes, "source": k.source, "export": k.export,
        "fetchable": !crate::fetch::sources(k).is_empty(), "looked_for": expected_folder(k, registry),
        "installed": installed_entry(k, found).is_some(),
    })
}

fn installed_json(m: &Installed) -> serde_json::Value {
    json!({
        "name": m.name, "family": m.family, "duties": m.tasks, "folder": m.folder, "untrained": m.untrained(), "unused": m.unused,
        "graphs": m.graphs.values().map(graph_json).collect::<Vec<_>>(),
    })
}

fn graph_json(g: &GraphFile) -> serde_json::Value {
    json!({
        "part": g.binding.part, "file": g.path, "parameters": g.parameters, "bytes": g.bytes(), "opset": g.opset,
        "sha256": g.pinned.iter().map(|f| json!({ "file": f.path, "pinned": f.sha256 })).collect::<Vec<_>>(),
    })
}
