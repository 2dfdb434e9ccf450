//! Conformal test of whether a scene shows the thing that a text names
//! (docs/internals/method.md#presence). The text is compared with names of other things; one that
//! fits the scene no better than they do is no evidence.
use super::CanonicalCosines;
use super::maps::CodeMaps;
use crate::math::dot_f32 as dot;
use crate::scene::LanguageField;
use rayon::prelude::*;
use serde::Serialize;
use splatvk_infer::PresenceLevels;
use std::sync::Arc;

/// Smallest number n of other things for a test: the smallest p-value, 1 / (1 + n), is below
/// the level of found texts.
pub const MIN_OTHERS: usize = 20;

/// Smallest share of all pixels of a code. Smaller codes are specks, which match any text by
/// chance.
const LEAST_SHARE: f64 = 3e-4;

/// Embeddings of alternatives to a text.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Alternatives {
    /// [N, D] unit rows of other things; shared by many texts.
    pub things: Arc<Vec<f32>>,
    /// [M, D] unit rows of the same thing in other colours.
    pub colours: Vec<f32>,
    /// Levels of the test.
    pub levels: PresenceLevels,
}

/// Presence of a thing in a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Presence {
    /// It is in the scene.
    Found,
    /// The features do not decide.
    Unsure,
    /// There is no sign of it: it fits no better than most other things.
    Absent,
}

/// Result of the presence test.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Evidence {
    /// The verdict.
    pub presence: Presence,
    /// Share of texts that fit the scene at least as well, this one included, in (0, 1].
    pub p_value: f32,
}

impl Evidence {
    /// Lowers [`Presence::Found`] to [`Presence::Unsure`], for a text that may be misread.
    pub fn in_doubt(self) -> Evidence {
        match self.presence {
            Presence::Found => Evidence { presence: Presence::Unsure, ..self },
            _ => self,
        }
    }
}

/// Number of pixels that views show of every code.
#[derive(Clone, Debug, Default)]
pub struct ShownPixels {
    /// Per level [K] pixels.
    codes: Vec<Vec<usize>>,
    /// Per level all pixels.
    all: Vec<usize>,
}

impl ShownPixels {
    /// Counts a view with these maps.
    pub fn add(&mut self, field: &LanguageField, maps: &CodeMaps) {
        self.codes.resize(field.levels.len(), Vec::new());
        self.all.resize(field.levels.len(), 0);
        for (((counts, all), level), map) in
            self.codes.iter_mut().zip(&mut self.all).zip(&field.levels).zip(&maps.levels)
        {
            counts.resize(level.codebook.len(), 0);
            *all += map.codes.len();
            for shown in &map.shown {
                if let Some(n) = counts.get_mut(usize::from(shown.code)) {
                    *n += shown.pixels;
                }
            }
        }
    }

    /// Counts several views.
    pub fn of<'m>(field: &LanguageField, views: impl IntoIterator<Item = &'m CodeMaps>) -> ShownPixels {
        let mut shown = ShownPixels::default();
        views.into_iter().for_each(|maps| shown.add(field, maps));
        shown
    }
}

/// Codes visible in views, with their cosines to canonical phrases.
#[derive(Default)]
pub struct ShownCodes<'f> {
    /// [D] embedding, and the largest cosine to a canonical phrase.
    codes: Vec<(&'f [f32], f32)>,
}

impl<'f> ShownCodes<'f> {
    /// Collects the visible codes of `field` without specks.
    pub fn new(shown: &ShownPixels, field: &'f LanguageField, cosines: &CanonicalCosines) -> ShownCodes<'f> {
        let mut codes = Vec::new();
        let levels = field.levels.iter().zip(&cosines.short);
        for (((level, common), shown), all) in levels.zip(&shown.codes).zip(&shown.all) {
            let book = &level.codebook;
            let least = LEAST_SHARE * *all as f64;
            let rows = book.embeddings.chunks_exact(book.embedding_dim.max(1)).zip(common).zip(shown);
            let kept = rows.filter(|(_, n)| **n > 0 && **n as f64 >= least);
            codes.extend(kept.map(|((row, common), _)| (row, *common)));
        }
        ShownCodes { codes }
    }

    /// The codes of both.
    pub fn joined(mut self, other: ShownCodes<'f>) -> ShownCodes<'f> {
        self.codes.extend(other.codes);
        self
    }

    /// The code with the largest margin, and its margin: cosine to the text less the largest cosine
    /// to a canonical phrase.
    fn best(&self, text: &[f32]) -> Option<(&'f [f32], f32)> {
        let fits = self.codes.iter().map(|(row, common)| (*row, dot(row, text) - common));
        fits.max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// Margins of other things [N, D].
    pub fn background(&self, others: &[f32]) -> Background {
        let dim = self.codes.first().map_or(1, |c| c.0.len());
        let scores = others.par_chunks_exact(dim).filter_map(|other| Some(self.best(other)?.1));
        Background { scores: scores.collect() }
    }

    /// Tests a text against the margins of other things; `alternatives` has its other colours and
    /// the levels. `None` with fewer than [`MIN_OTHERS`] other things or without a
    /// visible code.
    pub fn evidence(
        &self,
        text: &[f32],
        alternatives: &Alternatives,
        background: &Background,
    ) -> Option<Evidence> {
        if background.scores.len() < MIN_OTHERS {
            return None;
        }
        let (code, own) = self.best(text)?;
        // "green mug" whose best code is a blue mug.
        let fit = dot(code, text);
        let other_colour = alternatives.colours.chunks_exact(code.len()).any(|c| dot(code, c) > fit);
        let better = background.scores.iter().filter(|other| **other >= own).count();
        let p_value = (1 + better) as f32 / (1 + background.scores.len()) as f32;
        let presence = match p_value {
            p if p <= alternatives.levels.found && !other_colour => Presence::Found,
            p if p < alternatives.levels.absent => Presence::Unsure,
            _ => Presence::Absent,
        };
        Some(Evidence { presence, p_value })
    }
}

/// Margins of other things in a scene.
#[derive(Clone, Debug, Default)]
pub struct Background {
    scores: Vec<f32>,
}
