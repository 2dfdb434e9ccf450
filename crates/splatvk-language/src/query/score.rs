//! Relevancy of codes to a text (docs/internals/method.md#relevancy).
use super::{QueryOptions, TextQuery};
use crate::math::{dot, dot_f32};
use crate::scene::{Codebook, LanguageField};
use crate::{Error, Result};
use rayon::prelude::*;

/// Cosines are multiplied by this before the softmax (LERF); without it no relevancy leaves 0.45 to
/// 0.55.
pub(super) const LOGIT_SCALE: f64 = 10.0;

/// Codes whose dot products are summed side by side: a sum waits for the addition before it.
const TOGETHER: usize = 4;

/// Largest cosines of the codes of a field to the canonical phrases. They depend on no text and are
/// computed once for many queries.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CanonicalCosines {
    /// [C, D] rows of the phrases.
    canonicals: Vec<f32>,
    /// Per level [K], summed in f64.
    pub(super) exact: Vec<Vec<f64>>,
    /// Per level [K], summed in f32.
    pub(super) short: Vec<Vec<f32>>,
}

impl CanonicalCosines {
    /// Computes the cosines to the canonical rows [C, D].
    pub fn new(field: &LanguageField, canonicals: &[f32]) -> CanonicalCosines {
        let books = || field.levels.iter().map(|l| &l.codebook);
        CanonicalCosines {
            canonicals: canonicals.to_vec(),
            exact: books().map(|b| hardest(b, canonicals, dot, f64::NEG_INFINITY, f64::max)).collect(),
            short: books().map(|b| hardest(b, canonicals, dot_f32, f32::NEG_INFINITY, f32::max)).collect(),
        }
    }

    /// Whether the cosines are those to these phrases.
    pub fn is_of(&self, canonicals: &[f32]) -> bool {
        self.canonicals == canonicals
    }

    /// [`code_relevancy`] of every level, with the canonical phrases of the query. Unless the
    /// options ask for a published protocol, codes that fit another colour than the query's are
    /// limited to 0.5.
    pub fn relevancy(
        &self,
        field: &LanguageField,
        query: &TextQuery,
        options: &QueryOptions,
    ) -> Result<Vec<Vec<f32>>> {
        let mut levels = self.plain(field, query)?;
        if !options.published {
            let books = field.levels.iter().map(|level| &level.codebook);
            books.zip(&mut levels).for_each(|(book, values)| limit_other_colours(book, query, values));
        }
        Ok(levels)
    }

    fn plain(&self, field: &LanguageField, query: &TextQuery) -> Result<Vec<Vec<f32>>> {
        let books = field.levels.iter().map(|level| &level.codebook);
        let level = |(book, hardest): (&Codebook, &Vec<f64>)| {
            check(book, query)?;
            Ok(relevancies(book, query, hardest))
        };
        books.zip(&self.exact).map(level).collect()
    }
}

fn hardest<T: Copy + Send + Sync>(
    book: &Codebook,
    canonicals: &[f32],
    dot: fn(&[f32], &[f32]) -> T,
    lowest: T,
    largest: fn(T, T) -> T,
) -> Vec<T> {
    let d = book.embedding_dim.max(1);
    let rows = book.embeddings.par_chunks_exact(d);
    rows.map(|row| canonicals.chunks_exact(d).map(|n| dot(row, n)).fold(lowest, largest)).collect()
}

/// Relevancy of every code, [K]: `min_i σ(10 (φ·q − φ·n_i))` (docs/internals/method.md#relevancy).
/// Answers take [`CanonicalCosines::relevancy`], which also limits codes of another colour than the
/// query's.
pub fn code_relevancy(codebook: &Codebook, query: &TextQuery) -> Result<Vec<f32>> {
    check(codebook, query)?;
    Ok(relevancies(codebook, query, &hardest(codebook, &query.canonicals, dot, f64::NEG_INFINITY, f64::max)))
}

