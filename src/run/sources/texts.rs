//! Embeddings of texts for precomputed features: a table of phrases first, then a network whose
//! texts are as long.
use crate::infer::clip::Clip;
use crate::infer::contract::Part;
use crate::infer::installed::{Installed, Task, inventory};
use crate::infer::{RegionEncoder, Registry, nearest, things};
use crate::language::dir::TextEmbeddings;
use crate::progress::Progress;
use crate::query::CANONICAL_PHRASES;
use crate::query::presence::MIN_OTHERS;
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};
use std::path::Path;

/// Space name of precomputed features.
pub const DIR_SPACE: &str = "dir";

/// Phrases of the table that a network must embed alike.
const PROBES: usize = 4;
/// Least cosine between its embedding of a phrase and the table's. Tables may word a phrase as "a
/// photo of …", which leaves it at 0.8 and more; directions of another space are at 0 ± 1/√D.
const SAME_SPACE: f64 = 0.5;

fn cosine(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum()
}

/// What embeds texts for the features of a `dir:` folder whose table is `path`, if it has one;
/// `dim` is the length of the features, where that is known.
pub fn dir_encoder(path: &Path, dim: Option<usize>, registry: &Registry) -> Result<Box<dyn RegionEncoder>> {
    let mut texts = TextEmbeddings::default();
    match dim {
        Some(dim) if !path.is_file() => texts.dim = dim,
        _ => texts = TextEmbeddings::read(path)?,
    }
    let registry = registry.clone();
    Ok(Box::new(DirTexts { texts, registry, tower: None }))
}

/// Texts behind the encoder boundary; region features were read with the masks.
struct DirTexts {
    texts: TextEmbeddings,
    registry: Registry,
    /// Loaded for the first text that the table does not have.
    tower: Option<Tower>,
}

struct Tower {
    name: String,
    network: Clip,
    /// Whether phrases of the table have shown that its space is that of the features.
    proven: bool,
}

impl DirTexts {
    /// [N, D] rows of those texts that the table has.
    fn known(&self, texts: &[String]) -> Vec<f32> {
        texts.iter().filter_map(|text| self.texts.get(text)).flatten().copied().collect()
    }

    /// The first installed network of the table's space; `text` is what it is for.
    fn tower(&mut self, text: &str) -> Result<&mut Tower> {
        if self.tower.is_none() {
            let found = self.find()?;
            self.tower = Some(found.ok_or_else(|| {
                let known: Vec<&str> = self.texts.iter().map(|(phrase, _)| phrase).take(20).collect();
                let table = if known.is_empty() { "nothing".to_owned() } else { known.join(", ") };
                Error::missing(format!(
                    "no text embedding for '{text}': text_embeddings.npz has {table}, and no installed text model has embeddings \
                     of {} values in its space; add the phrase to the table, or install the model that made the features",
                    self.texts.dim
                ))
            })?);
        }
        self.tower.as_mut().ok_or_else(|| Error::work("the text model is gone"))
    }

    fn find(&self) -> Result<Option<Tower>> {
        let length = |m: &Installed| m.graph(Part::TextTower).ok()?.fixed("embedding", "D");
        let fits = |m: &Installed| length(m).is_none_or(|d| d == self.texts.dim);
        let models = inventory(&self.registry).models;
        for model in models.into_iter().filter(|m| m.tasks.contains(&Task::Text) && fits(m)) {
            let name = model.name.clone();
            let mut network = Clip::load(model)?;
            if network.dim() != self.texts.dim {
                continue;
            }
            let probes: Vec<(&str, &[f32])> = self.texts.iter().take(PROBES).collect();
            let phrases: Vec<&str> = probes.iter().map(|p| p.0).collect();
            let rows = network.embed_texts(&phrases)?;
            let alike = |(row, probe): (&[f32], &(&str, &[f32]))| cosine(row, probe.1) >= SAME_SPACE;
            if rows.chunks_exact(self.texts.dim.max(1)).zip(&probes).all(alike) {
                return Ok(Some(Tower { name, network, proven: !probes.is_empty() }));
            }
        }
        Ok(None)
    }
}

