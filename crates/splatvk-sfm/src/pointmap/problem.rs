//! What is adjusted and what holds it: matches of pairs, priors, and their robust cost.
use super::canonical::{Canonical, Focals};
use super::matches::PairMatches;
use super::residual::{Direction, End, Lattice, PITCH};
use super::tree::{Placement, largest_component};
use crate::math::median;
use crate::numeric::cauchy;
use crate::scene::{ModelView, PairPointmaps, Pose};
use glam::{DVec2, DVec3};
use nalgebra::DVector;
use rayon::prelude::*;

/// Cauchy scale of reprojections as a fraction of the long side (1.5 px at 512).
const PIXEL_SCALE: f64 = 1.5 / 512.0;
/// Priors: size of a correction at a pixel the pairs agree on, and difference between neighbours.
const SIZE_SIGMA: f64 = 0.05;
const STEP_SIGMA: f64 = 0.02;
/// The mean log scale is the gauge; any stiff value holds it.
const GAUGE_SIGMA: f64 = 1e-3;
/// Matches that a view takes part in at most, for each corner of its grid: what 8192 in each of
/// three pairs are for the 825 of a 512 × 384 input. Four views keep all of theirs, and sixteen
/// take four times as long.
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

/// A vector of all unknowns.
#[derive(Clone, Debug)]
pub(super) struct Step {
    /// Poses, focal lengths, log scales: as [`Problem`] numbers them.
    pub(super) camera: DVector<f64>,
    /// Depth corrections, view by view.
    pub(super) grid: Vec<f64>,
}

impl State {
    pub(super) fn new(start: &Placement, focals: &Focals, lattices: &[Lattice]) -> State {
        State {
            poses: start.poses.clone(),
            log_focals: focals.values.iter().map(|f| f.ln()).collect(),
            kappa: start.kappa.clone(),
            grid: lattices.iter().map(|l| vec![0.0; l.len()]).collect(),
        }
    }

