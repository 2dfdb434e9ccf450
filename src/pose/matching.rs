//! Keypoint features, their matches between two photos, and the parts of photos that cannot hold features.
use crate::photo::PlainBorder;
use crate::scene::{Plane, RgbImage};
use glam::DVec2;
use rayon::prelude::*;

/// Keypoints with unit descriptors of one photo.
#[derive(Clone, Debug, Default)]
pub struct Keypoints {
    /// Pixel positions (centre of the first pixel 0.5).
    pub points: Vec<DVec2>,
    /// Descriptor length.
    pub dim: usize,
    /// [N, dim] unit rows.
    pub descriptors: Vec<f32>,
}

impl From<crate::infer::xfeat::XFeatKeypoints> for Keypoints {
    fn from(f: crate::infer::xfeat::XFeatKeypoints) -> Keypoints {
        Keypoints {
            points: f.keypoints.iter().map(|k| DVec2::new(k[0] as f64, k[1] as f64)).collect(),
            dim: crate::infer::xfeat::DIM,
            descriptors: f.descriptors,
        }
    }
}

/// A putative match, better ones have a higher quality.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Match {
    pub(crate) first: usize,
    pub(crate) second: usize,
    pub(crate) quality: f64,
}

/// Best and second-best similarity of each row of `a` among the rows of `b`.
fn nearest(a: &Keypoints, b: &Keypoints) -> Vec<(usize, f32, f32)> {
    let d = a.dim;
    a.descriptors
        .par_chunks(d.max(1))
        .map(|row| {
            let (mut index, mut best, mut second) = (0, f32::NEG_INFINITY, f32::NEG_INFINITY);
            for (k, other) in b.descriptors.chunks_exact(d).enumerate() {
                let mut lanes = [0f32; 8];
                for (x, y) in row.chunks_exact(8).zip(other.chunks_exact(8)) {
                    for l in 0..8 {
                        lanes[l] += x[l] * y[l];
                    }
                }
                let s: f32 = lanes.iter().sum();
                if s > best {
                    // The same corner may be listed twice (two orientations): it must not spoil its own ratio.
                    if best > f32::NEG_INFINITY && (b.points[k] - b.points[index]).length() > 2.0 {
                        second = best;
                    }
                    (index, best) = (k, s);
                } else if s > second && (b.points[k] - b.points[index]).length() > 2.0 {
                    second = s;
                }
            }
            (index, best, second)
        })
        .collect()
}

/// Mutual nearest neighbours whose distance is below `ratio` of the distance to the second-best elsewhere, best first.
/// Descriptor lengths must be multiples of 8 and equal; otherwise there are no matches.
pub(crate) fn mutual_matches(a: &Keypoints, b: &Keypoints, ratio: f32) -> Vec<Match> {
    if a.dim != b.dim || !a.dim.is_multiple_of(8) || a.points.is_empty() || b.points.is_empty() {
        return Vec::new();
    }
    let (forward, backward) = (nearest(a, b), nearest(b, a));
    let mut out: Vec<Match> = forward
        .iter()
        .enumerate()
        .filter(|(i, m)| backward[m.0].0 == *i)
        .filter_map(|(i, m)| {
            // |a − b|² = 2 − 2 a·b for unit vectors.
            let distance = |s: f32| (2.0 - 2.0 * s.min(1.0)).max(0.0).sqrt();
            let (d1, d2) = (distance(m.1), distance(m.2.max(backward[m.0].2).max(-1.0)));
            (d1 < ratio * d2).then(|| Match {
                first: i,
                second: m.0,
                quality: 1.0 - (d1 / d2.max(1e-6)) as f64,
            })
        })
        .collect();
    out.sort_by(|x, y| y.quality.total_cmp(&x.quality).then(x.first.cmp(&y.first)));
    out
}

