//! Features as in LEGaussians (Shi et al. 2024): smoothing in space, and a head that classifies
//! rendered features as codebook entries.
use crate::math::Random;
use crate::scene::{Codebook, Splats};
use rayon::prelude::*;
use std::collections::HashMap;

/// Least weight of the neighbourhood in a smoothed feature (λ_min of the paper).
const LEAST_SMOOTHING: f32 = 0.1;
/// Side of a neighbourhood in units of the scene extent: a few times the distance between splats of
/// a draft scene.
const NEIGHBOURHOOD: f64 = 0.01;
/// Gradient steps of the head; the loss of a few thousand samples is flat after that.
const STEPS: usize = 150;
/// Learning rate of the head.
const RATE: f32 = 0.05;
/// Samples per step.
const BATCH: usize = 1024;

/// Moves the feature of every splat, `[N, d]`, towards the mean of its neighbourhood by 1 − cosine,
/// at least a tenth; lengths stay.
pub fn smooth(splats: &Splats, features: &mut [f32], d: usize, extent: f64) {
    let side = (NEIGHBOURHOOD * extent) as f32;
    if d == 0 || side <= 0.0 {
        return;
    }
    let cell = |p: &[f32; 3]| p.map(|v| (v / side).floor() as i64);
    let mut sums: HashMap<[i64; 3], Vec<f32>> = HashMap::new();
    for (mean, f) in splats.means.iter().zip(features.chunks_exact(d)) {
        let sum = sums.entry(cell(mean)).or_insert_with(|| vec![0.0; d]);
        sum.iter_mut().zip(f).for_each(|(s, v)| *s += v);
    }
    features.par_chunks_exact_mut(d).zip(&splats.means).for_each(|(f, mean)| {
        let (own, Some(sum)) = (length(f), sums.get(&cell(mean))) else { return };
        let around = length(sum);
        if own <= 0.0 || around <= 0.0 {
            return;
        }
        let cosine: f32 = f.iter().zip(sum).map(|(a, b)| a * b).sum::<f32>() / (own * around);
        let share = (1.0 - cosine).clamp(LEAST_SMOOTHING, 1.0);
        f.iter_mut().zip(sum).for_each(|(a, b)| *a = (1.0 - share) * *a / own + share * b / around);
        let scale = own / length(f).max(1e-12);
        f.iter_mut().for_each(|v| *v *= scale);
    });
}

/// Length of a vector.
fn length(v: &[f32]) -> f32 {
    v.iter().map(|x| x * x).sum::<f32>().sqrt()
}

/// Trains the rows of a linear softmax head, [K, d], on rendered features and the indices of their
/// entries. The rows replace the codes, so that decoding gives the most probable entry.
pub fn train_head(book: &mut Codebook, features: &[f32], labels: &[u32], seed: u64) {
    let (d, k) = (book.code_dim, book.len());
    if labels.is_empty() || k == 0 {
        return;
    }
    let mut random = Random::new(seed ^ 0x4ead);
    // Logits of unit features and unit rows are too flat to start from.
    let mut rows: Vec<f32> = book.codes.iter().map(|v| 5.0 * v).collect();
    let (mut first, mut second) = (vec![0.0f32; rows.len()], vec![0.0f32; rows.len()]);
    for step in 1..=STEPS {
        let mut gradient = vec![0.0f32; rows.len()];
        for _ in 0..BATCH {
            let s = random.below(labels.len());
            let f = &features[s * d..(s + 1) * d];
            let logits: Vec<f32> =
                rows.chunks_exact(d).map(|r| r.iter().zip(f).map(|(a, b)| a * b).sum()).collect();
            let top = logits.iter().copied().fold(f32::MIN, f32::max);
            let weights: Vec<f32> = logits.iter().map(|l| (l - top).exp()).collect();
            let total: f32 = weights.iter().sum();
            for (c, row) in gradient.chunks_exact_mut(d).enumerate() {
                let error = weights[c] / total - f32::from(u8::from(c == labels[s] as usize));
                row.iter_mut().zip(f).for_each(|(g, v)| *g += error * v / BATCH as f32);
            }
        }
        let (c1, c2) = (1.0 - 0.9f32.powi(step as i32), 1.0 - 0.999f32.powi(step as i32));
        for (((r, g), m), v) in rows.iter_mut().zip(&gradient).zip(&mut first).zip(&mut second) {
            *m = 0.9 * *m + 0.1 * g;
            *v = 0.999 * *v + 0.001 * g * g;
            *r -= RATE * (*m / c1) / ((*v / c2).sqrt() + 1e-8);
        }
    }
    book.codes = rows;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn train_head_learns_confused_entries() {
        let d = 4;
        let mut random = Random::new(1000);
        let directions: Vec<Vec<f32>> =
            (0..6).map(|_| (0..d).map(|_| random.normal() as f32).collect()).collect();
        let (mut features, mut labels) = (Vec::new(), Vec::new());
        for s in 0..3000u32 {
            let k = s % 6;
            labels.push(k);
            features.extend(directions[k as usize].iter().map(|v| v + 0.05 * random.normal() as f32));
        }
        let mut book = Codebook {
            embedding_dim: 1,
            code_dim: d,
            embeddings: vec![1.0; 6],
            // Directions that are independent of the features.
            codes: (0..6 * d).map(|_| random.normal() as f32).collect(),
            ..Codebook::default()
        };
        let right = |book: &Codebook| {
            let all = features.chunks_exact(d).zip(&labels);
            all.filter(|(f, l)| book.decode(f) == Some(**l as usize)).count()
        };
        let before = right(&book);
        train_head(&mut book, &features, &labels, 0);
        assert!(before < 1500 && right(&book) > 2850, "{before} {}", right(&book));
    }

    #[test]
    fn smooth_turns_outlier_keeps_lengths() {
        let splats = Splats { means: vec![[0.001; 3]; 9], ..Splats::default() };
        let mut features: Vec<f32> = [[1.0, 0.0]; 8].concat();
        features.extend([0.0, 2.0]);
        smooth(&splats, &mut features, 2, 1.0);
        let odd = &features[16..];
        assert!(
            odd[0] > odd[1] && ((odd[0] * odd[0] + odd[1] * odd[1]).sqrt() - 2.0).abs() < 1e-5,
            "{odd:?}"
        );
        assert!(features[0] > 0.999, "the many hardly move: {:?}", &features[..2]);
        // Distant splats do not affect each other.
        let apart = Splats { means: vec![[0.0; 3], [1.0; 3]], ..Splats::default() };
        let mut two = vec![1.0, 0.0, 0.0, 1.0];
        smooth(&apart, &mut two, 2, 1.0);
        assert_eq!(two, [1.0, 0.0, 0.0, 1.0]);
    }
}
