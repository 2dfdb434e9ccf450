//! XFeat keypoints and descriptors (Potje et al., CVPR 2024).
use rayon::prelude::*;

use super::registry::{PackFileKind, Registry};
use super::runtime::{Input, Session};
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};

/// Length of a descriptor.
pub const DIM: usize = 64;
/// Side of the square of pixels that one cell of the network's maps covers.
const CELL: usize = 8;
/// Input sides are multiples of this: the network halves the image five times.
const MULTIPLE: usize = 32;
/// Least keypoint probability, as published with the weights.
const THRESHOLD: f32 = 0.05;

/// Keypoints of one image, best first.
#[derive(Clone, Debug, Default)]
pub struct XFeatKeypoints {
    /// [N] continuous (u, v) pixels of the input image; the centre of the first pixel is (0.5,
    /// 0.5).
    pub keypoints: Vec<[f32; 2]>,
    /// [N] keypoint probability × reliability, in (0, 1].
    pub scores: Vec<f32>,
    /// [N, 64] unit vectors.
    pub descriptors: Vec<f32>,
}

impl XFeatKeypoints {
    /// Descriptor `i`.
    pub fn descriptor(&self, i: usize) -> &[f32] {
        &self.descriptors[i * DIM..(i + 1) * DIM]
    }

    /// Pairs (index here, index in `other`, cosine) that are each other's best match, with cosine ≥
    /// `min_cosine`.
    pub fn mutual_matches(&self, other: &XFeatKeypoints, min_cosine: f32) -> Vec<(usize, usize, f32)> {
        let forward = best_matches(&self.descriptors, &other.descriptors);
        let backward = best_matches(&other.descriptors, &self.descriptors);
        let mutual = forward.into_iter().enumerate().filter_map(|(i, best)| {
            let (j, cosine) = best?;
            let back = backward[j].is_some_and(|(k, _)| k == i);
            (back && cosine >= min_cosine).then_some((i, j, cosine))
        });
        mutual.collect()
    }
}

/// For each row of `a` [N, 64] the row of `b` [M, 64] with the largest dot product.
fn best_matches(a: &[f32], b: &[f32]) -> Vec<Option<(usize, f32)>> {
    a.par_chunks_exact(DIM).map(|x| best_match(x, b)).collect()
}

fn best_match(x: &[f32], b: &[f32]) -> Option<(usize, f32)> {
    let mut best: Option<(usize, f32)> = None;
    for (j, y) in b.chunks_exact(DIM).enumerate() {
        let dot = x.iter().zip(y).map(|(p, q)| p * q).sum::<f32>();
        if best.is_none_or(|(_, most)| dot > most) {
            best = Some((j, dot));
        }
    }
    best
}

/// Descriptors of every 8×8 cell.
#[derive(Clone, Debug, Default)]
pub struct DenseFeatures {
    /// Cells across.
    pub width: usize,
    /// Cells down.
    pub height: usize,
    /// [height, width, 64] unit vectors.
    pub descriptors: Vec<f32>,
    /// Reliability of each cell, in (0, 1).
    pub reliability: Image<f32>,
    /// Input pixels per cell, across and down: cell (c, r) is centred at `((c + 0.5)·x, (r +
    /// 0.5)·y)`.
    pub pixels_per_cell: [f32; 2],
}

impl DenseFeatures {
    /// Unit descriptor at continuous input pixel (u, v), bicubic between cells.
    pub fn sample(&self, u: f32, v: f32) -> [f32; DIM] {
        let (x, y) = (u / self.pixels_per_cell[0] - 0.5, v / self.pixels_per_cell[1] - 0.5);
        let (x0, y0) = (x.floor(), y.floor());
        let (wx, wy) = (cubic_weights(x - x0), cubic_weights(y - y0));
        let mut out = [0f32; DIM];
        for (j, &wy) in wy.iter().enumerate() {
            let row = (y0 as isize + j as isize - 1).clamp(0, self.height as isize - 1) as usize;
            for (i, &wx) in wx.iter().enumerate() {
                let column = (x0 as isize + i as isize - 1).clamp(0, self.width as isize - 1) as usize;
                let at = (row * self.width + column) * DIM;
                for (o, d) in out.iter_mut().zip(&self.descriptors[at..at + DIM]) {
                    *o += wx * wy * d;
                }
            }
        }
        normalise(&mut out);
        out
    }

    fn sample_reliability(&self, u: f32, v: f32) -> f32 {
        bilinear(&self.reliability, u / self.pixels_per_cell[0] - 0.5, v / self.pixels_per_cell[1] - 0.5)
    }
}

/// Weights of the four neighbours of a point `t` past the second one (Keys 1981, a = −0.75 as
/// torch's grid_sample).
fn cubic_weights(t: f32) -> [f32; 4] {
    let a = -0.75f32;
    let near = |d: f32| ((a + 2.0) * d - (a + 3.0)) * d * d + 1.0;
    let far = |d: f32| ((a * d - 5.0 * a) * d + 8.0 * a) * d - 4.0 * a;
    [far(1.0 + t), near(t), near(1.0 - t), far(2.0 - t)]
}

