//! Installed networks of users: the `.onnx` files in the model folders, recognised and grouped into
//! models.
//!
//! A folder is a model (`sam_vit_b/encoder.onnx`, `sam_vit_b/decoder.onnx`); files that lie
//! directly in a model folder belong together when their names do (`sam_vit_b_encoder.onnx`,
//! `sam_vit_b_decoder.onnx`).
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::cache::fingerprint;
pub use super::catalogue::{CatalogueEntry, Task, catalogue};
use super::compute::Compute;
use super::contract::Part;
use super::graph::GraphFile;
pub use super::graph::HashedFile;
use super::registry::Registry;
use crate::{Error, Result};

/// A complete installed model.
#[derive(Clone, Debug)]
pub struct Installed {
    /// Name of its folder, or the common part of its file names.
    pub name: String,
    /// Its name in `--init` and similar options.
    pub family: String,
    /// Its tasks.
    pub tasks: Vec<Task>,
    /// Its graphs, one per part.
    pub graphs: BTreeMap<Part, GraphFile>,
    /// Where it lies.
    pub folder: PathBuf,
    /// Reasons why further graphs in its folder cannot be used.
    pub unused: Vec<String>,
}

impl Installed {
    /// The graph of a part.
    pub fn graph(&self, part: Part) -> Result<&GraphFile> {
        self.graphs.get(&part).ok_or_else(|| {
            let (folder, name) = (self.folder.display(), &self.name);
            Error::missing_model(name, format!("{folder}: model {name} has no {}", part.name()))
        })
    }

    /// Execution settings.
    pub fn compute(&self) -> Compute {
        self.graphs.values().next().map(|g| g.compute.clone()).unwrap_or_default()
    }

    /// Whether one of its graphs is untrained.
    pub fn untrained(&self) -> bool {
        self.graphs.values().any(|g| g.untrained)
    }

    /// Its files with their sha256.
    pub fn files(&self) -> Result<Vec<HashedFile>> {
        let files = self.graphs.values().flat_map(|g| std::iter::once(&g.path).chain(&g.external));
        let hash = |file: &PathBuf| {
            Ok(HashedFile { path: file.clone(), sha256: fingerprint(file).map_err(Error::io(file))? })
        };
        files.map(hash).collect()
    }

    /// Rank in the catalogue's order of preference; networks outside of it come last.
    fn rank(&self) -> usize {
        let own = self.catalogue_entry().map(|k| &k.id);
        catalogue().iter().position(|k| Some(&k.id) == own).unwrap_or(usize::MAX)
    }

    /// The catalogue entry with its name.
    pub fn catalogue_entry(&self) -> Option<&'static CatalogueEntry> {
        // "sam_vit_b" is longer, so more specific, than "sam".
        catalogue().iter().filter(|k| self.name.starts_with(&k.id)).max_by_key(|k| k.id.len())
    }
}

/// A file or folder that is no usable model.
#[derive(Clone, Debug)]
pub struct BrokenFile {
    /// Where it lies.
    pub path: PathBuf,
    /// Reason and remedy, one line.
    pub reason: String,
}

/// Contents of the model folders beside the built-in pack.
#[derive(Debug, Default)]
pub struct Inventory {
    /// Complete models.
    pub models: Vec<Installed>,
    /// Files that cannot be used.
    pub broken: Vec<BrokenFile>,
}

impl Inventory {
    /// The most preferred network for a task that has trained weights.
    pub fn best(&self, task: Task) -> Option<&Installed> {
        let fitting = self.models.iter().filter(|m| m.tasks.contains(&task) && !m.untrained());
        // A network with this as its main task comes first.
        fitting.min_by_key(|m| (m.tasks.first() != Some(&task), m.rank()))
    }
}

/// Sets of parts that form a model, and its tasks.
const WHOLE: [(&[Part], &[Task]); 9] = [
    (&[Part::Pair], &[Task::Geometry, Task::Depth]),
    (&[Part::PairEncoder, Part::PairDecoder], &[Task::Geometry, Task::Depth]),
    (&[Part::MultiView], &[Task::Geometry, Task::Depth]),
    (&[Part::Depth], &[Task::Depth]),
    (&[Part::Warp], &[Task::Matcher]),
    (&[Part::MaskEncoder, Part::MaskDecoder], &[Task::Masks]),
    (&[Part::ImageTower, Part::TextTower], &[Task::Features, Task::Text]),
    (&[Part::DenseFeatures, Part::TextTower], &[Task::Features, Task::Text]),
    (&[Part::ConceptImage, Part::ConceptText, Part::ConceptDecoder], &[Task::Concepts]),
];

