//! Answers in frames: level, score and location from prepared code maps.
use super::maps::{CodeMaps, LevelMap};
use super::result::{AnswerImages, Mask, QueryResult};
use super::score::margin;
pub use super::window::Table;
use super::window::{AREA, Part, blended, box_rows};
use super::{
    CanonicalCosines, MaskRule, QueryOptions, TextQuery, coarsest_good, code_bar, filter, first_best,
};
use crate::scene::{Image, LanguageField};
use crate::{Error, Result};
use rayon::prelude::*;
use std::sync::Arc;

/// Fewest rows of a band: the box reads 29 rows besides its own.
const LEAST_ROWS: usize = 60;

/// A level of a frame in a query of [`MaskRule::Codes`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LevelPeaks {
    /// Largest sum of 900 times the excess of a pixel and of its box.
    pub peak: u32,
    /// Pixel with the largest relevancy of all levels in its box, of those whose code answers, or
    /// of all if none does.
    pub location: usize,
}

/// Finds the peaks of all levels of frames at once: a device that keeps the maps of the frames.
pub trait FrameSearch {
    /// Per frame and level the peaks of a query: relevancy per level, and the shown codes that answer
    /// per frame and level, ascending. A level without codes has an empty table and default peaks.
    fn search(&mut self, tables: &[Table], answering: &[Vec<Vec<u16>>]) -> Result<Vec<Vec<LevelPeaks>>>;
}

/// [`FrameSearch`] on the processor.
pub struct HostSearch<'a>(pub &'a [Arc<CodeMaps>]);

impl FrameSearch for HostSearch<'_> {
    fn search(&mut self, tables: &[Table], answering: &[Vec<Vec<u16>>]) -> Result<Vec<Vec<LevelPeaks>>> {
        let frame = |(maps, answering): (&Arc<CodeMaps>, &Vec<Vec<u16>>)| {
            let level = |(level, codes): (usize, &Vec<u16>)| LevelPeaks {
                peak: peak(maps, level, &tables[level].excess(), 1),
                location: locate_codes(maps, tables, level, codes, 1),
            };
            answering.par_iter().enumerate().map(level).collect()
        };
        Ok(self.0.par_iter().zip(answering).map(frame).collect())
    }
}

/// Relevancy per pixel of a decoded map; void pixels (−1) get 0.
pub fn relevancy_map(codes: &Image<i32>, relevancy: &[f32]) -> Image<f32> {
    let value = |&k: &i32| usize::try_from(k).ok().and_then(|k| relevancy.get(k)).copied().unwrap_or(0.0);
    Image { width: codes.width, height: codes.height, data: codes.data.par_iter().map(value).collect() }
}

/// Answers a query in one frame. `codes` holds the frame's decoded map per level; levels without
/// codes are skipped.
pub fn answer(
    codes: &[Image<i32>],
    field: &LanguageField,
    query: &TextQuery,
    options: &QueryOptions,
) -> Result<QueryResult> {
    let cosines = CanonicalCosines::new(field, &query.canonicals);
    answer_with(codes, &cosines.relevancy(field, query, options)?, options)
}

/// [`answer`] with the relevancy of every code per level ([`CanonicalCosines::relevancy`]).
pub fn answer_with(
    codes: &[Image<i32>],
    relevancy: &[Vec<f32>],
    options: &QueryOptions,
) -> Result<QueryResult> {
    let frame = [Arc::new(CodeMaps::new(codes)?)];
    answer_all(&frame, relevancy, options, None)?.pop().ok_or_else(no_level)
}

fn no_level() -> Error {
    Error::work("the scene has no language level to query")
}

/// [`answer_with`] in several prepared frames. `search` has the maps of these frames; the processor
/// finds the peaks without one, and always those of [`MaskRule::Lerf`].
pub fn answer_all(
    frames: &[Arc<CodeMaps>],
    relevancy: &[Vec<f32>],
    options: &QueryOptions,
    search: Option<&mut dyn FrameSearch>,
) -> Result<Vec<QueryResult>> {
    let tables: Vec<Table> = relevancy.iter().map(|r| Table::new(r)).collect();
    let candidates: Vec<Vec<Candidate>> =
        frames.iter().map(|maps| candidates(maps, relevancy, options)).collect();
    let peaks = match (search, options.mask) {
        (Some(search), MaskRule::Codes(_)) => {
            let codes = |list: &Vec<Candidate>| list.iter().map(|c| c.answering.clone()).collect();
            Some(search.search(&tables, &candidates.iter().map(codes).collect::<Vec<_>>())?)
        }
        _ => None,
    };
    let threads = rayon::current_num_threads();
    let bands = threads.div_ceil((frames.len() * relevancy.len()).max(1));
    let answer = |(f, candidates): (usize, &Vec<Candidate>)| {
        let frame = Frame { maps: &frames[f], tables: &tables, candidates, bands };
        frame.answer(options, peaks.as_ref().map(|p| &p[f][..]))
    };
    candidates.par_iter().enumerate().map(answer).collect()
}

