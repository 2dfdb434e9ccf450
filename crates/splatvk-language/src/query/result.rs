//! The answer to a query in one frame, with its images.
use super::maps::{CodeMaps, LevelMap};
use super::window::{AREA, Part, Table, blended, box_rows, whole};
use crate::scene::Image;
use rayon::prelude::*;
use std::sync::Arc;

/// Rows of one task of an image.
const BAND: usize = 96;

/// The answer to one query in one frame.
#[derive(Clone, Debug, Default)]
pub struct QueryResult {
    /// Chosen level, index as in [`crate::scene::LEVEL_NAMES`].
    pub level: usize,
    /// Column and row of the most relevant pixel.
    pub location: (usize, usize),
    /// Best unsmoothed relevancy of the frame at the chosen level.
    pub score: f32,
    /// Whether the score reaches [`super::QueryOptions::abs_threshold`].
    pub found: bool,
    /// Relevancy and mask.
    pub images: AnswerImages,
}

impl QueryResult {
    /// The answer of a value in 0..1 per pixel. The mask are the pixels with at least `bar`, the
    /// location is the maximum of the blended values (docs/internals/method.md#smoothing).
    pub fn of_values(values: Image<f32>, bar: f32) -> QueryResult {
        let (width, height) = (values.width, values.height);
        let mask = Image { width, height, data: values.data.iter().map(|v| *v >= bar).collect() };
        let mut best = (0, (0, 0));
        if width > 0 {
            let fill = |y: usize, x: usize, row: &mut [u32]| {
                row.iter_mut().zip(&values.data[y * width + x..]).for_each(|(out, v)| *out = whole(*v));
            };
            box_rows((width, height), &Part { x: 0..width, y: 0..height }, fill, |y, x, row, sums| {
                for (k, (v, s)) in row.iter().zip(sums).enumerate() {
                    let sum = AREA * v + s;
                    if sum > best.0 {
                        best = (sum, (x + k, y));
                    }
                }
            });
        }
        QueryResult {
            level: 0,
            location: best.1,
            score: values.data.iter().copied().fold(0.0, f32::max),
            found: mask.data.contains(&true),
            images: AnswerImages { values: Some(Arc::new(values)), ..AnswerImages::of_mask(mask) },
        }
    }

    /// Marks the text as not found and clears the mask; relevancy still shows the nearest codes.
    pub fn mark_not_found(&mut self) {
        self.found = false;
        self.images.mask = Mask::None;
    }

    /// [H, W] blended relevancy of the chosen level (docs/internals/method.md#smoothing), 0 where
    /// nothing is. Computed by each call.
    pub fn relevancy(&self) -> Image<f32> {
        self.images.relevancy()
    }

    /// [H, W] the mask. Computed by each call.
    pub fn mask(&self) -> Image<bool> {
        self.images.mask()
    }

    /// Number of pixels of the mask.
    pub fn mask_pixels(&self) -> usize {
        self.images.mask_pixels()
    }
}

/// Images of an answer. Most queries need few or none of them: they are computed from the code maps
/// when asked for.
#[derive(Clone, Debug, Default)]
pub struct AnswerImages {
    maps: Arc<CodeMaps>,
    level: usize,
    /// Relevancy of the codes of the level.
    table: Table,
    /// Given relevancy, which needs no codes.
    values: Option<Arc<Image<f32>>>,
    pub(super) mask: Mask,
}

/// The mask of an answer.
#[derive(Clone, Debug, Default)]
pub(super) enum Mask {
    /// Empty.
    #[default]
    None,
    /// The pixels of these codes, ascending.
    Codes(Vec<u16>),
    /// Given.
    Image(Arc<Image<bool>>),
}

impl AnswerImages {
    pub(super) fn new(maps: &Arc<CodeMaps>, level: usize, table: &Table, mask: Mask) -> AnswerImages {
        AnswerImages { maps: maps.clone(), level, table: table.clone(), values: None, mask }
    }

