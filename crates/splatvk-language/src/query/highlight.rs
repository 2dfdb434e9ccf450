//! Codes that viewers highlight for a query, in any view.
use super::QueryResult;
use super::maps::CodeMaps;
use crate::scene::LEVEL_NAMES;
use std::collections::BTreeSet;
use std::sync::Arc;

/// Codes that viewers highlight for a query: those of the masks in the views where the text was
/// found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Highlight {
    /// Chosen level, index as in [`LEVEL_NAMES`].
    pub level: usize,
    /// Codes of that level that answer, ascending.
    pub codes: Vec<usize>,
    /// Relevancy of every code, per level.
    pub relevancy: Vec<Vec<f32>>,
}

/// Combines the answers to a query with this relevancy per level and code in frames with these maps.
/// The level has the largest sum of scores over the views that found the text, or over all views if
/// none did.
pub fn highlight(maps: &[Arc<CodeMaps>], relevancy: Vec<Vec<f32>>, answers: &[QueryResult]) -> Highlight {
    let any = answers.iter().any(|a| a.found);
    let is_counted = |a: &&QueryResult| a.found || !any;
    let mut scores = [0.0; LEVEL_NAMES.len()];
    answers.iter().filter(is_counted).for_each(|a| scores[a.level] += a.score);
    // Ties go to the coarser level: max_by keeps the last maximum.
    let level = (0..scores.len()).max_by(|&a, &b| scores[a].total_cmp(&scores[b])).unwrap_or(0);
    let count = relevancy.get(level).map_or(0, Vec::len);
    let mut codes = BTreeSet::new();
    for (maps, answer) in maps.iter().zip(answers).filter(|(_, a)| is_counted(a) && a.level == level) {
        match answer.images.mask_codes() {
            Some(list) => codes.extend(list.iter().copied()),
            None => {
                let (pixels, mask) = (&maps.levels[level].codes, answer.mask());
                let inside = pixels.iter().zip(&mask.data).filter(|(_, m)| **m);
                codes.extend(inside.map(|(code, _)| *code));
            }
        }
    }
    let codes = codes.into_iter().map(usize::from).filter(|code| *code < count).collect();
    Highlight { level, codes, relevancy }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::query::{AnswerImages, TextQuery, field_relevancy};
    use crate::scene::{Codebook, Image, LanguageField, LevelField};

    /// A level whose codes are unit vectors of the text space itself.
    fn level(rows: &[[f32; 3]]) -> LevelField {
        let flat: Vec<f32> = rows.iter().flatten().copied().collect();
        let codebook = Codebook {
            embedding_dim: 3,
            code_dim: 3,
            embeddings: flat.clone(),
            codes: flat,
            ..Codebook::default()
        };
        LevelField { codebook, ..LevelField::default() }
    }

    #[test]
    fn highlight_uses_views_that_found() {
        let fine = level(&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        let coarse = level(&[[0.9, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let field = LanguageField { levels: vec![fine, LevelField::default(), coarse], space: "t".into() };
        let query = TextQuery {
            text: "x".into(),
            embedding: vec![1.0, 0.0, 0.0],
            canonicals: vec![0.0, 0.0, 1.0],
            ..Default::default()
        };
        let map = |data: &[i32]| Image { width: data.len(), height: 1, data: data.to_vec() };
        let (first, second) = (
            vec![map(&[0, 1]), map(&[-1, -1]), map(&[0, 2])],
            vec![map(&[1, 1]), map(&[-1, -1]), map(&[1, 1])],
        );
        let frames = [first, second].map(|maps| Arc::new(CodeMaps::new(&maps).unwrap()));
        let relevancy = field_relevancy(&field, &query).unwrap();
        let answer = |level, found, score, mask: [bool; 2]| QueryResult {
            level,
            found,
            score,
            images: AnswerImages::of_mask(Image { width: 2, height: 1, data: mask.to_vec() }),
            ..QueryResult::default()
        };
        let seen = [answer(2, true, 0.9, [true, false]), answer(0, false, 0.95, [true, true])];
        let lit = highlight(&frames, relevancy.clone(), &seen);
        assert_eq!((lit.level, &lit.codes[..]), (2, &[0][..]));
        assert_eq!(lit.relevancy.iter().map(Vec::len).collect::<Vec<_>>(), [2, 0, 3]);
        assert!(lit.relevancy[2][0] > 0.99 && lit.relevancy[2][2] < 0.01, "σ(±10·0.9)");
        // Found nowhere: the level with the higher score.
        let unseen = [answer(2, false, 0.3, [true, false]), answer(0, false, 0.4, [true, true])];
        let lit = highlight(&frames, relevancy, &unseen);
        assert_eq!((lit.level, &lit.codes[..]), (0, &[1][..]));
    }
}
