//! Scenes for tests of things.
use crate::scene::{Codebook, LevelField};

/// A level of `count` codes, unit vectors, with the code of each splat.
pub(super) fn level_of(codes: impl IntoIterator<Item = usize>, count: usize) -> LevelField {
    let unit = |k: usize| (0..count).map(move |c| f32::from(u8::from(c == k)));
    let rows: Vec<f32> = (0..count).flat_map(unit).collect();
    let codebook = Codebook {
        embedding_dim: count,
        code_dim: count,
        embeddings: rows.clone(),
        codes: rows,
        ..Codebook::default()
    };
    LevelField { codebook, features: codes.into_iter().flat_map(unit).collect(), ..LevelField::default() }
}
