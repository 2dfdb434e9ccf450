use super::spread::unit;
use super::*;
use crate::math::Random;

fn entries(count: usize, dim: usize, seed: u64) -> Vec<CodeEntry> {
    let mut random = Random::new(seed);
    (0..count)
        .map(|k| CodeEntry {
            embedding: unit(&mut random, dim).iter().map(|&v| v as f32).collect(),
            weight: 10.0 + k as f64,
            members: vec![MaskId::new(0, k)],
        })
        .collect()
}

#[test]
fn build_round_trips_every_count() {
    for (count, dim) in [(1, 3), (2, 3), (3, 3), (16, 16), (17, 16), (120, 3), (200, 16)] {
        let built = build(&entries(count, 64, 5), dim, 1).unwrap();
        let book = &built.codebook;
        assert_eq!((book.len(), book.code_dim), (count, dim));
        assert_eq!(built.code_of, (0..count as u32).collect::<Vec<_>>());
        for (k, code) in book.codes.chunks_exact(dim).enumerate() {
            assert!((code.iter().map(|c| c * c).sum::<f32>() - 1.0).abs() < 1e-5);
            assert_eq!(book.decode(code), Some(k));
        }
    }
}

#[test]
fn spread_approaches_best_known_distances() {
    // Best known: about 3.09/√K on the Fibonacci lattice for d = 3
    // (docs/internals/method.md#code-construction); measured .81 for 200 in d = 8.
    let three = build(&entries(200, 64, 9), 3, 1).unwrap().codebook.min_chord;
    assert!(three > 0.6 * 3.09 / 200f32.sqrt(), "{three}");
    let eight = build(&entries(200, 64, 9), 8, 1).unwrap().codebook.min_chord;
    assert!(eight > 0.6 * 0.81, "{eight}");
}

#[test]
fn build_duplicates_share_one_code() {
    let mut list = entries(4, 32, 2);
    list[3].embedding = list[1].embedding.clone();
    let built = build(&list, 16, 0).unwrap();
    assert_eq!(built.code_of, [0, 1, 2, 1]);
    assert_eq!(built.codebook.members[1], [MaskId::new(0, 1), MaskId::new(0, 3)]);
    assert_eq!(built.codebook.weights[1], 24.0);
    assert!(build(&[], 16, 0).unwrap().codebook.is_empty());
    assert!(build(&list, 0, 0).is_err());
}

#[test]
fn build_too_many_codes_fails() {
    let text = build(&entries(3, 32, 4), 1, 0).unwrap_err().to_string();
    assert!(text.contains("--feature-dim"), "{text}");
}

#[test]
fn build_is_deterministic() {
    let list = entries(60, 48, 3);
    assert_eq!(build(&list, 8, 7).unwrap(), build(&list, 8, 7).unwrap());
}

#[test]
fn one_hot_codes_switch_once_between() {
    let built = build(&entries(12, 48, 3), 16, 7).unwrap();
    let book = &built.codebook;
    let (a, b) = (&book.codes[2 * 16..3 * 16], &book.codes[7 * 16..8 * 16]);
    // [16, 100]
    let mix = |i: usize| {
        let t = (i % 100) as f32 / 99.0;
        (1.0 - t) * a[i / 100] + t * b[i / 100]
    };
    let features: Vec<f32> = (0..1600).map(mix).collect();
    let cosine =
        |k: usize, p: usize| -> f32 { (0..16).map(|c| book.codes[16 * k + c] * features[100 * c + p]).sum() };
    let nearest = |p: usize| (0..12).max_by(|a, b| cosine(*a, p).total_cmp(&cosine(*b, p)));
    assert!((0..50).all(|p| nearest(p) == Some(2)) && (50..100).all(|p| nearest(p) == Some(7)));
}

#[test]
fn pca_matches_svd() {
    let list = entries(40, 20, 8);
    let rows: Vec<f32> = list.iter().flat_map(|e| e.embedding.clone()).collect();
    let weights: Vec<f64> = list.iter().map(|e| e.weight).collect();
    let got = pca::project(&rows, &weights, 20, 4).unwrap();
    // whitened coordinates have weighted mean 0, weighted variance 1 and no correlation
    let total: f64 = weights.iter().sum();
    for a in 0..4 {
        let mean: f64 = (0..40).map(|k| weights[k] * got[k * 4 + a]).sum::<f64>() / total;
        assert!(mean.abs() < 1e-9);
        for b in 0..4 {
            let c: f64 = (0..40).map(|k| weights[k] * got[k * 4 + a] * got[k * 4 + b]).sum::<f64>() / total;
            assert!((c - f64::from(a == b)).abs() < 1e-4, "{a} {b} {c}");
        }
    }
    // and they are the leading directions: an independent SVD gives the same subspace variance
    let mean: Vec<f64> =
        (0..20).map(|c| (0..40).map(|k| weights[k] * rows[k * 20 + c] as f64).sum::<f64>() / total).collect();
    let m = nalgebra::DMatrix::from_fn(40, 20, |k, c| {
        (rows[k * 20 + c] as f64 - mean[c]) * (weights[k] / total).sqrt()
    });
    let svd = m.clone().svd(true, true);
    let (u, s) = (svd.u.unwrap(), svd.singular_values);
    let mut order: Vec<usize> = (0..s.len()).collect();
    order.sort_by(|&a, &b| s[b].total_cmp(&s[a]));
    for (axis, &k) in order.iter().take(4).enumerate() {
        let dot: f64 = (0..40).map(|r| u[(r, k)] * got[r * 4 + axis] * (weights[r] / total).sqrt()).sum();
        assert!((dot.abs() - 1.0).abs() < 1e-4, "axis {axis}: {dot}");
    }
}

#[test]
#[ignore = "a thousand codes take tens of seconds on two cores"]
fn build_thousand_codes_stay_distinct() {
    assert!(build(&entries(1000, 64, 5), 16, 1).unwrap().codebook.min_chord > 0.3);
}
