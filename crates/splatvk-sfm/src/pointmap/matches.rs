//! Step A: matches by reciprocal nearest neighbours of descriptors or of 3-D points.
use crate::scene::{Descriptors, ModelView, PairPointmaps, Pointmap};
use glam::DVec2;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Pitch of the grid of seeds (MASt3R's `subsample`).
const PITCH: usize = 8;
/// Rounds after which a seed that has not converged is dropped (MASt3R).
const ROUNDS: usize = 10;
/// Most matches per pair, and cells per side of the grid over which they are spread.
const MAX_MATCHES: usize = 8192;
const CELLS: usize = 16;

/// Positions of one scene point in two views, model pixels.
#[derive(Clone, Copy, Debug)]
pub struct PixelMatch {
    /// Position in the first view.
    pub a: DVec2,
    /// Position in the second view.
    pub b: DVec2,
    /// Weight, above 0.
    pub weight: f64,
}

/// Matched pixels of a pair.
#[derive(Clone, Debug, Default)]
pub struct PairMatches {
    /// Matches in model pixels.
    pub matches: Vec<PixelMatch>,
}

/// Fast reciprocal matching (Leroy et al. 2024): follows seeds between two images until they return
/// to themselves, as pairs of mutual nearest neighbours. `forward` maps pixels of A to their
/// nearest in B, `backward` the reverse.
fn reciprocal(
    seeds: Vec<usize>,
    forward: impl Fn(&[usize]) -> Vec<usize>,
    backward: impl Fn(&[usize]) -> Vec<usize>,
) -> Vec<(usize, usize)> {
    let mut active = seeds;
    let mut found = Vec::new();
    for _ in 0..ROUNDS {
        if active.is_empty() {
            break;
        }
        let nearest = forward(&active);
        // Seeds that meet at a pixel take the same path from there: only the first continues.
        let mut arrivals: BTreeMap<usize, usize> = BTreeMap::new();
        for (a, b) in active.iter().zip(&nearest) {
            arrivals.entry(*b).or_insert(*a);
        }
        let (b, a): (Vec<usize>, Vec<usize>) = arrivals.into_iter().unzip();
        let back = backward(&b);
        let mut next: Vec<usize> = Vec::new();
        for k in 0..b.len() {
            if back[k] == a[k] { found.push((a[k], b[k])) } else { next.push(back[k]) }
        }
        next.sort_unstable();
        next.dedup();
        active = next;
    }
    found.sort_unstable();
    found.dedup();
    found
}

fn seeds(width: usize, height: usize) -> Vec<usize> {
    (PITCH / 2..height)
        .step_by(PITCH)
        .flat_map(|y| (PITCH / 2..width).step_by(PITCH).map(move |x| y * width + x))
        .collect()
}

/// Mutual nearest neighbours of dense descriptors as (pixel of A, pixel of B), sorted; seeds from
/// both images. `size` is (width, height) of A and B.
pub fn descriptor_matches(
    a: &Descriptors,
    b: &Descriptors,
    size: [(usize, usize); 2],
) -> Vec<(usize, usize)> {
    reciprocal_from_both(size, |rows| a.nearest(rows, b), |rows| b.nearest(rows, a))
}

/// Mutual nearest neighbours of two pointmaps in one frame as (pixel of A, pixel of B), sorted;
/// seeds from both images.
pub fn point_matches(a: &Pointmap, b: &Pointmap, size: [(usize, usize); 2]) -> Vec<(usize, usize)> {
    let (ta, tb) = (Tree::new(&a.points), Tree::new(&b.points));
    if ta.order.is_empty() || tb.order.is_empty() {
        return Vec::new();
    }
    reciprocal_from_both(size, |rows| tb.nearest_to(rows, a), |rows| ta.nearest_to(rows, b))
}

/// Reciprocal matches (pixel of A, pixel of B) from the seeds of both images, sorted.
fn reciprocal_from_both(
    size: [(usize, usize); 2],
    forward: impl Fn(&[usize]) -> Vec<usize>,
    backward: impl Fn(&[usize]) -> Vec<usize>,
) -> Vec<(usize, usize)> {
    let mut all = reciprocal(seeds(size[0].0, size[0].1), &forward, &backward);
    let reverse = reciprocal(seeds(size[1].0, size[1].1), &backward, &forward);
    all.extend(reverse.into_iter().map(|(b, a)| (a, b)));
    all.sort_unstable();
    all.dedup();
    all
}

/// Weighted matches of a pair, at most [`MAX_MATCHES`], spread over the first image.
pub(super) fn of_pair(first: &ModelView, second: &ModelView, pair: &PairPointmaps) -> PairMatches {
    let size = [(first.width, first.height), (second.width, second.height)];
    let mut weights: BTreeMap<(usize, usize), f64> = BTreeMap::new();
    match &pair.descriptors {
        Some([d11, d21, d12, d22]) => {
            for (a, b) in [(d11, d21), (d12, d22)] {
                add_matches(&mut weights, descriptor_matches(a, b, size), &a.confidence, &b.confidence);
            }
        }
        None => {
            for (a, b) in [(&pair.x11, &pair.x21), (&pair.x12, &pair.x22)] {
                add_matches(&mut weights, point_matches(a, b, size), &a.confidence, &b.confidence);
            }
        }
    }
    // Round-robin over cells, best first within each.
    let mut cells: Vec<Vec<(f64, usize, usize)>> = vec![Vec::new(); CELLS * CELLS];
    for ((a, b), w) in weights {
        let (x, y) = (a % first.width * CELLS / first.width, a / first.width * CELLS / first.height);
        if w > 0.0 {
            cells[y * CELLS + x].push((w, a, b));
        }
    }
    for cell in &mut cells {
        cell.sort_by(|p, q| q.0.total_cmp(&p.0).then((p.1, p.2).cmp(&(q.1, q.2))));
    }
    let deepest = cells.iter().map(Vec::len).max().unwrap_or(0);
    let matches = (0..deepest)
        .flat_map(|k| cells.iter().filter_map(move |c| c.get(k)))
        .take(MAX_MATCHES)
        .map(|&(weight, a, b)| PixelMatch {
            a: pixel_centre(a, first.width),
            b: pixel_centre(b, second.width),
            weight,
        })
        .collect();
    PairMatches { matches }
}

/// Adds matches weighted by √(qa qb); a repeated match keeps its larger weight.
fn add_matches(
    weights: &mut BTreeMap<(usize, usize), f64>,
    found: Vec<(usize, usize)>,
    qa: &[f32],
    qb: &[f32],
) {
    for (a, b) in found {
        let w = (qa[a] as f64 * qb[b] as f64).max(0.0).sqrt();
        let slot = weights.entry((a, b)).or_insert(w);
        *slot = slot.max(w);
    }
}

fn pixel_centre(k: usize, width: usize) -> DVec2 {
    DVec2::new((k % width) as f64 + 0.5, (k / width) as f64 + 0.5)
}

/// Balanced k-d tree over finite points: `order` holds each subtree's median in the middle of its
/// range.
struct Tree<'a> {
    points: &'a [[f32; 3]],
    order: Vec<u32>,
}