    /// The state after a step of Gauss–Newton, which is subtracted.
    pub(super) fn stepped(&self, problem: &Problem, step: &Step) -> State {
        let mut s = self.clone();
        for v in 1..s.poses.len() {
            let at = |k: usize| -step.camera[6 * (v - 1) + k];
            let step = Pose::exp(DVec3::new(at(0), at(1), at(2)), DVec3::new(at(3), at(4), at(5)));
            s.poses[v] = step.compose(&s.poses[v]).orthonormalised();
        }
        // Steps beyond e^±0.3 leave the range where the linearisation holds.
        let limited = |v: f64| v.clamp(-0.3, 0.3);
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

/// A match between the two views of a pair.
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

/// A pair with fewer matches holds no views together; structure from motion rests cameras on no
/// fewer points.
const LEAST_MATCHES: usize = 20;

impl PairLinks {
    /// Whether the pair joins its views.
    pub(super) fn joins(&self) -> bool {
        self.links.len() >= LEAST_MATCHES
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
    /// 1/σ² of the corrections' size, per view and corner.
    pub(super) size_weights: Vec<Vec<f64>>,
    start_kappa: f64,
    /// Cauchy scale of reprojections, pixels.
    pixel_scale: f64,
    pub(super) long: f64,
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
        let long = views.iter().map(|v| v.width.max(v.height)).max().unwrap_or(1) as f64;
        let end = |view: usize, p: DVec2| -> Option<End> {
            let v = &views[view];
            let (x, y) =
                ((p.x.max(0.0) as usize).min(v.width - 1), (p.y.max(0.0) as usize).min(v.height - 1));
            let depth = canonical[view].points[y * v.width + x].z;
            let (corners, weights) = lattices[view].corners(p);
            (depth > 0.0).then_some(End { pixel: p - v.centre(), depth, corners, weights })
        };
        let counts: Vec<_> =
            pairs.iter().zip(matches).map(|(p, m)| ([p.first, p.second], m.matches.len())).collect();
        let most: Vec<usize> = lattices.iter().map(|l| PER_CORNER * l.len()).collect();
        let kept = shares(&counts, &most);
        let linked = |(pair, (m, kept)): (&PairPointmaps, (&PairMatches, usize))| {
            // Spread and best first: the rest can go.
            let chosen = &m.matches[..kept];
            let mean = chosen.iter().map(|x| x.weight).sum::<f64>() / chosen.len().max(1) as f64;
            let links = chosen.iter().filter_map(|x| {
                let ends = [end(pair.first, x.a)?, end(pair.second, x.b)?];
                Some(Link { ends, weight: x.weight / mean })
            });
            PairLinks { views: [pair.first, pair.second], links: links.collect() }
        };
        let size_weights = views.iter().zip(canonical).zip(&lattices).map(|((v, c), l)| {
            let at = |i: usize| {
                let x = ((i % l.columns) as f64 * PITCH) as usize;
                let y = ((i / l.columns) as f64 * PITCH) as usize;
                let spread = c.spread[y.min(v.height - 1) * v.width + x.min(v.width - 1)];
                (SIZE_SIGMA * (1.0 + 20.0 * spread)).powi(-2)
            };
            (0..l.len()).map(at).collect()
        });
        Problem {
            group: focals.group.clone(),
            pairs: pairs.iter().zip(matches.iter().zip(kept)).map(linked).collect(),
            focal_priors: focals.priors.clone(),
            size_weights: size_weights.collect(),
            start_kappa: 0.0,
            pixel_scale: PIXEL_SCALE * long,
            long,
            lattices,
        }
    }

    /// Holds the mean log scale where a start has it.
    pub(super) fn hold(&mut self, start: &State) {
        self.start_kappa = start.kappa.iter().sum();
    }

    /// Index of a pose's first unknown; camera 0 has none.
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
    /// Number of unknowns other than corrections.
    pub(super) fn camera_unknowns(&self) -> usize {
        self.kappa(self.lattices.len())
    }
    /// First corner of a view among those of all.
    pub(super) fn grid(&self, view: usize) -> usize {
        self.lattices[..view].iter().map(Lattice::len).sum()
    }

    /// A pair seen from `side` towards the other.
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

    /// Residuals and factors of the linear priors: Σκ, each ln f, then size and steps of the
    /// corrections; `f` takes (residual, weight).
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

    /// How far the sum of the log scales is from where it is held.
    pub(super) fn gauge(&self, s: &State) -> f64 {
        s.kappa.iter().sum::<f64>() - self.start_kappa
    }

    /// Robust cost of matches; `c` stretches the Cauchy scales.
    pub(super) fn match_cost(&self, pairs: &[PairLinks], s: &State, c: f64) -> f64 {
        let of_pair = |pair: &PairLinks| {
            let mut sum = 0.0;
            let directions = [0, 1].map(|side| self.direction(s, pair, side));
            for link in &pair.links {
                let d = self.depths(s, pair, link);
                for (k, direction) in directions.iter().enumerate() {
                    let depths = [d[k], d[1 - k]];
                    // Behind the camera: as bad as a residual of a thousand scales.
                    let r = direction.residual(&link.ends[k], &link.ends[1 - k], depths).unwrap_or([1e3; 3]);
                    sum += link.weight * (cauchy(r[0] * r[0] + r[1] * r[1], c) + cauchy(r[2] * r[2], c));
                }
            }
            sum
        };
        // Collected first: a parallel sum would depend on who is free.
        let costs: Vec<f64> = pairs.par_iter().map(of_pair).collect();
        costs.iter().sum()
    }

    /// Robust cost of the matches, and that of the priors.
    pub(super) fn cost(&self, s: &State, c: f64) -> f64 {
        let mut sum = self.match_cost(&self.pairs, s, c);
        self.priors(s, |r, w| sum += w * r * r);
        sum
    }

    /// Whether pairs with matches hold all views together.
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

pub(super) const STEP_WEIGHT: f64 = 1.0 / (STEP_SIGMA * STEP_SIGMA);
pub(super) const GAUGE_WEIGHT: f64 = 1.0 / (GAUGE_SIGMA * GAUGE_SIGMA);

/// How many matches of each pair ([views], matches) are used so that no view has more than its
/// `most`: views with too many cut their largest pairs to one size.
fn shares(pairs: &[([usize; 2], usize)], most: &[usize]) -> Vec<usize> {
    let cap = |(view, most): (usize, &usize)| {
        let mut counts: Vec<usize> = pairs.iter().filter(|p| p.0.contains(&view)).map(|p| p.1).collect();
        counts.sort_unstable();
        let mut left = *most;
        for (k, n) in counts.iter().enumerate() {
            let share = left / (counts.len() - k);
            if *n > share {
                return share;
            }
            left -= n;
        }
        usize::MAX
    };
    let caps: Vec<usize> = most.iter().enumerate().map(cap).collect();
    pairs.iter().map(|(v, n)| (*n).min(caps[v[0]]).min(caps[v[1]])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_view_has_more_than_its_share_of_matches_and_small_pairs_stay_whole() {
        let pairs = [([0, 1], 100), ([0, 2], 10), ([0, 3], 100), ([2, 3], 60)];
        assert_eq!(shares(&pairs, &[1000; 4]), [100, 10, 100, 60]);
        // View 0: all of the small pair, half of the rest for each of the others; view 3: half and
        // half, of which view 0 takes less.
        assert_eq!(shares(&pairs, &[110; 4]), [50, 10, 50, 55]);
        assert_eq!(shares(&pairs, &[0; 4]), [0; 4]);
    }
}
