//! Gains and vignetting by robust linear least squares, with standard deviations.
use super::sample::Pair;
use crate::math::{median, quantile};
use nalgebra::{DMatrix, DVector};
use std::collections::BTreeMap;

/// Prior σ of ln gain: four photos in a thousand differ by more than 3 EV. It only fixes photos
/// without points.
const GAIN_PRIOR: f64 = 1.0;
/// Prior σ of the vignetting terms: wide apertures lose about a third in the corners.
const FALLOFF_PRIOR: [f64; 2] = [0.3, 0.15];
/// Cutoff of Tukey's biweight, standard deviations (95 % efficient on Gaussian noise; Holland &
/// Welsch 1977). Highlights are not noise around the matt points but a cluster of their own, often
/// the larger one, which would win with a weight that never reaches zero.
const TUKEY: f64 = 4.685;
/// Rounds of re-weighting; after five the estimate moves by less than one standard deviation.
const ROUNDS: usize = 12;
/// Fewest common points for the difference of two photos.
const MIN_COMMON: usize = 20;
/// Standard deviations that a correction must exceed.
const SIGNIFICANT: f64 = 4.0;
/// Smallest correction of exposure or colour, ln.
const MIN_GAIN: f64 = 0.01;
/// Smallest correction of the corners, ln.
const MIN_FALLOFF: f64 = 0.03;

/// One of the three linear problems.
#[derive(Clone, Copy)]
pub(super) struct System<'a> {
    pub(super) pairs: &'a [Pair],
    pub(super) views: usize,
    /// Lens of every view.
    pub(super) lenses: &'a [usize],
    /// Difference to fit: 0 = brightness, 1 = red, 2 = blue.
    pub(super) channel: usize,
}

/// Estimated unknowns; the others are 0.
#[derive(Clone, Debug, PartialEq)]
struct Unknowns {
    gains: bool,
    /// Per lens.
    falloff: Vec<bool>,
}

/// Solution of a [`System`] with standard deviations.
#[derive(Clone, Debug)]
pub(super) struct Solution {
    /// ln, per view.
    pub(super) gain: Vec<f64>,
    pub(super) sigma: Vec<f64>,
    /// Per lens.
    pub(super) falloff: Vec<[f64; 2]>,
    pub(super) corner_sigma: Vec<f64>,
    pub(super) reference: usize,
    /// Biweight per pair: 1 = inlier, 0 = a cause other than the light of the whole photo.
    pub(super) agreement: Vec<f64>,
}

impl Solution {
    pub(super) fn gains_matter(&self) -> bool {
        self.gain.iter().zip(&self.sigma).any(|(g, d)| g.abs() > MIN_GAIN.max(SIGNIFICANT * d))
    }

    /// True per lens with significantly darker corners. Brighter ones are no vignetting.
    fn falloff_matters(&self) -> Vec<bool> {
        let corner = self.falloff.iter().map(|f| f[0] + f[1]);
        corner.zip(&self.corner_sigma).map(|(v, d)| -v > MIN_FALLOFF.max(SIGNIFICANT * d)).collect()
    }
}

/// Exposure and vignetting, each only if significant. The photo of median exposure is the
/// reference: its light is the scene's, so that the scene looks like one of the photos and few
/// values leave the range of the files.
pub(super) fn exposure(system: &System) -> Solution {
    let lenses = system.lenses.iter().max().map_or(0, |l| l + 1);
    let mut free = Unknowns { gains: true, falloff: vec![true; lenses] };
    let first = system.solve(&free, 0);
    let mut order: Vec<usize> = (0..system.views).collect();
    order.sort_by(|a, b| first.gain[*a].total_cmp(&first.gain[*b]));
    // Of two middle ones the darker: darkening the others to it loses nothing.
    let reference = order[(system.views - 1) / 2];
    let mut found = system.solve(&free, reference);
    free.falloff = found.falloff_matters();
    if free.falloff.contains(&false) {
        found = system.solve(&free, reference);
    }
    if !found.gains_matter() {
        free.gains = false;
        found = system.solve(&free, reference);
    }
    found
}

