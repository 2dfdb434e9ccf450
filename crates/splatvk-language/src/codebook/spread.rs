//! Spreads codes over the sphere so that they stay apart
//! (docs/internals/method.md#code-construction, step 4).
use crate::math::{Random, dot};
use rayon::prelude::*;

/// Gradient steps; the minimum distance no longer grows after about 200 on 50 to 600 codes.
const STEPS: usize = 300;

/// Number of nearest embeddings that attract each code, and strength of the attraction beside a
/// repulsion of 1: it keeps codes of related meaning near each other but does not join them.
const NEIGHBOURS: usize = 3;
const ATTRACTION: f64 = 0.02;

/// A uniformly random direction.
pub(super) fn unit(random: &mut Random, dim: usize) -> Vec<f64> {
    let mut v: Vec<f64> = (0..dim).map(|_| random.normal()).collect();
    normalise(&mut v);
    v
}

fn normalise(v: &mut [f64]) {
    let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    if norm > 1e-12 {
        v.iter_mut().for_each(|x| *x /= norm);
    } else if let Some(first) = v.first_mut() {
        *first = 1.0;
    }
}

/// Minimises `Σ 1/‖y_k − y_l‖^p` plus a weak attraction between nearest embeddings, by projected
/// gradient steps with a shrinking step length; returns the layout with the largest minimum
/// distance seen, [K, dim] unit rows.
pub(super) fn spread(
    start: Vec<f64>,
    embeddings: &[f32],
    embedding_dim: usize,
    dim: usize,
    seed: u64,
) -> Vec<f32> {
    let mut random = Random::new(seed);
    let mut y = start;
    for row in y.chunks_exact_mut(dim) {
        normalise(row);
        // equal projections (two embeddings alike in the kept directions) need a nudge to repel
        // each other
        row.iter_mut().for_each(|v| *v += 1e-3 * random.normal());
        normalise(row);
    }
    if dim == 1 {
        return y.iter().map(|&v| v as f32).collect();
    }
    let count = y.len() / dim;
    let neighbours = nearest(embeddings, embedding_dim, count);
    let power = if dim < 6 { dim as i32 } else { 4 };
    // typical spacing of K points on the sphere: the natural step length
    let spacing = 2.0 / (count as f64).powf(1.0 / (dim - 1) as f64);
    let (mut best, mut best_chord) = (y.clone(), min_chord(&y, dim));
    for step in 0..STEPS {
        let length = 0.2 * spacing * (1.0 - step as f64 / STEPS as f64) + 1e-4 * spacing;
        let previous = y.clone();
        y.par_chunks_exact_mut(dim).enumerate().for_each(|(k, row)| {
            let mut force = repulsion(&previous, k, dim, power);
            normalise_force(&mut force);
            for &l in &neighbours[k] {
                for c in 0..dim {
                    force[c] += ATTRACTION * (previous[l * dim + c] - row[c]);
                }
            }
            // only the tangential part moves the point along the sphere
            let radial: f64 = force.iter().zip(row.iter()).map(|(f, v)| f * v).sum();
            for c in 0..dim {
                row[c] += length * (force[c] - radial * row[c]);
            }
            normalise(row);
        });
        let chord = min_chord(&y, dim);
        if chord > best_chord {
            (best, best_chord) = (y.clone(), chord);
        }
    }
    best.iter().map(|&v| v as f32).collect()
}

/// `Σ_l (y_k − y_l)/‖y_k − y_l‖^(p+2)`, the descent direction of the energy.
fn repulsion(y: &[f64], k: usize, dim: usize, power: i32) -> Vec<f64> {
    let mut force = vec![0.0; dim];
    let own = &y[k * dim..(k + 1) * dim];
    for (l, other) in y.chunks_exact(dim).enumerate() {
        if l == k {
            continue;
        }
        let square: f64 = own.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum();
        // 1e-12 keeps coincident points finite; they were nudged apart before
        let scale = square.max(1e-12).powi(-(power + 2) / 2);
        for c in 0..dim {
            force[c] += scale * (own[c] - other[c]);
        }
    }
    force
}

/// Scales a force to unit length: with p = 4 forces span many decades; a fixed step length
/// converges and a scaled one diverges.
fn normalise_force(force: &mut [f64]) {
    let norm = force.iter().map(|x| x * x).sum::<f64>().sqrt();
    if norm > 0.0 {
        force.iter_mut().for_each(|x| *x /= norm);
    }
}

/// [`super::min_chord`] in f64.
fn min_chord(y: &[f64], dim: usize) -> f64 {
    let rows: Vec<&[f64]> = y.chunks_exact(dim).collect();
    let nearest = (0..rows.len()).into_par_iter().map(|k| squared_chord(rows[k], &rows[k + 1..]));
    nearest.reduce(|| 4.0, f64::min).sqrt()
}

fn squared_chord(code: &[f64], others: &[&[f64]]) -> f64 {
    let squared = |other: &[f64]| code.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
    others.iter().map(|other| squared(other)).fold(4.0, f64::min)
}

/// The most similar embeddings of each embedding.
fn nearest(embeddings: &[f32], dim: usize, count: usize) -> Vec<Vec<usize>> {
    let rows: Vec<&[f32]> = embeddings.chunks_exact(dim).collect();
    (0..count)
        .into_par_iter()
        .map(|k| {
            let mut order: Vec<(f64, usize)> =
                (0..count).filter(|&l| l != k).map(|l| (dot(rows[k], rows[l]), l)).collect();
            order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            order.truncate(NEIGHBOURS);
            order.into_iter().map(|(_, l)| l).collect()
        })
        .collect()
}
