//! Gets networks: public ONNX files over HTTP, or the export of a checkpoint, into a hidden folder;
//! there they are held to their contract and to a numeric self-check, and appear whole in their
//! place or not at all. See docs/use/models.md#fetching.
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

/// The names of the packs.
pub const PACKS: [&str; 2] = ["open", "paper"];

/// A model that was fetched.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Report {
    /// Its name.
    pub id: String,
    /// Where it lies.
    pub folder: PathBuf,
    /// The files that came over the network.
    pub files: Vec<Fetched>,
    /// What the self-check did.
    pub steps: Vec<Measured>,
}

/// What there is of a model before it is fetched.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Present {
    /// Nothing.
    Absent,
    /// A folder, whose files are what its adapter pins, if it pins any.
    Sound,
    /// A folder in which a file is not what was pinned; one line that says which.
    Changed(String),
}

/// The models that packs and names stand for, each once, in the order of the catalogue.
pub fn chosen(names: &[String]) -> Result<Vec<&'static CatalogueEntry>> {
    for name in names {
        let known = PACKS.contains(&name.as_str()) || catalogue().iter().any(|k| k.id == *name);
        if !known {
            let all: Vec<&str> = PACKS.into_iter().chain(catalogue().iter().map(|k| k.id.as_str())).collect();
            return Err(Error::input(format!("{name}: no such model or pack; there are {}", all.join(", "))));
        }
    }
    let wanted = |k: &&CatalogueEntry| names.iter().any(|n| k.id == *n || k.packs.contains(n));
    let some: Vec<_> = catalogue().iter().filter(wanted).collect();
    match some.iter().find(|k| sources(k).is_empty()) {
        Some(k) => Err(Error::input(format!(
            "{}: no public source is known; export it yourself ({}, {})",
            k.id, k.source, k.export
        ))),
        None => Ok(some),
    }
}

/// Everything that is downloaded for a model: its ONNX files, or the checkpoints that are exported.
pub fn sources(entry: &CatalogueEntry) -> &[Source] {
    match &entry.recipe {
        Some(recipe) if entry.files.is_empty() => &recipe.weights,
        _ => &entry.files,
    }
}

/// The export that a model needs.
pub fn recipe(entry: &CatalogueEntry) -> Option<&Recipe> {
    entry.recipe.as_ref().filter(|_| entry.files.is_empty())
}

/// The folder in which a model is put together before it appears in `folder`.
pub fn work_folder(folder: &Path, id: &str) -> PathBuf {
    staging::root(folder, id).join("work")
}

/// Looks at a model in its folder and compares its files with what was pinned when it came.
pub fn present(entry: &CatalogueEntry, folder: &Path) -> Result<Present> {
    let place = folder.join(&entry.id);
    if place.symlink_metadata().is_err() {
        return Ok(Present::Absent);
    }
    for (name, wanted) in pinned(&place)?.sha256 {
        let file = place.join(&name);
        let found = files::content_hash(&file).unwrap_or_else(|e| format!("unreadable, {e}"));
        if found != wanted {
            let text = format!("{}: has sha256 {found}, {wanted} was pinned", file.display());
            return Ok(Present::Changed(text));
        }
    }
    Ok(Present::Sound)
}

/// Removes what interrupted fetches left of models that are installed by now, and puts back a model
/// that one had taken out to replace it; not of those in `for_continuation`, which are fetched next.
pub fn tidy(folder: &Path, for_continuation: &[&str]) -> Result<()> {
    for (root, _) in leftovers(folder) {
        let name = staging::name(&root).unwrap_or_default();
        if let Found::Left(held) = look(&root) {
            held.put_back();
        }
        if !for_continuation.contains(&name.as_str()) && folder.join(&name).exists() {
            remove_leftover(&root).map_err(Error::io(&root))?;
        }
    }
    Ok(())
}

fn pinned(place: &Path) -> Result<Adapter> {
    Adapter::of_file(&place.join("any.onnx"))
}

/// Fetches one model into `folder`, in the place of one that is there.
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
    // What only this download says that it is right, and is not, must not be taken for it the next
    // time.
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

/// The files of which the catalogue does not know the content.
fn unpinned(entry: &CatalogueEntry) -> impl Iterator<Item = &str> {
    entry.files.iter().filter(|s| s.sha256.is_none()).map(|s| s.name.as_str())
}

/// The first download of a file whose content the catalogue does not know decides what it is:
/// another one from the same address is refused.
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

/// The adapter of downloaded files: their family, what they hash to and where they are from.
fn adapter(entry: &CatalogueEntry, files: &[Fetched]) -> String {
    let table = |of: fn(&Fetched) -> &String| {
        files.iter().map(|f| (f.name.clone(), of(f).clone())).collect::<BTreeMap<_, _>>()
    };
    let lines = |map: BTreeMap<String, String>| {
        map.into_iter().map(|(name, value)| format!("{name:?} = {value:?}\n")).collect::<String>()
    };
    format!(
        "# Written by splatvk models fetch.\nfamily = {:?}\n\n[sha256]\n{}\n[source]\n{}",
        entry.family,
        lines(table(|f| &f.sha256)),
        lines(table(|f| &f.from))
    )
}

/// Holds what came to the contract of its kind and repeats references and the built-in pictures
/// with it.
fn verify(entry: &CatalogueEntry, registry: &Registry, staging: &Staging) -> Result<Vec<Measured>> {
    let useless = |why: &str| {
        Error::missing_model(
            &entry.id,
            format!(
                "{}: what came is not a model that splatvk can use, nothing was installed: {why}",
                entry.id
            ),
        )
    };
    let found = inventory(&registry.only(staging.root()).uncached());
    let model = found.models.iter().find(|m| m.name == entry.id && m.tasks.contains(&entry.task));
    let Some(model) = model else {
        let why = found.broken.first().map_or("no part of it is recognised", |b| &b.reason);
        return Err(useless(why));
    };
    match check(model) {
        Err(Error::Cancelled) => Err(Error::Cancelled),
        Err(e) => Err(useless(&e.to_string())),
        Ok(steps) => Ok(steps),
    }
}
