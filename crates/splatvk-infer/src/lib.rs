//! ONNX inference: sessions, model registry, one file per model family.
//!
//! Networks of users are recognised by their inputs and outputs: [`onnx`] reads a file's header,
//! [`contract`] states the interface of each part of a model, [`adapter`] maps a file's names to
//! it, [`graph`] runs it by role.
//!
//! ```no_run
//! use splatvk_infer::{Registry, hed::Hed};
//! use splatvk_types::scene::RgbImage;
//!
//! # fn main() -> splatvk_types::Result<()> {
//! // The folder where `tools/setup` and `splatvk models fetch` install.
//! let registry = Registry::open(None)?;
//! let image = RgbImage { width: 64, height: 48, data: vec![[0.5; 3]; 64 * 48] };
//! let edges = Hed::load(&registry)?.edges(&image)?;
//! println!("{} × {}", edges.width, edges.height);
//! # Ok(())
//! # }
//! ```
// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod adapter;
pub mod best_pairs;
pub mod cache;
pub mod catalogue;
pub mod check;
mod classify;
pub mod clip;
mod colour;
mod compute;
pub mod concepts;
pub mod contract;
pub mod depth_prior;
pub mod graph;
pub mod hed;
pub mod installed;
mod lexicon;
mod library;
mod multiview;
pub mod onnx;
pub mod pairs;
pub mod prepare;
pub mod provider;
mod registry;
mod runtime;
pub mod sam;
pub mod stuff;
#[cfg(test)]
mod tests;
pub mod text;
pub mod things;
mod tokens;
pub mod warp;
pub mod words;
pub mod xfeat;

pub use compute::Compute;
pub use library::runtime;
pub use registry::{ModelStatus, PackFileKind, Registry, home};
pub use runtime::{Input, Session, Tensor};

pub(crate) use splatvk_io::{format, photo};
pub(crate) use splatvk_types::{Error, Result, error, files, math, progress, scene, sync};

use crate::progress::Progress;
use crate::scene::{Image, RgbImage};

/// Returns, for each of the regions [count, D], the `best` of the rows [P, D] with the largest
/// cosine, as (row, cosine), best first.
pub fn nearest(regions: &[f32], rows: &[f32], dim: usize, best: usize) -> Vec<Vec<(usize, f32)>> {
    use rayon::prelude::*;
    regions.par_chunks_exact(dim).map(|region| nearest_rows(region, rows, best)).collect()
}

fn nearest_rows(region: &[f32], rows: &[f32], best: usize) -> Vec<(usize, f32)> {
    let mut list: Vec<(usize, f32)> = cosines(region, rows).into_iter().enumerate().collect();
    list.sort_by(|a, b| b.1.total_cmp(&a.1));
    list.truncate(best);
    list
}

/// `row·v` of the rows [P, D]. Each is summed in the order of its elements; eight sums side by side
/// need not wait for one another's additions.
fn cosines(v: &[f32], rows: &[f32]) -> Vec<f32> {
    const TOGETHER: usize = 8;
    let d = v.len().max(1);
    let mut all = Vec::with_capacity(rows.len() / d);
    let mut blocks = rows.chunks_exact(TOGETHER * d);
    for block in &mut blocks {
        let rows: [&[f32]; TOGETHER] = std::array::from_fn(|k| &block[k * d..(k + 1) * d]);
        let mut sums = [0f32; TOGETHER];
        for (i, x) in v.iter().enumerate() {
            sums.iter_mut().zip(rows).for_each(|(sum, row)| *sum += row[i] * x);
        }
        all.extend(sums);
    }
    let rest = blocks.remainder().chunks_exact(d);
    all.extend(rest.map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum::<f32>()));
    all
}

/// Levels of the presence test on p-values: the share of other things that fit a scene at least as
/// well as a text does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PresenceLevels {
    /// Largest p-value of a found text. Of texts that are not in the scene, at most this share is
    /// called found if they are exchangeable with the other things.
    pub found: f32,
    /// Smallest p-value of a text of which there is no sign.
    pub absent: f32,
}

