//! Unknowns, matches, priors and robust cost of the adjustment.
use super::canonical::{Canonical, Focals};
use super::matches::{PairMatches, PixelMatch};
use super::residual::{Direction, End, Lattice, PITCH};
use super::tree::{Registration, largest_component};
use crate::math::median;
use crate::numeric::cauchy;
use crate::scene::{ModelView, PairPointmaps, Pose};
use glam::{DVec2, DVec3};
use nalgebra::DVector;
use rayon::prelude::*;

/// Cauchy scale of reprojections as a fraction of the long side (1.5 px at 512).
const PIXEL_SCALE: f64 = 1.5 / 512.0;
/// σ of a correction where the pairs agree, and of its difference to a neighbour.
const CORRECTION_SIGMA: f64 = 0.05;
const STEP_SIGMA: f64 = 0.02;
/// The sum of the log scales fixes the gauge; any small σ does.
const GAUGE_SIGMA: f64 = 1e-3;
/// Most matches of a view per corner of its grid: 8192 in each of three pairs for the 825 corners
/// of a 512 × 384 input. Four views keep all their matches, and sixteen take four times as long.
const PER_CORNER: usize = 30;

/// The unknowns.
#[derive(Clone, Debug)]
pub(super) struct State {
    /// World → camera; camera 0 fixed.
    pub(super) poses: Vec<Pose>,
    pub(super) log_focals: Vec<f64>,
    /// ln(global depth / canonical depth) per view.
    pub(super) kappa: Vec<f64>,
    /// ln depth correction at the grid corners per view, row-major.
    pub(super) grid: Vec<Vec<f64>>,
}

/// Vector over all unknowns.
#[derive(Clone, Debug)]
pub(super) struct Step {
    /// Poses, focal lengths and log scales, in the order of [`Problem`].
    pub(super) camera: DVector<f64>,
    /// Depth corrections, view by view.
    pub(super) grid: Vec<f64>,
}

impl State {
    pub(super) fn new(start: &Registration, focals: &Focals, lattices: &[Lattice]) -> State {
        State {
            poses: start.poses.clone(),
            log_focals: focals.values.iter().map(|f| f.ln()).collect(),
            kappa: start.kappa.clone(),
            grid: lattices.iter().map(|l| vec![0.0; l.len()]).collect(),
        }
    }

    /// State after a Gauss–Newton step, which is subtracted.
    pub(super) fn updated(&self, problem: &Problem, step: &Step) -> State {
        let mut s = self.clone();
        for v in 1..s.poses.len() {
            let [x, y, z, a, b, c] = std::array::from_fn(|k| -step.camera[6 * (v - 1) + k]);
            let step = Pose::exp(DVec3::new(x, y, z), DVec3::new(a, b, c));
            s.poses[v] = step.compose(&s.poses[v]).orthonormalised();
        }
        for (g, f) in s.log_focals.iter_mut().enumerate() {
            *f -= limited(step.camera[problem.focal(g)]);
        }
        for (v, k) in s.kappa.iter_mut().enumerate() {
            *k -= limited(step.camera[problem.kappa(v)]);
        }
        for (a, d) in s.grid.iter_mut().flatten().zip(&step.grid) {
            *a -= limited(*d);
        }
        s
    }
}

/// Clamps a step to e^±0.3, the range of the linearisation.
fn limited(step: f64) -> f64 {
    step.clamp(-0.3, 0.3)
}

/// Match between the two views of a pair.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    pub(super) ends: [End; 2],
    pub(super) weight: f64,
}

/// The matches of one pair.
#[derive(Clone, Debug)]
pub(super) struct PairLinks {
    pub(super) views: [usize; 2],
    pub(super) links: Vec<Link>,
}

/// Fewest matches of a pair that connect its views; fewest points of a camera in structure from
/// motion.
const MIN_MATCHES: usize = 20;

impl PairLinks {
    /// True if the pair connects its views.
    pub(super) fn joins(&self) -> bool {
        self.links.len() >= MIN_MATCHES
    }
}

/// Measurements and priors.
#[derive(Clone)]
pub(super) struct Problem {
    pub(super) group: Vec<usize>,
    pub(super) lattices: Vec<Lattice>,
    pub(super) pairs: Vec<PairLinks>,
    /// (mean, σ) of ln f per group.
    pub(super) focal_priors: Vec<(f64, f64)>,
    /// 1/σ² of the prior on the corrections, per view and corner.
    pub(super) size_weights: Vec<Vec<f64>>,
    gauge_kappa: f64,
    /// Cauchy scale of reprojections, pixels.
    pixel_scale: f64,
    pub(super) long_side: f64,
}

