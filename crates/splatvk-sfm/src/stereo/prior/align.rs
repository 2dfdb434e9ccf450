//! Piecewise alignment of a depth prior by scale and shift.
//!
//! Both are fitted in inverse depth, where planes are affine in the image: one scale and one shift
//! map planes to planes, networks of relative depth leave open just these two (Ranftl et al. 2020),
//! and matching noise is uniform. In depth or its logarithm a shift would bend walls.
use super::pieces::{NO_PIECE, Pieces};
use crate::math::hash;

/// Pixels with correlated errors, those of one matching window: one independent measurement.
const CORRELATED: f64 = 81.0;
/// σ of the relative change of a prior's error between neighbouring pieces. Errors of a tenth that
/// swing twice over the image change as much.
const CHANGE: f64 = 0.02;
/// σ of a piece's correction; separates scale and shift where a piece has one depth.
const SPREAD: f64 = 0.3;
/// Scales of the Cauchy loss, multiples of stereo's own σ, one per round: wide first, so that a
/// piece that is far off is fitted before it counts as an outlier.
const WIDTHS: [f64; 5] = [16.0, 8.0, 4.0, 2.0, 2.0];
/// Two-pixel hypotheses for the global scale and shift: with half of the pixels right, all miss
/// with probability 0.75^300.
const TRIALS: u32 = 300;
/// Pixels that score a hypothesis.
const SCORED: usize = 500;
/// Least share of inliers in a piece that is kept.
const LEAST_AGREEMENT: f64 = 0.5;
/// Least ratio of a prior's score to that of a constant depth: the prior of another scene can be
/// flattened to a ratio of one.
const BETTER_THAN_FLAT: f64 = 1.05;
/// Residual of an outlier, multiples of σ: no noise is as large.
const OUTLIER: f64 = 4.0;
/// Fewest independent measurements for the decision on a piece.
const MIN_EVIDENCE: f64 = 2.0;

/// Prior at the scale of stereo.
pub struct Aligned {
    /// Inverse depth per pixel; 0 where the prior is unknown or contradicts stereo.
    pub inverse: Vec<f32>,
    /// Relative standard deviation per pixel.
    pub deviation: Vec<f32>,
    /// Share of the prior's pixels in pieces that contradict stereo.
    pub contradicted: f32,
}

/// Stereo measurement at a pixel.
#[derive(Clone, Copy)]
struct Sample {
    pixel: usize,
    inverse: f64,
    weight: f64,
}

/// Aligns `prior` (affine in inverse depth, [H, W], 0 = unknown) with `stereo` (inverse depth, 0 =
/// unmatched), weighted by `confidence`. `tolerance` is the relative σ of stereo. `None` if no
/// scale and shift fit better than one constant depth.
pub fn align(
    prior: &[f32],
    stereo: &[f32],
    confidence: &[f32],
    (width, height): (usize, usize),
    tolerance: f32,
    seed: u32,
) -> Option<Aligned> {
    let samples: Vec<Sample> = (0..prior.len())
        .filter(|&k| prior[k] > 0.0 && stereo[k] > 0.0)
        .map(|k| Sample { pixel: k, inverse: f64::from(stereo[k]), weight: f64::from(confidence[k]) })
        .collect();
    let (scale, shift) = global_fit(prior, &samples, f64::from(tolerance), seed)?;
    // Limit for values that the shift maps to infinity or beyond.
    let farthest = 0.25 * stereo.iter().copied().filter(|s| *s > 0.0).fold(f32::INFINITY, f32::min);
    let rough_inverse =
        |q: f32| if q > 0.0 { ((scale * f64::from(q) + shift) as f32).max(farthest) } else { 0.0 };
    let rough: Vec<f32> = prior.iter().map(|&q| rough_inverse(q)).collect();
    let pieces = Pieces::cut(&rough, width, height);
    let corrections = Corrections::solve(&rough, &pieces, &samples, f64::from(tolerance));
    Some(corrections.applied(&rough, &pieces, &samples, (width, height), f64::from(tolerance)))
}

