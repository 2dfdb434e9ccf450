//! Text queries and evaluation.
//!
//! A query is a unit vector and the canonical vectors of the same space. Its relevancy is computed
//! once per code and gathered through the decoded code maps of a frame
//! (docs/internals/method.md#queries). Level and location are chosen on the smoothed map; the mask
//! of the `field` protocol is chosen on codes, so smoothing never moves its edges.
pub mod filter;
pub mod highlight;
pub mod instances;
pub mod phrasing;
pub mod presence;
pub mod select;

use self::phrasing::Reading;
use self::presence::Alternatives;
use crate::math::dot;
use crate::scene::{Codebook, Image, LanguageField, LevelField};
use crate::{Error, Result};
use rayon::prelude::*;

/// The phrases that every query is compared against (LERF).
pub const CANONICAL_PHRASES: [&str; 4] = ["object", "things", "stuff", "texture"];

/// Cosines are multiplied by this before the softmax (LERF); without it no relevancy leaves 0.45 to
/// 0.55.
const LOGIT_SCALE: f64 = 10.0;

/// A text query in the field's embedding space.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TextQuery {
    /// The text of the query.
    pub text: String,
    /// [D] unit vector.
    pub embedding: Vec<f32>,
    /// [C, D] unit rows of the canonical phrases.
    pub canonicals: Vec<f32>,
    /// Alternatives to the text; may be empty.
    pub alternatives: Alternatives,
    /// Interpretation of the text.
    pub reading: Reading,
}

/// Options of an answer.
#[derive(Clone, Debug, PartialEq)]
pub struct QueryOptions {
    /// Mask rule.
    pub mask: MaskRule,
    /// A query whose best relevancy stays below this is "not found". 0.5 means: no closer than the
    /// nearest canonical phrase (docs/internals/method.md#level-and-mask).
    pub abs_threshold: f32,
    /// For [`MaskRule::Codes`]: tolerance in the choice of the level. A part often matches a phrase
    /// slightly better than its whole, although the phrase means the whole. The coarsest level
    /// within the tolerance of the best margin is chosen.
    pub slack: Slack,
}

/// Tolerance by which a coarser level may be worse and is still chosen. Levels are compared by
/// their margin: cosine of the best code to the phrase less its largest cosine to a canonical
/// phrase. Relevancy, the sigmoid of ten times the margin, saturates near 1 for good answers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slack {
    /// Difference of margins within the noise of the features.
    pub margin: f32,
    /// Difference within the noise, as a share of the best margin.
    pub share: f32,
}

/// Measured on the breakfast photos: features of one thing seen from several sides differ by 0.01
/// where its margin is 0.02 ("box of cereal") and 0.03 to 0.09 where it is 0.2 to 0.5. On 80
/// perturbed segmentations the mean IoU is flat for margins of 0.02 to 0.03 with shares of 0.1 to
/// 0.2, and 4 to 8 points lower without either.
pub const SLACK: Slack = Slack { margin: 0.02, share: 0.1 };

/// Rule that derives the mask from relevancy.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum MaskRule {
    /// Protocol `field`: the codes whose relevancy is at least this share of the way from 0.5 (as
    /// close as a canonical phrase) to the best code of the level; their pixels are the mask,
    /// without smoothing.
    Codes(f32),
    /// Protocol `lerf` (docs/internals/method.md#lerf-ovs): threshold on the min–max-normalised
    /// smoothed map, then a 7×7 majority filter.
    Lerf(f32),
}

impl Default for QueryOptions {
    fn default() -> Self {
        QueryOptions { mask: MaskRule::Codes(CODE_SHARE), abs_threshold: 0.5, slack: SLACK }
    }
}

/// Default of [`MaskRule::Codes`]. With 0.8, pieces of one object with similar features join the
/// best code, and a different object with a related meaning does not.
pub const CODE_SHARE: f32 = 0.8;

