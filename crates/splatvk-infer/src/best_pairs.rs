//! Selects the pairs of photos with the largest overlap, a bounded number per photo, so that time
//! and memory of later steps grow linearly with the number of photos.
use crate::math::median;
use crate::scene::{ModelView, PairPointmaps, Pointmap};

/// Smallest number of partners that a photo keeps, if it has so many: all of four photos.
const PARTNERS: usize = 3;
/// Sampling step in both directions, pixels: a few thousand samples of an input of 512 × 384.
const STRIDE: usize = 8;
/// Relative depth difference to the surface from which a point is occluded or the maps disagree.
const SAME_SURFACE: f64 = 0.1;

/// Collects pairs and drops those that are certain not to be selected.
pub struct BestPairs {
    /// Width and height of each view.
    sizes: Vec<(usize, usize)>,
    pairs: Vec<(f64, PairPointmaps)>,
}

impl BestPairs {
    /// Creates an empty selection.
    pub fn new(views: &[ModelView]) -> BestPairs {
        BestPairs { sizes: views.iter().map(|v| (v.width, v.height)).collect(), pairs: Vec::new() }
    }

    /// Adds a pair.
    pub fn add(&mut self, pair: PairPointmaps) {
        let sizes = [self.sizes[pair.first], self.sizes[pair.second]];
        let shared = overlap(&pair.x21, &pair.x11, sizes[1], sizes[0])
            + overlap(&pair.x12, &pair.x22, sizes[0], sizes[1]);
        self.pairs.push((shared, pair));
        let scores: Vec<_> = self.pairs.iter().map(|(s, p)| ([p.first, p.second], *s)).collect();
        let keep = best(self.sizes.len(), &scores);
        let mut keep = keep.into_iter();
        self.pairs.retain(|_| keep.next().unwrap_or(true));
    }

    /// The chosen pairs.
    pub fn finish(mut self) -> Vec<PairPointmaps> {
        let scores: Vec<_> = self.pairs.iter().map(|(s, p)| ([p.first, p.second], *s)).collect();
        let mut keep = without_spare(self.sizes.len(), &scores).into_iter();
        self.pairs.retain(|_| keep.next().unwrap_or(true));
        self.pairs.into_iter().map(|p| p.1).collect()
    }
}

/// Marks pairs that are among the best three of one of their views or in the maximum spanning
/// forest, which preserves connectivity. A pair rejected among some pairs is rejected among more,
/// so pairs may be added one by one.
fn best(views: usize, pairs: &[([usize; 2], f64)]) -> Vec<bool> {
    let order = best_first(pairs);
    let mut keep = forest(views, pairs, &order);
    let mut partners = vec![0; views];
    for k in order {
        let [a, b] = pairs[k].0;
        keep[k] |= partners[a] < PARTNERS || partners[b] < PARTNERS;
        partners[a] += 1;
        partners[b] += 1;
    }
    keep
}

/// Drops spare pairs, worst first: both views keep three partners, and the spanning forest stays.
/// Without this step, a view that is a best partner of many others would keep many more.
fn without_spare(views: usize, pairs: &[([usize; 2], f64)]) -> Vec<bool> {
    let mut keep = vec![true; pairs.len()];
    let mut partners = vec![0; views];
    pairs.iter().flat_map(|p| p.0).for_each(|v| partners[v] += 1);
    let order = best_first(pairs);
    let tree = forest(views, pairs, &order);
    for k in order.into_iter().rev() {
        let [a, b] = pairs[k].0;
        if partners[a] > PARTNERS && partners[b] > PARTNERS && !tree[k] {
            keep[k] = false;
            partners[a] -= 1;
            partners[b] -= 1;
        }
    }
    keep
}

fn best_first(pairs: &[([usize; 2], f64)]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by(|a, b| pairs[*b].1.total_cmp(&pairs[*a].1).then(pairs[*a].0.cmp(&pairs[*b].0)));
    order
}

/// Marks the pairs of the maximum spanning forest; `order` is best first.
fn forest(views: usize, pairs: &[([usize; 2], f64)], order: &[usize]) -> Vec<bool> {
    let mut tree: Vec<usize> = (0..views).collect();
    let mut keep = vec![false; pairs.len()];
    for &k in order {
        let (joined, gone) = (tree[pairs[k].0[0]], tree[pairs[k].0[1]]);
        keep[k] = joined != gone;
        tree.iter_mut().filter(|t| **t == gone).for_each(|t| *t = joined);
    }
    keep
}

