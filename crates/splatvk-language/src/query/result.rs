//! The answer to a query in one frame, with its images.
use super::maps::{CodeMaps, LevelMap};
use super::window::{AREA, Part, Table, blended, box_rows};
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
        AnswerImages { maps: maps.clone(), level, table: table.clone(), mask }
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