/// Recognises every `.onnx` file in the folders of `registry` and one folder below.
pub fn inventory(registry: &Registry) -> Inventory {
    let mut found = Inventory::default();
    for folder in registry.folders() {
        let mut groups: BTreeMap<(PathBuf, String), Vec<PathBuf>> = BTreeMap::new();
        for file in onnx_files(folder).into_iter().filter(|f| !registry.owns(f)) {
            groups.entry((folder.clone(), shared_name(&file))).or_default().push(file);
        }
        for sub in folders(folder) {
            let name = sub.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let mut files = onnx_files(&sub);
            // Repositories of Hugging Face have the graphs of a model in a folder of this name.
            files.extend(onnx_files(&sub.join("onnx")));
            if !files.is_empty() {
                groups.entry((sub, name)).or_default().extend(files);
            }
        }
        for ((folder, name), files) in groups {
            group(folder, name, &files, registry.compute(), &mut found);
        }
    }
    found
}

fn group(folder: PathBuf, name: String, files: &[PathBuf], compute: &Compute, found: &mut Inventory) {
    let mut graphs: BTreeMap<Part, GraphFile> = BTreeMap::new();
    let mut failed: Vec<BrokenFile> = Vec::new();
    for file in files {
        match GraphFile::recognise(file) {
            // The first of several variants (quantised, half precision) counts: the plain name
            // sorts first.
            Ok(graph) => {
                let graph = GraphFile { compute: compute.clone(), ..graph };
                graphs.entry(graph.binding.part).or_insert(graph);
            }
            Err(e) => failed.push(BrokenFile { path: file.clone(), reason: e.to_string() }),
        }
    }
    if graphs.is_empty() {
        found.broken.extend(failed);
        return;
    }
    let has = |parts: &&(&[Part], &[Task])| parts.0.iter().all(|p| graphs.contains_key(p));
    let Some((parts, tasks)) = WHOLE.iter().find(has) else {
        let have: Vec<&str> = graphs.keys().map(|p| p.name()).collect();
        let lacks = WHOLE.iter().filter(|w| w.0.iter().any(|p| graphs.contains_key(p)));
        let lacks: Vec<&str> =
            lacks.flat_map(|w| w.0).filter(|p| !graphs.contains_key(p)).map(|p| p.name()).collect();
        let text = format!(
            "{}: {name} has only its {}; put its {} into the same folder",
            folder.display(),
            have.join(", "),
            lacks.join(" or ")
        );
        found.broken.extend(failed);
        found.broken.push(BrokenFile { path: folder, reason: text });
        return;
    };
    let differ = |a: &&GraphFile, b: &&GraphFile| {
        a.checkpoint != b.checkpoint && a.checkpoint.is_some() && b.checkpoint.is_some()
    };
    let used: Vec<&GraphFile> = parts.iter().filter_map(|p| graphs.get(p)).collect();
    if let Some(pair) = used.windows(2).find(|w| differ(&w[0], &w[1])) {
        let text = format!(
            "{} and {}: weights of different checkpoints ({} and {}); export both from one",
            pair[0].path.display(),
            pair[1].path.display(),
            pair[0].checkpoint.as_deref().unwrap_or_default(),
            pair[1].checkpoint.as_deref().unwrap_or_default()
        );
        found.broken.push(BrokenFile { path: folder, reason: text });
        return;
    }
    // Encoders are alike in several families; the last part decides.
    let family = used.last().map(|g| g.binding.family.clone()).unwrap_or_default();
    let mut tasks = tasks.to_vec();
    if used.iter().any(|g| g.has("desc1")) {
        tasks.push(Task::Matcher);
    }
    let unused = failed.into_iter().map(|f| f.reason).collect();
    let mut model = Installed { name, family, tasks, graphs, folder, unused };
    if let Some(known) = model.catalogue_entry().filter(|k| model.tasks.contains(&k.task)) {
        model.family.clone_from(&known.family);
    }
    found.models.push(model);
}