/// Global scale and shift: the hypothesis of two pixels with the best robust score, then
/// re-weighted least squares.
fn global_fit(prior: &[f32], samples: &[Sample], tolerance: f64, seed: u32) -> Option<(f64, f64)> {
    if samples.len() < 2 * CORRELATED as usize {
        return None;
    }
    // Wide, so that the prior's own errors of some ten percent are inliers.
    let width = WIDTHS[0] * tolerance;
    let residual =
        |(a, b): (f64, f64), s: &Sample| (a * f64::from(prior[s.pixel]) + b - s.inverse) / s.inverse;
    let stride = (samples.len() / SCORED).max(1);
    let score = |ab: (f64, f64)| -> f64 {
        let all = samples.iter().step_by(stride);
        all.map(|s| s.weight / (1.0 + (residual(ab, s) / width).powi(2))).sum()
    };
    let mut state = seed;
    let mut draw = || {
        state = hash(state);
        &samples[state as usize % samples.len()]
    };
    let mut best = (0.0, (0.0, 0.0));
    let mut flat = 0f64;
    for _ in 0..TRIALS {
        let (s, t) = (draw(), draw());
        let (p, q) = (f64::from(prior[s.pixel]), f64::from(prior[t.pixel]));
        let a = (s.inverse - t.inverse) / (p - q);
        flat = flat.max(score((0.0, s.inverse)));
        // Scales must be positive; one without shift fits a prior of constant depth.
        for (a, b) in [(a, s.inverse - a * p), (s.inverse / p, 0.0)] {
            if a > 0.0 && a.is_finite() && score((a, b)) > best.0 {
                best = (score((a, b)), (a, b));
            }
        }
    }
    let mut found = best.1;
    for _ in 0..10 {
        let (mut n, mut rhs) = ([0.0; 3], [0.0; 2]);
        for s in samples.iter().step_by(stride) {
            let weight = s.weight / (1.0 + (residual(found, s) / width).powi(2)) / s.inverse.powi(2);
            let q = f64::from(prior[s.pixel]);
            for (slot, v) in n.iter_mut().zip([q * q, q, 1.0]) {
                *slot += weight * v;
            }
            for (slot, v) in rhs.iter_mut().zip([q, 1.0]) {
                *slot += weight * v * s.inverse;
            }
        }
        let det = n[0] * n[2] - n[1] * n[1];
        let (a, b) = ((n[2] * rhs[0] - n[1] * rhs[1]) / det, (n[0] * rhs[1] - n[1] * rhs[0]) / det);
        if det <= 1e-12 * n[0] * n[2] || a <= 0.0 || score((a, b)) < score(found) {
            break;
        }
        found = (a, b);
    }
    (found.0 > 0.0 && score(found) > BETTER_THAN_FLAT * flat).then_some(found)
}

/// Correction (u, v) of every piece: inverse depth = (1 + u) · rough + v · unit.
struct Corrections {
    per_piece: Vec<[f64; 2]>,
    unit: f64,
}

/// Sparse system of 2 × 2 blocks on the diagonal and rank-one couplings of pairs of pieces.
struct System {
    diagonal: Vec<[f64; 3]>,
    /// (a, b, h, weight): weight · (h · (x_a − x_b))².
    couplings: Vec<(usize, usize, [f64; 2], f64)>,
}

impl System {
    fn product(&self, x: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let mut out: Vec<[f64; 2]> = self
            .diagonal
            .iter()
            .zip(x)
            .map(|(d, x)| [d[0] * x[0] + d[1] * x[1], d[1] * x[0] + d[2] * x[1]])
            .collect();
        for &(a, b, h, weight) in &self.couplings {
            let along = weight * (h[0] * (x[a][0] - x[b][0]) + h[1] * (x[a][1] - x[b][1]));
            for c in 0..2 {
                out[a][c] += along * h[c];
                out[b][c] -= along * h[c];
            }
        }
        out
    }

    /// Conjugate gradients with the diagonal blocks as preconditioner.
    fn solve(&self, rhs: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let mut blocks = self.diagonal.clone();
        for &(a, b, h, weight) in &self.couplings {
            for n in [a, b] {
                for (slot, v) in blocks[n].iter_mut().zip([h[0] * h[0], h[0] * h[1], h[1] * h[1]]) {
                    *slot += weight * v;
                }
            }
        }
        let mut x = vec![[0.0; 2]; rhs.len()];
        let mut r = rhs.to_vec();
        let mut z = preconditioned(&blocks, &r);
        let mut p = z.clone();
        let mut rz = dot(&r, &z);
        let end = 1e-12 * rz;
        // Exact after as many steps as unknowns; about fifty are enough.
        for _ in 0..2 * rhs.len() {
            if rz <= end {
                break;
            }
            let q = self.product(&p);
            let step = rz / dot(&p, &q);
            add_scaled(&mut x, &p, step);
            add_scaled(&mut r, &q, -step);
            z = preconditioned(&blocks, &r);
            let next = dot(&r, &z);
            p.iter_mut().zip(&z).for_each(|(p, z)| (0..2).for_each(|c| p[c] = z[c] + next / rz * p[c]));
            rz = next;
        }
        x
    }
}

