//! Whether a scene shows what a text means (docs/internals/method.md#presence): a text is weighed
//! against other things that it could have said. One that fits the scene no better than they do is
//! no evidence of anything.
use crate::math::dot_f32 as dot;
use crate::scene::{Image, LanguageField};
use rayon::prelude::*;
use serde::Serialize;
use std::sync::Arc;

/// Fewer other things tell nothing: the least share that they can state is above [`FOUND`].
pub const MIN_OTHERS: usize = 20;

/// Share of other things that fit at least as well, up to which a text is found. Of texts that are
/// not in the scene no more than this share is called found, as far as they are like the other
/// things: the level of a conformal test.
pub const FOUND: f32 = 0.05;

/// The same, from which on a text is not in the scene: three of four things that are hardly there
/// fit better. Of what is in `breakfast` and five generated scenes (tuning; built-in words) one in
/// sixteen is above, of what is not one in seven.
const ABSENT: f32 = 0.75;

/// Codes that show less than this share of all pixels are specks, which answer anything by chance.
const LEAST_SHARE: f64 = 3e-4;

/// What a text could have said instead.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Alternatives {
    /// [N, D] unit rows of other things; the same for many texts.
    pub things: Arc<Vec<f32>>,
    /// [M, D] unit rows of the same thing in other colours.
    pub colours: Vec<f32>,
}

/// Whether something is in a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Presence {
    /// It is.
    Found,
    /// What the features say does not decide.
    Unsure,
    /// It is not.
    Absent,
}

/// What speaks for a text.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Evidence {
    /// The verdict.
    pub presence: Presence,
    /// Share of other things that fit the scene at least as well, in (0, 1].
    pub p_value: f32,
}

impl Evidence {
    /// The same, where the answer may be for something else than what was asked.
    pub fn in_doubt(self) -> Evidence {
        match self.presence {
            Presence::Found => Evidence { presence: Presence::Unsure, ..self },
            _ => self,
        }
    }
}

/// How much views show of every code.
#[derive(Clone, Debug, Default)]
pub struct ShownPixels {
    /// Per level [K] pixels.
    codes: Vec<Vec<usize>>,
    /// Per level all pixels.
    all: Vec<usize>,
}

impl ShownPixels {
    /// Counts a view; `maps` holds its decoded map per level.
    pub fn add(&mut self, field: &LanguageField, maps: &[Image<i32>]) {
        self.codes.resize(field.levels.len(), Vec::new());
        self.all.resize(field.levels.len(), 0);
        for (((counts, all), level), map) in
            self.codes.iter_mut().zip(&mut self.all).zip(&field.levels).zip(maps)
        {
            counts.resize(level.codebook.len(), 0);
            *all += map.data.len();
            for code in &map.data {
                if let Some(n) = usize::try_from(*code).ok().and_then(|k| counts.get_mut(k)) {
                    *n += 1;
                }
            }
        }
    }

    /// Of several views.
    pub fn of(field: &LanguageField, views: &[&[Image<i32>]]) -> ShownPixels {
        let mut shown = ShownPixels::default();
        views.iter().for_each(|maps| shown.add(field, maps));
        shown
    }
}

/// The codes that views show, and what of their meaning the canonical phrases have.
pub struct ShownCodes<'f> {
    /// [D] embedding, and the largest cosine to a canonical phrase.
    codes: Vec<(&'f [f32], f32)>,
}

impl<'f> ShownCodes<'f> {
    /// Those of `field` that are no specks.
    pub fn new(shown: &ShownPixels, field: &'f LanguageField, canonicals: &[f32]) -> ShownCodes<'f> {
        let mut codes = Vec::new();
        for ((level, shown), all) in field.levels.iter().zip(&shown.codes).zip(&shown.all) {
            let book = &level.codebook;
            let least = LEAST_SHARE * *all as f64;
            let rows = book.embeddings.chunks_exact(book.embedding_dim.max(1)).zip(shown);
            codes.extend(rows.filter(|(_, n)| **n > 0 && **n as f64 >= least).map(|(row, _)| {
                let common = canonicals.chunks_exact(row.len()).map(|c| dot(row, c));
                (row, common.fold(f32::NEG_INFINITY, f32::max))
            }));
        }
        ShownCodes { codes }
    }

    /// The code that fits a text best, and by how much it is nearer to it than to every canonical
    /// phrase, as a difference of cosines.
    fn best(&self, text: &[f32]) -> Option<(&'f [f32], f32)> {
        let fits = self.codes.iter().map(|(row, common)| (*row, dot(row, text) - common));
        fits.max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// The scores of other things.
    pub fn background(&self, others: &[f32]) -> Background {
        let dim = self.codes.first().map_or(1, |c| c.0.len());
        let scores = others.par_chunks_exact(dim).filter_map(|other| Some(self.best(other)?.1));
        Background { scores: scores.collect() }
    }

    /// What speaks for a text against the scores of other things, and its embedding in other
    /// colours ([`Alternatives::colours`]); `None` where there are too few other things to say, or
    /// no code is shown.
    pub fn evidence(&self, text: &[f32], colours: &[f32], background: &Background) -> Option<Evidence> {
        if background.scores.len() < MIN_OTHERS {
            return None;
        }
        let (code, own) = self.best(text)?;
        // "green mug": the code that fits it best is a blue mug.
        let fit = dot(code, text);
        let other_colour = colours.chunks_exact(code.len()).any(|c| dot(code, c) > fit);
        let better = background.scores.iter().filter(|other| **other >= own).count();
        let p_value = (1 + better) as f32 / (1 + background.scores.len()) as f32;
        let presence = match p_value {
            p if p <= FOUND && !other_colour => Presence::Found,
            p if p < ABSENT => Presence::Unsure,
            _ => Presence::Absent,
        };
        Some(Evidence { presence, p_value })
    }
}

/// How well other things fit a scene.
#[derive(Clone, Debug, Default)]
pub struct Background {
    scores: Vec<f32>,
}
