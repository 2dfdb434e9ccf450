//! Texts of `words`: sentence embeddings, and the classes that a noun means.
use super::row::{COLOUR_AT, SHARES, STUFF_AT, fill, fill_text, stuff_of};
use crate::cache::OutputKey;
use crate::classify::CLASSES;
use crate::progress::Progress;
use crate::registry::{PackFileKind, Registry};
use crate::stuff;
use crate::text::{self, TextEncoder, normalise};
use crate::{Error, KnownWord, Result, colour, cosines, files, lexicon};
use rayon::prelude::*;

/// Softness of the step from text to classes; 0.03 to 0.05 measured equally good, 0.1 worse.
const SOFTNESS: f32 = 0.03;
/// Cosine to a class name from which a text counts as meaning that class: "object", "things",
/// "stuff" and "texture" stay below 0.37, "blue mug" reaches 0.7 with "coffee mug". 0.5 to 0.6
/// measured equally good.
const THRESHOLD: f32 = 0.55;

/// Softness of the choice among the classes of a noun: "floor lamp" means the table lamp more than
/// the candle.
const OF_KIND: f32 = 0.1;

/// The sentence encoder and its embeddings of the class names.
pub(super) struct Vocabulary {
    pub(super) encoder: TextEncoder,
    /// [384] mean of the class names' embeddings.
    pub(super) mean: Vec<f32>,
    /// [1008, 384] unit embeddings of the names of classes and stuff, less the mean.
    pub(super) names: Vec<f32>,
    /// [1008] the names.
    pub(super) list: Vec<String>,
}

/// Cache key of the text models.
pub(super) fn text_key(kind: &'static str, registry: &Registry) -> OutputKey {
    let used = registry.status_of(&[PackFileKind::Text, PackFileKind::Tokenizer, PackFileKind::Classes]);
    used.iter().fold(OutputKey::new(kind), |key, file| key.text(&file.sha256))
}

impl Vocabulary {
    pub(super) fn load(registry: &Registry, progress: &dyn Progress) -> Result<Self> {
        let file = registry.path(PackFileKind::Classes)?;
        let table = files::read_text(&file)?;
        // The first of a class's names: "lemon"; the rest are synonyms and Latin.
        let first = |line: &str| line.split(['\t', ',']).next().unwrap_or_default().to_string();
        let mut list: Vec<String> = table.lines().map(first).collect();
        if list.len() != CLASSES {
            return Err(Error::missing_model(
                file.display(),
                format!("{}: {} classes, expected {CLASSES}", file.display(), list.len()),
            ));
        }
        list.extend(stuff::names().map(str::to_owned));
        let mut encoder = TextEncoder::load(registry)?;
        // Embedding a thousand names takes seconds, too long for a single query.
        let key = text_key("class-names", registry).text(&list.join("\n"));
        let mut names = registry.compute().remember(key, || {
            encoder.embed_list(&list.iter().map(String::as_str).collect::<Vec<_>>(), progress)
        })?;
        let mut mean = vec![0f32; text::DIM];
        for name in names.chunks_exact(text::DIM).take(CLASSES) {
            mean.iter_mut().zip(name).for_each(|(m, n)| *m += n / CLASSES as f32);
        }
        for name in names.chunks_exact_mut(text::DIM) {
            name.iter_mut().zip(&mean).for_each(|(n, m)| *n -= m);
            normalise(name);
        }
        Ok(Vocabulary { encoder, mean, names, list })
    }

    /// Names of classes (index, cosine), behind the region's colour where that raises the cosine.
    pub(super) fn with_colour(&self, list: Vec<(usize, f32)>, region: &[f32]) -> Vec<(String, f32)> {
        let (term, cosine) = colour::nearest_term(&region[COLOUR_AT..STUFF_AT]);
        let gain = SHARES[2].sqrt() * cosine;
        let name = |(i, cosine): (usize, f32)| match self.list[i].as_str() {
            name if gain > 0.0 && colour::terms_in(name).is_none() => {
                (format!("{term} {name}"), cosine + gain)
            }
            name => (name.to_owned(), cosine),
        };
        list.into_iter().map(name).collect()
    }

