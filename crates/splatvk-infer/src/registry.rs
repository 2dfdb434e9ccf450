//! The default model pack: its files, their locations and checksums.
//!
//! The table is `crates/splatvk-infer/src/pack.json`, which the set-up script also reads.
use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::compute::Compute;
use super::runtime::Session;
use crate::error::words;
use crate::files::content_hash;
pub use crate::files::home;
use crate::{Error, Result};

const PACK: &str = include_str!("pack.json");
/// Remedy for missing or broken files.
const FIX: &str = "run tools/setup (or tools/models/build) to get it";

/// Purpose of a model file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum PackFileKind {
    /// Keypoints and descriptors.
    Keypoints,
    /// Edge probability.
    Edges,
    /// Image classifier.
    Classifier,
    /// Names of the classifier's classes.
    Classes,
    /// Sentence encoder.
    Text,
    /// Its tokenizer.
    Tokenizer,
}

/// State of one file of the pack on this machine.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct ModelStatus {
    /// Its purpose.
    pub kind: PackFileKind,
    /// The model's name.
    pub name: String,
    /// Its path, or where it should be.
    pub file: PathBuf,
    /// Whether the file is present with the right content.
    pub installed: bool,
    /// Expected size, bytes.
    pub bytes: u64,
    /// Expected sha256.
    pub sha256: String,
    /// Actual sha256; `None` when the file is absent or unreadable.
    pub actual_sha256: Option<String>,
    /// SPDX expression.
    pub licence: String,
    /// Its origin.
    pub source: String,
    /// Problem and remedy; `None` when installed.
    pub fix: Option<String>,
}

#[derive(Clone, Deserialize)]
struct Package {
    version: String,
    licence: String,
}

#[derive(Clone, Deserialize)]
struct PackFile {
    #[serde(rename = "role")]
    kind: PackFileKind,
    name: String,
    package: String,
    file: String,
    bytes: u64,
    sha256: String,
}

#[derive(Clone, Deserialize, Default)]
struct Pack {
    packages: HashMap<String, Package>,
    files: Vec<PackFile>,
}

/// Finds model files and checks their content.
#[derive(Clone)]
pub struct Registry {
    folders: Vec<PathBuf>,
    pack: Pack,
    compute: Compute,
}

impl Registry {
    /// The folders of `models_dir`, else of `SPLATVK_MODELS` (both may be lists, written like
    /// `PATH`), else `models` under [`home`]. Opening does not read the files.
    pub fn open(models_dir: Option<&Path>) -> Result<Self> {
        Registry::with(models_dir, Compute::default())
    }

    /// [`Registry::open`] with execution settings.
    pub fn with(models_dir: Option<&Path>, compute: Compute) -> Result<Self> {
        let pack =
            serde_json::from_str(PACK).map_err(|e| Error::work(format!("built-in model table: {e}")))?;
        let folders = Registry::places(models_dir)?;
        if let Some(absent) = models_dir.and_then(|_| folders.iter().find(|f| !f.is_dir())) {
            return Err(Error::input(format!("{}: no such model folder; {FIX}", absent.display())));
        }
        Ok(Registry { folders, pack, compute })
    }

    /// The folders that [`Registry::open`] would search, whether they exist or not.
    pub fn places(models_dir: Option<&Path>) -> Result<Vec<PathBuf>> {
        let set = || std::env::var_os("SPLATVK_MODELS").filter(|v| !v.is_empty());
        match models_dir.map(|d| split_list(d.as_os_str())).or_else(|| set().map(|text| split_list(&text))) {
            Some(folders) => Ok(folders),
            None => Ok(vec![home()?.join("models")]),
        }
    }

    /// The registry restricted to one folder.
    pub fn only(&self, folder: &Path) -> Registry {
        Registry { folders: vec![folder.to_path_buf()], ..self.clone() }
    }

    /// Models in these folders only, computed without a cache. For tests.
    #[doc(hidden)]
    pub fn of(folders: &[&Path]) -> Registry {
        // `with` reports an error of the built-in table.
        let pack = serde_json::from_str(PACK).unwrap_or_default();
        let folders = folders.iter().map(|f| f.to_path_buf()).collect();
        Registry { folders, pack, compute: Compute::default().uncached() }
    }

    /// Execution settings of the networks.
    pub fn compute(&self) -> &Compute {
        &self.compute
    }

    /// The registry without the cache of outputs.
    pub fn uncached(&self) -> Registry {
        Registry { compute: self.compute.uncached(), ..self.clone() }
    }

    /// Loads the model for `kind`.
    pub(super) fn session(&self, kind: PackFileKind) -> Result<Session> {
        Session::load(&self.path(kind)?, &self.compute)
    }

    /// The folders that are searched, first to last.
    pub fn folders(&self) -> &[PathBuf] {
        &self.folders
    }

    /// Whether a file is one of the built-in pack's.
    pub(super) fn owns(&self, file: &Path) -> bool {
        self.pack.files.iter().any(|f| file.file_name().is_some_and(|n| n == f.file.as_str()))
    }