impl Problem {
    pub(super) fn new(
        views: &[ModelView],
        canonical: &[Canonical],
        focals: &Focals,
        pairs: &[PairPointmaps],
        matches: &[PairMatches],
    ) -> Problem {
        let lattices: Vec<Lattice> = views.iter().map(Lattice::new).collect();
        let long_side = views.iter().map(|v| v.width.max(v.height)).max().unwrap_or(1) as f64;
        let counts: Vec<_> =
            pairs.iter().zip(matches).map(|(p, m)| ([p.first, p.second], m.matches.len())).collect();
        let limits: Vec<usize> = lattices.iter().map(|l| PER_CORNER * l.len()).collect();
        let kept = matches_per_pair(&counts, &limits);
        // Matches are spread over the image and sorted best first: the tail can be cut.
        let links = pairs.iter().zip(matches.iter().zip(kept)).map(|(pair, (m, kept))| {
            pair_links(views, canonical, &lattices, [pair.first, pair.second], &m.matches[..kept])
        });
        let size_weights = views
            .iter()
            .zip(canonical)
            .zip(&lattices)
            .map(|((v, c), l)| (0..l.len()).map(|i| size_weight(v, c, l, i)).collect());
        Problem {
            group: focals.group.clone(),
            pairs: links.collect(),
            focal_priors: focals.priors.clone(),
            size_weights: size_weights.collect(),
            gauge_kappa: 0.0,
            pixel_scale: PIXEL_SCALE * long_side,
            long_side,
            lattices,
        }
    }

    /// Fixes the sum of the log scales at its value in `start`.
    pub(super) fn fix_gauge(&mut self, start: &State) {
        self.gauge_kappa = start.kappa.iter().sum();
    }

    /// Index of the first unknown of a pose; camera 0 has none.
    pub(super) fn pose(&self, view: usize) -> Option<usize> {
        (view > 0).then(|| 6 * (view - 1))
    }
    /// Index of the focal length of a group.
    pub(super) fn focal(&self, group: usize) -> usize {
        6 * (self.lattices.len() - 1) + group
    }
    /// Index of a view's log scale.
    pub(super) fn kappa(&self, view: usize) -> usize {
        self.focal(self.focal_priors.len()) + view
    }
    /// Number of unknowns without the depth corrections.
    pub(super) fn camera_unknowns(&self) -> usize {
        self.kappa(self.lattices.len())
    }
    /// Index of the first corner of a view among the corners of all views.
    pub(super) fn grid(&self, view: usize) -> usize {
        self.lattices[..view].iter().map(Lattice::len).sum()
    }

    /// Reprojection of the points of view `side` of a pair into the other view.
    pub(super) fn direction(&self, s: &State, pair: &PairLinks, side: usize) -> Direction {
        let [a, b] = [pair.views[side], pair.views[1 - side]];
        Direction {
            relative: s.poses[b].compose(&s.poses[a].inverse()),
            focals: [a, b].map(|v| s.log_focals[self.group[v]].exp()),
            side,
            pixel_scale: self.pixel_scale,
        }
    }

    /// Depths of both ends of a match.
    pub(super) fn depths(&self, s: &State, pair: &PairLinks, link: &Link) -> [f64; 2] {
        [0, 1].map(|k| link.ends[k].depth(s.kappa[pair.views[k]], &s.grid[pair.views[k]]))
    }

    /// Calls `f(residual, weight)` for every linear prior: each ln f, Σκ, then size and neighbour
    /// differences of the corrections.
    fn priors(&self, s: &State, mut f: impl FnMut(f64, f64)) {
        for (g, (mean, sigma)) in self.focal_priors.iter().enumerate() {
            f(s.log_focals[g] - mean, sigma.powi(-2));
        }
        f(self.gauge(s), GAUGE_WEIGHT);
        for (v, l) in self.lattices.iter().enumerate() {
            for (i, a) in s.grid[v].iter().enumerate() {
                f(*a, self.size_weights[v][i]);
                for j in l.later_neighbours(i) {
                    f(a - s.grid[v][j], STEP_WEIGHT);
                }
            }
        }
    }

    /// Difference of the sum of the log scales to its fixed value.
    pub(super) fn gauge(&self, s: &State) -> f64 {
        s.kappa.iter().sum::<f64>() - self.gauge_kappa
    }

    /// Robust cost of matches, with Cauchy scales stretched by `c`.
    pub(super) fn match_cost(&self, pairs: &[PairLinks], s: &State, c: f64) -> f64 {
        // Collected before the sum: the order of a parallel sum depends on the threads.
        let costs: Vec<f64> = pairs.par_iter().map(|pair| self.pair_cost(pair, s, c)).collect();
        costs.iter().sum()
    }

    fn pair_cost(&self, pair: &PairLinks, s: &State, c: f64) -> f64 {
        let mut sum = 0.0;
        let directions = [0, 1].map(|side| self.direction(s, pair, side));
        for link in &pair.links {
            let d = self.depths(s, pair, link);
            for (k, direction) in directions.iter().enumerate() {
                let depths = [d[k], d[1 - k]];
                // A point behind the camera costs as much as a residual of a thousand scales.
                let r = direction.residual(&link.ends[k], &link.ends[1 - k], depths).unwrap_or([1e3; 3]);
                sum += link.weight * (cauchy(r[0] * r[0] + r[1] * r[1], c) + cauchy(r[2] * r[2], c));
            }
        }
        sum
    }

