//! Panoptic quality (Kirillov et al. 2019) without classes: segments of a picture match where
//! their IoU is above one half, which makes the match unique.
use splatvk::scene::Image;
use std::collections::BTreeMap;

/// IoU from which segments match.
const MATCH: f64 = 0.5;
/// Smallest segment that counts, as a share of the picture: smaller ones are mostly edges.
const LEAST: f64 = 0.001;

/// Matches of segments over pictures.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Panoptic {
    /// Sum of the IoU of matched segments.
    iou: f64,
    /// Matched segments.
    pub matched: usize,
    /// Segments that match none of the truth.
    pub extra: usize,
    /// Segments of the truth that none matches.
    pub missed: usize,
}

impl Panoptic {
    /// Adds a picture: segments of the prediction and of the truth, 0 = none. Pixels without truth do
    /// not count. `counts` decides by the share of the picture which segments count.
    pub fn add(&mut self, predicted: &Image<u32>, truth: &Image<u32>, counts: impl Fn(f64) -> bool) {
        let (mut found, mut known, mut both) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        for (p, t) in predicted.data.iter().zip(&truth.data).filter(|(_, t)| **t > 0) {
            *known.entry(*t).or_insert(0usize) += 1;
            if *p > 0 {
                *found.entry(*p).or_insert(0usize) += 1;
                *both.entry((*p, *t)).or_insert(0usize) += 1;
            }
        }
        let share = |size: usize| size as f64 / truth.data.len() as f64;
        let is_counted = |size: usize| share(size) >= LEAST && counts(share(size));
        let mut matches = BTreeMap::new();
        for ((p, t), common) in both {
            let iou = common as f64 / (found[&p] + known[&t] - common) as f64;
            if iou > MATCH {
                matches.insert(t, (p, iou));
            }
        }
        for (t, _) in known.into_iter().filter(|(_, size)| is_counted(*size)) {
            match matches.get(&t) {
                Some((_, iou)) => {
                    self.iou += iou;
                    self.matched += 1;
                }
                None => self.missed += 1,
            }
        }
        let is_matched = |p: u32| matches.values().any(|(own, _)| *own == p);
        self.extra += found.into_iter().filter(|(p, size)| is_counted(*size) && !is_matched(*p)).count();
    }

    /// Panoptic quality: segmentation quality times recognition quality; 0 without segments.
    pub fn quality(&self) -> f64 {
        self.segmentation() * self.recognition()
    }

    /// Mean IoU of matched segments.
    pub fn segmentation(&self) -> f64 {
        self.iou / self.matched.max(1) as f64
    }

    /// F1 of the matches.
    pub fn recognition(&self) -> f64 {
        let all = self.matched as f64 + 0.5 * (self.extra + self.missed) as f64;
        if all > 0.0 { self.matched as f64 / all } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(data: &[u32]) -> Image<u32> {
        Image { width: data.len(), height: 1, data: data.to_vec() }
    }

    #[test]
    fn segments_match_above_half_their_union() {
        let mut score = Panoptic::default();
        // 7 covers 3 of 4 pixels of 1; 8 covers 2 of the 5 of 2 and no match; 3 is missed; the last
        // pixels have no truth.
        let truth = row(&[1, 1, 1, 1, 2, 2, 2, 2, 2, 3, 0, 0]);
        let found = row(&[7, 7, 7, 0, 8, 8, 0, 0, 0, 0, 8, 9]);
        score.add(&found, &truth, |_| true);
        assert_eq!((score.matched, score.extra, score.missed), (1, 1, 2));
        assert!((score.segmentation() - 0.75).abs() < 1e-12);
        assert!((score.recognition() - 0.4).abs() < 1e-12);
        assert!((score.quality() - 0.3).abs() < 1e-12);
        // Only segments of at most two pixels: 3 is missed, and 8 is extra.
        let mut small = Panoptic::default();
        small.add(&found, &truth, |share| share < 0.2);
        assert_eq!((small.matched, small.extra, small.missed), (0, 1, 1));
        assert_eq!(Panoptic::default().quality(), 0.0);
    }
}