impl System<'_> {
    pub(super) fn gains(&self, reference: usize) -> Solution {
        let lenses = self.lenses.iter().max().map_or(0, |l| l + 1);
        self.solve(&Unknowns { gains: true, falloff: vec![false; lenses] }, reference)
    }

    /// Row of a pair: columns with their coefficients.
    fn row(&self, pair: &Pair, column: &Columns) -> Vec<(usize, f64)> {
        let mut row = Vec::with_capacity(6);
        for (k, sign) in [(0, 1.0), (1, -1.0)] {
            let view = pair.views[k];
            row.extend(column.gain[view].map(|c| (c, sign)));
            if let Some(c) = column.falloff[self.lenses[view]] {
                row.extend([(c, sign * pair.r[k][0]), (c + 1, sign * pair.r[k][1])]);
            }
        }
        row
    }

    fn variance(&self, pair: &Pair) -> f64 {
        pair.variance[self.channel.min(1)]
    }

    /// Iteratively re-weighted least squares. Standard deviations: cluster-robust sandwich
    /// estimator (Liang & Zeger 1986) over cells, since residuals within a cell have common causes.
    fn solve(&self, free: &Unknowns, reference: usize) -> Solution {
        let columns = Columns::new(free, self.views, reference);
        let rows: Vec<_> = self.pairs.iter().map(|p| self.row(p, &columns)).collect();
        let mut x = self.initial(&columns);
        let (mut h, mut residuals) = (DMatrix::from_diagonal(&columns.prior), Vec::new());
        let (mut weights, mut agreement) = (vec![0.0; rows.len()], vec![0.0; rows.len()]);
        // Slope of the scores over their secant: information left by a redescending weight.
        let mut slope = 1.0;
        for _ in 0..ROUNDS {
            residuals = self.residuals(&rows, &x);
            let mut sizes: Vec<f64> =
                self.pairs.iter().zip(&residuals).map(|(p, r)| r.abs() / self.variance(p).sqrt()).collect();
            // 1.4826 median |u| is σ of Gaussian u. Below a tenth of the expected noise the model
            // is exact; above it the cause is not noise.
            let scale = (1.4826 * median(&mut sizes).unwrap_or(1.0)).clamp(0.1, 1.0);
            h = DMatrix::from_diagonal(&columns.prior);
            let mut g = DVector::zeros(x.len());
            let (mut tangents, mut secants) = (0.0, 0.0);
            for (k, ((pair, row), r)) in self.pairs.iter().zip(&rows).zip(&residuals).enumerate() {
                let variance = scale * scale * self.variance(pair);
                let rest = (1.0 - r * r / (variance * TUKEY * TUKEY)).max(0.0);
                agreement[k] = rest * rest;
                let weight = pair.share * agreement[k] / variance;
                weights[k] = weight;
                secants += weight;
                tangents += pair.share * rest * (5.0 * rest - 4.0) / variance;
                for (a, ca) in row {
                    g[*a] += weight * ca * pair.difference[self.channel];
                    for (b, cb) in row {
                        h[(*a, *b)] += weight * ca * cb;
                    }
                }
            }
            if secants > 0.0 {
                slope = (tangents / secants).clamp(0.1, 1.0);
            }
            let Some(factor) = h.clone().cholesky() else { break };
            x = factor.solve(&g);
        }
        let mut scores: BTreeMap<(usize, usize), DVector<f64>> = BTreeMap::new();
        for (((pair, row), r), weight) in self.pairs.iter().zip(&rows).zip(&residuals).zip(&weights) {
            let score =
                scores.entry((pair.views[0], pair.cells[0])).or_insert_with(|| DVector::zeros(x.len()));
            row.iter().for_each(|(a, c)| score[*a] += weight * r * c);
        }
        let spread = scores.len() as f64 / (scores.len() as f64 - 1.0).max(1.0);
        let mut middle = DMatrix::from_diagonal(&columns.prior);
        scores.values().for_each(|v| middle += spread * v * v.transpose());
        let covariance = h.try_inverse().map(|i| &i * middle * &i / (slope * slope));
        Solution { agreement, ..columns.solution(&x, covariance.as_ref(), reference) }
    }

    /// Initial gains: pairwise differences by the shorth (least median of squares, Rousseeuw 1984),
    /// combined by least absolute deviations against pairs whose highlights agree better.
    fn initial(&self, columns: &Columns) -> DVector<f64> {
        let mut common: BTreeMap<[usize; 2], Vec<f64>> = BTreeMap::new();
        for pair in self.pairs {
            let [a, b] = pair.views;
            let d = pair.difference[self.channel];
            common.entry([a.min(b), a.max(b)]).or_default().push(if a < b { d } else { -d });
        }
        common.retain(|_, d| d.len() >= MIN_COMMON);
        let offsets: Vec<([usize; 2], f64)> =
            common.into_iter().map(|(v, mut d)| (v, shorth(&mut d))).collect();
        let mut x = DVector::zeros(columns.prior.len());
        // Only for photos with too few points in common with any other: absolute deviations would
        // not outweigh the full prior where photos differ by more than its σ.
        let prior = 1e-6 * &columns.prior;
        for round in 0..ROUNDS {
            let mut h = DMatrix::from_diagonal(&prior);
            let mut g = DVector::zeros(x.len());
            for (views, difference) in &offsets {
                let row = [(columns.gain[views[0]], 1.0), (columns.gain[views[1]], -1.0)];
                let row = row.into_iter().filter_map(|(c, sign)| Some((c?, sign)));
                let r = difference - row.clone().map(|(c, sign)| sign * x[c]).sum::<f64>();
                // A thousandth is below a grey level.
                let weight = if round == 0 { 1.0 } else { 1.0 / r.abs().max(1e-3) };
                for (a, ca) in row.clone() {
                    g[a] += weight * ca * difference;
                    row.clone().for_each(|(b, cb)| h[(a, b)] += weight * ca * cb);
                }
            }
            let Some(factor) = h.cholesky() else { break };
            x = factor.solve(&g);
        }
        x
    }

    fn residuals(&self, rows: &[Vec<(usize, f64)>], x: &DVector<f64>) -> Vec<f64> {
        let residual = |(p, row): (&Pair, &Vec<(usize, f64)>)| {
            p.difference[self.channel] - row.iter().map(|(a, c)| c * x[*a]).sum::<f64>()
        };
        self.pairs.iter().zip(rows).map(residual).collect()
    }

    /// Per view: 0.9 quantile over its cells of the remaining |ln| difference to the others. A cell
    /// takes the median of its pairs, so that noise and single highlights do not count.
    pub(super) fn unexplained(&self, found: &Solution) -> Vec<f64> {
        let mut cells: BTreeMap<(usize, usize), Vec<f64>> = BTreeMap::new();
        for p in self.pairs {
            let predicted = |k: usize| {
                let f = found.falloff[self.lenses[p.views[k]]];
                found.gain[p.views[k]] + f[0] * p.r[k][0] + f[1] * p.r[k][1]
            };
            let residual = p.difference[self.channel] - predicted(0) + predicted(1);
            cells.entry((p.views[0], p.cells[0])).or_default().push(residual);
            cells.entry((p.views[1], p.cells[1])).or_default().push(-residual);
        }
        let mut per_view = vec![Vec::new(); self.views];
        for ((view, _), mut residuals) in cells {
            // Fewer pairs have no reliable median.
            if residuals.len() >= 5 {
                per_view[view].extend(median(&mut residuals).map(f64::abs));
            }
        }
        per_view.iter_mut().map(|v| quantile(v, 0.9).unwrap_or(0.0)).collect()
    }
}

