//! Selects the splats that answer a query in space, without any view
//! (docs/internals/method.md#selection-in-space).
use super::instances::Places;
use super::score::margin;
use super::{MaskRule, QueryOptions};

/// Smallest number of splats of a code. Smaller codes are specks: at a pixel per splat, below the
/// smallest mask.
const MIN_SPLATS: usize = 32;

/// The splats that answer a query.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Selection {
    /// Level that answers, index as in [`crate::scene::LEVEL_NAMES`].
    pub level: usize,
    /// Indices into the scene's splats, ascending.
    pub splats: Vec<usize>,
    /// Best relevancy of a code.
    pub score: f32,
    /// Whether the score reaches [`QueryOptions::abs_threshold`].
    pub found: bool,
}

/// Selects by relevancy per level and code with the rule of the `field` masks: the coarsest level that is nearly as good as the best
/// one, and its codes that are nearly as relevant as the best.
pub fn select(places: &Places, relevancy: &[Vec<f32>], options: &QueryOptions) -> Selection {
    let (mut levels, mut best): (Vec<usize>, Vec<f32>) = Default::default();
    for (l, (lists, values)) in places.lists().iter().zip(relevancy).enumerate() {
        let solid = values.iter().zip(lists.counts()).filter(|(_, n)| *n >= MIN_SPLATS).map(|(v, _)| *v);
        if let Some(top) = solid.reduce(f32::max) {
            levels.push(l);
            best.push(top);
        }
    }
    let peaks: Vec<f32> = best.iter().map(|top| margin(*top)).collect();
    let chosen = match options.mask {
        MaskRule::Codes(_) => super::coarsest_good(&peaks, options.slack),
        MaskRule::Lerf(_) => super::first_best(&peaks),
    };
    let Some(chosen) = chosen else { return Selection::default() };
    let (level, score) = (levels[chosen], best[chosen]);
    let share = match options.mask {
        MaskRule::Codes(share) => share,
        MaskRule::Lerf(_) => super::CODE_SHARE,
    };
    let bar = super::code_bar(score, share);
    let answers = relevancy[level].iter().enumerate().filter(|(_, r)| **r >= bar).map(|(k, _)| k);
    let splats = places.lists()[level].splats_of(answers);
    Selection { level, splats, score, found: score >= options.abs_threshold }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::{TextQuery, field_relevancy};
    use crate::scene::{Codebook, LanguageField, LevelField, Splats};

    #[test]
    fn select_uses_coarsest_good_level() {
        // embeddings: the thing, almost the thing, something else; canonical orthogonal to all
        let rows: Vec<f32> = [[0.8, 0.0, 0.6, 0.0], [0.78, 0.0, 0.6258, 0.0], [0.0, 1.0, 0.0, 0.0]].concat();
        let codes = vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let book = Codebook { embedding_dim: 4, code_dim: 3, embeddings: rows, codes, ..Codebook::default() };
        let axis = |k: usize| (0..3).map(move |c| f32::from(u8::from(c == k)) * 0.9);
        // 40 splats of each code, then 40 without a feature
        let features: Vec<f32> = (0..160).flat_map(|i| axis(if i < 120 { i / 40 } else { 7 })).collect();
        let level = LevelField { codebook: book.clone(), features, ..LevelField::default() };
        // the finer level has the thing only as a speck
        let speck: Vec<f32> = (0..160).flat_map(|i| axis(if i < 5 { 0 } else { 2 })).collect();
        let fine = LevelField { codebook: book, features: speck, ..LevelField::default() };
        let field = LanguageField { levels: vec![fine, level, LevelField::default()], space: "x".into() };
        let query = |v: [f32; 4]| TextQuery {
            text: "q".into(),
            embedding: v.to_vec(),
            canonicals: vec![0.0, 0.0, 0.0, 1.0],
            ..Default::default()
        };
        let options = QueryOptions::default();
        let places = Places::of(&Splats::default(), &field);
        let ask = |v: [f32; 4]| select(&places, &field_relevancy(&field, &query(v)).unwrap(), &options);
        let thing = ask([1.0, 0.0, 0.0, 0.0]);
        assert_eq!((thing.level, thing.found), (1, true));
        assert_eq!(thing.splats, (0..80).collect::<Vec<_>>());
        assert_eq!(ask([0.0, 1.0, 0.0, 0.0]).splats, (80..120).collect::<Vec<_>>());
        assert!(select(&Places::default(), &[], &options).splats.is_empty());
    }
}
