//! Keypoints, descriptor matching, and the image area where keypoints may lie.
use crate::photo::PlainBorder;
use crate::scene::{Coverage, Image, RgbImage};
use glam::DVec2;
use nalgebra::{DMatrix, DMatrixView, DMatrixViewMut};
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

impl Keypoints {
    /// The first `count` keypoints.
    pub(crate) fn first(&self, count: usize) -> Keypoints {
        let count = count.min(self.points.len());
        Keypoints {
            points: self.points[..count].to_vec(),
            dim: self.dim,
            descriptors: self.descriptors[..count * self.dim].to_vec(),
        }
    }
}

/// Keypoint detector for images at working size, such as a network.
pub type Detect<'a> = dyn FnMut(&RgbImage) -> crate::Result<Keypoints> + 'a;

/// A putative match; a better one has a higher quality.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Match {
    pub(crate) first: usize,
    pub(crate) second: usize,
    pub(crate) quality: f64,
}

/// Nearest neighbour of a descriptor in the other photo, and the best similarity elsewhere in that
/// photo.
#[derive(Clone, Copy)]
struct Nearest {
    index: usize,
    best: f32,
    second: f32,
}

impl Nearest {
    const NONE: Nearest = Nearest { index: 0, best: f32::NEG_INFINITY, second: f32::NEG_INFINITY };

    /// Updates the neighbour with candidate `k` of `points`; candidates come in order.
    fn consider(&mut self, k: usize, similarity: f32, points: &[DVec2]) {
        // A corner that is listed twice (two orientations) must not spoil its own ratio.
        let elsewhere = |index: usize| (points[k] - points[index]).length() > 2.0;
        if similarity > self.best {
            if self.best > f32::NEG_INFINITY && elsewhere(self.index) {
                self.second = self.best;
            }
            (self.index, self.best) = (k, similarity);
        } else if similarity > self.second && elsewhere(self.index) {
            self.second = similarity;
        }
    }
}

/// Similarities [M, N] of the descriptors `rows`, [M, dim], to those of another photo, the rows of
/// an [N, dim] matrix.
fn similarities(rows: &[f32], others: &DMatrix<f32>, out: &mut [f32]) {
    let (n, dim) = others.shape();
    let m = rows.len() / dim;
    // nalgebra's matrices are column-major: a slice of rows is the transposed matrix.
    let rows = DMatrixView::from_slice(rows, dim, m);
    DMatrixViewMut::from_slice(out, n, m).gemm(1.0, others, &rows, 0.0);
}

/// Nearest neighbours of `a` in `b`, and of `b` in `a`. Similarities are computed once, for some
/// rows of `a` at a time.
fn nearest(a: &Keypoints, b: &Keypoints) -> (Vec<Nearest>, Vec<Nearest>) {
    // With 8,000 keypoints in `b` the similarities of this many take 8 MB.
    const ROWS: usize = 256;
    // Enough parts for every core, and each fits its L1 cache.
    const COLUMNS: usize = 512;
    // Rows of a task: enough work for a matrix product.
    const TASK: usize = 64;
    let (dim, columns) = (a.dim, b.points.len());
    let (mut forward, mut backward) = (vec![Nearest::NONE; a.points.len()], vec![Nearest::NONE; columns]);
    let others = DMatrix::from_row_slice(columns, dim, &b.descriptors);
    let mut block_similarities = vec![0f32; ROWS.min(a.points.len()) * columns];
    for (block, (found, rows)) in forward.chunks_mut(ROWS).zip(a.descriptors.chunks(ROWS * dim)).enumerate() {
        let block_similarities = &mut block_similarities[..found.len() * columns];
        let outputs = block_similarities.par_chunks_mut(TASK * columns).zip(found.par_chunks_mut(TASK));
        outputs.zip(rows.par_chunks(TASK * dim)).for_each(|((out, found), rows)| {
            similarities(rows, &others, out);
            for (found, similarities) in found.iter_mut().zip(out.chunks_exact(columns)) {
                for (k, similarity) in similarities.iter().enumerate() {
                    found.consider(k, *similarity, &b.points);
                }
            }
        });
        backward.par_chunks_mut(COLUMNS).enumerate().for_each(|(part, found)| {
            for (row, similarities) in block_similarities.chunks_exact(columns).enumerate() {
                let similarities = &similarities[part * COLUMNS..];
                for k in 0..found.len() {
                    found[k].consider(block * ROWS + row, similarities[k], &a.points);
                }
            }
        });
    }
    (forward, backward)
}