/// The answer to one query in one frame.
#[derive(Clone, Debug, Default)]
pub struct QueryResult {
    /// Chosen level, index as in [`crate::scene::LEVEL_NAMES`].
    pub level: usize,
    /// [H, W] blended relevancy of the chosen level (docs/internals/method.md#smoothing), 0 where
    /// nothing is.
    pub relevancy: Image<f32>,
    /// [H, W] the mask.
    pub mask: Image<bool>,
    /// Column and row of the most relevant pixel.
    pub location: (usize, usize),
    /// Best unsmoothed relevancy of the frame at the chosen level.
    pub score: f32,
    /// Whether the score reaches [`QueryOptions::abs_threshold`].
    pub found: bool,
}

impl QueryResult {
    /// Marks the text as not found and clears the mask; relevancy still shows the nearest codes.
    pub fn mark_not_found(&mut self) {
        self.found = false;
        self.mask.data.fill(false);
    }
}

/// Relevancy of every code, [K]: `min_i σ(10 (φ·q − φ·n_i))` (docs/internals/method.md#relevancy).
/// Answers take [`field_relevancy`], which also limits codes of another colour than the query's.
pub fn code_relevancy(codebook: &Codebook, query: &TextQuery) -> Result<Vec<f32>> {
    let d = codebook.embedding_dim;
    if codebook.is_empty() {
        return Ok(Vec::new());
    }
    if query.embedding.len() != d || query.canonicals.is_empty() || !query.canonicals.len().is_multiple_of(d)
    {
        return Err(Error::input(format!(
            "the query '{}' has {} values, the scene's embeddings {d}: they come from different models",
            query.text,
            query.embedding.len()
        )));
    }
    let rate = |phi: &[f32]| relevancy(phi, dot(phi, &query.embedding), &query.canonicals);
    Ok(codebook.embeddings.chunks_exact(d).map(rate).collect())
}

/// Relevancy of a text whose cosine to the region embedding `phi` is known, against canonical rows
/// [C, D].
pub fn relevancy(phi: &[f32], cosine: f64, canonicals: &[f32]) -> f32 {
    let hardest =
        canonicals.chunks_exact(phi.len().max(1)).map(|n| dot(phi, n)).fold(f64::NEG_INFINITY, f64::max);
    (1.0 / (1.0 + (-LOGIT_SCALE * (cosine - hardest)).exp())) as f32
}

/// Relevancy per pixel of a decoded map; void pixels (−1) get 0.
pub fn relevancy_map(codes: &Image<i32>, relevancy: &[f32]) -> Image<f32> {
    let value = |&k: &i32| usize::try_from(k).ok().and_then(|k| relevancy.get(k)).copied().unwrap_or(0.0);
    Image { width: codes.width, height: codes.height, data: codes.data.par_iter().map(value).collect() }
}

/// Answers a query in one frame. `codes` holds the frame's decoded map per level; levels without
/// codes are skipped.
pub fn answer(
    codes: &[Image<i32>],
    field: &LanguageField,
    query: &TextQuery,
    options: &QueryOptions,
) -> Result<QueryResult> {
    answer_with(codes, &field_relevancy(field, query)?, options)
}

/// [`answer`] in several frames.
pub fn answer_all(
    frames: &[&[Image<i32>]],
    field: &LanguageField,
    query: &TextQuery,
    options: &QueryOptions,
) -> Result<Vec<QueryResult>> {
    let relevancy = field_relevancy(field, query)?;
    frames.par_iter().map(|codes| answer_with(codes, &relevancy, options)).collect()
}

/// [`code_relevancy`] of every level; codes that fit another colour than the query's are limited to
/// 0.5.
pub fn field_relevancy(field: &LanguageField, query: &TextQuery) -> Result<Vec<Vec<f32>>> {
    field.levels.iter().map(|level| level_relevancy(level, query)).collect()
}