/// A level of a frame before the search of its pixels.
struct Candidate {
    /// Whether the level has codes.
    is_known: bool,
    /// Best relevancy of a shown code, at least 0.
    top: f32,
    /// Shown codes that answer ([`MaskRule::Codes`]), ascending. Only codes visible in this frame
    /// are compared, so that a code of another view does not suppress the best one here.
    answering: Vec<u16>,
}

fn candidates(maps: &CodeMaps, relevancy: &[Vec<f32>], options: &QueryOptions) -> Vec<Candidate> {
    let candidate = |(map, relevancy): (&LevelMap, &Vec<f32>)| {
        let shown = || {
            let value = |code: u16| relevancy.get(usize::from(code)).map(|r| (code, *r));
            map.shown.iter().filter_map(move |s| value(s.code))
        };
        let top = shown().map(|(_, r)| r).fold(0.0, f32::max);
        let share = if let MaskRule::Codes(share) = options.mask { share } else { super::CODE_SHARE };
        let bar = code_bar(top, share);
        let answering = shown().filter(|(_, r)| *r > 0.0 && *r >= bar).map(|(code, _)| code).collect();
        Candidate { is_known: !relevancy.is_empty(), top, answering }
    };
    maps.levels.iter().zip(relevancy).map(candidate).collect()
}

/// A frame in a query.
struct Frame<'a> {
    maps: &'a Arc<CodeMaps>,
    tables: &'a [Table],
    candidates: &'a [Candidate],
    /// Bands that a level is divided into.
    bands: usize,
}

impl Frame<'_> {
    fn answer(&self, options: &QueryOptions, found: Option<&[LevelPeaks]>) -> Result<QueryResult> {
        let known: Vec<usize> = (0..self.candidates.len()).filter(|l| self.candidates[*l].is_known).collect();
        let compared: Vec<f32> =
            known.par_iter().map(|&l| self.compared(l, options.mask, found.map(|f| f[l].peak))).collect();
        let chosen = match options.mask {
            MaskRule::Codes(_) => coarsest_good(&compared, options.slack),
            MaskRule::Lerf(_) => first_best(&compared),
        };
        let level = chosen.map(|c| known[c]).ok_or_else(no_level)?;
        let own = &self.candidates[level];
        let mut images = AnswerImages::new(self.maps, level, &self.tables[level], Mask::None);
        let location = match options.mask {
            // All levels determine the location: the whole "plate" may include a lemon that finer
            // levels separate. The published protocols use the chosen level alone
            // (docs/internals/method.md#lerf-ovs).
            MaskRule::Codes(_) => {
                images.mask = Mask::Codes(own.answering.clone());
                let search = || locate_codes(self.maps, self.tables, level, &own.answering, self.bands);
                found.map_or_else(search, |f| f[level].location)
            }
            MaskRule::Lerf(threshold) => {
                let mask = filter::lerf_mask(&images.relevancy(), threshold);
                let location = locate_in(self.maps, level, &self.tables[level], &mask, self.bands);
                images.mask = Mask::Image(Arc::new(mask));
                location
            }
        };
        let width = self.maps.width.max(1);
        Ok(QueryResult {
            level,
            location: (location % width, location / width),
            score: own.top,
            found: own.top >= options.abs_threshold,
            images,
        })
    }

    /// Value by which a level is compared with others. The published protocols take the peak of the
    /// blended map (docs/internals/method.md#lerf-ovs). For masks of codes it is the margin whose
    /// relevancy is the peak of the blended *excess* over a canonical phrase: smoothing then counts
    /// against specks, which the usual 0.5 of their surroundings would hide.
    fn compared(&self, level: usize, rule: MaskRule, found: Option<u32>) -> f32 {
        let table = &self.tables[level];
        if matches!(rule, MaskRule::Lerf(_)) {
            return blended(peak(self.maps, level, table, self.bands));
        }
        let excess = blended(found.unwrap_or_else(|| peak(self.maps, level, &table.excess(), self.bands)));
        // No code exceeds the canonical phrases: negative margin of the best code.
        margin(if excess > 0.0 { 0.5 + 0.5 * excess } else { self.candidates[level].top.min(0.5) })
    }
}