    /// Every file of the pack, read and hashed.
    pub fn status(&self) -> Vec<ModelStatus> {
        self.pack.files.iter().map(|f| self.inspect(f)).collect()
    }

    /// The files of some kinds, read and hashed.
    pub fn status_of(&self, kinds: &[PackFileKind]) -> Vec<ModelStatus> {
        let wanted = self.pack.files.iter().filter(|f| kinds.contains(&f.kind));
        wanted.map(|f| self.inspect(f)).collect()
    }

    /// The file for `kind`, present and with the right content; otherwise an error that names the
    /// file, the sha256 it should have and how to get it. Content is hashed once per process and
    /// file version.
    pub fn path(&self, kind: PackFileKind) -> Result<PathBuf> {
        let found = self.pack.files.iter().find(|f| f.kind == kind).map(|f| self.inspect(f));
        match found {
            Some(ModelStatus { name, fix: Some(fix), .. }) => Err(Error::missing_model(name, fix)),
            Some(status) => Ok(status.file),
            None => Err(Error::work(format!("no model for {kind:?} in the model table"))),
        }
    }

    fn inspect(&self, entry: &PackFile) -> ModelStatus {
        let places: Vec<PathBuf> = self.folders.iter().map(|f| f.join(&entry.file)).collect();
        let there = places.iter().find(|p| p.exists()).or(places.first());
        let file = there.cloned().unwrap_or_else(|| PathBuf::from(&entry.file));
        let (actual, problem) = match content_hash(&file) {
            Ok(hash) if hash == entry.sha256 => (Some(hash), None),
            Ok(hash) => {
                let size = std::fs::metadata(&file).map_or(0, |m| m.len());
                let what = if size < entry.bytes { "truncated" } else { "corrupt or of another version" };
                let problem = format!("is {what} ({size} bytes of {}, sha256 {hash})", entry.bytes);
                (Some(hash), Some(problem))
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => (None, Some("is missing".to_string())),
            Err(e) => (None, Some(format!("cannot be read ({})", words(&e)))),
        };
        let package = self.pack.packages.get(&entry.package);
        let fix = problem.map(|p| {
            format!(
                "model {}: {} {p}; it should have sha256 {}: {FIX}",
                entry.name,
                file.display(),
                entry.sha256
            )
        });
        ModelStatus {
            kind: entry.kind,
            name: entry.name.clone(),
            installed: fix.is_none(),
            file,
            bytes: entry.bytes,
            sha256: entry.sha256.clone(),
            actual_sha256: actual,
            licence: package.map(|p| p.licence.clone()).unwrap_or_default(),
            source: package.map(|p| format!("PyPI {} {}", entry.package, p.version)).unwrap_or_default(),
            fix,
        }
    }
}

/// Folders of a list, written like `PATH`.
fn split_list(text: &std::ffi::OsStr) -> Vec<PathBuf> {
    std::env::split_paths(text).filter(|p| !p.as_os_str().is_empty()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder with the pack's small files, so that corrupting one is cheap.
    fn copied_pack() -> tempfile::TempDir {
        let from = Registry::open(None).unwrap();
        let dir = tempfile::tempdir().unwrap();
        for kind in [PackFileKind::Classes, PackFileKind::Keypoints] {
            let path = from.path(kind).unwrap();
            std::fs::copy(&path, dir.path().join(path.file_name().unwrap())).unwrap();
        }
        dir
    }

    #[test]
    fn status_of_installed_pack_is_sound() {
        for status in Registry::open(None).unwrap().status() {
            assert!(status.installed, "{:?}", status.fix);
            assert_eq!(std::fs::metadata(&status.file).unwrap().len(), status.bytes);
            assert!(!status.licence.is_empty() && status.source.starts_with("PyPI "));
        }
    }

    #[test]
    fn path_errors_state_hash_and_remedy() {
        let dir = copied_pack();
        let registry = Registry::open(Some(dir.path())).unwrap();
        assert!(registry.path(PackFileKind::Classes).is_ok());
        let missing = registry.path(PackFileKind::Edges).unwrap_err();
        let wanted = registry.status().into_iter().find(|s| s.kind == PackFileKind::Edges).unwrap();
        for part in ["hed.onnx is missing", &wanted.sha256, "tools/setup"] {
            assert!(missing.to_string().contains(part), "{missing}");
        }
        assert_eq!(missing.exit_code(), 3);

        let file = registry.path(PackFileKind::Keypoints).unwrap();
        let mut bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
        let truncated = registry.path(PackFileKind::Keypoints).unwrap_err().to_string();
        assert!(truncated.contains("xfeat.onnx is truncated"), "{truncated}");

        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&file, &bytes).unwrap();
        let corrupt = registry.path(PackFileKind::Keypoints).unwrap_err().to_string();
        assert!(corrupt.contains("is corrupt"), "{corrupt}");
        assert!(!corrupt.contains('\n'));
    }

    #[test]
    fn open_absent_folder_is_bad_input() {
        let error = Registry::open(Some(Path::new("/no/such/folder"))).err().unwrap();
        assert_eq!(error.exit_code(), 2);
        assert!(error.to_string().contains("/no/such/folder"));
    }
}
