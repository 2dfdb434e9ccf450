//! Steps B and C: a canonical depth map per view from all its pairs, and the focal lengths.
use crate::math::median;
use crate::scene::{Camera, ModelView, PairPointmaps, Pointmap};
use glam::{DVec2, DVec3};

/// Canonical pointmap of one view: mean over all its pairs in the scale of the reference pair.
#[derive(Clone, Debug, Default)]
pub(super) struct Canonical {
    /// [H, W] points in the view's own camera frame.
    pub(super) points: Vec<DVec3>,
    /// [H, W] `Σw²/Σw` of w = confidence − 1.
    pub(super) confidence: Vec<f64>,
    /// [H, W] weighted standard deviation of ln z between the pairs: uncertainty of the depth.
    pub(super) spread: Vec<f64>,
}

/// The pointmaps of a view in its own frame.
fn own_maps(pairs: &[PairPointmaps], view: usize) -> Vec<&Pointmap> {
    pairs
        .iter()
        .filter_map(|p| match view {
            v if v == p.first => Some(&p.x11),
            v if v == p.second => Some(&p.x22),
            _ => None,
        })
        .collect()
}

fn mean_confidence(m: &Pointmap) -> f64 {
    m.confidence.iter().map(|c| *c as f64).sum::<f64>() / m.confidence.len().max(1) as f64
}

pub(super) fn median_confidence(m: &Pointmap) -> Option<f64> {
    median(&mut m.confidence.iter().map(|c| *c as f64).collect::<Vec<_>>())
}

/// Scale from `map` to `reference`: median ratio of z over pixels above median confidence in both.
pub(super) fn scale_to(reference: &Pointmap, map: &Pointmap) -> Option<f64> {
    let (a, b) = (median_confidence(reference)?, median_confidence(map)?);
    let mut ratios: Vec<f64> = (0..map.points.len())
        .filter(|&k| reference.confidence[k] as f64 >= a && map.confidence[k] as f64 >= b)
        .filter(|&k| reference.points[k][2] > 0.0 && map.points[k][2] > 0.0)
        .map(|k| reference.points[k][2] as f64 / map.points[k][2] as f64)
        .collect();
    median(&mut ratios)
}

/// Canonical map of every view.
pub(super) fn canonical_maps(views: &[ModelView], pairs: &[PairPointmaps]) -> Vec<Canonical> {
    (0..views.len()).map(|v| canonical_map(views[v].width * views[v].height, &own_maps(pairs, v))).collect()
}

fn canonical_map(size: usize, maps: &[&Pointmap]) -> Canonical {
    let mut best: Option<(f64, &Pointmap)> = None;
    for m in maps {
        let mean = mean_confidence(m);
        if best.is_none_or(|b| mean > b.0) {
            best = Some((mean, m));
        }
    }
    let Some((_, reference)) = best else { return Canonical::default() };
    let scales: Vec<Option<f64>> = maps.iter().map(|m| scale_to(reference, m)).collect();
    let mut out = Canonical::default();
    for k in 0..size {
        let (mut sum, mut weight, mut squares) = (DVec3::ZERO, 0.0, 0.0);
        let (mut log, mut log2) = (0.0, 0.0);
        for (m, s) in maps.iter().zip(&scales) {
            let (Some(s), p) = (*s, m.point(k)) else { continue };
            if !(p.is_finite() && p.z > 0.0) {
                continue;
            }
            // Above zero, so that a pixel of lowest confidence in all pairs still has a depth.
            let w = (m.confidence[k] as f64 - 1.0).max(0.0) + 1e-3;
            let l = (p.z * s).ln();
            sum += p * (s * w);
            log += l * w;
            log2 += l * l * w;
            weight += w;
            squares += w * w;
        }
        if weight > 0.0 {
            out.points.push(sum / weight);
            out.confidence.push(squares / weight);
            out.spread.push((log2 / weight - (log / weight).powi(2)).max(0.0).sqrt());
        } else {
            out.points.push(DVec3::ZERO);
            out.confidence.push(0.0);
            out.spread.push(1.0);
        }
    }
    out
}

/// Focal lengths, shared by groups of views.
#[derive(Clone, Debug)]
pub(super) struct Focals {
    pub(super) group: Vec<usize>,
    /// Model pixels.
    pub(super) values: Vec<f64>,
    /// (ln f, σ) for the adjustment.
    pub(super) priors: Vec<(f64, f64)>,
}

