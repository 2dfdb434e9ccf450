//! The bijection between embeddings and the short codes that splats carry
//! (docs/internals/method.md#codebook).
mod append;
pub(super) mod autoencoder;
mod network;
mod pca;
pub(super) mod quantise;
mod spread;
pub(super) mod unreduced;

pub use append::append;

use crate::math::{Random, dot};
use crate::scene::{Codebook, MaskId};
use crate::{Error, Result};
use rayon::prelude::*;

/// Cosine above which no text query separates two embeddings, so that they share a code
/// (docs/internals/method.md#code-construction, step 1).
const SAME_EMBEDDING: f64 = 0.9995;

/// Smallest distance between two codes that the construction accepts
/// (docs/internals/method.md#code-construction, step 5).
const MIN_CHORD: f32 = 0.02;

/// One distinct embedding and the masks that have it.
#[derive(Clone, Debug, PartialEq)]
pub struct CodeEntry {
    /// [D] unit vector.
    pub embedding: Vec<f32>,
    /// Σ pixels × quality of the masks.
    pub weight: f64,
    /// The masks that share it.
    pub members: Vec<MaskId>,
}

/// A codebook and, for every input entry, the code it received.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EncodedLevel {
    /// The bijection.
    pub codebook: Codebook,
    /// [entries] code index.
    pub code_of: Vec<u32>,
}

/// Builds the codebook of one level: merges indistinguishable embeddings, gives each of the K that
/// remain a unit code of length `dim`, and verifies that decoding inverts encoding, also under
/// noise.
pub fn build(entries: &[CodeEntry], dim: usize, seed: u64) -> Result<EncodedLevel> {
    if dim == 0 {
        return Err(Error::input("the feature dimension must be at least 1"));
    }
    let (kept, code_of) = deduplicate(entries);
    if kept.is_empty() {
        return Ok(EncodedLevel::default());
    }
    let embedding_dim = kept[0].embedding.len();
    let embeddings: Vec<f32> = kept.iter().flat_map(|e| e.embedding.iter().copied()).collect();
    let weights: Vec<f64> = kept.iter().map(|e| e.weight.max(1.0)).collect();
    let codes = if kept.len() <= dim {
        one_hot(kept.len(), dim)
    } else {
        let start = pca::project(&embeddings, &weights, embedding_dim, dim)?;
        spread::spread(start, &embeddings, embedding_dim, dim, seed)
    };
    let codebook = Codebook {
        embedding_dim,
        code_dim: dim,
        min_chord: min_chord(&codes, dim),
        embeddings,
        codes,
        weights: weights.iter().map(|&w| w as f32).collect(),
        members: kept.into_iter().map(|e| e.members).collect(),
    };
    assert_bijection(&codebook, seed)?;
    Ok(EncodedLevel { codebook, code_of })
}

/// Keeps the heaviest of indistinguishable entries; the order of first appearance stays.
fn deduplicate(entries: &[CodeEntry]) -> (Vec<CodeEntry>, Vec<u32>) {
    let mut kept: Vec<CodeEntry> = Vec::new();
    let mut heaviest: Vec<f64> = Vec::new();
    let mut code_of = Vec::with_capacity(entries.len());
    for e in entries {
        let same = kept.iter().position(|k| dot(&k.embedding, &e.embedding) > SAME_EMBEDDING);
        match same {
            Some(k) => {
                kept[k].weight += e.weight;
                kept[k].members.extend_from_slice(&e.members);
                if e.weight > heaviest[k] {
                    heaviest[k] = e.weight;
                    kept[k].embedding.clone_from(&e.embedding);
                }
                code_of.push(k as u32);
            }
            None => {
                code_of.push(kept.len() as u32);
                heaviest.push(e.weight);
                kept.push(e.clone());
            }
        }
    }
    (kept, code_of)
}

/// `c_k = e_k`: with at most as many codes as dimensions, a mix of two codes is never nearest to a
/// third.
fn one_hot(count: usize, dim: usize) -> Vec<f32> {
    (0..count * dim).map(|i| if i / dim == i % dim { 1.0 } else { 0.0 }).collect()
}

/// Smallest distance between two codes; 2 (the diameter) for fewer than two codes.
pub fn min_chord(codes: &[f32], dim: usize) -> f32 {
    let rows: Vec<&[f32]> = codes.chunks_exact(dim).collect();
    let nearest = (0..rows.len()).into_par_iter().map(|k| squared_chord(rows[k], &rows[k + 1..]));
    nearest.reduce(|| 4.0, f32::min).sqrt()
}

/// Smallest squared distance of a code to some others, at most 4.
fn squared_chord(code: &[f32], others: &[&[f32]]) -> f32 {
    let squared = |other: &[f32]| code.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
    others.iter().map(|other| squared(other)).fold(4.0, f32::min)
}

/// The bijection guarantee: codes are distinct, decode(encode(k)) = k, also with uniform noise of
/// amplitude 0.45 δ_min along a random direction.
fn assert_bijection(codebook: &Codebook, seed: u64) -> Result<()> {
    let chord = codebook.min_chord;
    if chord < MIN_CHORD {
        return Err(Error::work(format!(
            "codebook: two of {} codes are only {chord:.4} apart in {} dimensions; raise --feature-dim",
            codebook.len(),
            codebook.code_dim
        )));
    }
    let mut random = Random::new(seed ^ 0x5eed);
    for (k, code) in codebook.codes.chunks_exact(codebook.code_dim).enumerate() {
        let direction = spread::unit(&mut random, codebook.code_dim);
        let amplitude = 0.45 * chord * random.uniform() as f32;
        let noisy: Vec<f32> = code.iter().zip(&direction).map(|(c, n)| c + amplitude * *n as f32).collect();
        if codebook.decode(code) != Some(k) || codebook.decode(&noisy) != Some(k) {
            return Err(Error::work(format!("codebook: code {k} does not decode to itself")));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
