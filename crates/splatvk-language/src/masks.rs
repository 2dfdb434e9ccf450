//! Masks of the photos.
use crate::scene::Image;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The label map of one level of one view.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct LevelMasks {
    /// [H, W] mask index, −1 = hole.
    pub labels: Image<i32>,
    /// [M] quality weight of each mask (predicted IoU · stability; 1 when unknown).
    pub quality: Vec<f32>,
    /// [M, D] unit feature per mask, row-major; empty until region features ran.
    pub features: Vec<f32>,
    /// Label maps of the complete masks; overlapping masks are in different maps. Empty if `labels`
    /// shows every mask complete, and after features are computed.
    pub whole: Vec<Image<i32>>,
}

impl LevelMasks {
    /// Keeps the pixels for which `keep(index)` is true and removes masks that have no pixels then.
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

impl ViewMasks {
    /// Per label of `truth`, the IoU of its best mask on each level. Labels of fewer than `least`
    /// pixels are left out. The two may differ in size.
    pub fn best_ious(&self, truth: &Image<u32>, least: usize) -> BTreeMap<u32, [f64; 3]> {
        let mut sizes: BTreeMap<u32, usize> = BTreeMap::new();
        truth.data.iter().for_each(|&t| *sizes.entry(t).or_default() += 1);
        sizes.retain(|_, n| *n >= least);
        let mut best: BTreeMap<u32, [f64; 3]> = sizes.keys().map(|&t| (t, [0.0; 3])).collect();
        for (k, level) in self.levels.iter().enumerate().take(3) {
            let mut areas = vec![0usize; level.quality.len()];
            let mut shared: BTreeMap<(usize, u32), usize> = BTreeMap::new();
            for (p, &t) in truth.data.iter().enumerate() {
                let x = p % truth.width * level.labels.width / truth.width;
                let y = p / truth.width * level.labels.height / truth.height;
                if let Ok(mask) = usize::try_from(level.labels.data[y * level.labels.width + x]) {
                    areas[mask] += 1;
                    *shared.entry((mask, t)).or_default() += 1;
                }
            }
            for (&(mask, t), &both) in &shared {
                if let (Some(best), Some(size)) = (best.get_mut(&t), sizes.get(&t)) {
                    best[k] = best[k].max(both as f64 / (areas[mask] + size - both) as f64);
                }
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keep_removes_empty_masks() {
        let mut masks = LevelMasks {
            labels: Image { width: 5, height: 1, data: vec![0, 0, 1, 2, -1] },
            quality: vec![0.1, 0.2, 0.3],
            features: vec![1.0, 0.0, 0.0, 1.0, 0.6, 0.8],
            whole: Vec::new(),
        };
        masks.keep(|i| i != 0 && i != 2);
        assert_eq!(masks.labels.data, [-1, 0, -1, 1, -1]);
        assert_eq!((masks.quality, masks.features), (vec![0.1, 0.3], vec![1.0, 0.0, 0.6, 0.8]));
    }

    #[test]
    fn best_ious_ignore_size_and_specks() {
        // 20 x 20 truth: label 7 on the left 8 columns, label 9 on 4 pixels; masks at half the
        // size, left 5 columns and rest
        let mut truth = Image::filled(20, 20, 0u32);
        let mut labels = Image::filled(10, 10, 1i32);
        for y in 0..20 {
            for x in 0..8 {
                truth.data[y * 20 + x] = 7;
            }
            for x in 0..10 {
                labels.data[y / 2 * 10 + x / 2] = 0;
            }
        }
        truth.data[10..14].fill(9);
        let level = LevelMasks { labels, quality: vec![1.0; 2], ..Default::default() };
        let hole = LevelMasks { labels: Image::filled(10, 10, -1), ..Default::default() };
        let found = ViewMasks { levels: vec![level, hole] }.best_ious(&truth, 5);
        assert_eq!(found.keys().copied().collect::<Vec<_>>(), [0, 7]);
        assert_eq!(found[&7], [160.0 / 200.0, 0.0, 0.0]);
    }
}