/// Solution of each 2 × 2 block for its part of `r`.
fn preconditioned(blocks: &[[f64; 3]], r: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let solve_block = |(m, r): (&[f64; 3], &[f64; 2])| {
        let det = m[0] * m[2] - m[1] * m[1];
        [(m[2] * r[0] - m[1] * r[1]) / det, (m[0] * r[1] - m[1] * r[0]) / det]
    };
    blocks.iter().zip(r).map(solve_block).collect()
}

fn dot(a: &[[f64; 2]], b: &[[f64; 2]]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a[0] * b[0] + a[1] * b[1]).sum()
}

fn add_scaled(a: &mut [[f64; 2]], b: &[[f64; 2]], s: f64) {
    a.iter_mut().zip(b).for_each(|(a, b)| (0..2).for_each(|c| a[c] += s * b[c]));
}

impl Corrections {
    fn solve(rough: &[f32], pieces: &Pieces, samples: &[Sample], tolerance: f64) -> Corrections {
        let mut all: Vec<f64> = samples.iter().map(|s| s.inverse).collect();
        let unit = crate::math::median(&mut all).unwrap_or(1.0);
        let (mut mean, mut size) = (vec![0.0; pieces.count], vec![0.0f64; pieces.count]);
        for (&piece, &value) in pieces.of.iter().zip(rough).filter(|(p, _)| **p != NO_PIECE) {
            mean[piece as usize] += f64::from(value);
            size[piece as usize] += 1.0;
        }
        mean.iter_mut().zip(&size).for_each(|(m, n)| *m /= n.max(1.0));
        let mut couplings = Vec::new();
        for &(a, b, length) in &pieces.borders {
            let (a, b) = (a as usize, b as usize);
            // Full weight where the border is as long as the smaller piece is wide.
            let share = (f64::from(length) / size[a].min(size[b]).sqrt()).min(1.0);
            for at in [mean[a], mean[b]] {
                couplings.push((a, b, [1.0, unit / at], 0.5 * share / (CHANGE * CHANGE)));
            }
        }
        let mut corrections = Corrections { per_piece: vec![[0.0; 2]; pieces.count], unit };
        for width in WIDTHS {
            let start = [1.0 / (SPREAD * SPREAD), 0.0, 1.0 / (SPREAD * SPREAD)];
            let mut system = System { diagonal: vec![start; pieces.count], couplings };
            let mut rhs = vec![[0.0; 2]; pieces.count];
            for s in samples {
                let piece = pieces.of[s.pixel] as usize;
                let at = f64::from(rough[s.pixel]);
                let off = corrections.residual(piece, at, s.inverse) / (width * tolerance);
                let weight = s.weight / CORRELATED / (1.0 + off * off) / (tolerance * tolerance);
                let g = [at / s.inverse, unit / s.inverse];
                let wanted = 1.0 - at / s.inverse;
                for (slot, v) in
                    system.diagonal[piece].iter_mut().zip([g[0] * g[0], g[0] * g[1], g[1] * g[1]])
                {
                    *slot += weight * v;
                }
                (0..2).for_each(|c| rhs[piece][c] += weight * wanted * g[c]);
            }
            corrections.per_piece = system.solve(&rhs);
            couplings = system.couplings;
        }
        corrections
    }

    /// Relative residual of the corrected prior.
    fn residual(&self, piece: usize, rough: f64, inverse: f64) -> f64 {
        let [u, v] = self.per_piece[piece];
        ((1.0 + u) * rough + v * self.unit - inverse) / inverse
    }

