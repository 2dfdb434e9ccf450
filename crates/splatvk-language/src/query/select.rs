//! Selects the splats that answer a query in space, without any view
//! (docs/internals/method.md#selection-in-space).
use super::instances::Places;
use super::{MaskRule, QueryOptions, TextQuery, field_relevancy, margin};
use crate::Result;
use crate::scene::LanguageField;

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

/// Selects by the rule of the `field` masks: the coarsest level that is nearly as good as the best
/// one, and its codes that are nearly as relevant as the best.
pub fn select(
    field: &LanguageField,
    places: &Places,
    query: &TextQuery,
    options: &QueryOptions,
) -> Result<Selection> {
    let relevancy = field_relevancy(field, query)?;
    let mut found: Vec<(usize, f32, &[Option<usize>])> = Vec::new();
    for (l, (codes, values)) in places.codes().iter().zip(&relevancy).enumerate() {
        let mut carried = vec![0usize; values.len()];
        codes.iter().flatten().for_each(|&k| carried[k] += 1);
        let solid = values.iter().zip(&carried).filter(|(_, n)| **n >= MIN_SPLATS).map(|(v, _)| *v);
        if let Some(best) = solid.reduce(f32::max) {
            found.push((l, best, codes));
        }
    }
    let peaks: Vec<f32> = found.iter().map(|f| margin(f.1)).collect();
    let chosen = match options.mask {
        MaskRule::Codes(_) => super::coarsest_good(&peaks, options.slack),
        MaskRule::Lerf(_) => super::first_best(&peaks),
    };
    let Some(chosen) = chosen else { return Ok(Selection::default()) };
    let (level, score, codes) = &found[chosen];
    let share = match options.mask {
        MaskRule::Codes(share) => share,
        MaskRule::Lerf(_) => super::CODE_SHARE,
    };
    let bar = super::code_bar(*score, share);
    let answers = |k: &Option<usize>| k.is_some_and(|k| relevancy[*level][k] >= bar);
    let splats = codes.iter().enumerate().filter(|(_, k)| answers(k)).map(|(i, _)| i).collect();
    Ok(Selection { level: *level, splats, score: *score, found: *score >= options.abs_threshold })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Codebook, LevelField, Splats};

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
        let thing = select(&field, &places, &query([1.0, 0.0, 0.0, 0.0]), &options).unwrap();
        assert_eq!((thing.level, thing.found), (1, true));
        assert_eq!(thing.splats, (0..80).collect::<Vec<_>>());
        let other = select(&field, &places, &query([0.0, 1.0, 0.0, 0.0]), &options).unwrap();
        assert_eq!(other.splats, (80..120).collect::<Vec<_>>());
        assert!(
            select(&LanguageField::default(), &Places::default(), &query([1.0, 0.0, 0.0, 0.0]), &options)
                .unwrap()
                .splats
                .is_empty()
        );
    }
}
