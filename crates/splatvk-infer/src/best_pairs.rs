//! Which pairs of many photos are worth keeping: those that show most in common, a bounded number
//! for every photo, so that time and memory of what follows grow with the number of photos and not
//! with its square.
use crate::math::median;
use crate::scene::{ModelView, PairPointmaps, Pointmap};

/// Partners of every photo that are kept at least, if it has so many: of four photos all.
const PARTNERS: usize = 3;
/// Pixels looked at: every eighth in both directions, a few thousand of an input of 512 × 384.
const STRIDE: usize = 8;
/// A point that far from the surface at its pixel is hidden by it, or the maps disagree.
const SAME_SURFACE: f64 = 0.1;

/// Collects pairs and lets go of those that are not among the best, as soon as that is certain.
pub struct BestPairs {
    /// Width and height of each view.
    sizes: Vec<(usize, usize)>,
    pairs: Vec<(f64, PairPointmaps)>,
}

impl BestPairs {
    /// Starts with the views and no pair.
    pub fn new(views: &[ModelView]) -> BestPairs {
        BestPairs { sizes: views.iter().map(|v| (v.width, v.height)).collect(), pairs: Vec::new() }
    }

    /// Adds a pair.
    pub fn add(&mut self, pair: PairPointmaps) {
        let sizes = [self.sizes[pair.first], self.sizes[pair.second]];
        let common =
            shown(&pair.x21, &pair.x11, sizes[1], sizes[0]) + shown(&pair.x12, &pair.x22, sizes[0], sizes[1]);
        self.pairs.push((common, pair));
        let scores: Vec<_> = self.pairs.iter().map(|(s, p)| ([p.first, p.second], *s)).collect();
        let keep = best(self.sizes.len(), &scores);
        let mut keep = keep.into_iter();
        self.pairs.retain(|_| keep.next().unwrap_or(true));
    }

    /// The chosen pairs.
    pub fn finish(mut self) -> Vec<PairPointmaps> {
        let scores: Vec<_> = self.pairs.iter().map(|(s, p)| ([p.first, p.second], *s)).collect();
        let mut keep = enough(self.sizes.len(), &scores).into_iter();
        self.pairs.retain(|_| keep.next().unwrap_or(true));
        self.pairs.into_iter().map(|p| p.1).collect()
    }
}

/// Which pairs are among the best three of one of their views, or in the maximum spanning forest,
/// which keeps together what holds together. A pair that fails this among some pairs fails it among
/// more, so pairs may come one after another.
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

/// Of the best pairs those without which a view would have fewer than three, or views would fall
/// apart: a view that many others count among their best would have many more.
fn enough(views: usize, pairs: &[([usize; 2], f64)]) -> Vec<bool> {
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

/// Which pairs are in the maximum spanning forest; `order` is best first.
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

/// How much of one view the other shows: the share of pixels of `seen` whose points, given in the
/// other's camera, fall into its picture on the surface `base` that it sees, each counting by its
/// confidence against the mean of that surface.
fn shown(seen: &Pointmap, base: &Pointmap, seen_size: (usize, usize), size: (usize, usize)) -> f64 {
    let samples = |(w, h): (usize, usize)| {
        (STRIDE / 2..h)
            .step_by(STRIDE)
            .flat_map(move |y| (STRIDE / 2..w).step_by(STRIDE).map(move |x| (x, y)))
    };
    let (width, height) = (size.0 as f64, size.1 as f64);
    let (mut focals, mut sure, mut count) = (Vec::new(), 0.0, 0.0f64);
    for (x, y) in samples(size) {
        let p = base.point(y * size.0 + x);
        let (u, v) = (x as f64 + 0.5 - 0.5 * width, y as f64 + 0.5 - 0.5 * height);
        let slope = [p.x / p.z, p.y / p.z];
        let focal = (u * slope[0] + v * slope[1]) / (slope[0] * slope[0] + slope[1] * slope[1]);
        if p.z > 0.0 && focal.is_finite() {
            focals.push(focal);
        }
        sure += f64::from(base.confidence[y * size.0 + x]) - 1.0;
        count += 1.0;
    }
    let Some(focal) = median(&mut focals) else { return 0.0 };
    // Where no point is surer than another, all count alike.
    let mean = (sure / count).max(1e-3);
    let (mut sum, mut all) = (0.0, 0.0f64);
    for (x, y) in samples(seen_size) {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn each_view_keeps_its_best_partners_and_what_holds_together_stays_so() {
        // Two groups of five, joined by one poor pair.
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
        // One after another they leave the same.
        let mut some: Vec<([usize; 2], f64)> = Vec::new();
        for p in &pairs {
            some.push(*p);
            let mut keep = best(10, &some).into_iter();
            some.retain(|_| keep.next().unwrap());
        }
        assert_eq!(some, kept);
        // In the end each view has three partners still, and no pair can go without that it would
        // have fewer.
        let left = enough(10, &kept);
        let left: Vec<_> = kept.iter().zip(&left).filter(|p| *p.1).map(|p| p.0.0).collect();
        let partners = |v: usize| left.iter().filter(|p| p.contains(&v)).count();
        assert!((0..10).all(|v| partners(v) >= 3), "{left:?}");
        assert!(left.iter().any(|[i, j]| (*i < 5) != (*j < 5)) && left.len() < kept.len(), "{left:?}");
        let spare = left.iter().filter(|[i, j]| partners(*i) > 3 && partners(*j) > 3).count();
        assert!(spare <= 9, "only the nine of the spanning tree may be spare: {spare}");
        assert_eq!(best(4, &[([0, 1], 0.0), ([0, 2], 0.0), ([0, 3], 0.0), ([1, 2], 0.0)]), [true; 4]);
    }

    #[test]
    fn what_two_views_show_in_common_is_measured_by_their_points() {
        // A plane 4 ahead of two cameras of 90°, the second moved to the right by a share of what
        // they see.
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
            let found = shown(&plane(shift), &base, (w, h), (w, h));
            assert!((found - share).abs() < 0.04, "{shift}: {found}");
        }
        // Points of little confidence, and points behind the surface, show nothing.
        let unsure = Pointmap { confidence: vec![1.01; w * h], ..plane(0.0) };
        assert!(shown(&unsure, &base, (w, h), (w, h)) < 0.01);
        let mut far = plane(0.0);
        far.points.iter_mut().for_each(|p| *p = p.map(|c| 1.5 * c));
        assert_eq!(shown(&far, &base, (w, h), (w, h)), 0.0);
    }
}
