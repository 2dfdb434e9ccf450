//! Language data of the splats on each level, as named arrays: the same in a scene directory and
//! beside a file of Gaussians (docs/use/formats.md#features-of-splats).
use super::npy::{NpyArray, NpyData};
use crate::scene::{CodeMix, Codebook, LevelField};
use crate::{Error, Result};
use std::collections::BTreeMap;

/// Appends the arrays of a level with codes. Row r is splat `order[r]`; an empty order is the
/// scene's own.
pub fn append(
    arrays: &mut Vec<(String, NpyArray)>,
    name: &str,
    level: &LevelField,
    splats: usize,
    order: &[u32],
) -> Result<()> {
    let book = &level.codebook;
    if level.features.len() != splats * book.code_dim {
        return Err(Error::work(format!("level {name} has features for another number of splats")));
    }
    let written = check(book).and_then(|()| finite("its features", &level.features, book.code_dim));
    written.map_err(|what| Error::work(format!("level {name}: nothing is written: {what}")))?;
    let rows: Vec<usize> = match order {
        [] => (0..splats).collect(),
        order => order.iter().map(|&i| i as usize).collect(),
    };
    let mut put = |kind: &str, array: NpyArray| arrays.push((format!("{kind}_{name}"), array));
    if level.mixes.len() == splats {
        let code_array = |of: fn(&CodeMix) -> u16| {
            let values = rows.iter().map(|&i| of(&level.mixes[i]));
            // The number of codes itself encodes "no feature".
            let data = match book.len() {
                0..=255 => NpyData::U8(values.map(|v| v as u8).collect()),
                _ => NpyData::I32(values.map(i32::from).collect()),
            };
            NpyArray { shape: vec![rows.len()], data }
        };
        put("first", code_array(|m| m.first));
        put("second", code_array(|m| m.second));
        put("share", NpyArray::u8(&[rows.len()], rows.iter().map(|&i| level.mixes[i].share).collect()));
    } else {
        let d = book.code_dim;
        let features = rows.iter().flat_map(|&i| &level.features[i * d..(i + 1) * d]).copied().collect();
        put("features", NpyArray::f32(&[rows.len(), d], features));
    }
    if level.reliability.len() == splats {
        let bytes = rows.iter().map(|&i| (255.0 * level.reliability[i]).round() as u8).collect();
        put("reliability", NpyArray::u8(&[rows.len()], bytes));
    }
    Ok(())
}

/// Codebook from the arrays clip [K, D], code [K, d], weight [K] and delta_min, without members;
/// `Err` describes the mismatch.
pub fn codebook([clip, code, weight, delta_min]: [&NpyArray; 4]) -> std::result::Result<Codebook, String> {
    let (&[k, embedding_dim], &[k2, code_dim]) = (&clip.shape[..], &code.shape[..]) else {
        return Err("its codes have no two dimensions".to_owned());
    };
    if k != k2 || weight.shape != [k] || embedding_dim * code_dim == 0 {
        return Err(format!(
            "the arrays of its codes do not fit together ({:?}, {:?}, {:?})",
            clip.shape, code.shape, weight.shape
        ));
    }
    let book = Codebook {
        embedding_dim,
        code_dim,
        embeddings: clip.to_f32(),
        codes: code.to_f32(),
        weights: weight.to_f32(),
        members: vec![Vec::new(); k],
        min_chord: delta_min.to_f32().first().copied().unwrap_or(0.0),
    };
    check(&book)?;
    Ok(book)
}

/// Refuses a codebook with numbers that are not finite, on reading and on writing.
pub fn check(book: &Codebook) -> std::result::Result<(), String> {
    finite("its embeddings", &book.embeddings, book.embedding_dim)?;
    finite("its codes", &book.codes, book.code_dim)?;
    finite("its weights", &book.weights, 1)?;
    finite("delta_min", &[book.min_chord], 1)
}

/// Refuses numbers that are not finite; the error has their count and the first row of `width` with
/// one.
fn finite(what: &str, values: &[f32], width: usize) -> std::result::Result<(), String> {
    let mut bad = values.iter().enumerate().filter(|(_, v)| !v.is_finite()).map(|(i, _)| i / width);
    match bad.next() {
        Some(first) => {
            Err(format!("{} numbers of {what} are not finite, the first in row {first}", 1 + bad.count()))
        }
        None => Ok(()),
    }
}

/// Reads the arrays of [`append`] into a level whose codebook is set; `Err` describes the mismatch.
pub fn read(
    arrays: &BTreeMap<String, NpyArray>,
    name: &str,
    splats: usize,
    level: &mut LevelField,
) -> std::result::Result<(), String> {
    let get = |kind: &str| arrays.get(&format!("{kind}_{name}"));
    let (d, codes) = (level.codebook.code_dim, level.codebook.len());
    let column = |kind: &str| match get(kind) {
        Some(a) if a.shape == [splats] => Ok(a.to_i32()),
        Some(a) => Err(format!("array {kind}_{name} has the shape {:?} for {splats} splats", a.shape)),
        None => Err(format!("no array {kind}_{name}")),
    };
    // Scenes of version 1 use the bare name of the level.
    match get("features").or_else(|| arrays.get(name)) {
        Some(a) if a.shape == [splats, d] => {
            level.features = a.to_f32();
            finite(&format!("the features of level {name}"), &level.features, d)?;
        }
        Some(a) => return Err(format!("the features of level {name} have the shape {:?}", a.shape)),
        None => {
            let (first, second, share) = (column("first")?, column("second")?, column("share")?);
            let known = |k: &i32| usize::try_from(*k).is_ok_and(|k| k <= codes);
            if !first.iter().chain(&second).all(known) || share.iter().any(|s| *s > 255) {
                return Err(format!("level {name} names codes that its codebook of {codes} lacks"));
            }
            let mix = |((a, b), s): ((&i32, &i32), &i32)| CodeMix {
                first: *a as u16,
                second: *b as u16,
                share: *s as u8,
            };
            level.set_mixes(first.iter().zip(&second).zip(&share).map(mix).collect());
        }
    }
    if get("reliability").is_some() {
        level.reliability = column("reliability")?.iter().map(|&r| r as f32 / 255.0).collect();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn code_indices_beyond_byte_survive() {
        let codes = 300;
        let codebook = Codebook {
            embedding_dim: 1,
            code_dim: 1,
            embeddings: vec![1.0; codes],
            codes: vec![1.0; codes],
            weights: vec![1.0; codes],
            ..Codebook::default()
        };
        let mut level = LevelField { codebook: codebook.clone(), ..LevelField::default() };
        let mixes =
            [(299, 43), (7, 256), (300, 300)].map(|(first, second)| CodeMix { first, second, share: 9 });
        level.set_mixes(mixes.to_vec());
        let mut arrays = Vec::new();
        append(&mut arrays, "s", &level, 3, &[]).unwrap();
        let arrays: BTreeMap<String, NpyArray> = arrays.into_iter().collect();
        let mut back = LevelField { codebook, ..LevelField::default() };
        read(&arrays, "s", 3, &mut back).unwrap();
        assert_eq!(back, level);
    }
}