/// Overlap of two views: share of the pixels of `seen` whose points, in the other camera's frame,
/// project onto the surface `base` of that camera. Each is weighted by its confidence relative to
/// the mean of `base`, at most 1.
fn overlap(seen: &Pointmap, base: &Pointmap, seen_size: (usize, usize), size: (usize, usize)) -> f64 {
    let (width, height) = (size.0 as f64, size.1 as f64);
    let (mut focals, mut confidence, mut count) = (Vec::new(), 0.0, 0.0f64);
    for (x, y) in sample_grid(size) {
        let p = base.point(y * size.0 + x);
        let (u, v) = (x as f64 + 0.5 - 0.5 * width, y as f64 + 0.5 - 0.5 * height);
        let slope = [p.x / p.z, p.y / p.z];
        let focal = (u * slope[0] + v * slope[1]) / (slope[0] * slope[0] + slope[1] * slope[1]);
        if p.z > 0.0 && focal.is_finite() {
            focals.push(focal);
        }
        confidence += f64::from(base.confidence[y * size.0 + x]) - 1.0;
        count += 1.0;
    }
    let Some(focal) = median(&mut focals) else { return 0.0 };
    // If all confidences are 1, all weights are 1.
    let mean = (confidence / count).max(1e-3);
    let (mut sum, mut all) = (0.0, 0.0f64);
    for (x, y) in sample_grid(seen_size) {
        all += 1.0;
        let k = y * seen_size.0 + x;
        let p = seen.point(k);
        let (u, v) = (focal * p.x / p.z + 0.5 * width, focal * p.y / p.z + 0.5 * height);
        if p.z > 0.0 && u >= 0.0 && v >= 0.0 && u < width && v < height {
            let surface = base.point(v as usize * size.0 + u as usize).z;
            if (p.z - surface).abs() < SAME_SURFACE * surface {
                sum += ((f64::from(seen.confidence[k]) - 1.0 + 1e-3) / mean).min(1.0);
            }
        }
    }
    sum / all.max(1.0)
}

/// Every [`STRIDE`]-th pixel in both directions.
fn sample_grid((w, h): (usize, usize)) -> impl Iterator<Item = (usize, usize)> {
    (STRIDE / 2..h).step_by(STRIDE).flat_map(move |y| (STRIDE / 2..w).step_by(STRIDE).map(move |x| (x, y)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn best_keeps_partners_and_connectivity() {
        // Two groups of five; pairs between them have little overlap.
        let mut rng = Random::new(2);
        let mut pairs = Vec::new();
        for i in 0..10usize {
            for j in i + 1..10 {
                let together = (i < 5) == (j < 5);
                pairs.push(([i, j], if together { 0.5 + 0.5 * rng.uniform() } else { 0.1 * rng.uniform() }));
            }
        }
        let keep = best(10, &pairs);
        let kept: Vec<_> = pairs.iter().zip(&keep).filter(|p| *p.1).map(|p| *p.0).collect();
        let bridges: Vec<_> = kept.iter().filter(|([i, j], _)| (*i < 5) != (*j < 5)).collect();
        let widest = pairs.iter().filter(|([i, j], _)| (*i < 5) != (*j < 5)).map(|p| p.1).fold(0.0, f64::max);
        assert!(bridges.len() == 1 && bridges[0].1 == widest, "{bridges:?}");
        for v in 0..10 {
            let mut own: Vec<_> = pairs.iter().filter(|p| p.0.contains(&v)).collect();
            own.sort_by(|a, b| b.1.total_cmp(&a.1));
            assert!(own[..3].iter().all(|p| kept.contains(p)), "{v}");
        }
        assert!(kept.len() <= 3 * 10 + 9);
        // Adding pairs one by one selects the same.
        let mut some: Vec<([usize; 2], f64)> = Vec::new();
        for p in &pairs {
            some.push(*p);
            let mut keep = best(10, &some).into_iter();
            some.retain(|_| keep.next().unwrap());
        }
        assert_eq!(some, kept);
        // At the end each view still has three partners, and only pairs of the spanning tree are
        // spare.
        let left = without_spare(10, &kept);
        let left: Vec<_> = kept.iter().zip(&left).filter(|p| *p.1).map(|p| p.0.0).collect();
        let partners = |v: usize| left.iter().filter(|p| p.contains(&v)).count();
        assert!((0..10).all(|v| partners(v) >= 3), "{left:?}");
        assert!(left.iter().any(|[i, j]| (*i < 5) != (*j < 5)) && left.len() < kept.len(), "{left:?}");
        let spare = left.iter().filter(|[i, j]| partners(*i) > 3 && partners(*j) > 3).count();
        assert!(spare <= 9, "only the nine of the spanning tree may be spare: {spare}");
        assert_eq!(best(4, &[([0, 1], 0.0), ([0, 2], 0.0), ([0, 3], 0.0), ([1, 2], 0.0)]), [true; 4]);
    }

    #[test]
    fn overlap_matches_shared_area() {
        // A plane at depth 4 before two cameras of 90°, the second moved to the right by a share of
        // the field of view.
        let (w, h) = (128usize, 96);
        let plane = |shift: f32| Pointmap {
            points: (0..w * h)
                .map(|k| {
                    let (x, y) = ((k % w) as f32 + 0.5 - 64.0, (k / w) as f32 + 0.5 - 48.0);
                    [4.0 * x / 64.0 + shift, 4.0 * y / 64.0, 4.0]
                })
                .collect(),
            confidence: vec![5.0; w * h],
        };
        let base = plane(0.0);
        for (shift, share) in [(0.0, 1.0), (2.0, 0.75), (6.0, 0.25), (9.0, 0.0)] {
            let found = overlap(&plane(shift), &base, (w, h), (w, h));
            assert!((found - share).abs() < 0.04, "{shift}: {found}");
        }
        // Points of low confidence or behind the surface do not count.
        let unsure = Pointmap { confidence: vec![1.01; w * h], ..plane(0.0) };
        assert!(overlap(&unsure, &base, (w, h), (w, h)) < 0.01);
        let mut far = plane(0.0);
        far.points.iter_mut().for_each(|p| *p = p.map(|c| 1.5 * c));
        assert_eq!(overlap(&far, &base, (w, h), (w, h)), 0.0);
    }
}
