//! Embeddings of texts for precomputed features: a table of phrases first, then a network with
//! embeddings of the same length.
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

/// Phrases of the table that a network must embed equally.
const PROBES: usize = 4;
/// Minimum cosine between the network's embedding of a phrase and the table's. Tables may word a
/// phrase as "a photo of …", which leaves it at 0.8 and more; directions of another space are at 0
/// ± 1/√D.
const SAME_SPACE: f64 = 0.5;

fn cosine(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum()
}

/// Text encoder for the features of a `dir:` folder with the table `path`, if it exists; `dim` is
/// the length of the features, if known.
pub fn dir_encoder(path: &Path, dim: Option<usize>, registry: &Registry) -> Result<Box<dyn RegionEncoder>> {
    let mut texts = TextEmbeddings::default();
    match dim {
        Some(dim) if !path.is_file() => texts.dim = dim,
        _ => texts = TextEmbeddings::read(path)?,
    }
    let registry = registry.clone();
    Ok(Box::new(DirTexts { texts, registry, text_network: None }))
}

/// Text encoder of precomputed features; region features were read with the masks.
struct DirTexts {
    texts: TextEmbeddings,
    registry: Registry,
    /// Network for texts outside the table, loaded on first use.
    text_network: Option<TextNetwork>,
}

struct TextNetwork {
    name: String,
    encoder: Clip,
    /// Whether phrases of the table confirmed the space of the features.
    confirmed: bool,
}

impl DirTexts {
    /// [N, D] embeddings of those texts that the table has.
    fn table_rows(&self, texts: &[String]) -> Vec<f32> {
        texts.iter().filter_map(|text| self.texts.get(text)).flatten().copied().collect()
    }

    /// The first installed network of the table's space; `text` is named in the error.
    fn text_network(&mut self, text: &str) -> Result<&mut TextNetwork> {
        if self.text_network.is_none() {
            let found = self.find_network()?;
            self.text_network = Some(found.ok_or_else(|| {
                let phrases: Vec<&str> = self.texts.iter().map(|(phrase, _)| phrase).take(20).collect();
                let table = if phrases.is_empty() { "nothing".to_owned() } else { phrases.join(", ") };
                Error::missing(format!(
                    "no text embedding for '{text}': text_embeddings.npz has {table}, and no installed text model has embeddings \
                     of {} values in its space; add the phrase to the table, or install the model that made the features",
                    self.texts.dim
                ))
            })?);
        }
        self.text_network.as_mut().ok_or_else(|| Error::work("the text model is gone"))
    }

    fn find_network(&self) -> Result<Option<TextNetwork>> {
        let fits = |m: &Installed| text_dim(m).is_none_or(|d| d == self.texts.dim);
        let models = inventory(&self.registry).models;
        for model in models.into_iter().filter(|m| m.tasks.contains(&Task::Text) && fits(m)) {
            let name = model.name.clone();
            let mut encoder = Clip::load(model)?;
            if encoder.dim() != self.texts.dim {
                continue;
            }
            let probes: Vec<(&str, &[f32])> = self.texts.iter().take(PROBES).collect();
            let phrases: Vec<&str> = probes.iter().map(|p| p.0).collect();
            let rows = encoder.embed_texts(&phrases)?;
            let alike = |(row, probe): (&[f32], &(&str, &[f32]))| cosine(row, probe.1) >= SAME_SPACE;
            if rows.chunks_exact(self.texts.dim.max(1)).zip(&probes).all(alike) {
                return Ok(Some(TextNetwork { name, encoder, confirmed: !probes.is_empty() }));
            }
        }
        Ok(None)
    }
}

/// Fixed length of a model's text embeddings, if it has one.
fn text_dim(model: &Installed) -> Option<usize> {
    model.graph(Part::TextTower).ok()?.fixed("embedding", "D")
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
                None => rows.extend(self.text_network(text)?.encoder.embed_texts(&[text])?),
            }
        }
        Ok(rows)
    }
    fn has_table_entry(&self, text: &str) -> bool {
        self.texts.get(text).is_some()
    }
    fn embed_other_things(&mut self, form: &str) -> Result<Vec<f32>> {
        let rows = self.table_rows(&things::of_form(form));
        match &mut self.text_network {
            Some(network) if rows.len() < MIN_OTHERS * self.texts.dim => {
                network.encoder.embed_other_things(form)
            }
            _ => Ok(rows),
        }
    }
    fn embed_recoloured(&mut self, text: &str) -> Result<Vec<f32>> {
        match &mut self.text_network {
            Some(network) => network.encoder.embed_recoloured(text),
            None => Ok(self.table_rows(&things::recoloured(text))),
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
            None => self.text_network.as_ref().map(|t| t.name.clone()),
        }
    }
    fn embedding_warning(&self) -> Option<String> {
        let network = self.text_network.as_ref().filter(|t| !t.confirmed)?;
        Some(format!(
            "texts are embedded by {}, since it gives {} values as the features have: whether it is their space cannot be known \
             without phrases in text_embeddings.npz",
            network.name, self.texts.dim
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
    fn texts_prefer_table_over_network() {
        let folder = tempfile::tempdir().unwrap();
        clip_in(folder.path(), [0, 1, 2]);
        let table = |row: Vec<f32>| {
            let row = NpyArray::f32(&[3], row);
            write_npz(folder.path().join("text_embeddings.npz"), &[("Blue", &row)]).unwrap();
        };
        // Without a table only the length is known.
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
        assert!(error.exit_code() == 3 && error.to_string().contains("'green'"), "{error}");

        let none = dir_encoder(&folder.path().join("nowhere.npz"), None, &Registry::of(&[folder.path()]));
        assert!(none.err().unwrap().to_string().contains("missing"));
        let mut longer = encoder(folder.path(), None);
        assert_eq!(longer.dim(), 3);
        std::fs::remove_file(folder.path().join("text_embeddings.npz")).unwrap();
        longer = encoder(folder.path(), Some(4));
        assert!(longer.embed_texts(&["green"]).unwrap_err().to_string().contains("of 4 values"));
    }
}