impl Default for PresenceLevels {
    /// Five of a hundred; three of four other things fit better.
    fn default() -> Self {
        PresenceLevels { found: 0.05, absent: 0.75 }
    }
}

/// Look-up of a text in a vocabulary.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct KnownWord {
    /// The word of the vocabulary that the text means most; `None` for a text outside of it.
    pub nearest: Option<String>,
    /// Words of an unknown text that are not English.
    pub not_english: Vec<String>,
}

/// Embeds image regions and texts in one space of unit vectors, so that a cosine measures how well
/// a phrase names a region. Implemented by `words` (the built-in default) and by user-supplied
/// CLIP-like pairs of towers.
pub trait RegionEncoder: Send {
    /// Name of the space; only features and texts of one space are comparable.
    fn space(&self) -> &str;
    /// D, the length of every embedding.
    fn dim(&self) -> usize;
    /// [count, D] row-major unit vectors, one per region `0..count` of `labels` (the same size as
    /// `image`; −1 and values ≥ `count` belong to no region). A region without a pixel gets a zero
    /// row. Checks between batches whether to stop.
    fn embed_regions(
        &mut self,
        image: &RgbImage,
        labels: &Image<i32>,
        count: usize,
        progress: &dyn Progress,
    ) -> Result<Vec<f32>>;
    /// Adds the shapes of regions to their [`RegionEncoder::embed_regions`] rows, for encoders that
    /// name surfaces by shape.
    fn add_surfaces(&mut self, _features: &mut [f32], _surfaces: &[stuff::Surface]) -> Result<()> {
        Ok(())
    }
    /// Changes to another revision of the encoder's space; `false` if the encoder has none of this
    /// name.
    fn use_space(&mut self, space: &str) -> bool {
        self.space() == space
    }
    /// [texts.len(), D] row-major unit vectors.
    fn embed_texts(&mut self, texts: &[&str]) -> Result<Vec<f32>>;
    /// [N, D] unit rows of [`things::of_form`]; fewer or none from an encoder of a limited set of
    /// texts.
    fn embed_other_things(&mut self, form: &str) -> Result<Vec<f32>> {
        let list = things::of_form(form);
        self.embed_texts(&list.iter().map(String::as_str).collect::<Vec<_>>())
    }
    /// [M, D] unit rows of [`things::recoloured`]; fewer or none from an encoder of a limited set
    /// of texts.
    fn embed_recoloured(&mut self, text: &str) -> Result<Vec<f32>> {
        let list = things::recoloured(text);
        self.embed_texts(&list.iter().map(String::as_str).collect::<Vec<_>>())
    }
    /// Levels of the presence test for texts of this encoder.
    fn presence_levels(&self) -> PresenceLevels {
        PresenceLevels::default()
    }
    /// Whether the text is an entry of the encoder's table, which must not be split into words.
    fn has_table_entry(&self, _text: &str) -> bool {
        false
    }
    /// Looks up a text in the encoder's vocabulary; `None` from an encoder without a fixed one.
    fn look_up(&mut self, _text: &str) -> Result<Option<KnownWord>> {
        Ok(None)
    }
    /// The embedding [D] of a text, and [`RegionEncoder::look_up`] of it, for encoders that share
    /// work between the two.
    fn embed_and_look_up(&mut self, text: &str) -> Result<(Vec<f32>, Option<KnownWord>)> {
        Ok((self.embed_texts(&[text])?, self.look_up(text)?))
    }
    /// Name of the table or network that embedded a text; `None` from an encoder with a single one.
    fn embedding_source(&self, _text: &str) -> Option<String> {
        None
    }
    /// Warning about the embeddings returned so far, if they may be of another space.
    fn embedding_warning(&self) -> Option<String> {
        None
    }
    /// Per region embedding ([count, D] rows) the `best` phrases of the encoder's own vocabulary,
    /// with their cosine, best first; empty lists from an encoder without one.
    fn name_regions(&mut self, regions: &[f32], _best: usize) -> Result<Vec<Vec<(String, f32)>>> {
        Ok(vec![Vec::new(); regions.len() / self.dim().max(1)])
    }
}
