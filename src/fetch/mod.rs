//! Installation of networks: public ONNX files over HTTP, or the export of a checkpoint, into a
//! hidden folder. There they must pass their contract and a numeric self-check; then they appear
//! complete in their place, else not at all. See docs/use/models.md#fetching.
mod download;
mod export;
mod meter;
mod staging;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use download::{Client, Fetched, Limits, MIRROR};
pub use export::commands;
pub use staging::leftovers;

use crate::files::{Found, look, remove_leftover};
use crate::infer::Registry;
use crate::infer::adapter::Adapter;
use crate::infer::catalogue::{CatalogueEntry, Recipe, Source, catalogue};
use crate::infer::check::{Measured, check};
use crate::infer::installed::inventory;
use crate::progress::Progress;
use crate::{Error, Result, files};
use staging::Staging;

/// Names of the packs.
pub const PACKS: [&str; 2] = ["open", "paper"];

/// A fetched model.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Report {
    /// Name of the model.
    pub id: String,
    /// Folder of the model.
    pub folder: PathBuf,
    /// Downloaded files.
    pub files: Vec<Fetched>,
    /// Steps of the self-check.
    pub steps: Vec<Measured>,
}

/// State of a model before it is fetched.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Present {
    /// No folder.
    Absent,
    /// A folder whose files match the checksums of its adapter, if it pins any.
    Sound,
    /// A folder with a file that differs from its pinned checksum; one line names it.
    Changed(String),
}

/// Models of packs and names, each once, in the order of the catalogue.
pub fn chosen(names: &[String]) -> Result<Vec<&'static CatalogueEntry>> {
    for name in names {
        let known = PACKS.contains(&name.as_str()) || catalogue().iter().any(|k| k.id == *name);
        if !known {
            let all: Vec<&str> = PACKS.into_iter().chain(catalogue().iter().map(|k| k.id.as_str())).collect();
            return Err(Error::input(format!("{name}: no such model or pack; there are {}", all.join(", "))));
        }
    }
    let is_named = |k: &&CatalogueEntry| names.iter().any(|n| k.id == *n || k.packs.contains(n));
    let models: Vec<_> = catalogue().iter().filter(is_named).collect();
    match models.iter().find(|k| sources(k).is_empty()) {
        Some(k) => Err(Error::input(format!(
            "{}: no public source is known; export it yourself ({}, {})",
            k.id, k.source, k.export
        ))),
        None => Ok(models),
    }
}

/// Downloads of a model: its ONNX files, or the checkpoints for its export.
pub fn sources(entry: &CatalogueEntry) -> &[Source] {
    match &entry.recipe {
        Some(recipe) if entry.files.is_empty() => &recipe.weights,
        _ => &entry.files,
    }
}

/// Export recipe of a model without public ONNX files.
pub fn recipe(entry: &CatalogueEntry) -> Option<&Recipe> {
    entry.recipe.as_ref().filter(|_| entry.files.is_empty())
}

/// Folder in which a model for `folder` is put together.
pub fn work_folder(folder: &Path, id: &str) -> PathBuf {
    staging::root(folder, id).join("work")
}

/// Compares the files of an installed model with the checksums pinned at its installation.
pub fn present(entry: &CatalogueEntry, folder: &Path) -> Result<Present> {
    let place = folder.join(&entry.id);
    if place.symlink_metadata().is_err() {
        return Ok(Present::Absent);
    }
    for (name, expected) in pinned(&place)?.sha256 {
        let file = place.join(&name);
        let found = files::content_hash(&file).unwrap_or_else(|e| format!("unreadable, {e}"));
        if found != expected {
            let text = format!("{}: has sha256 {found}, {expected} was pinned", file.display());
            return Ok(Present::Changed(text));
        }
    }
    Ok(Present::Sound)
}

/// Restores models that interrupted fetches had moved aside, and removes their leftovers for
/// installed models, except those in `requested`, which are fetched next.
pub fn tidy(folder: &Path, requested: &[&str]) -> Result<()> {
    for (root, _) in leftovers(folder) {
        let name = staging::name(&root).unwrap_or_default();
        if let Found::Left(held) = look(&root) {
            held.put_back();
        }
        if !requested.contains(&name.as_str()) && folder.join(&name).exists() {
            remove_leftover(&root).map_err(Error::io(&root))?;
        }
    }
    Ok(())
}

