//! Language beside a file of Gaussians: `NAME.language.npz`, for formats that have no place for it. Described in
//! docs/formats.md.
use super::npy::{self, NpyArray};
use crate::scene::{Codebook, LEVEL_NAMES, LanguageField, LevelField};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Version of the layout; readers refuse newer ones.
const VERSION: u32 = 1;

/// Where the language of a file is.
pub fn path(splats: &Path) -> PathBuf {
    let mut name = splats.as_os_str().to_os_string();
    name.push(".language.npz");
    name.into()
}

/// Writes the language of `count` Gaussians in the order of their file: its row r is number `order[r]` of the scene; an
/// empty order is the scene's own.
pub fn write(path: &Path, field: &LanguageField, count: usize, order: &[u32]) -> Result<()> {
    let mut arrays: Vec<(String, NpyArray)> = vec![
        ("space".into(), NpyArray::text(&field.space)),
        ("version".into(), NpyArray::i32(&[], vec![VERSION as i32])),
    ];
    for (name, level) in LEVEL_NAMES.iter().zip(&field.levels).filter(|(_, l)| !l.codebook.is_empty()) {
        let (book, d) = (&level.codebook, level.codebook.code_dim);
        if level.features.len() != count * d {
            return Err(Error::work(format!("level {name} has features for another number of splats")));
        }
        let features = match order {
            [] => level.features.clone(),
            order => {
                let row = |i: &u32| level.features[*i as usize * d..(*i as usize + 1) * d].iter().copied();
                order.iter().flat_map(row).collect()
            }
        };
        arrays.push((format!("features_{name}"), NpyArray::f32(&[count, d], features)));
        arrays.push((format!("code_{name}"), NpyArray::f32(&[book.len(), d], book.codes.clone())));
        let clip = NpyArray::f32(&[book.len(), book.embedding_dim], book.embeddings.clone());
        arrays.push((format!("clip_{name}"), clip));
        arrays.push((format!("weight_{name}"), NpyArray::f32(&[book.weights.len()], book.weights.clone())));
        arrays.push((format!("delta_min_{name}"), NpyArray::f32(&[], vec![book.min_chord])));
    }
    let list: Vec<(&str, &NpyArray)> = arrays.iter().map(|(n, a)| (n.as_str(), a)).collect();
    npy::write_npz(path, &list)
}

/// Reads the language beside a file of `count` Gaussians; `None` where there is none.
pub fn read(splats: &Path, count: usize) -> Result<Option<LanguageField>> {
    let file = path(splats);
    if !file.is_file() {
        return Ok(None);
    }
    let arrays = npy::read_npz(&file)?;
    let bad = |what: String| Error::input(format!("{}: {what}", file.display()));
    let version = arrays.get("version").and_then(|a| a.to_i32().first().copied()).unwrap_or(0);
    if version < 1 || version > VERSION as i32 {
        return Err(bad(format!("version {version}; this program reads 1 to {VERSION}")));
    }
    let space = arrays.get("space").and_then(NpyArray::as_text).unwrap_or_default().to_owned();
    let mut field = LanguageField { levels: vec![LevelField::default(); LEVEL_NAMES.len()], space };
    for (name, level) in LEVEL_NAMES.iter().zip(&mut field.levels) {
        let get = |part: &str| {
            let key = format!("{part}_{name}");
            arrays.get(&key).ok_or_else(|| bad(format!("no array {key:?}")))
        };
        let Ok(features) = get("features") else { continue };
        let (code, clip, weight) = (get("code")?, get("clip")?, get("weight")?);
        let (&[k, code_dim], &[k2, embedding_dim]) = (&code.shape[..], &clip.shape[..]) else {
            return Err(bad(format!("the codes of level {name} have no two dimensions")));
        };
        if k != k2 || weight.shape != [k] || features.shape != [count, code_dim] {
            return Err(bad(format!(
                "level {name} does not fit {count} Gaussians; it belongs to another file"
            )));
        }
        *level = LevelField {
            codebook: Codebook {
                embedding_dim,
                code_dim,
                embeddings: clip.to_f32(),
                codes: code.to_f32(),
                weights: weight.to_f32(),
                members: vec![Vec::new(); k],
                min_chord: get("delta_min")?.to_f32().first().copied().unwrap_or(0.0),
            },
            features: features.to_f32(),
            targets: Vec::new(),
        };
    }
    Ok(Some(field))
}