/// True where features may lie: away from the image edge, from a border that was found on loading and from uniform
/// saturated margins (undistorted or scanned photos have white or black borders; their outline does not move with the
/// scene and would pass for a match).
pub(crate) fn valid_area(image: &RgbImage, border: PlainBorder, margin: usize) -> Plane<bool> {
    let (w, h) = (image.width, image.height);
    let mut excluded: Vec<bool> = (0..w * h).map(|i| border.covers(i % w, i / w, w, h)).collect();
    for white in [true, false] {
        let saturated = |i: usize| {
            let c = image.data[i];
            // JPEG and resampling leave a few grey levels of ringing on a saturated border.
            if white { c.iter().all(|v| *v > 0.97) } else { c.iter().all(|v| *v < 0.012) }
        };
        let mut seen = vec![false; w * h];
        let mut stack: Vec<usize> = (0..w)
            .flat_map(|x| [x, (h - 1) * w + x])
            .chain((0..h).flat_map(|y| [y * w, y * w + w - 1]))
            .filter(|i| saturated(*i))
            .collect();
        let touching = stack.len();
        while let Some(i) = stack.pop() {
            if seen[i] || !saturated(i) {
                continue;
            }
            seen[i] = true;
            let (x, y) = (i % w, i / w);
            if x > 0 {
                stack.push(i - 1);
            }
            if x + 1 < w {
                stack.push(i + 1);
            }
            if y > 0 {
                stack.push(i - w);
            }
            if y + 1 < h {
                stack.push(i + w);
            }
        }
        // A border touches a good part of the outline; an overexposed window at the edge touches less.
        if touching * 5 > 2 * (w + h) {
            excluded.iter_mut().zip(&seen).for_each(|(b, s)| *b |= s);
        }
    }
    let blocked = Plane { width: w, height: h, data: excluded };
    let near = dilated(&blocked, 2 * margin);
    let data = (0..w * h)
        .map(|i| {
            let (x, y) = (i % w, i / w);
            !near.data[i] && x >= margin && y >= margin && x + margin < w && y + margin < h
        })
        .collect();
    Plane { width: w, height: h, data }
}

/// Pixels within `radius` (square) of a set pixel.
fn dilated(p: &Plane<bool>, radius: usize) -> Plane<bool> {
    let (w, h) = (p.width, p.height);
    let spread = |n: usize, stride: usize, start: usize, source: &[bool], out: &mut [bool]| {
        let mut last: Option<usize> = None;
        for k in 0..n {
            if source[start + k * stride] {
                last = Some(k);
            }
            out[start + k * stride] |= last.is_some_and(|l| k - l <= radius);
        }
        let mut last: Option<usize> = None;
        for k in (0..n).rev() {
            if source[start + k * stride] {
                last = Some(k);
            }
            out[start + k * stride] |= last.is_some_and(|l| l - k <= radius);
        }
    };
    let mut across = vec![false; w * h];
    for y in 0..h {
        spread(w, 1, y * w, &p.data, &mut across);
    }
    let mut out = vec![false; w * h];
    for x in 0..w {
        spread(h, w, x, &across, &mut out);
    }
    Plane { width: w, height: h, data: out }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_white_frame_is_masked_and_a_bright_window_is_not() {
        let mut image = RgbImage { width: 100, height: 80, data: vec![[0.4, 0.5, 0.6]; 8000] };
        for y in 30..40 {
            for x in 0..6 {
                image.data[y * 100 + x] = [1.0; 3];
            }
        }
        let open = valid_area(&image, PlainBorder::default(), 2);
        assert!(open.at(12, 35) && !open.at(1, 35) && open.at(3, 60));
        for y in 0..80 {
            for x in 0..100 {
                if x < 7 || y < 7 || x >= 93 || y >= 73 {
                    image.data[y * 100 + x] = [1.0; 3];
                }
            }
        }
        let framed = valid_area(&image, PlainBorder::default(), 2);
        assert!(!framed.at(9, 50) && framed.at(12, 50) && framed.at(50, 40) && !framed.at(50, 3));
    }

    #[test]
    fn ambiguous_descriptors_are_dropped_and_clear_ones_matched() {
        let unit = |k: usize| {
            let mut v = vec![0f32; 8];
            v[k] = 1.0;
            v
        };
        let at = |n: usize| (0..n).map(|k| DVec2::new(10.0 * k as f64, 0.0)).collect::<Vec<_>>();
        let a = Keypoints { points: at(3), dim: 8, descriptors: [unit(0), unit(1), unit(2)].concat() };
        // Two copies of descriptor 1 far apart are ambiguous.
        let b =
            Keypoints { points: at(4), dim: 8, descriptors: [unit(2), unit(1), unit(1), unit(0)].concat() };
        let m: Vec<_> = mutual_matches(&a, &b, 0.9).iter().map(|m| (m.first, m.second)).collect();
        assert_eq!(m, [(0, 3), (2, 0)]);
    }
}