impl Focals {
    /// Starts from the median focal lengths of a network's cameras; the priors stay.
    pub(super) fn starting_from(&self, cameras: &[Camera]) -> Focals {
        let group_median = |g: usize| {
            let members = cameras.iter().zip(&self.group).filter(|(_, own)| **own == g);
            median(&mut members.map(|(c, _)| (c.fx * c.fy).sqrt()).collect::<Vec<f64>>())
        };
        let values = self.values.iter().enumerate().map(|(g, f)| group_median(g).unwrap_or(*f)).collect();
        Focals { values, ..self.clone() }
    }

    pub(super) fn of(&self, view: usize) -> f64 {
        self.values[self.group[view]]
    }
}

/// Weiszfeld estimate of f, which minimises `Σ w |p − f·(x/z, y/z)|`, with the total weight.
pub(super) fn weiszfeld(view: &ModelView, c: &Canonical) -> Option<(f64, f64)> {
    let principal_point = view.centre();
    // Every third pixel in both axes still leaves tens of thousands of samples.
    let samples: Vec<FocalSample> = (0..c.points.len())
        .filter(|k| (k % view.width).is_multiple_of(3) && (k / view.width).is_multiple_of(3))
        .filter(|&k| c.points[k].z > 0.0)
        .map(|k| {
            let p =
                DVec2::new((k % view.width) as f64 + 0.5, (k / view.width) as f64 + 0.5) - principal_point;
            let x = c.points[k];
            FocalSample { pixel: p, direction: DVec2::new(x.x, x.y) / x.z, weight: c.confidence[k] }
        })
        .collect();
    let mut f = weighted_focal(&samples, |s| s.weight);
    for _ in 0..20 {
        f = weighted_focal(&samples, |s| s.weight / (s.pixel - s.direction * f).length().max(1e-8));
    }
    let total: f64 = samples.iter().map(|s| s.weight).sum();
    (f.is_finite() && f > 0.0).then_some((f, total))
}

/// Sample of [`weiszfeld`].
struct FocalSample {
    /// Pixel from the principal point.
    pixel: DVec2,
    /// (x, y) / z of its point.
    direction: DVec2,
    weight: f64,
}

/// Weighted least-squares focal length.
fn weighted_focal(samples: &[FocalSample], weight: impl Fn(&FocalSample) -> f64) -> f64 {
    let (mut a, mut b) = (0.0, 0.0);
    for s in samples {
        let w = weight(s);
        a += w * s.pixel.dot(s.direction);
        b += w * s.direction.length_squared();
    }
    a / b
}

/// Without EXIF, all views share a focal length if their estimates differ by less than this share.
const AGREEMENT: f64 = 0.15;

pub(super) fn focals(views: &[ModelView], canonical: &[Canonical]) -> Focals {
    let estimates: Vec<(f64, f64)> = views
        .iter()
        .zip(canonical)
        // 1.2 × the width (45°) for a view without points; the prior then decides.
        .map(|(v, c)| weiszfeld(v, c).unwrap_or((1.2 * v.width as f64, 1e-9)))
        .collect();
    let no_exif = views.iter().all(|v| v.exif_focal.is_none());
    let same_size = views.iter().all(|v| (v.width, v.height) == (views[0].width, views[0].height));
    let (low, high) = estimates.iter().fold((f64::MAX, 0f64), |m, e| (m.0.min(e.0), m.1.max(e.0)));
    let share_all = no_exif && same_size && high / low < 1.0 + AGREEMENT;
    let mut keys: Vec<usize> = Vec::new();
    let mut group = Vec::new();
    for v in views {
        let key = if share_all { 0 } else { v.camera_group };
        let g = keys.iter().position(|k| *k == key).unwrap_or_else(|| {
            keys.push(key);
            keys.len() - 1
        });
        group.push(g);
    }
    let (mut values, mut priors) = (Vec::new(), Vec::new());
    for g in 0..keys.len() {
        let members: Vec<usize> = (0..views.len()).filter(|v| group[*v] == g).collect();
        let mut exif: Vec<f64> = members.iter().filter_map(|v| views[*v].exif_focal).collect();
        match median(&mut exif) {
            Some(f) => {
                values.push(f);
                priors.push((f.ln(), 0.05));
            }
            None => {
                let f = weighted_median(members.iter().map(|v| estimates[*v]).collect());
                values.push(f);
                priors.push((f.ln(), 0.10));
            }
        }
    }
    Focals { group, values, priors }
}

fn weighted_median(mut values: Vec<(f64, f64)>) -> f64 {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = 0.5 * values.iter().map(|v| v.1).sum::<f64>();
    let mut sum = 0.0;
    for v in &values {
        sum += v.1;
        if sum >= half {
            return v.0;
        }
    }
    values.last().map_or(1.0, |v| v.0)
}
