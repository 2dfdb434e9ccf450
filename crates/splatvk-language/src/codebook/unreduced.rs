//! Codes without reduction: the embeddings themselves, as coordinates in an orthonormal basis of
//! their span.
//!
//! The basis keeps all lengths and angles, so that blending, lifting and decoding give the results
//! of full embeddings, with as many numbers as there are codes instead of D.
use super::{CodeEntry, EncodedLevel, deduplicate, min_chord};
use crate::dir::normalise_rows;
use crate::math::dot;
use crate::scene::Codebook;

/// Squared distance of an embedding to the span of others, below which it lies in it.
const IN_SPAN: f64 = 1e-9;

/// Encodes the entries of all levels with codes of one length, the largest number of codes.
pub fn build(levels: &[Vec<CodeEntry>]) -> Vec<EncodedLevel> {
    let kept: Vec<_> = levels.iter().map(|entries| deduplicate(entries)).collect();
    let dim = kept.iter().map(|(kept, _)| kept.len()).max().unwrap_or(0);
    kept.into_iter().map(|(kept, code_of)| EncodedLevel { codebook: codebook(kept, dim), code_of }).collect()
}

fn codebook(kept: Vec<CodeEntry>, dim: usize) -> Codebook {
    let Some(first) = kept.first() else { return Codebook::default() };
    let embedding_dim = first.embedding.len();
    let embeddings: Vec<f32> = kept.iter().flat_map(|e| e.embedding.iter().copied()).collect();
    let mut unit = embeddings.clone();
    normalise_rows(&mut unit, embedding_dim);
    let codes = coordinates(&unit, embedding_dim, dim);
    Codebook {
        embedding_dim,
        code_dim: dim,
        min_chord: min_chord(&codes, dim),
        codes,
        embeddings,
        weights: kept.iter().map(|e| e.weight.max(1.0) as f32).collect(),
        members: kept.into_iter().map(|e| e.members).collect(),
    }
}

/// Coordinates [K, dim] of K ≤ `dim` rows in an orthonormal basis of their span: the Cholesky
/// factor of their Gram matrix.
fn coordinates(rows: &[f32], width: usize, dim: usize) -> Vec<f32> {
    let rows: Vec<&[f32]> = rows.chunks_exact(width).collect();
    let mut factor = vec![0.0f64; rows.len() * dim];
    for k in 0..rows.len() {
        for j in 0..=k {
            let (a, b) = (&factor[k * dim..k * dim + j], &factor[j * dim..j * dim + j]);
            let rest = dot(rows[k], rows[j]) - a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let pivot = factor[j * dim + j];
            factor[k * dim + j] = if j < k && pivot > 0.0 {
                rest / pivot
            } else if j == k && rest > IN_SPAN {
                rest.sqrt()
            } else {
                0.0
            };
        }
    }
    factor.into_iter().map(|v| v as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::MaskId;

    fn entry(embedding: [f32; 4]) -> CodeEntry {
        CodeEntry { embedding: embedding.into(), weight: 1.0, members: vec![MaskId::new(0, 0)] }
    }

    #[test]
    fn codes_keep_the_cosines_of_embeddings() {
        // The last one of the first level lies in the span of the others.
        let far = vec![
            entry([1.0, 0.0, 0.0, 0.0]),
            entry([0.6, 0.8, 0.0, 0.0]),
            entry([0.0, 0.6, 0.0, 0.8]),
            entry([0.0, 1.0, 0.0, 0.0]),
        ];
        let built = build(&[far, vec![entry([0.0, 0.0, 1.0, 0.0])], Vec::new()]);
        assert_eq!(built.iter().map(|b| b.codebook.len()).collect::<Vec<_>>(), [4, 1, 0]);
        assert_eq!((built[0].codebook.code_dim, built[1].codebook.code_dim), (4, 4));
        let book = &built[0].codebook;
        let (rows, codes): (Vec<_>, Vec<_>) =
            (book.embeddings.chunks_exact(4).collect(), book.codes.chunks_exact(4).collect());
        for (k, j) in (0..4).flat_map(|k| (0..4).map(move |j| (k, j))) {
            assert!((dot(codes[k], codes[j]) - dot(rows[k], rows[j])).abs() < 1e-6, "{k} {j}");
            assert_eq!(book.decode(codes[k]), Some(k));
        }
    }
}
