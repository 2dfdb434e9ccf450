//! Codes for things that come later: those there are stay as they are
//! (docs/internals/method.md#photos-added-later).
use super::{CodeEntry, EncodedLevel, SAME_EMBEDDING, assert_bijection, build, min_chord, spread};
use crate::Result;
use crate::math::{Random, dot};
use crate::scene::Codebook;

/// Random directions tried for a code: of 16 numbers, with 200 codes, ten times as many find a
/// place 2 % farther from the others.
const TRIED: usize = 4000;
/// Steps that then move the best of them away from its nearest neighbours.
const STEPS: usize = 400;

/// The codebook with a code for every entry: that of an embedding which no text query can tell from
/// its own, else a new one as far from all others as can be found. `dim` is the length of the codes
/// where there are none yet.
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
                let free = farthest(&out.codes, out.code_dim, &mut random);
                out.codes.extend(free);
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

/// A unit vector whose nearest of the codes is as far away as random search finds.
fn farthest(codes: &[f32], dim: usize, random: &mut Random) -> Vec<f32> {
    let cosine = |v: &[f64]| {
        let with = |row: &[f32]| row.iter().zip(v).map(|(c, x)| f64::from(*c) * x).sum::<f64>();
        codes.chunks_exact(dim).map(with).fold(-1.0, f64::max)
    };
    let axis = |k: usize| (0..dim).map(|i| if i == k { 1.0 } else { 0.0 }).collect::<Vec<f64>>();
    let mut best = axis(0);
    let mut nearest = cosine(&best);
    let consider = |v: Vec<f64>, best: &mut Vec<f64>, nearest: &mut f64| {
        let own = cosine(&v);
        if own < *nearest {
            (*best, *nearest) = (v, own);
        }
    };
    // While there are fewer codes than numbers they are axes, and the next axis keeps mixtures of
    // two from reading as a third.
    (1..dim).for_each(|k| consider(axis(k), &mut best, &mut nearest));
    if nearest <= 0.0 {
        return best.iter().map(|v| *v as f32).collect();
    }
    for _ in 0..TRIED {
        consider(spread::unit(random, dim), &mut best, &mut nearest);
    }
    for step in 0..STEPS {
        let length = 0.3 * (1.0 - step as f64 / STEPS as f64);
        let side = spread::unit(random, dim);
        let mut moved: Vec<f64> = best.iter().zip(&side).map(|(b, s)| b + length * s).collect();
        let norm = moved.iter().map(|v| v * v).sum::<f64>().sqrt();
        moved.iter_mut().for_each(|v| *v /= norm.max(1e-12));
        consider(moved, &mut best, &mut nearest);
    }
    best.iter().map(|v| *v as f32).collect()
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
    fn old_codes_stay_and_new_ones_keep_away_from_them() {
        let mut random = Random::new(4);
        for (old, new) in [(3, 4), (60, 20)] {
            let entries: Vec<CodeEntry> = (0..old + new).map(|k| entry(&mut random, k)).collect();
            let book = build(&entries[..old], 16, 1).unwrap().codebook;
            let mut later = entries[old..].to_vec();
            // One that is an old thing once more.
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
    fn a_scene_without_codes_on_a_level_gets_its_first_ones() {
        let entries = [entry(&mut Random::new(2), 0)];
        assert_eq!(append(&Codebook::default(), &entries, 8, 0).unwrap(), build(&entries, 8, 0).unwrap());
    }
}