fn level_relevancy(level: &LevelField, query: &TextQuery) -> Result<Vec<f32>> {
    let mut relevancy = code_relevancy(&level.codebook, query)?;
    limit_other_colours(&level.codebook, query, &mut relevancy);
    Ok(relevancy)
}

/// Limits codes that fit another colour better to a relevancy of 0.5 if the best code has the
/// colour that the query names: "yellow brick" excludes similar green bricks. If the best code fits
/// another colour better, features do not separate colours and nothing changes.
fn limit_other_colours(book: &Codebook, query: &TextQuery, relevancy: &mut [f32]) {
    let rows = || book.embeddings.chunks_exact(book.embedding_dim.max(1));
    let has_colour = |row: &[f32]| {
        let own = dot(row, &query.embedding);
        query.alternatives.colours.chunks_exact(row.len()).all(|other| dot(row, other) <= own)
    };
    let best = rows().zip(relevancy.iter()).max_by(|a, b| a.1.total_cmp(b.1));
    if best.is_some_and(|(row, _)| has_colour(row)) {
        let others = rows().zip(relevancy).filter(|(row, _)| !has_colour(row));
        others.for_each(|(_, r)| *r = r.min(0.5));
    }
}

/// One level of a frame.
struct LevelCandidate {
    level: usize,
    raw: Image<f32>,
    /// Value by which levels are compared.
    peak: f32,
}

/// [`answer`] with the relevancy of every code per level ([`field_relevancy`]).
pub fn answer_with(
    codes: &[Image<i32>],
    relevancy: &[Vec<f32>],
    options: &QueryOptions,
) -> Result<QueryResult> {
    let levels = codes.iter().zip(relevancy).enumerate().filter(|(_, (_, r))| !r.is_empty());
    let mut candidates: Vec<LevelCandidate> = levels
        .map(|(level, (map, relevancy))| {
            let raw = relevancy_map(map, relevancy);
            let peak = level_peak(&raw, options.mask);
            LevelCandidate { level, raw, peak }
        })
        .collect();
    let chosen = choose_level(&candidates, options)
        .ok_or_else(|| Error::work("the scene has no language level to query"))?;
    // With masks of codes, all levels determine the location: the whole "plate" may include a lemon
    // that finer levels separate. The published protocols use the chosen level alone
    // (docs/internals/method.md#lerf-ovs).
    let all = matches!(options.mask, MaskRule::Codes(_)).then(|| filter::box30(&sum(&candidates)));
    let best = candidates.swap_remove(chosen);
    let boxed = filter::box30(&best.raw);
    let blended = filter::blend(&best.raw, &boxed);
    let score = highest(&best.raw).max(0.0);
    let mask = match options.mask {
        MaskRule::Codes(share) => code_mask(&codes[best.level], &relevancy[best.level], share),
        MaskRule::Lerf(threshold) => filter::lerf_mask(&blended, threshold),
    };
    Ok(QueryResult {
        level: best.level,
        location: locate(&all.unwrap_or(boxed).data, &mask),
        relevancy: blended,
        mask,
        score,
        found: score >= options.abs_threshold,
    })
}

fn highest(map: &Image<f32>) -> f32 {
    map.data.iter().copied().fold(f32::NEG_INFINITY, f32::max)
}

/// The published protocols take the peak of the blended map (docs/internals/method.md#lerf-ovs).
/// For masks of codes it is the margin whose relevancy is the peak of the blended *excess* over a
/// canonical phrase, `max(0, 2·rel − 1)`: smoothing then counts against specks, which the usual 0.5
/// of their surroundings would hide.
fn level_peak(raw: &Image<f32>, rule: MaskRule) -> f32 {
    if !matches!(rule, MaskRule::Codes(_)) {
        return highest(&filter::blend(raw, &filter::box30(raw)));
    }
    let data = raw.data.iter().map(|v| (2.0 * v - 1.0).max(0.0)).collect();
    let excess = Image { data, ..*raw };
    let peak = highest(&filter::blend(&excess, &filter::box30(&excess)));
    // no code exceeds the canonical phrases: negative margin of the best code
    margin(if peak > 0.0 { 0.5 + 0.5 * peak } else { highest(raw).min(0.5) })
}