impl<'a> Tree<'a> {
    fn new(points: &'a [[f32; 3]]) -> Tree<'a> {
        let mut order: Vec<u32> =
            (0..points.len() as u32).filter(|k| points[*k as usize].iter().all(|v| v.is_finite())).collect();
        sort_into_tree(points, &mut order, 0);
        Tree { points, order }
    }

    /// Nearest point of the tree to each of the pixels `rows` of `from`.
    fn nearest_to(&self, rows: &[usize], from: &Pointmap) -> Vec<usize> {
        rows.par_iter().map(|r| self.nearest(from.points[*r])).collect()
    }

    fn nearest(&self, query: [f32; 3]) -> usize {
        let mut best = (f32::INFINITY, u32::MAX);
        self.search(0, self.order.len(), 0, &query, &mut best);
        (best.1 as usize).min(self.points.len() - 1)
    }

    fn search(&self, low: usize, high: usize, axis: usize, q: &[f32; 3], best: &mut (f32, u32)) {
        if low >= high {
            return;
        }
        let middle = (low + high) / 2;
        let index = self.order[middle];
        let p = &self.points[index as usize];
        let d2 = (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f32>();
        if d2 < best.0 || (d2 == best.0 && index < best.1) {
            *best = (d2, index);
        }
        let side = q[axis] - p[axis];
        let next = (axis + 1) % 3;
        let (near, far) = if side < 0.0 {
            ((low, middle), (middle + 1, high))
        } else {
            ((middle + 1, high), (low, middle))
        };
        self.search(near.0, near.1, next, q, best);
        if side * side <= best.0 {
            self.search(far.0, far.1, next, q, best);
        }
    }
}

fn sort_into_tree(points: &[[f32; 3]], order: &mut [u32], axis: usize) {
    if order.len() < 2 {
        return;
    }
    let middle = order.len() / 2;
    order.select_nth_unstable_by(middle, |a, b| {
        points[*a as usize][axis].total_cmp(&points[*b as usize][axis]).then(a.cmp(b))
    });
    let (low, high) = order.split_at_mut(middle);
    sort_into_tree(points, low, (axis + 1) % 3);
    sort_into_tree(points, &mut high[1..], (axis + 1) % 3);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn descriptor_matches_are_mutual_nearest() {
        let mut rng = Random::new(9);
        let (w, h, d) = (32, 24, 8);
        let mut random_descriptors = |n: usize| Descriptors {
            dim: d,
            data: (0..n)
                .flat_map(|_| {
                    let v: Vec<f32> = (0..d).map(|_| rng.normal() as f32).collect();
                    let n = v.iter().map(|x| x * x).sum::<f32>().sqrt();
                    v.into_iter().map(move |x| x / n).collect::<Vec<_>>()
                })
                .collect(),
            confidence: vec![1.0; n],
        };
        let a = random_descriptors(w * h);
        let mut b = random_descriptors(w * h);
        // A shift by three columns makes true matches.
        for k in 0..w * h {
            if k % w >= 3 {
                let (from, to) = ((k - 3) * d, k * d);
                b.data[to..to + d].copy_from_slice(&a.data[from..from + d]);
            }
        }
        let dot = |p: usize, q: usize| -> f32 {
            a.data[p * d..(p + 1) * d].iter().zip(&b.data[q * d..(q + 1) * d]).map(|(x, y)| x * y).sum()
        };
        let found = descriptor_matches(&a, &b, [(w, h), (w, h)]);
        for &(p, q) in &found {
            assert!((0..w * h).all(|k| dot(p, k) <= dot(p, q) && dot(k, q) <= dot(p, q)), "{p} {q}");
        }
        let true_ones = found.iter().filter(|(p, q)| q - p == 3).count();
        assert!(found.len() >= 10 && true_ones * 10 > found.len() * 9, "{true_ones} of {}", found.len());
    }

    #[test]
    fn nearest_equals_brute_force() {
        let mut rng = Random::new(1);
        let points: Vec<[f32; 3]> = (0..500).map(|_| std::array::from_fn(|_| rng.normal() as f32)).collect();
        let tree = Tree::new(&points);
        for _ in 0..200 {
            let q: [f32; 3] = std::array::from_fn(|_| rng.normal() as f32);
            let d2 = |k: usize| (0..3).map(|c| (points[k][c] - q[c]).powi(2)).sum::<f32>();
            let best = (0..500).min_by(|a, b| d2(*a).total_cmp(&d2(*b))).unwrap();
            assert_eq!(tree.nearest(q), best);
        }
    }
}