fn normalise(v: &mut [f32]) {
    let norm = v.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-12);
    v.iter_mut().for_each(|x| *x /= norm);
}

/// Value at index coordinates (x, y), clamped to the border.
fn bilinear(plane: &Image<f32>, x: f32, y: f32) -> f32 {
    let (x, y) = (x.clamp(0.0, (plane.width - 1) as f32), y.clamp(0.0, (plane.height - 1) as f32));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(plane.width - 1), (y0 + 1).min(plane.height - 1));
    let (fx, fy) = (x - x0 as f32, y - y0 as f32);
    let top = plane.at(x0, y0) * (1.0 - fx) + plane.at(x1, y0) * fx;
    let bottom = plane.at(x0, y1) * (1.0 - fx) + plane.at(x1, y1) * fx;
    top * (1.0 - fy) + bottom * fy
}

/// The loaded network.
pub struct XFeat {
    session: Session,
}

impl XFeat {
    /// Loads the network of the model pack.
    pub fn load(registry: &Registry) -> Result<Self> {
        Ok(XFeat { session: registry.session(PackFileKind::Keypoints)? })
    }

    /// At most `max_keypoints` keypoints, best first.
    pub fn detect(&mut self, image: &RgbImage, max_keypoints: usize) -> Result<XFeatKeypoints> {
        let (dense, heat) = self.forward(image)?;
        let scale = [dense.pixels_per_cell[0] / CELL as f32, dense.pixels_per_cell[1] / CELL as f32];
        let mut found: Vec<([f32; 2], f32)> = local_maxima(&heat)
            .into_iter()
            .map(|(x, y)| {
                let [sx, sy] = peak_offset(&heat, x, y);
                let at = [(x as f32 + 0.5 + sx) * scale[0], (y as f32 + 0.5 + sy) * scale[1]];
                (at, heat.at(x, y) * dense.sample_reliability(at[0], at[1]))
            })
            .filter(|(_, score)| *score > 0.0)
            .collect();
        found.sort_by(|a, b| b.1.total_cmp(&a.1));
        found.truncate(max_keypoints);
        let descriptors = found.par_iter().flat_map_iter(|(at, _)| dense.sample(at[0], at[1])).collect();
        let (keypoints, scores) = found.into_iter().unzip();
        Ok(XFeatKeypoints { keypoints, scores, descriptors })
    }

    /// A descriptor and a reliability for every 8×8 cell.
    pub fn dense(&mut self, image: &RgbImage) -> Result<DenseFeatures> {
        Ok(self.forward(image)?.0)
    }

    /// Dense features and the keypoint probability of every pixel of the resized image.
    fn forward(&mut self, image: &RgbImage) -> Result<(DenseFeatures, Image<f32>)> {
        if image.width == 0 || image.height == 0 {
            return Err(Error::input("the image has no pixels"));
        }
        let fit = |n: usize| (n / MULTIPLE * MULTIPLE).max(MULTIPLE);
        let (w, h) = (fit(image.width), fit(image.height));
        let grey = resized_grey(image, w, h);
        let outputs = self.session.run(
            vec![("image", Input::F32(vec![1, 1, h, w], grey))],
            &["descriptors", "keypoints", "reliability"],
        )?;
        let [descriptors, logits, reliability] = &outputs[..] else {
            return Err(Error::work("XFeat did not return its three maps"));
        };
        let (cw, ch) = (w / CELL, h / CELL);
        let cells = cw * ch;
        let mut by_cell = vec![0f32; cells * DIM];
        by_cell.par_chunks_exact_mut(DIM).enumerate().for_each(|(i, row)| {
            row.iter_mut().enumerate().for_each(|(c, value)| *value = descriptors.data[c * cells + i]);
            normalise(row);
        });
        let dense = DenseFeatures {
            width: cw,
            height: ch,
            descriptors: by_cell,
            reliability: Image { width: cw, height: ch, data: reliability.data.clone() },
            pixels_per_cell: [image.width as f32 / cw as f32, image.height as f32 / ch as f32],
        };
        Ok((dense, heatmap(&logits.data, cw, ch)))
    }
}

/// Mean of the channels, resized bilinearly (half-pixel centres; the sizes differ by less than 32
/// pixels).
fn resized_grey(image: &RgbImage, w: usize, h: usize) -> Vec<f32> {
    let data = image.data.iter().map(|c| (c[0] + c[1] + c[2]) / 3.0).collect();
    let grey = Image { width: image.width, height: image.height, data };
    if (w, h) == (image.width, image.height) {
        return grey.data;
    }
    let (sx, sy) = (image.width as f32 / w as f32, image.height as f32 / h as f32);
    let rows = (0..h).into_par_iter().flat_map_iter(|y| {
        let grey = &grey;
        (0..w).map(move |x| bilinear(grey, (x as f32 + 0.5) * sx - 0.5, (y as f32 + 0.5) * sy - 0.5))
    });
    rows.collect()
}

