//! Class probabilities of an image region: EfficientNet-Lite0 (Tan 2020) on a crop of the region
//! without its surroundings.
use rayon::prelude::*;

use super::registry::{PackFileKind, Registry};
use super::runtime::{Input, Session};
use crate::progress::Progress;
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};

/// ImageNet classes.
pub const CLASSES: usize = 1000;
/// Side of the network's input, pixels.
const SIDE: usize = 224;
/// Background of a crop: the value that the network's normalisation maps to zero.
const GREY: f32 = 127.0 / 255.0;
/// Crops per forward pass.
const BATCH: usize = 8;

/// The loaded network.
pub struct Classifier {
    session: Session,
}

/// The bounding box of a region, in pixels, ends excluded.
#[derive(Clone, Copy)]
pub(super) struct Extent {
    x0: usize,
    y0: usize,
    x1: usize,
    y1: usize,
}

impl Classifier {
    /// Loads the network of the model pack.
    pub fn load(registry: &Registry) -> Result<Self> {
        Ok(Classifier { session: registry.session(PackFileKind::Classifier)? })
    }

    /// [count, 1000] class probabilities of the regions `0..count` of `labels`; a zero row for a
    /// region without pixels.
    ///
    /// A region is classified from one crop: the square around its bounding box with everything
    /// else grey. On breakfast (40 perfect masks, 840 Felzenszwalb segments, 416 masks of the graph
    /// segmentation) no alternative named more regions correctly: wider crops, blurred, white,
    /// black or dimmed surroundings, the mirrored crop, filled holes or a grown mask, averages of
    /// these, and the larger Lite1 and Lite2.
    pub fn regions(
        &mut self,
        image: &RgbImage,
        labels: &Image<i32>,
        count: usize,
        progress: &dyn Progress,
    ) -> Result<Vec<f32>> {
        if (labels.width, labels.height) != (image.width, image.height) {
            return Err(Error::input(format!(
                "label map is {}×{} but its image is {}×{}",
                labels.width, labels.height, image.width, image.height
            )));
        }
        let present: Vec<(usize, Extent)> =
            extents(labels, count).into_iter().enumerate().filter_map(|(i, e)| Some((i, e?))).collect();
        let mut all = vec![0f32; count * CLASSES];
        for batch in present.chunks(BATCH) {
            progress.check()?;
            let crops: Vec<f32> = batch
                .par_iter()
                .flat_map_iter(|(i, e)| crop(image, labels, *i as i32, *e, SIDE, GREY))
                .collect();
            let input = Input::F32(vec![batch.len(), 3, SIDE, SIDE], crops);
            let output = self.session.run(vec![("image", input)], &["logits"])?;
            let logits = output.first().map(|t| &t.data[..]).unwrap_or_default();
            for ((i, _), row) in batch.iter().zip(logits.chunks_exact(CLASSES)) {
                all[i * CLASSES..(i + 1) * CLASSES].copy_from_slice(&softmax(row));
            }
        }
        Ok(all)
    }
}

fn softmax(logits: &[f32]) -> Vec<f32> {
    let most = logits.iter().copied().fold(f32::MIN, f32::max);
    let powers: Vec<f32> = logits.iter().map(|l| (l - most).exp()).collect();
    let total: f32 = powers.iter().sum();
    powers.into_iter().map(|p| p / total).collect()
}

/// The boxes of the regions `0..count`; `None` for one without pixels.
pub(super) fn extents(labels: &Image<i32>, count: usize) -> Vec<Option<Extent>> {
    let mut found: Vec<Option<Extent>> = vec![None; count];
    for y in 0..labels.height {
        for x in 0..labels.width {
            let label = labels.at(x, y);
            if label >= 0 && (label as usize) < count {
                let e = found[label as usize].get_or_insert(Extent { x0: x, y0: y, x1: x + 1, y1: y + 1 });
                *e = Extent { x0: e.x0.min(x), y0: e.y0, x1: e.x1.max(x + 1), y1: y + 1 };
            }
        }
    }
    found
}