/// Middle of the shortest interval that holds half of the values.
fn shorth(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let half = values.len().div_ceil(2);
    let shortest = values.windows(half).min_by(|a, b| (a[half - 1] - a[0]).total_cmp(&(b[half - 1] - b[0])));
    shortest.map_or(0.0, |w| w[half / 2])
}

/// Column of each unknown.
struct Columns {
    gain: Vec<Option<usize>>,
    falloff: Vec<Option<usize>>,
    /// 1 / prior variance.
    prior: DVector<f64>,
}

impl Columns {
    fn new(free: &Unknowns, views: usize, reference: usize) -> Columns {
        let mut prior: Vec<f64> = Vec::new();
        let mut take = |wanted: bool, sigmas: &[f64]| {
            wanted.then(|| {
                prior.extend(sigmas.iter().map(|s| 1.0 / (s * s)));
                prior.len() - sigmas.len()
            })
        };
        let gain = (0..views).map(|v| take(free.gains && v != reference, &[GAIN_PRIOR])).collect();
        let falloff = free.falloff.iter().map(|f| take(*f, &FALLOFF_PRIOR)).collect();
        Columns { gain, falloff, prior: DVector::from_vec(prior) }
    }

    fn solution(&self, x: &DVector<f64>, covariance: Option<&DMatrix<f64>>, reference: usize) -> Solution {
        let variance = |a: usize, b: usize| covariance.map_or(f64::INFINITY, |c| c[(a, b)]);
        let gain = |c: &Option<usize>| c.map_or(0.0, |c| x[c]);
        let falloff = |c: &Option<usize>| c.map_or([0.0; 2], |c| [x[c], x[c + 1]]);
        let corner_sigma = |c: &Option<usize>| {
            c.map_or(0.0, |c| {
                (variance(c, c) + 2.0 * variance(c, c + 1) + variance(c + 1, c + 1)).max(0.0).sqrt()
            })
        };
        Solution {
            gain: self.gain.iter().map(gain).collect(),
            sigma: self.gain.iter().map(|c| c.map_or(0.0, |c| variance(c, c).max(0.0).sqrt())).collect(),
            falloff: self.falloff.iter().map(falloff).collect(),
            corner_sigma: self.falloff.iter().map(corner_sigma).collect(),
            reference,
            agreement: Vec::new(),
        }
    }
}
