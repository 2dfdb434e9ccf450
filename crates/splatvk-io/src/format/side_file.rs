//! Language beside a file of Gaussians: `NAME.language.npz`, for formats without a place for it.
//! Described in docs/use/formats.md.
use super::level_arrays;
use super::npy::{self, NpyArray};
use crate::scene::{LEVEL_NAMES, LanguageField, LevelField};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Version of the layout; readers refuse newer ones.
const VERSION: u32 = 2;

/// Path of the language of a file.
pub fn path(splats: &Path) -> PathBuf {
    let mut name = splats.as_os_str().to_os_string();
    name.push(".language.npz");
    name.into()
}

/// Writes the language of `count` Gaussians in the order of their file: its row r is Gaussian
/// `order[r]` of the scene; an empty order is the scene's own.
pub fn write(path: &Path, field: &LanguageField, count: usize, order: &[u32]) -> Result<()> {
    let mut arrays: Vec<(String, NpyArray)> = vec![
        ("space".into(), NpyArray::text(&field.space)),
        ("version".into(), NpyArray::i32(&[], vec![VERSION as i32])),
    ];
    for (name, level) in LEVEL_NAMES.iter().zip(&field.levels).filter(|(_, l)| !l.codebook.is_empty()) {
        let (book, d) = (&level.codebook, level.codebook.code_dim);
        level_arrays::append(&mut arrays, name, level, count, order)?;
        arrays.push((format!("code_{name}"), NpyArray::f32(&[book.len(), d], book.codes.clone())));
        let clip = NpyArray::f32(&[book.len(), book.embedding_dim], book.embeddings.clone());
        arrays.push((format!("clip_{name}"), clip));
        arrays.push((format!("weight_{name}"), NpyArray::f32(&[book.weights.len()], book.weights.clone())));
        arrays.push((format!("delta_min_{name}"), NpyArray::f32(&[], vec![book.min_chord])));
    }
    let list: Vec<(&str, &NpyArray)> = arrays.iter().map(|(n, a)| (n.as_str(), a)).collect();
    npy::write_packed_npz(path, &list)
}

/// Reads the language beside a file of `count` Gaussians; `None` if the file does not exist.
pub fn read(splats: &Path, count: usize) -> Result<Option<LanguageField>> {
    let file = path(splats);
    if !file.is_file() {
        return Ok(None);
    }
    let arrays = npy::read_npz_of(&file, count)?;
    let bad = |what: String| Error::input(format!("{}: {what}", file.display()));
    let version = arrays.get("version").and_then(|a| a.to_i32().first().copied()).unwrap_or(0);
    if version < 1 || version > VERSION as i32 {
        return Err(bad(format!("version {version}; this program reads 1 to {VERSION}: export it again")));
    }
    let space = arrays.get("space").and_then(NpyArray::as_text).unwrap_or_default().to_owned();
    let mut field = LanguageField { levels: vec![LevelField::default(); LEVEL_NAMES.len()], space };
    for (name, level) in LEVEL_NAMES.iter().zip(&mut field.levels) {
        let get = |part: &str| {
            let key = format!("{part}_{name}");
            arrays.get(&key).ok_or_else(|| bad(format!("no array {key:?}")))
        };
        let Ok(code) = get("code") else { continue };
        level.codebook = level_arrays::codebook([get("clip")?, code, get("weight")?, get("delta_min")?])
            .map_err(|e| bad(format!("level {name}: {e}; export it again")))?;
        level_arrays::read(&arrays, name, count, level)
            .map_err(|e| bad(format!("{e}; it belongs to another file of {count} Gaussians")))?;
    }
    Ok(Some(field))
}