fn check(codebook: &Codebook, query: &TextQuery) -> Result<()> {
    let d = codebook.embedding_dim;
    let fits = || query.embedding.len() == d && !query.canonicals.is_empty();
    if codebook.is_empty() || (fits() && query.canonicals.len().is_multiple_of(d)) {
        return Ok(());
    }
    Err(Error::input(format!(
        "the query '{}' has {} values, the scene's embeddings {d}: they come from different models",
        query.text,
        query.embedding.len()
    )))
}

fn relevancies(codebook: &Codebook, query: &TextQuery, hardest: &[f64]) -> Vec<f32> {
    let cosines = dots(&codebook.embeddings, &query.embedding);
    cosines.iter().zip(hardest).map(|(cosine, hardest)| sigmoid(cosine - hardest)).collect()
}

/// `row·v` of all rows [K, D], each the sum of [`dot`].
fn dots(rows: &[f32], v: &[f32]) -> Vec<f64> {
    let d = v.len().max(1);
    let block = |block: &[f32]| -> Vec<f64> {
        let mut sums = [0.0f64; TOGETHER];
        if block.len() < TOGETHER * d {
            return block.chunks_exact(d).map(|row| dot(row, v)).collect();
        }
        let rows: [&[f32]; TOGETHER] = std::array::from_fn(|k| &block[k * d..(k + 1) * d]);
        for (i, value) in v.iter().enumerate() {
            for (sum, row) in sums.iter_mut().zip(rows) {
                *sum += f64::from(row[i]) * f64::from(*value);
            }
        }
        sums.to_vec()
    };
    rows.par_chunks(TOGETHER * d).flat_map_iter(block).collect()
}

/// Relevancy of a text whose cosine to the region embedding `phi` is known, against canonical rows
/// [C, D].
pub fn relevancy(phi: &[f32], cosine: f64, canonicals: &[f32]) -> f32 {
    let rows = canonicals.chunks_exact(phi.len().max(1));
    sigmoid(cosine - rows.map(|n| dot(phi, n)).fold(f64::NEG_INFINITY, f64::max))
}

fn sigmoid(margin: f64) -> f32 {
    (1.0 / (1.0 + (-LOGIT_SCALE * margin).exp())) as f32
}

/// The margin in cosine that gives a relevancy: the inverse of the sigmoid.
pub(super) fn margin(relevancy: f32) -> f32 {
    let r = f64::from(relevancy);
    ((r / (1.0 - r)).ln() / LOGIT_SCALE) as f32
}

/// [`code_relevancy`] of every level: the relevancy of the published protocols.
pub fn field_relevancy(field: &LanguageField, query: &TextQuery) -> Result<Vec<Vec<f32>>> {
    CanonicalCosines::new(field, &query.canonicals).plain(field, query)
}

/// Limits codes that fit another colour better to a relevancy of 0.5 if the best code has the
/// colour that the query names: "yellow brick" excludes similar green bricks. If the best code fits
/// another colour better, features do not separate colours and nothing changes.
fn limit_other_colours(book: &Codebook, query: &TextQuery, relevancy: &mut [f32]) {
    if query.alternatives.colours.is_empty() {
        return;
    }
    let rows = || book.embeddings.chunks_exact(book.embedding_dim.max(1));
    let has_colour = |row: &[f32]| {
        let own = dot(row, &query.embedding);
        query.alternatives.colours.chunks_exact(row.len()).all(|other| dot(row, other) <= own)
    };
    let best = rows().zip(relevancy.iter()).max_by(|a, b| a.1.total_cmp(b.1));
    if best.is_some_and(|(row, _)| has_colour(row)) {
        // Others are below the limit.
        let above: Vec<(&[f32], &mut f32)> = rows().zip(relevancy).filter(|(_, r)| **r > 0.5).collect();
        above.into_par_iter().filter(|(row, _)| !has_colour(row)).for_each(|(_, r)| *r = 0.5);
    }
}