/// The region in the centre of a uniform square, resized to the network's input, [3, to, to] in [0,
/// 1].
pub(super) fn crop(
    image: &RgbImage,
    labels: &Image<i32>,
    label: i32,
    e: Extent,
    to: usize,
    around: f32,
) -> Vec<f32> {
    let side = (e.x1 - e.x0).max(e.y1 - e.y0);
    let left = (e.x0 + e.x1) as f32 / 2.0 - side as f32 / 2.0;
    let top = (e.y0 + e.y1) as f32 / 2.0 - side as f32 / 2.0;
    let columns = taps(left, side, to, e.x0, e.x1);
    let rows = taps(top, side, to, e.y0, e.y1);
    // Separable: first along x for every source row of the box, then along y.
    let mut by_column = vec![[0f32; 3]; (e.y1 - e.y0) * to];
    for y in e.y0..e.y1 {
        for (x, (start, weights)) in columns.iter().enumerate() {
            let out = &mut by_column[(y - e.y0) * to + x];
            for (k, w) in weights.iter().enumerate() {
                if labels.at(start + k, y) == label {
                    let c = image.at(start + k, y);
                    // Relative to the background, so that omitted pixels count as background.
                    (0..3).for_each(|i| out[i] += w * (c[i] - around));
                }
            }
        }
    }
    let mut planes = vec![around; 3 * to * to];
    for (y, (start, weights)) in rows.iter().enumerate() {
        for x in 0..to {
            for (k, w) in weights.iter().enumerate() {
                let c = by_column[(start + k - e.y0) * to + x];
                (0..3).for_each(|i| planes[(i * to + y) * to + x] += w * c[i]);
            }
        }
    }
    planes
}

/// For each output pixel of one axis: the first source pixel and the weights from there on. A
/// triangle as wide as the reduction (at least one source pixel to each side), cut to the source
/// range `from..to`.
fn taps(start: f32, side: usize, pixels: usize, from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = side as f32 / pixels as f32;
    let reach = scale.max(1.0);
    let taps = (0..pixels).map(|i| {
        let centre = start + (i as f32 + 0.5) * scale;
        let first = ((centre - reach - 0.5).ceil().max(0.0) as usize).clamp(from, to);
        let last = ((centre + reach - 0.5).floor().max(-1.0) + 1.0) as usize;
        let weight = |j: usize| (1.0 - ((j as f32 + 0.5) - centre).abs() / reach).max(0.0) / reach;
        (first, (first..last.clamp(first, to)).map(weight).collect())
    });
    taps.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crop_centres_region_on_grey() {
        let (width, height) = (40, 30);
        let mut image = RgbImage { width, height, data: vec![[1.0, 0.0, 0.0]; width * height] };
        let mut labels = Image::filled(width, height, -1);
        for y in 10..14 {
            for x in 5..25 {
                labels.data[y * width + x] = 2;
                image.data[y * width + x] = [0.2, 0.4, 0.6];
            }
        }
        let e = extents(&labels, 3)[2].unwrap();
        assert_eq!((e.x0, e.y0, e.x1, e.y1), (5, 10, 25, 14));
        assert!(extents(&labels, 3)[0].is_none() && extents(&labels, 2).iter().all(Option::is_none));
        let planes = crop(&image, &labels, 2, e, SIDE, GREY);
        let value = |c: usize, x: usize, y: usize| planes[(c * SIDE + y) * SIDE + x];
        for (c, want) in [0.2, 0.4, 0.6].into_iter().enumerate() {
            assert!((value(c, 112, 112) - want).abs() < 1e-4, "{}", value(c, 112, 112));
            assert!((value(c, 112, 30) - GREY).abs() < 1e-6 && (value(c, 112, 200) - GREY).abs() < 1e-6);
        }
        // The region fills a fifth of the square: its share of the green plane's departure from
        // grey is that fifth.
        let sum: f32 = (0..SIDE * SIDE).map(|i| planes[SIDE * SIDE + i] - GREY).sum();
        let want = (0.4 - GREY) * (SIDE * SIDE) as f32 / 5.0;
        assert!((sum / want - 1.0).abs() < 0.02, "{sum} {want}");
    }

    #[test]
    fn taps_sum_to_one_inside() {
        for (side, from, to) in [(1000, 0, 1000), (224, 0, 224), (60, 0, 60)] {
            let all = taps(0.0, side, SIDE, from, to);
            for (_, weights) in &all[20..200] {
                assert!((weights.iter().sum::<f32>() - 1.0).abs() < 0.02, "{side}: {weights:?}");
            }
        }
    }
}