/// Keypoint probability per pixel from logits [65, ch, cw]: softmax over the 64 pixels of a cell
/// and "none".
fn heatmap(logits: &[f32], cw: usize, ch: usize) -> Image<f32> {
    let mut heat = Image::filled(cw * CELL, ch * CELL, 0f32);
    for cy in 0..ch {
        for cx in 0..cw {
            let logit = |c: usize| logits[(c * ch + cy) * cw + cx];
            let most = (0..=CELL * CELL).map(logit).fold(f32::MIN, f32::max);
            let total: f32 = (0..=CELL * CELL).map(|c| (logit(c) - most).exp()).sum();
            for c in 0..CELL * CELL {
                let at = (cy * CELL + c / CELL) * heat.width + cx * CELL + c % CELL;
                heat.data[at] = (logit(c) - most).exp() / total;
            }
        }
    }
    heat
}

/// Pixels above the threshold that are the maximum of their 5×5 window.
fn local_maxima(heat: &Image<f32>) -> Vec<(usize, usize)> {
    let rows = (0..heat.height).into_par_iter().flat_map_iter(|y| {
        (0..heat.width).filter_map(move |x| {
            let value = heat.at(x, y);
            let is_highest = || {
                (y.saturating_sub(2)..(y + 3).min(heat.height))
                    .all(|j| (x.saturating_sub(2)..(x + 3).min(heat.width)).all(|i| heat.at(i, j) <= value))
            };
            (value > THRESHOLD && is_highest()).then_some((x, y))
        })
    });
    rows.collect()
}

/// Sub-pixel position of a peak relative to its pixel: a parabola per axis through the logarithms.
fn peak_offset(heat: &Image<f32>, x: usize, y: usize) -> [f32; 2] {
    let log = |x: usize, y: usize| heat.at(x, y).max(1e-8).ln();
    let inside = x > 0 && y > 0 && x + 1 < heat.width && y + 1 < heat.height;
    if !inside {
        return [0.0, 0.0];
    }
    [
        parabola_peak(log(x - 1, y), log(x, y), log(x + 1, y)),
        parabola_peak(log(x, y - 1), log(x, y), log(x, y + 1)),
    ]
}

/// Offset of the maximum of the parabola through three values, at most half a pixel.
fn parabola_peak(before: f32, at: f32, after: f32) -> f32 {
    let curvature = before - 2.0 * at + after;
    if curvature < -1e-6 { (0.5 * (before - after) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;
    use splatvk_test_support::breakfast::{TestView, train_views};

    /// Distance in pixels of each match from its position by exact depth and cameras, without
    /// occluded points.
    fn errors(a: &TestView, b: &TestView, fa: &XFeatKeypoints, fb: &XFeatKeypoints) -> Vec<f64> {
        let error = |(i, j, _): (usize, usize, f32)| {
            let [u, v] = fa.keypoints[i];
            let depth = a.depth.at(u as usize, v as usize) as f64;
            let world = a.camera.unproject(DVec2::new(u as f64, v as f64), depth);
            let (p, z) = b.camera.project(world);
            let inside = depth > 0.0 && z > 0.0 && p.x >= 0.0 && p.y >= 0.0 && p.x < 640.0 && p.y < 480.0;
            // 2 % of depth is well above the 0.06 % to which the two maps agree and below any
            // occluder's distance.
            let seen = inside && (b.depth.at(p.x as usize, p.y as usize) as f64 - z).abs() < 0.02 * z;
            let [x, y] = fb.keypoints[j];
            seen.then(|| p.distance(DVec2::new(x as f64, y as f64)))
        };
        fa.mutual_matches(fb, 0.82).into_iter().filter_map(error).collect()
    }

    #[test]
    fn matches_agree_with_exact_depth() {
        let views = train_views();
        let mut net = XFeat::load(&Registry::open(None).unwrap()).unwrap();
        let features: Vec<_> = views.iter().map(|v| net.detect(&v.image, 4096).unwrap()).collect();
        for (i, a) in views.iter().enumerate() {
            for (j, b) in views.iter().enumerate().skip(i + 1) {
                let mut e = errors(a, b, &features[i], &features[j]);
                e.sort_by(f64::total_cmp);
                let share = e.iter().filter(|d| **d < 2.0).count() as f64 / e.len() as f64;
                println!(
                    "{i}-{j}: {} matches in both views' sight, {:.1} % within 2 px",
                    e.len(),
                    100.0 * share
                );
                // Measured: 319 to 1253 matches, 24 % (views 75° apart) to 38 % of them within 2
                // px; 53 % with a cosine of 0.9. Chance is 0.004 % (a disc of 2 px in 640 × 480).
                assert!(e.len() > 250 && share > 0.2, "views {i} and {j}: {} matches, {share}", e.len());
                // Sub-pixel peaks: 1.2 to 1.6 px among matches within 5 px; whole pixels give 1.35
                // to 1.8.
                let near = e.partition_point(|d| *d < 5.0);
                assert!(e[near / 2] < 1.75, "views {i} and {j}: median error {}", e[near / 2]);
            }
        }
    }
}