    fn applied(
        &self,
        rough: &[f32],
        pieces: &Pieces,
        samples: &[Sample],
        (width, height): (usize, usize),
        tolerance: f64,
    ) -> Aligned {
        let mut errors: Vec<Vec<f64>> = vec![Vec::new(); pieces.count];
        for s in samples {
            let piece = pieces.of[s.pixel] as usize;
            errors[piece].push(self.residual(piece, f64::from(rough[s.pixel]), s.inverse).abs());
        }
        let mut all: Vec<f64> = errors.iter().flatten().copied().collect();
        // 1.4826 × the median absolute error is σ of a normal distribution.
        let overall = (1.4826 * crate::math::median(&mut all).unwrap_or(0.0)).max(0.5 * tolerance);
        let limit = OUTLIER * overall.max(tolerance);
        let wrong: Vec<bool> = errors
            .iter()
            .map(|e| {
                let agree = e.iter().filter(|e| **e < limit).count() as f64;
                has_evidence(e) && agree < LEAST_AGREEMENT * e.len() as f64
            })
            .collect();
        let hops = hops(pieces, &errors.iter().map(|e| has_evidence(e)).collect::<Vec<_>>());
        let deviation: Vec<f32> = (0..pieces.count)
            .map(|piece| {
                let own = match has_evidence(&errors[piece]) {
                    true => 1.4826 * crate::math::median(&mut errors[piece]).unwrap_or(overall),
                    false => overall,
                };
                own.max(0.5 * overall).hypot(CHANGE * f64::from(hops[piece])) as f32
            })
            .collect();
        let radius = (width as f32 * 0.5 * super::pieces::SIDE_SHARE) as usize;
        let field = |c: usize| {
            let value =
                |&p: &u32| if p == NO_PIECE { f32::NAN } else { self.per_piece[p as usize][c] as f32 };
            box_filtered(&pieces.of.iter().map(value).collect::<Vec<_>>(), width, height, radius)
        };
        let (u, v) = (field(0), field(1));
        let mut out =
            Aligned { inverse: vec![0.0; rough.len()], deviation: vec![0.0; rough.len()], contradicted: 0.0 };
        let (mut known, mut rejected) = (0.0f32, 0.0f32);
        for (k, &piece) in pieces.of.iter().enumerate().filter(|(_, p)| **p != NO_PIECE) {
            known += 1.0;
            if wrong[piece as usize] {
                rejected += 1.0;
                continue;
            }
            let value = (1.0 + u[k]) * rough[k] + v[k] * self.unit as f32;
            if value > 0.0 {
                out.inverse[k] = value;
                out.deviation[k] = deviation[piece as usize];
            }
        }
        out.contradicted = rejected / known.max(1.0);
        out
    }
}

/// True if a piece with these errors has enough independent measurements.
fn has_evidence(errors: &[f64]) -> bool {
    errors.len() as f64 >= MIN_EVIDENCE * CORRELATED
}

/// Distance to the nearest piece with evidence, in pieces.
fn hops(pieces: &Pieces, evidence: &[bool]) -> Vec<u32> {
    let mut hops: Vec<u32> = evidence.iter().map(|&e| if e { 0 } else { u32::MAX }).collect();
    // At the width of the image and beyond, the global fit is as good.
    let farthest = (1.0 / super::pieces::SIDE_SHARE) as u32;
    for far in 0..farthest {
        for &(a, b, _) in &pieces.borders {
            for (from, to) in [(a as usize, b as usize), (b as usize, a as usize)] {
                if hops[from] == far && hops[to] > far + 1 {
                    hops[to] = far + 1;
                }
            }
        }
    }
    hops.into_iter().map(|h| h.min(farthest)).collect()
}

/// Box filter over known values within `radius`, by rows and columns, against visible seams.
fn box_filtered(values: &[f32], width: usize, height: usize, radius: usize) -> Vec<f32> {
    let start: Vec<(f64, f64)> =
        values.iter().map(|v| if v.is_nan() { (0.0, 0.0) } else { (f64::from(*v), 1.0) }).collect();
    let rows = line_sums(&start, |y, x| y * width + x, height, width, radius);
    let both = line_sums(&rows, |x, y| y * width + x, width, height, radius);
    both.into_iter().map(|(sum, n)| if n > 0.0 { (sum / n) as f32 } else { 0.0 }).collect()
}

/// Sums of values and counts over `radius` on either side; `index` takes line and pixel.
fn line_sums(
    from: &[(f64, f64)],
    index: impl Fn(usize, usize) -> usize,
    lines: usize,
    length: usize,
    radius: usize,
) -> Vec<(f64, f64)> {
    let mut out = vec![(0.0, 0.0); from.len()];
    for line in 0..lines {
        let mut sums = vec![(0.0, 0.0)];
        for k in 0..length {
            let (last, next) = (sums[k], from[index(line, k)]);
            sums.push((last.0 + next.0, last.1 + next.1));
        }
        for k in 0..length {
            let (a, b) = (sums[k.saturating_sub(radius)], sums[(k + radius + 1).min(length)]);
            out[index(line, k)] = (b.0 - a.0, b.1 - a.1);
        }
    }
    out
}