impl RegionEncoder for DirTexts {
    fn space(&self) -> &str {
        DIR_SPACE
    }
    fn dim(&self) -> usize {
        self.texts.dim
    }
    fn embed_regions(
        &mut self,
        _: &RgbImage,
        _: &Image<i32>,
        _: usize,
        _: &dyn Progress,
    ) -> Result<Vec<f32>> {
        Err(Error::work("precomputed features cannot describe new regions; give --masks dir: with them"))
    }
    fn embed_texts(&mut self, texts: &[&str]) -> Result<Vec<f32>> {
        let mut rows = Vec::with_capacity(texts.len() * self.texts.dim);
        for text in texts {
            match self.texts.get(text) {
                Some(row) => rows.extend_from_slice(row),
                None => rows.extend(self.tower(text)?.network.embed_texts(&[text])?),
            }
        }
        Ok(rows)
    }
    fn has_table_entry(&self, text: &str) -> bool {
        self.texts.get(text).is_some()
    }
    fn embed_other_things(&mut self, form: &str) -> Result<Vec<f32>> {
        let rows = self.known(&things::of_form(form));
        match &mut self.tower {
            Some(tower) if rows.len() < MIN_OTHERS * self.texts.dim => tower.network.embed_other_things(form),
            _ => Ok(rows),
        }
    }
    fn embed_recoloured(&mut self, text: &str) -> Result<Vec<f32>> {
        match &mut self.tower {
            Some(tower) => tower.network.embed_recoloured(text),
            None => Ok(self.known(&things::recoloured(text))),
        }
    }
    fn name_regions(&mut self, regions: &[f32], best: usize) -> Result<Vec<Vec<(String, f32)>>> {
        let named: Vec<_> = self.texts.iter().filter(|(p, _)| !CANONICAL_PHRASES.contains(p)).collect();
        let rows: Vec<f32> = named.iter().flat_map(|(_, v)| v.iter().copied()).collect();
        let found = nearest(regions, &rows, self.texts.dim, best);
        let text = |(i, cosine): (usize, f32)| (named[i].0.to_owned(), cosine);
        Ok(found.into_iter().map(|list| list.into_iter().map(text).collect()).collect())
    }
    fn embedding_source(&self, text: &str) -> Option<String> {
        match self.texts.get(text) {
            Some(_) => Some("text_embeddings.npz".to_owned()),
            None => self.tower.as_ref().map(|t| t.name.clone()),
        }
    }
    fn embedding_warning(&self) -> Option<String> {
        let tower = self.tower.as_ref().filter(|t| !t.proven)?;
        Some(format!(
            "texts are embedded by {}, since it gives {} values as the features have: whether it is their space cannot be known \
             without phrases in text_embeddings.npz",
            tower.name, self.texts.dim
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::npy::{NpyArray, write_npz};
    use splatvk_test_support::toys::clip_in;

    fn encoder(folder: &Path, dim: Option<usize>) -> Box<dyn RegionEncoder> {
        dir_encoder(&folder.join("text_embeddings.npz"), dim, &Registry::of(&[folder])).unwrap()
    }

    #[test]
    fn the_table_answers_first_and_then_a_network_of_its_space() {
        let folder = tempfile::tempdir().unwrap();
        clip_in(folder.path(), [0, 1, 2]);
        let table = |row: Vec<f32>| {
            let row = NpyArray::f32(&[3], row);
            write_npz(folder.path().join("text_embeddings.npz"), &[("Blue", &row)]).unwrap();
        };
        // Without a table the length is all that is known.
        let mut towers = encoder(folder.path(), Some(3));
        let blue = towers.embed_texts(&["blue"]).unwrap();
        assert_eq!(towers.embedding_source("blue").as_deref(), Some("clip_toy"));
        assert!(towers.embedding_warning().unwrap().contains("clip_toy"), "{:?}", towers.embedding_warning());

        table(blue.clone());
        let mut both = encoder(folder.path(), None);
        assert_eq!(both.embed_texts(&["blue"]).unwrap(), blue);
        assert_eq!(
            (both.embedding_source("blue").as_deref(), both.embedding_source("green")),
            (Some("text_embeddings.npz"), None)
        );
        let green = both.embed_texts(&["green"]).unwrap();
        assert!(cosine(&green, &blue) < 0.9 && (cosine(&green, &green) - 1.0).abs() < 1e-5);
        assert_eq!(both.embedding_source("green").as_deref(), Some("clip_toy"));
        assert_eq!(both.embedding_warning(), None, "the network says of \"blue\" what the table says");

        table(blue.iter().map(|v| -v).collect());
        let mut other = encoder(folder.path(), None);
        assert!(other.embed_texts(&["blue"]).is_ok(), "what the table has needs no network");
        let error = other.embed_texts(&["green"]).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains("'green'"), "{error}");

        let none = dir_encoder(&folder.path().join("nowhere.npz"), None, &Registry::of(&[folder.path()]));
        assert!(none.err().unwrap().to_string().contains("missing"));
        let mut longer = encoder(folder.path(), None);
        assert_eq!(longer.dim(), 3);
        std::fs::remove_file(folder.path().join("text_embeddings.npz")).unwrap();
        longer = encoder(folder.path(), Some(4));
        assert!(longer.embed_texts(&["green"]).unwrap_err().to_string().contains("of 4 values"));
    }
}