fn pinned(place: &Path) -> Result<Adapter> {
    Adapter::of_file(&place.join("any.onnx"))
}

/// Fetches one model into `folder`; replaces an installed one.
pub fn fetch(
    entry: &CatalogueEntry,
    registry: &Registry,
    folder: &Path,
    client: &Client,
    progress: &dyn Progress,
) -> Result<Report> {
    let staging = Staging::open(folder, &entry.id)?;
    let files = match recipe(entry) {
        Some(recipe) => export::export(entry, recipe, &staging, client, progress)?,
        None => download_files(entry, &staging, folder, client, progress)?,
    };
    progress.begin("check", 1);
    // A wrong file that only this download pins must not be trusted next time.
    let steps = verify(entry, registry, &staging).inspect_err(|_| staging.discard(unpinned(entry)))?;
    progress.step(1, "");
    progress.end();
    Ok(Report { id: entry.id.clone(), folder: staging.install()?, files, steps })
}

fn download_files(
    entry: &CatalogueEntry,
    staging: &Staging,
    folder: &Path,
    client: &Client,
    progress: &dyn Progress,
) -> Result<Vec<Fetched>> {
    let model = staging.model();
    let mut files = Vec::new();
    for source in &entry.files {
        let to = model.join(&source.name);
        files.push(client.download(source, entry.ceiling(), &staging.work(), &to, progress)?);
    }
    same_as_before(&files, &folder.join(&entry.id)).inspect_err(|_| staging.discard(unpinned(entry)))?;
    let path = model.join("adapter.toml");
    files::write(&path, &[adapter(entry, &files).as_bytes()]).map_err(Error::unwritable(&path))?;
    Ok(files)
}

/// Files without a checksum in the catalogue.
fn unpinned(entry: &CatalogueEntry) -> impl Iterator<Item = &str> {
    entry.files.iter().filter(|s| s.sha256.is_none()).map(|s| s.name.as_str())
}

/// Refuses a file that differs from the first download of the same address, if the catalogue has no
/// checksum of it.
fn same_as_before(files: &[Fetched], place: &Path) -> Result<()> {
    let Adapter { sha256, source, .. } = pinned(place)?;
    for file in files.iter().filter(|f| source.get(&f.name) == Some(&f.from)) {
        if let Some(old) = sha256.get(&file.name).filter(|old| **old != file.sha256) {
            return Err(Error::missing(format!(
                "{}: the file there has changed since it was first fetched (sha256 {}, {old} was pinned); to take the new one, remove \
                 {} first",
                file.from,
                file.sha256,
                place.display()
            )));
        }
    }
    Ok(())
}

/// Adapter of downloaded files: family, checksums and addresses.
fn adapter(entry: &CatalogueEntry, files: &[Fetched]) -> String {
    format!(
        "# Written by splatvk models fetch.\nfamily = {:?}\n\n[sha256]\n{}\n[source]\n{}",
        entry.family,
        toml_table(files, |f| &f.sha256),
        toml_table(files, |f| &f.from)
    )
}

/// Lines of a TOML table from file name to value, ordered by name.
fn toml_table(files: &[Fetched], value: fn(&Fetched) -> &String) -> String {
    let rows: BTreeMap<&String, &String> = files.iter().map(|f| (&f.name, value(f))).collect();
    rows.into_iter().map(|(name, value)| format!("{name:?} = {value:?}\n")).collect()
}

/// Verifies the model against the contract of its kind, its references and the built-in images.
fn verify(entry: &CatalogueEntry, registry: &Registry, staging: &Staging) -> Result<Vec<Measured>> {
    let unusable = |reason: &str| {
        Error::missing_model(
            &entry.id,
            format!(
                "{}: what came is not a model that splatvk can use, nothing was installed: {reason}",
                entry.id
            ),
        )
    };
    let found = inventory(&registry.only(staging.root()).uncached());
    let model = found.models.iter().find(|m| m.name == entry.id && m.tasks.contains(&entry.task));
    let Some(model) = model else {
        let reason = found.broken.first().map_or("no part of it is recognised", |b| &b.reason);
        return Err(unusable(reason));
    };
    match check(model) {
        Err(Error::Cancelled) => Err(Error::Cancelled),
        Err(e) => Err(unusable(&e.to_string())),
        Ok(steps) => Ok(steps),
    }
}