    /// Images with a given mask and no relevancy.
    pub fn of_mask(mask: Image<bool>) -> AnswerImages {
        let maps = CodeMaps { width: mask.width, height: mask.height, levels: Vec::new() };
        AnswerImages { maps: Arc::new(maps), mask: Mask::Image(Arc::new(mask)), ..AnswerImages::default() }
    }

    fn map(&self) -> Option<&LevelMap> {
        self.maps.levels.get(self.level)
    }

    /// The codes of the mask, ascending; `None` of a mask that is no set of codes.
    pub(super) fn mask_codes(&self) -> Option<&[u16]> {
        match &self.mask {
            Mask::None => Some(&[]),
            Mask::Codes(codes) => Some(codes),
            Mask::Image(_) => None,
        }
    }

    pub(super) fn relevancy(&self) -> Image<f32> {
        if let Some(values) = &self.values {
            return values.as_ref().clone();
        }
        let (width, height) = (self.maps.width, self.maps.height);
        let mut image = Image::filled(width, height, 0.0);
        let Some(map) = self.map().filter(|_| width > 0) else { return image };
        let fill = |y: usize, x: usize, row: &mut [u32]| self.table.gather(&map.codes[y * width + x..], row);
        image.data.par_chunks_mut(width * BAND).enumerate().for_each(|(band, out)| {
            let rows = band * BAND..band * BAND + out.len() / width;
            let part = Part { x: 0..width, y: rows.clone() };
            box_rows((width, height), &part, fill, |y, x, values, sums| {
                if rows.contains(&y) {
                    let row = &mut out[(y - rows.start) * width + x..][..values.len()];
                    let pairs = values.iter().zip(sums);
                    row.iter_mut().zip(pairs).for_each(|(o, (v, s))| *o = blended(AREA * v + s));
                }
            });
        });
        image
    }

    pub(super) fn mask(&self) -> Image<bool> {
        match &self.mask {
            Mask::Image(image) => image.as_ref().clone(),
            Mask::Codes(codes) => self.mask_of(codes),
            Mask::None => Image::filled(self.maps.width, self.maps.height, false),
        }
    }

    fn mask_of(&self, codes: &[u16]) -> Image<bool> {
        let (width, height) = (self.maps.width, self.maps.height);
        let mut chosen = vec![false; codes.last().map_or(1, |k| usize::from(*k) + 2)];
        codes.iter().for_each(|k| chosen[usize::from(*k)] = true);
        let last = chosen.len() - 1;
        let pixels = self.map().map_or(&[][..], |map| &map.codes);
        let data = pixels.par_iter().map(|k| chosen[usize::from(*k).min(last)]).collect();
        Image { width, height, data }
    }

    pub(super) fn mask_pixels(&self) -> usize {
        match &self.mask {
            Mask::None => 0,
            Mask::Codes(codes) => {
                let shown = self.map().map_or(&[][..], |map| &map.shown);
                shown.iter().filter(|s| codes.binary_search(&s.code).is_ok()).map(|s| s.pixels).sum()
            }
            Mask::Image(image) => image.data.iter().filter(|m| **m).count(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_values_masks_and_locates() {
        // A square of 20 pixels around (70, 30), and a brighter pixel far from it.
        let value = |x: usize, y: usize| match (x.abs_diff(70) <= 10 && y.abs_diff(30) <= 10, (x, y)) {
            (true, _) => 0.6,
            (_, (5, 5)) => 0.7,
            _ => 0.2,
        };
        let data = (0..100 * 60).map(|p| value(p % 100, p / 100)).collect();
        let values = Image { width: 100, height: 60, data };
        let answer = QueryResult::of_values(values.clone(), 0.5);
        assert_eq!((answer.found, answer.score, answer.mask_pixels()), (true, 0.7, 21 * 21 + 1));
        let (x, y) = answer.location;
        assert!(x.abs_diff(70) <= 6 && y.abs_diff(30) <= 6, "{x} {y}");
        assert_eq!(answer.relevancy(), values);
        let nothing = QueryResult::of_values(values, 0.95);
        assert!(!nothing.found && nothing.mask_pixels() == 0);
    }
}