impl Registry {
    /// The model with `name` (a family or a model's own name) in `--init`, `--masks` and so on: of
    /// several the first in the catalogue. The error states the remedy.
    pub fn installed(&self, task: Task, name: &str) -> Result<Installed> {
        let inventory = inventory(self);
        let mut fitting: Vec<Installed> = inventory
            .models
            .into_iter()
            .filter(|m| m.tasks.contains(&task) && (m.family == name || m.name == name))
            .collect();
        fitting.sort_by_key(Installed::rank);
        if let Some(model) = fitting.into_iter().next() {
            return Ok(model);
        }
        let concerns = |path: &Path| {
            let text = path.to_string_lossy();
            catalogue().iter().any(|k| k.family == name && text.contains(&k.id)) || text.contains(name)
        };
        if let Some(broken) = inventory.broken.iter().find(|b| concerns(&b.path)) {
            return Err(Error::missing_model(name, broken.reason.clone()));
        }
        let place = self.folders().first().map(|f| f.display().to_string()).unwrap_or_default();
        let message =
            format!("no model \"{name}\" for {} in {place}; {}", task.name(), how_to_get(name, task, &place));
        Err(Error::missing_model(name, message))
    }
}

/// Remedy for a missing model: fetch it or the one of its family that needs no export, or copy its
/// files.
fn how_to_get(name: &str, task: Task, place: &str) -> String {
    let own = catalogue().iter().find(|k| k.id == name);
    let family = || catalogue().iter().filter(|k| k.family == name && k.does(task));
    let known = own.or_else(|| family().find(|k| !k.files.is_empty())).or_else(|| family().next());
    let Some(k) = known else {
        return format!("put its ONNX files into {place}/{name}/, or see splatvk models list");
    };
    let fetch = match k.files.is_empty() && k.recipe.is_none() {
        true => String::new(),
        false => {
            let accept = k.forbids().map_or(String::new(), |_| format!(" --accept {}", k.id));
            format!("splatvk models fetch {}{accept} gets it ({}, from {}), or ", k.id, k.licence, k.source)
        }
    };
    format!(
        "{fetch}put its ONNX files into {place}/{name}/ ({} writes them); see splatvk models list",
        k.export
    )
}

fn onnx_files(folder: &Path) -> Vec<PathBuf> {
    entries(folder)
        .into_iter()
        .filter(|p| p.extension().is_some_and(|e| e == "onnx") && p.is_file())
        .collect()
}

fn folders(folder: &Path) -> Vec<PathBuf> {
    entries(folder).into_iter().filter(|p| p.is_dir()).collect()
}

fn entries(folder: &Path) -> Vec<PathBuf> {
    let list = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let hidden = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
    let mut list: Vec<PathBuf> = list.filter(|p| !hidden(p)).collect();
    list.sort();
    list
}

/// File name without words for parts.
fn shared_name(file: &Path) -> String {
    const PARTS: [&str; 14] = [
        "encoder", "decoder", "enc", "dec", "vision", "visual", "image", "text", "textual", "model", "fp16",
        "fp32", "tower", "batched",
    ];
    let stem = file.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
    let mut name = String::new();
    for piece in stem.split_inclusive(['_', '-', '.']) {
        if !PARTS.contains(&piece.trim_end_matches(['_', '-', '.'])) {
            name.push_str(piece);
        }
    }
    name.trim_end_matches(['_', '-', '.']).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk_test_support::toys::clip_in;

    #[test]
    fn inventory_best_skips_untrained_networks() {
        let dir = tempfile::tempdir().unwrap();
        clip_in(dir.path(), [0, 1, 2]);
        let registry = Registry::of(&[dir.path()]);
        let chosen = || inventory(&registry).best(Task::Features).map(|m| m.name.clone());
        assert_eq!(chosen().as_deref(), Some("clip_toy"));
        let adapter = dir.path().join("clip_toy/adapter.toml");
        std::fs::write(adapter, "family = \"clip\"\nuntrained = true\n").unwrap();
        assert_eq!(chosen(), None);
        assert!(registry.installed(Task::Features, "clip").unwrap().untrained());
    }
}