    /// Robust cost of the matches plus the cost of the priors.
    pub(super) fn cost(&self, s: &State, c: f64) -> f64 {
        let mut sum = self.match_cost(&self.pairs, s, c);
        self.priors(s, |r, w| sum += w * r * r);
        sum
    }

    /// True if pairs with enough matches connect all views.
    pub(super) fn joins_all_views(&self) -> bool {
        let joined: Vec<[usize; 2]> = self.pairs.iter().filter(|p| p.joins()).map(|p| p.views).collect();
        largest_component(self.lattices.len(), &joined).len() == self.lattices.len()
    }

    /// Median reprojection error of a pair, pixels.
    pub(super) fn median_error(&self, s: &State, pair: &PairLinks) -> Option<f64> {
        let direction = self.direction(s, pair, 0);
        let error = |l: &Link| {
            let r = direction.residual(&l.ends[0], &l.ends[1], self.depths(s, pair, l))?;
            Some(r[0].hypot(r[1]) * self.pixel_scale)
        };
        median(&mut pair.links.iter().filter_map(error).collect::<Vec<f64>>())
    }
}

/// Links of a pair from its matches, with weights of mean 1.
fn pair_links(
    views: &[ModelView],
    canonical: &[Canonical],
    lattices: &[Lattice],
    pair: [usize; 2],
    matches: &[PixelMatch],
) -> PairLinks {
    let end = |view: usize, p: DVec2| match_end(&views[view], &canonical[view], &lattices[view], p);
    let mean = matches.iter().map(|x| x.weight).sum::<f64>() / matches.len().max(1) as f64;
    let links = matches.iter().filter_map(|x| {
        let ends = [end(pair[0], x.a)?, end(pair[1], x.b)?];
        Some(Link { ends, weight: x.weight / mean })
    });
    PairLinks { views: pair, links: links.collect() }
}

/// End of a match at position `p` of a view; `None` without canonical depth.
fn match_end(view: &ModelView, c: &Canonical, lattice: &Lattice, p: DVec2) -> Option<End> {
    let (x, y) = ((p.x.max(0.0) as usize).min(view.width - 1), (p.y.max(0.0) as usize).min(view.height - 1));
    let depth = c.points[y * view.width + x].z;
    let (corners, weights) = lattice.corners(p);
    (depth > 0.0).then_some(End { pixel: p - view.centre(), depth, corners, weights })
}

/// 1/σ² of the prior on the correction at corner `i`.
fn size_weight(view: &ModelView, c: &Canonical, lattice: &Lattice, i: usize) -> f64 {
    let x = ((i % lattice.columns) as f64 * PITCH) as usize;
    let y = ((i / lattice.columns) as f64 * PITCH) as usize;
    let spread = c.spread[y.min(view.height - 1) * view.width + x.min(view.width - 1)];
    (CORRECTION_SIGMA * (1.0 + 20.0 * spread)).powi(-2)
}

pub(super) const STEP_WEIGHT: f64 = 1.0 / (STEP_SIGMA * STEP_SIGMA);
pub(super) const GAUGE_WEIGHT: f64 = 1.0 / (GAUGE_SIGMA * GAUGE_SIGMA);

/// Number of matches used of each pair ([views], matches), so that no view exceeds its limit: views
/// with too many cut their largest pairs to one size.
fn matches_per_pair(pairs: &[([usize; 2], usize)], limits: &[usize]) -> Vec<usize> {
    let caps: Vec<usize> = limits.iter().enumerate().map(|(view, n)| pair_cap(pairs, view, *n)).collect();
    pairs.iter().map(|(v, n)| (*n).min(caps[v[0]]).min(caps[v[1]])).collect()
}

/// Size to which the largest pairs of a view are cut so that its matches stay within `limit`.
fn pair_cap(pairs: &[([usize; 2], usize)], view: usize, limit: usize) -> usize {
    let mut counts: Vec<usize> = pairs.iter().filter(|p| p.0.contains(&view)).map(|p| p.1).collect();
    counts.sort_unstable();
    let mut left = limit;
    for (k, n) in counts.iter().enumerate() {
        let share = left / (counts.len() - k);
        if *n > share {
            return share;
        }
        left -= n;
    }
    usize::MAX
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_per_pair_cuts_largest_pairs() {
        let pairs = [([0, 1], 100), ([0, 2], 10), ([0, 3], 100), ([2, 3], 60)];
        assert_eq!(matches_per_pair(&pairs, &[1000; 4]), [100, 10, 100, 60]);
        // View 0: the whole small pair and half of the rest for each other pair. View 3: half and
        // half, of which view 0 cuts one further.
        assert_eq!(matches_per_pair(&pairs, &[110; 4]), [50, 10, 50, 55]);
        assert_eq!(matches_per_pair(&pairs, &[0; 4]), [0; 4]);
    }
}
