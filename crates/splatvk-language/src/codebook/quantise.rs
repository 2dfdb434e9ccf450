//! The quantised feature codebook of LEGaussians (Shi et al. 2024) as an alternative codebook: at
//! most 128 mean features stand for all. Codes are random until an index head is trained on them.
use super::{CodeEntry, EncodedLevel, min_chord};
use crate::dir::normalise_rows;
use crate::math::Random;
use crate::math::dot_f32 as dot;
use crate::scene::Codebook;

/// Entries of the published codebook.
const ENTRIES: usize = 128;
/// Rounds of k-means; assignments of a few hundred features settle within ten.
const ROUNDS: usize = 20;

/// Spherical k-means with weights: (unit centres, centre of each entry). Starts from entries far
/// from each other.
fn cluster(entries: &[CodeEntry], count: usize) -> (Vec<Vec<f32>>, Vec<usize>) {
    let heaviest =
        (0..entries.len()).max_by(|&a, &b| entries[a].weight.total_cmp(&entries[b].weight).then(b.cmp(&a)));
    let mut centres: Vec<Vec<f32>> = heaviest.map(|k| entries[k].embedding.clone()).into_iter().collect();
    let mut nearest: Vec<f32> = entries.iter().map(|e| dot(&e.embedding, &centres[0])).collect();
    while centres.len() < count {
        let Some(far) = (0..entries.len()).min_by(|&a, &b| nearest[a].total_cmp(&nearest[b])) else { break };
        let centre = entries[far].embedding.clone();
        nearest.iter_mut().zip(entries).for_each(|(n, e)| *n = n.max(dot(&e.embedding, &centre)));
        centres.push(centre);
    }
    let mut centre_of = vec![0; entries.len()];
    for _ in 0..ROUNDS {
        for (slot, e) in centre_of.iter_mut().zip(entries) {
            let best = (0..centres.len()).max_by(|&a, &b| {
                dot(&e.embedding, &centres[a]).total_cmp(&dot(&e.embedding, &centres[b])).then(b.cmp(&a))
            });
            *slot = best.unwrap_or(0);
        }
        for (k, centre) in centres.iter_mut().enumerate() {
            let mut sum = vec![0.0f32; centre.len()];
            for (e, _) in entries.iter().zip(&centre_of).filter(|(_, c)| **c == k) {
                sum.iter_mut().zip(&e.embedding).for_each(|(s, v)| *s += e.weight as f32 * v);
            }
            let dim = sum.len();
            normalise_rows(&mut sum, dim);
            // An empty cluster keeps its centre.
            if sum.iter().any(|v| *v != 0.0) {
                *centre = sum;
            }
        }
    }
    (centres, centre_of)
}

/// The codebook of one level: means of similar features, each with a random direction as code.
pub(crate) fn build(entries: &[CodeEntry], dim: usize, seed: u64) -> EncodedLevel {
    if entries.is_empty() || dim == 0 {
        return EncodedLevel::default();
    }
    let (centres, centre_of) = cluster(entries, ENTRIES.min(entries.len()));
    let mut random = Random::new(seed ^ 0x1e6);
    let mut codes: Vec<f32> = (0..centres.len() * dim).map(|_| random.normal() as f32).collect();
    normalise_rows(&mut codes, dim);
    let mut codebook = Codebook {
        embedding_dim: centres[0].len(),
        code_dim: dim,
        min_chord: min_chord(&codes, dim),
        embeddings: centres.concat(),
        codes,
        weights: vec![0.0; centres.len()],
        members: vec![Vec::new(); centres.len()],
    };
    for (e, &k) in entries.iter().zip(&centre_of) {
        codebook.weights[k] += e.weight as f32;
        codebook.members[k].extend_from_slice(&e.members);
    }
    EncodedLevel { codebook, code_of: centre_of.into_iter().map(|k| k as u32).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::MaskId;

    fn entry(embedding: Vec<f32>) -> CodeEntry {
        let mut embedding = embedding;
        let d = embedding.len();
        normalise_rows(&mut embedding, d);
        CodeEntry { embedding, weight: 1.0, members: vec![MaskId::new(0, 0)] }
    }

    #[test]
    fn quantise_merges_similar_features() {
        let mut random = Random::new(1000);
        let mut entries = Vec::new();
        for k in 0..150 {
            for _ in 0..2 {
                let axis = |i: usize| if i == k { 1.0 } else { 0.0 };
                let noise = 0.02 * random.normal() as f32;
                entries.push(entry((0..150).map(|i| axis(i) + noise / 12.0).collect()));
            }
        }
        let built = build(&entries, 8, 0);
        assert_eq!(built.codebook.len(), ENTRIES);
        let pairs = built.code_of.chunks(2).filter(|p| p[0] == p[1]).count();
        assert!(pairs > 140, "{pairs}");
        let few = build(&entries[..6], 8, 0);
        for (e, &k) in entries[..6].iter().zip(&few.code_of) {
            let d = few.codebook.embedding_dim;
            assert!(dot(&e.embedding, &few.codebook.embeddings[k as usize * d..(k as usize + 1) * d]) > 0.99);
        }
        assert!(build(&[], 8, 0).codebook.is_empty());
    }
}
