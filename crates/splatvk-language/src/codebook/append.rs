//! Adds codes for new things to a codebook; existing codes stay unchanged
//! (docs/internals/method.md#photos-added-later).
use super::{CodeEntry, EncodedLevel, SAME_EMBEDDING, assert_bijection, build, min_chord, spread};
use crate::Result;
use crate::math::{Random, dot};
use crate::scene::Codebook;

/// Random directions tried for a code. With 200 codes of length 16, ten times as many give a code 2
/// % farther from the others.
const TRIED: usize = 4000;
/// Steps of the local random search from the best of them.
const STEPS: usize = 400;

/// Returns the codebook with a code for every entry: the code of an embedding with a cosine above
/// 0.9995, else a new code far from all others. `dim` is the code length if `book` is empty.
pub fn append(book: &Codebook, entries: &[CodeEntry], dim: usize, seed: u64) -> Result<EncodedLevel> {
    if book.is_empty() {
        return build(entries, dim, seed);
    }
    let mut out = book.clone();
    let mut random = Random::new(seed ^ 0xadd);
    let mut code_of = Vec::with_capacity(entries.len());
    for entry in entries {
        let mut rows = out.embeddings.chunks_exact(out.embedding_dim);
        let same = rows.position(|row| dot(row, &entry.embedding) > SAME_EMBEDDING);
        let code = match same {
            Some(code) => {
                out.weights[code] += entry.weight as f32;
                out.members[code].extend_from_slice(&entry.members);
                code
            }
            None => {
                let code = farthest(&out.codes, out.code_dim, &mut random);
                out.codes.extend(code);
                out.embeddings.extend_from_slice(&entry.embedding);
                out.weights.push(entry.weight.max(1.0) as f32);
                out.members.push(entry.members.clone());
                out.weights.len() - 1
            }
        };
        code_of.push(code as u32);
    }
    if out.len() > book.len() {
        out.min_chord = min_chord(&out.codes, out.code_dim);
        assert_bijection(&out, seed)?;
    }
    Ok(EncodedLevel { codebook: out, code_of })
}

/// Finds a unit vector far from all codes by random search.
fn farthest(codes: &[f32], dim: usize, random: &mut Random) -> Vec<f32> {
    let axis = |k: usize| (0..dim).map(|i| if i == k { 1.0 } else { 0.0 }).collect::<Vec<f64>>();
    let mut best = Candidate::new(axis(0), codes);
    // With fewer codes than dimensions all codes are axes, and with another axis a mix of two codes
    // never decodes to a third.
    (1..dim).for_each(|k| best.improve(axis(k), codes));
    if best.cosine <= 0.0 {
        return best.direction.iter().map(|v| *v as f32).collect();
    }
    for _ in 0..TRIED {
        best.improve(spread::unit(random, dim), codes);
    }
    for step in 0..STEPS {
        let length = 0.3 * (1.0 - step as f64 / STEPS as f64);
        let side = spread::unit(random, dim);
        let mut moved: Vec<f64> = best.direction.iter().zip(&side).map(|(b, s)| b + length * s).collect();
        let norm = moved.iter().map(|v| v * v).sum::<f64>().sqrt();
        moved.iter_mut().for_each(|v| *v /= norm.max(1e-12));
        best.improve(moved, codes);
    }
    best.direction.iter().map(|v| *v as f32).collect()
}

/// A unit vector and its largest cosine to a code.
struct Candidate {
    direction: Vec<f64>,
    cosine: f64,
}

impl Candidate {
    fn new(direction: Vec<f64>, codes: &[f32]) -> Candidate {
        let cosine_to = |row: &[f32]| row.iter().zip(&direction).map(|(c, x)| f64::from(*c) * x).sum::<f64>();
        let cosine = codes.chunks_exact(direction.len()).map(cosine_to).fold(-1.0, f64::max);
        Candidate { direction, cosine }
    }

    /// Replaces the vector by another one that is farther from the codes.
    fn improve(&mut self, direction: Vec<f64>, codes: &[f32]) {
        let other = Candidate::new(direction, codes);
        if other.cosine < self.cosine {
            *self = other;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::MaskId;

    fn entry(random: &mut Random, mask: usize) -> CodeEntry {
        let embedding = spread::unit(random, 32).into_iter().map(|v| v as f32).collect();
        CodeEntry { embedding, weight: 100.0, members: vec![MaskId::new(0, mask)] }
    }

    #[test]
    fn append_keeps_codes_and_separates_new() {
        let mut random = Random::new(4);
        for (old, new) in [(3, 4), (60, 20)] {
            let entries: Vec<CodeEntry> = (0..old + new).map(|k| entry(&mut random, k)).collect();
            let book = build(&entries[..old], 16, 1).unwrap().codebook;
            let mut later = entries[old..].to_vec();
            // A duplicate of an existing entry.
            later.push(CodeEntry { members: vec![MaskId::new(5, 9)], ..entries[1].clone() });
            let joined = append(&book, &later, 16, 1).unwrap();
            let (codes, of) = (&joined.codebook, &joined.code_of);
            assert_eq!((codes.len(), of[new]), (old + new, 1));
            assert_eq!(codes.codes[..book.codes.len()], book.codes[..]);
            assert_eq!(codes.embeddings[..book.embeddings.len()], book.embeddings[..]);
            assert_eq!(codes.members[1], [MaskId::new(0, 1), MaskId::new(5, 9)]);
            assert_eq!(codes.weights[1], 200.0);
            // A layout from scratch is not much better.
            let fresh = build(&entries, 16, 1).unwrap().codebook.min_chord;
            println!("{old} + {new}: {} afterwards, {fresh} at once", codes.min_chord);
            assert!(codes.min_chord > 0.75 * fresh.min(book.min_chord), "{} {fresh}", codes.min_chord);
        }
    }

    #[test]
    fn append_to_empty_book_equals_build() {
        let entries = [entry(&mut Random::new(2), 0)];
        assert_eq!(append(&Codebook::default(), &entries, 8, 0).unwrap(), build(&entries, 8, 0).unwrap());
    }
}