/// Largest sum of 900 times the value of a pixel and of its box. A sum of the box is at most 900 times
/// the largest value, so that codes whose value is too small for the peak of the best code need not
/// be searched: often a part of the frame is enough.
fn peak(maps: &CodeMaps, level: usize, table: &Table, bands: usize) -> u32 {
    let map = &maps.levels[level];
    let top = map.shown.iter().map(|s| table.at(s.code.into())).max().unwrap_or(0);
    let Some(best) = map.part_of(|code| top > 0 && table.at(code) == top) else { return 0 };
    let highest = peak_in(maps, level, table, &best, bands);
    let rivals = map.shown.iter().filter(|s| {
        let value = table.at(s.code.into());
        value > 0 && AREA * (value + top) > highest && !best.contains(&s.part)
    });
    match rivals.map(|s| s.part.clone()).reduce(|a, b| a.joined(&b)) {
        Some(rest) => highest.max(peak_in(maps, level, table, &rest, bands)),
        None => highest,
    }
}

/// [`peak`] of a part.
fn peak_in(maps: &CodeMaps, level: usize, table: &Table, part: &Part, bands: usize) -> u32 {
    let codes = &maps.levels[level].codes;
    let bands: Vec<Part> = part.bands(bands, LEAST_ROWS).collect();
    let width = maps.width;
    let search = |band: &Part| {
        let mut highest = 0;
        let fill = |y: usize, x: usize, row: &mut [u32]| table.gather(&codes[y * width + x..], row);
        box_rows((width, maps.height), band, fill, |_, _, values, sums| {
            let row = values.iter().zip(sums).map(|(v, s)| AREA * v + s).fold(0, u32::max);
            highest = highest.max(row);
        });
        highest
    };
    bands.par_iter().map(search).max().unwrap_or(0)
}

/// Pixel with the largest relevancy of all levels in its box, of those whose code is in `codes`, or
/// of all if none is.
fn locate_codes(maps: &CodeMaps, tables: &[Table], level: usize, codes: &[u16], bands: usize) -> usize {
    let width = maps.width;
    let levels: Vec<(&[u16], &Table)> = maps
        .levels
        .iter()
        .zip(tables)
        .filter(|(_, t)| t.values().len() > 1)
        .map(|(m, t)| (&m.codes[..], t))
        .collect();
    let fill = |y: usize, x: usize, row: &mut [u32]| {
        row.fill(0);
        levels.iter().for_each(|(codes, table)| table.gather_more(&codes[y * width + x..], row));
    };
    let own = &maps.levels[level];
    let part = own.part_of(|code| codes.binary_search(&(code as u16)).is_ok());
    let Some(part) = part else { return locate(maps, &maps.whole(), bands, fill, |_| true) };
    let mut answers = vec![false; codes.last().map_or(0, |k| usize::from(*k) + 2)];
    codes.iter().for_each(|k| answers[usize::from(*k)] = true);
    let last = answers.len() - 1;
    locate(maps, &part, bands, fill, |p| answers[usize::from(own.codes[p]).min(last)])
}

/// Pixel with the largest relevancy of one level in its box, inside the mask unless it is empty.
fn locate_in(maps: &CodeMaps, level: usize, table: &Table, mask: &Image<bool>, bands: usize) -> usize {
    let any = mask.data.contains(&true);
    let codes = &maps.levels[level].codes;
    let fill = |y: usize, x: usize, row: &mut [u32]| table.gather(&codes[y * maps.width + x..], row);
    locate(maps, &maps.whole(), bands, fill, |p| !any || mask.data[p])
}

/// First pixel of a part with the largest sum of the values of its box, of those that `counts`.
fn locate(
    maps: &CodeMaps,
    part: &Part,
    bands: usize,
    fill: impl Fn(usize, usize, &mut [u32]) + Sync,
    counts: impl Fn(usize) -> bool + Sync,
) -> usize {
    let search = |band: &Part| {
        let mut best: Option<(u32, usize)> = None;
        box_rows((maps.width, maps.height), band, &fill, |y, x, _, sums| {
            for (k, &sum) in sums.iter().enumerate() {
                let pixel = y * maps.width + x + k;
                if best.is_none_or(|(top, _)| sum > top) && counts(pixel) {
                    best = Some((sum, pixel));
                }
            }
        });
        best
    };
    let bands: Vec<Part> = part.bands(bands, LEAST_ROWS).collect();
    let best: Vec<Option<(u32, usize)>> = bands.par_iter().map(search).collect();
    // Bands overlap near the borders of the image; of equal sums the first pixel answers.
    let best = best.into_iter().flatten().reduce(|a, b| {
        let later = b.0 > a.0 || (b.0 == a.0 && b.1 < a.1);
        if later { b } else { a }
    });
    best.map_or(0, |(_, pixel)| pixel)
}