/// The margin in cosine that gives a relevancy: the inverse of the sigmoid in [`code_relevancy`].
fn margin(relevancy: f32) -> f32 {
    let r = f64::from(relevancy);
    ((r / (1.0 - r)).ln() / LOGIT_SCALE) as f32
}

/// Index of the candidate that answers.
fn choose_level(candidates: &[LevelCandidate], options: &QueryOptions) -> Option<usize> {
    let peaks: Vec<f32> = candidates.iter().map(|c| c.peak).collect();
    match options.mask {
        MaskRule::Codes(_) => coarsest_good(&peaks, options.slack),
        MaskRule::Lerf(_) => first_best(&peaks),
    }
}

/// The first of the highest: ties go to the finer level.
fn first_best(peaks: &[f32]) -> Option<usize> {
    let top = peaks.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    peaks.iter().position(|&p| p >= top)
}

/// Last level whose margin is within the slack of the best one; the best level if no margin is
/// positive.
fn coarsest_good(peaks: &[f32], slack: Slack) -> Option<usize> {
    let top = peaks.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if top > 0.0 {
        let bar = ((1.0 - slack.share) * top - slack.margin).max(0.0);
        return peaks.iter().rposition(|&p| p > 0.0 && p >= bar);
    }
    first_best(peaks)
}

/// Relevancy summed over the levels.
fn sum(candidates: &[LevelCandidate]) -> Image<f32> {
    let Some((first, others)) = candidates.split_first() else { return Image::default() };
    let mut sum = first.raw.clone();
    for other in others {
        sum.data.iter_mut().zip(&other.raw.data).for_each(|(s, v)| *s += v);
    }
    sum
}

/// Pixel (column, row) with the highest evidence, inside the mask unless it is empty.
fn locate(evidence: &[f32], mask: &Image<bool>) -> (usize, usize) {
    let any = mask.data.iter().any(|&m| m);
    let mut top: Option<(f32, usize)> = None;
    for (p, &v) in evidence.iter().enumerate() {
        if (!any || mask.data[p]) && top.is_none_or(|(t, _)| v > t) {
            top = Some((v, p));
        }
    }
    let p = top.map_or(0, |(_, p)| p);
    (p % mask.width.max(1), p / mask.width.max(1))
}

/// Relevancy from which a code joins the best one: `share` of the way from 0.5, where a code is as
/// close to the phrase as to a canonical phrase, to the best relevancy `top`.
fn code_bar(top: f32, share: f32) -> f32 {
    if top > 0.5 { 0.5 + share * (top - 0.5) } else { top }
}

/// Pixels of the codes that answer the query ([`MaskRule::Codes`]). Only codes visible in this
/// frame are compared, so that a code of another view does not suppress the best one here.
fn code_mask(map: &Image<i32>, relevancy: &[f32], share: f32) -> Image<bool> {
    let mut shown = vec![false; relevancy.len()];
    for &k in map.data.iter().filter(|&&k| k >= 0) {
        if let Some(s) = shown.get_mut(k as usize) {
            *s = true;
        }
    }
    let visible = relevancy.iter().zip(&shown).filter(|(_, s)| **s).map(|(r, _)| *r);
    let top = visible.fold(0.0f32, f32::max);
    let bar = code_bar(top, share);
    let chosen: Vec<bool> = relevancy.iter().map(|&r| r > 0.0 && r >= bar).collect();
    let data = map.data.iter().map(|&k| k >= 0 && chosen.get(k as usize).copied().unwrap_or(false)).collect();
    Image { width: map.width, height: map.height, data }
}

#[cfg(test)]
mod tests;
