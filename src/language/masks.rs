//! Masks of the photos.
use crate::scene::Plane;
use serde::{Deserialize, Serialize};

/// The label map of one level of one view.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct LevelMasks {
    /// [H, W] mask index, −1 = hole.
    pub labels: Plane<i32>,
    /// [M] quality weight of each mask (predicted IoU · stability; 1 when unknown).
    pub quality: Vec<f32>,
    /// [M, D] unit feature per mask, row-major; empty until region features ran.
    pub features: Vec<f32>,
    /// Label maps with every mask as it was found, in one of them, so that masks which overlap are in different ones; empty
    /// where `labels` has them whole, and once features are there.
    pub whole: Vec<Plane<i32>>,
}

impl LevelMasks {
    /// Leaves the pixels for which `keep(index)` holds; masks without any pixel left go.
    pub fn keep(&mut self, keep: impl Fn(usize) -> bool) {
        let maps = || std::iter::once(&self.labels).chain(&self.whole);
        let mut counts = vec![0usize; self.quality.len()];
        for map in maps() {
            let kept = map.data.iter().enumerate().filter(|(i, label)| **label >= 0 && keep(*i));
            kept.for_each(|(_, label)| counts[*label as usize] += 1);
        }
        let rows: Vec<usize> = (0..counts.len()).filter(|m| counts[*m] > 0).collect();
        let mut number = vec![-1i32; counts.len()];
        rows.iter().enumerate().for_each(|(new, old)| number[*old] = new as i32);
        for map in std::iter::once(&mut self.labels).chain(&mut self.whole) {
            for (i, label) in map.data.iter_mut().enumerate().filter(|(_, label)| **label >= 0) {
                *label = if keep(i) { number[*label as usize] } else { -1 };
            }
        }
        let dim = self.features.len() / self.quality.len().max(1);
        self.quality = rows.iter().map(|m| self.quality[*m]).collect();
        self.features = rows.iter().flat_map(|m| self.features[m * dim..(m + 1) * dim].to_vec()).collect();
    }
}

/// The masks of one view, index as in [`crate::scene::LEVEL_NAMES`].
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct ViewMasks {
    /// Three levels.
    pub levels: Vec<LevelMasks>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_without_used_pixels_go() {
        let mut masks = LevelMasks {
            labels: Plane { width: 5, height: 1, data: vec![0, 0, 1, 2, -1] },
            quality: vec![0.1, 0.2, 0.3],
            features: vec![1.0, 0.0, 0.0, 1.0, 0.6, 0.8],
            whole: Vec::new(),
        };
        masks.keep(|i| i != 0 && i != 2);
        assert_eq!(masks.labels.data, [-1, 0, -1, 1, -1]);
        assert_eq!((masks.quality, masks.features), (vec![0.1, 0.3], vec![1.0, 0.0, 0.6, 0.8]));
    }
}