/// Mutual nearest neighbours whose distance is below `ratio` of the distance to the second-best
/// elsewhere, best first. Descriptors of unequal lengths have no matches.
pub(crate) fn mutual_matches(a: &Keypoints, b: &Keypoints, ratio: f32) -> Vec<Match> {
    if a.dim != b.dim || a.dim == 0 || a.points.is_empty() || b.points.is_empty() {
        return Vec::new();
    }
    let (forward, backward) = nearest(a, b);
    let mut out: Vec<Match> = forward
        .iter()
        .enumerate()
        .filter(|(i, m)| backward[m.index].index == *i)
        .filter_map(|(i, m)| {
            let second = m.second.max(backward[m.index].second).max(-1.0);
            let (d1, d2) = (descriptor_distance(m.best), descriptor_distance(second));
            (d1 < ratio * d2).then(|| Match {
                first: i,
                second: m.index,
                quality: 1.0 - (d1 / d2.max(1e-6)) as f64,
            })
        })
        .collect();
    out.sort_by(|x, y| y.quality.total_cmp(&x.quality).then(x.first.cmp(&y.first)));
    out
}

/// Distance of unit vectors from their dot product: |a − b|² = 2 − 2 a·b.
fn descriptor_distance(similarity: f32) -> f32 {
    (2.0 - 2.0 * similarity.min(1.0)).max(0.0).sqrt()
}

/// Mask of the pixels where keypoints may lie: `margin` pixels from the image edge, and away from
/// unused pixels, from `border` and from uniform saturated margins (undistorted or scanned photos
/// have white or black ones; their outline does not move with the scene and would match).
pub(crate) fn valid_area(
    image: &RgbImage,
    border: PlainBorder,
    coverage: Option<&Coverage>,
    margin: usize,
) -> Image<bool> {
    let (w, h) = (image.width, image.height);
    let unused = |i: usize| coverage.is_some_and(|c| !c.uses(i));
    let mut excluded: Vec<bool> =
        (0..w * h).map(|i| unused(i) || border.covers(i % w, i / w, w, h)).collect();
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
        // A border touches a good part of the outline; an overexposed window at the edge touches
        // less.
        if touching * 5 > 2 * (w + h) {
            excluded.iter_mut().zip(&seen).for_each(|(b, s)| *b |= s);
        }
    }
    let blocked = Image { width: w, height: h, data: excluded };
    let near = dilated(&blocked, 2 * margin);
    let data = (0..w * h)
        .map(|i| {
            let (x, y) = (i % w, i / w);
            !near.data[i] && x >= margin && y >= margin && x + margin < w && y + margin < h
        })
        .collect();
    Image { width: w, height: h, data }
}

/// Pixels within `radius` (square) of a set pixel.
fn dilated(p: &Image<bool>, radius: usize) -> Image<bool> {
    let (w, h) = (p.width, p.height);
    let mut across = vec![false; w * h];
    for y in 0..h {
        dilate_line(radius, y * w, 1, w, &p.data, &mut across);
    }
    let mut out = vec![false; w * h];
    for x in 0..w {
        dilate_line(radius, x, w, h, &across, &mut out);
    }
    Image { width: w, height: h, data: out }
}

