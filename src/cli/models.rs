//! `splatvk models list|check|path`
use super::args::{ModelsAction, ModelsArgs};
use super::{print, print_json};
use crate::infer::{ModelStatus, Registry};
use crate::{Error, Result};
use serde_json::json;
use std::fmt::Write;

pub fn models(args: &ModelsArgs) -> Result<()> {
    match &args.action {
        ModelsAction::List(device) => list(&Registry::open(device.models.as_deref())?.status(), device.json),
        ModelsAction::Check(device) => {
            let registry = Registry::open(device.models.as_deref())?;
            let status = registry.status();
            list(&status, device.json)?;
            match status.iter().filter_map(|m| m.fix.as_deref()).next() {
                Some(fix) => Err(Error::missing(fix)),
                None => Ok(()),
            }
        }
        ModelsAction::Path(device) => {
            let registry = Registry::open(device.models.as_deref())?;
            let folder = registry.folder().display();
            if device.json {
                print_json(&json!({ "path": folder.to_string() }))
            } else {
                print(&format!("{folder}\n"))
            }
        }
    }
}

fn list(status: &[ModelStatus], as_json: bool) -> Result<()> {
    if as_json {
        return print_json(&json!({ "models": status.iter().map(to_json).collect::<Vec<_>>() }));
    }
    let mut text = String::new();
    for m in status {
        let role = format!("{:?}", m.role).to_lowercase();
        let state = if m.installed { "installed" } else { "MISSING" };
        let size = m.bytes as f64 / 1e6;
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "{role:<10} {:<28} {state:<9} {size:6.1} MB  {:<12} {}",
            m.name, m.licence, m.source
        );
        let _ = writeln!(text, "{:10} sha256 {}", "", m.sha256);
        if let Some(fix) = &m.fix {
            let _ = writeln!(text, "{:10} → {fix}", "");
        }
    }
    print(&text)
}

/// The JSON of one model, as `models list --json`, `doctor --json` and `run.json` print it.
pub fn to_json(m: &ModelStatus) -> serde_json::Value {
    json!({
        "role": format!("{:?}", m.role).to_lowercase(), "name": m.name, "file": m.file, "installed": m.installed,
        "bytes": m.bytes, "sha256": m.sha256, "actual_sha256": m.actual_sha256, "licence": m.licence,
        "source": m.source, "fix": m.fix,
    })
}
