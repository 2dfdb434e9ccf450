//! Text queries and evaluation.
//!
//! A query is a unit vector and the canonical vectors of the same space. Its relevancy is computed
//! once per code and gathered through the decoded code maps of a frame
//! (docs/internals/method.md#queries). Level and location are chosen on the smoothed map; the mask
//! of the `field` protocol is chosen on codes, so smoothing never moves its edges.
mod cells;
mod enclosed;
pub mod filter;
pub mod frame;
pub mod highlight;
pub mod instances;
pub mod maps;
pub mod photos;
pub mod phrasing;
pub mod presence;
mod result;
mod score;
pub mod select;
mod surfaces;
#[cfg(test)]
mod testing;
pub mod things;
pub mod window;

pub use self::frame::{LevelPeaks, Table, answer, answer_all, answer_with, relevancy_map};
pub use self::result::{AnswerImages, QueryResult};
pub use self::score::{CanonicalCosines, code_relevancy, field_relevancy, relevancy};

use self::phrasing::Reading;
use self::presence::Alternatives;

/// The phrases that every query is compared against (LERF).
pub const CANONICAL_PHRASES: [&str; 4] = ["object", "things", "stuff", "texture"];

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
    /// Whether answers are those of the published protocols: every text counts with all its words,
    /// codes of another colour than the text's keep their relevancy, and presence is not judged, so
    /// that it empties no mask.
    pub published: bool,
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
        QueryOptions { mask: MaskRule::Codes(CODE_SHARE), abs_threshold: 0.5, slack: SLACK, published: false }
    }
}

/// Default of [`MaskRule::Codes`]. With 0.8, pieces of one object with similar features join the
/// best code, and a different object with a related meaning does not.
pub const CODE_SHARE: f32 = 0.8;

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

/// The first of the highest: ties go to the finer level.
fn first_best(peaks: &[f32]) -> Option<usize> {
    let top = peaks.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    peaks.iter().position(|&p| p >= top)
}

/// Relevancy from which a code joins the best one: `share` of the way from 0.5, where a code is as
/// close to the phrase as to a canonical phrase, to the best relevancy `top`.
fn code_bar(top: f32, share: f32) -> f32 {
    if top > 0.5 { 0.5 + share * (top - 0.5) } else { top }
}

#[cfg(test)]
mod tests;