/// Dilates one row or column of `n` pixels into `out`.
fn dilate_line(radius: usize, start: usize, stride: usize, n: usize, source: &[bool], out: &mut [bool]) {
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    /// `n` keypoints with unit descriptors at random positions, each third at that of the one
    /// before.
    fn random_keypoints(n: usize, seed: u64) -> Keypoints {
        let (mut random, dim) = (Random::new(seed), 16);
        let mut made = Keypoints { dim, ..Keypoints::default() };
        for k in 0..n {
            let place = DVec2::new(random.uniform(), random.uniform()) * 500.0;
            made.points.push(if k % 3 == 2 { made.points[k - 1] } else { place });
            let row: Vec<f32> = (0..dim).map(|_| random.uniform() as f32 - 0.5).collect();
            let length = row.iter().map(|v| v * v).sum::<f32>().sqrt();
            made.descriptors.extend(row.iter().map(|v| v / length));
        }
        made
    }

    #[test]
    fn nearest_equals_plain_search() {
        // More rows than a block, the last task of few rows; more columns than a part.
        let (a, b) = (random_keypoints(578, 1), random_keypoints(1100, 2));
        let plain = |from: &Keypoints, to: &Keypoints| -> Vec<(usize, f32)> {
            let rows = from.descriptors.chunks_exact(16);
            rows.map(|row| {
                let similarities: Vec<f32> = to
                    .descriptors
                    .chunks_exact(16)
                    .map(|o| row.iter().zip(o).map(|(x, y)| x * y).sum())
                    .collect();
                let best = (0..similarities.len())
                    .max_by(|i, k| similarities[*i].total_cmp(&similarities[*k]))
                    .unwrap();
                (best, similarities[best])
            })
            .collect()
        };
        let (forward, backward) = nearest(&a, &b);
        for (found, wanted) in [(forward, plain(&a, &b)), (backward, plain(&b, &a))] {
            assert_eq!(found.len(), wanted.len());
            for (f, w) in found.iter().zip(&wanted) {
                assert!(f.index == w.0 && (f.best - w.1).abs() < 1e-6, "{} {} {w:?}", f.index, f.best);
                assert!(f.second <= f.best && f.second > 0.0);
            }
        }
    }

    #[test]
    fn nearest_ignores_repeated_corner() {
        let mut found = Nearest::NONE;
        let points = [DVec2::ZERO, DVec2::new(50.0, 0.0), DVec2::new(50.5, 0.0)];
        for (k, similarity) in [0.2, 0.9, 0.8].into_iter().enumerate() {
            found.consider(k, similarity, &points);
        }
        assert_eq!((found.index, found.best, found.second), (1, 0.9, 0.2));
    }

    #[test]
    fn valid_area_masks_only_white_frames() {
        let mut image = RgbImage { width: 100, height: 80, data: vec![[0.4, 0.5, 0.6]; 8000] };
        for y in 30..40 {
            for x in 0..6 {
                image.data[y * 100 + x] = [1.0; 3];
            }
        }
        let open = valid_area(&image, PlainBorder::default(), None, 2);
        assert!(open.at(12, 35) && !open.at(1, 35) && open.at(3, 60));
        for y in 0..80 {
            for x in 0..100 {
                if x < 7 || y < 7 || x >= 93 || y >= 73 {
                    image.data[y * 100 + x] = [1.0; 3];
                }
            }
        }
        let framed = valid_area(&image, PlainBorder::default(), None, 2);
        assert!(!framed.at(9, 50) && framed.at(12, 50) && framed.at(50, 40) && !framed.at(50, 3));
    }

    #[test]
    fn mutual_matches_drop_ambiguous_descriptors() {
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

    #[test]
    fn valid_area_excludes_unused_pixels() {
        use crate::scene::Outside;
        let data = (0..60 * 40).map(|i| [0.3 + 0.4 * (i % 7) as f32 / 7.0; 3]).collect();
        let image = RgbImage { width: 60, height: 40, data };
        let share = (0..60 * 40).map(|i| if i % 60 < 30 { 1.0 } else { 0.0 }).collect();
        let coverage =
            Coverage { share: Image { width: 60, height: 40, data: share }, outside: Outside::Unknown };
        let open = valid_area(&image, PlainBorder::default(), Some(&coverage), 2);
        assert_eq!([25, 26, 29, 35].map(|x| open.at(x, 20)), [true, false, false, false]);
    }
}