    /// Looks up the noun of a text with its sentence embedding [384], without colours.
    pub(super) fn look_up(&self, text: &str, meaning: Vec<f32>) -> Result<KnownWord> {
        let plain = colour::without(text);
        let noun = lexicon::noun(&plain);
        let classes = noun.as_ref().map_or(&[][..], |noun| &noun.classes);
        let weights = self.weights(classes, &self.centred(meaning));
        let best = weights.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
        let nearest = noun.and(best).map(|(class, _)| self.list[class].clone());
        let mut not_english = Vec::new();
        if nearest.is_none() {
            for word in plain.split(|c: char| !c.is_alphabetic()).filter(|w| !w.is_empty()) {
                if !word.is_ascii() || !self.encoder.is_word(word)? {
                    not_english.push(word.to_owned());
                }
            }
        }
        Ok(KnownWord { nearest, not_english })
    }

    /// Subtracts the mean of the class names from a sentence embedding and normalises it.
    pub(super) fn centred(&self, mut meaning: Vec<f32>) -> Vec<f32> {
        meaning.iter_mut().zip(&self.mean).for_each(|(v, m)| *v -= m);
        normalise(&mut meaning);
        meaning
    }

    /// Writes the row of a text with its sentence embedding [384].
    pub(super) fn fill_phrase(&self, row: &mut [f32], text: &str, meaning: Vec<f32>) {
        let meaning = self.centred(meaning);
        let mut classes = lexicon::noun(&colour::without(text)).map_or(Vec::new(), |noun| noun.classes);
        if stuff_of(row).is_empty() {
            classes.retain(|class| *class < CLASSES);
        }
        fill_text(row, &meaning, &self.weights(&classes, &meaning));
        if let Some(said) = colour::terms_in(text) {
            fill(row, COLOUR_AT, SHARES[2], colour::direction(&said));
        }
        let rest = row.len() - 1;
        row[rest] = (1.0 - row.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    }

    /// The weight [1008] on each class and kind of stuff of a centred unit embedding: on the classes
    /// `of_kind`, with the sum 1; without any, on the nearest names, with a smaller sum. Kinds of stuff
    /// have half of the weight of a noun that also has classes.
    fn weights(&self, of_kind: &[usize], meaning: &[f32]) -> Vec<f32> {
        let mut scores = cosines(meaning, &self.names);
        if of_kind.is_empty() {
            scores[CLASSES..].fill(f32::NEG_INFINITY);
            let most = scores.iter().copied().fold(THRESHOLD, f32::max);
            let power = |score: f32| ((score - most) / SOFTNESS).exp();
            let total = scores.iter().map(|s| power(*s)).sum::<f32>() + power(THRESHOLD);
            return scores.iter().map(|s| power(*s) / total).collect();
        }
        let mut weights = vec![0.0; scores.len()];
        let (classes, kinds) = of_kind.split_at(of_kind.partition_point(|i| *i < CLASSES));
        let parts = [classes, kinds].into_iter().filter(|part| !part.is_empty());
        let share = 1.0 / parts.clone().count() as f32;
        for part in parts {
            let most = part.iter().map(|i| scores[*i]).fold(f32::MIN, f32::max);
            let power = |i: &usize| ((scores[*i] - most) / OF_KIND).exp();
            let total: f32 = part.iter().map(power).sum();
            part.iter().for_each(|i| weights[*i] = share * power(i) / total);
        }
        weights
    }

    /// The names as texts, without colour: [1008, dim], all but the last coordinate, which no region
    /// has.
    pub(super) fn rows(&self, dim: usize) -> Vec<f32> {
        let mut rows = vec![0f32; self.list.len() * dim];
        let names = self.names.par_chunks_exact(text::DIM);
        rows.par_chunks_exact_mut(dim).zip(names).enumerate().for_each(|(i, (row, name))| {
            let mut weights = vec![0.0; self.list.len()];
            weights[i] = 1.0;
            fill_text(row, name, &weights);
        });
        rows
    }
}
