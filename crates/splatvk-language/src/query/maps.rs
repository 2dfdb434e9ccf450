//! Code maps of a frame, prepared once for many queries.
use super::window::{MOST_LEVELS, Part};
use crate::scene::Image;
use crate::{Error, Result};
use rayon::prelude::*;

/// A pixel without a code.
pub const VOID: u16 = u16::MAX;

/// The code maps of a frame with the codes that they show.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CodeMaps {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Index as in [`crate::scene::LEVEL_NAMES`].
    pub levels: Vec<LevelMap>,
}

/// The code map of a level.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LevelMap {
    /// [H, W] code of every pixel, [`VOID`] without one.
    pub codes: Vec<u16>,
    /// The codes that it shows, ascending.
    pub shown: Vec<ShownCode>,
}

/// A code that a frame shows.
#[derive(Clone, Debug, PartialEq)]
pub struct ShownCode {
    /// Index in the codebook.
    pub code: u16,
    /// Number of its pixels.
    pub pixels: usize,
    /// The smallest rectangle of its pixels.
    pub part: Part,
}

impl CodeMaps {
    /// Prepares the decoded maps of a frame, one per level, −1 = no code.
    pub fn new(maps: &[Image<i32>]) -> Result<CodeMaps> {
        let size = maps.first().map_or((0, 0), |m| (m.width, m.height));
        if maps.len() > MOST_LEVELS || maps.iter().any(|m| (m.width, m.height) != size) {
            return Err(Error::work(format!("{} code maps, or maps of different sizes", maps.len())));
        }
        let levels = maps.par_iter().map(LevelMap::new).collect::<Result<_>>()?;
        Ok(CodeMaps { width: size.0, height: size.1, levels })
    }

    /// The whole frame.
    pub fn whole(&self) -> Part {
        Part { x: 0..self.width, y: 0..self.height }
    }
}

impl LevelMap {
    fn new(map: &Image<i32>) -> Result<LevelMap> {
        let mut codes = Vec::with_capacity(map.data.len());
        let mut seen: Vec<Option<ShownCode>> = Vec::new();
        for (y, row) in map.data.chunks_exact(map.width.max(1)).enumerate() {
            let mut x = 0;
            for run in row.chunk_by(|a, b| a == b) {
                let code = match run[0] {
                    k if k < 0 => VOID,
                    k => u16::try_from(k).ok().filter(|k| *k != VOID).ok_or_else(too_many)?,
                };
                codes.resize(codes.len() + run.len(), code);
                if code != VOID {
                    let part = Part { x: x..x + run.len(), y: y..y + 1 };
                    add(&mut seen, code, part);
                }
                x += run.len();
            }
        }
        Ok(LevelMap { codes, shown: seen.into_iter().flatten().collect() })
    }

    /// The smallest rectangle of the pixels of shown codes that `keep`; `None` without any.
    pub(super) fn part_of(&self, keep: impl Fn(usize) -> bool) -> Option<Part> {
        let kept = self.shown.iter().filter(|s| keep(usize::from(s.code)));
        kept.fold(None, |all: Option<Part>, s| {
            Some(all.map_or_else(|| s.part.clone(), |all| all.joined(&s.part)))
        })
    }
}

fn too_many() -> Error {
    Error::work(format!("a level with more than {VOID} codes"))
}

/// Adds a run of pixels of a row.
fn add(seen: &mut Vec<Option<ShownCode>>, code: u16, part: Part) {
    if seen.len() <= usize::from(code) {
        seen.resize(usize::from(code) + 1, None);
    }
    let slot = &mut seen[usize::from(code)];
    *slot = Some(match slot.take() {
        Some(s) => ShownCode { pixels: s.pixels + part.x.len(), part: s.part.joined(&part), ..s },
        None => ShownCode { code, pixels: part.x.len(), part },
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_list_shown_codes() {
        let map = Image { width: 4, height: 3, data: vec![-1, 2, 2, 0, -1, -1, 2, -1, 7, -1, -1, 0] };
        let maps = CodeMaps::new(&[Image::filled(4, 3, -1), map]).unwrap();
        let list: Vec<_> = maps.levels[1].shown.iter().map(|s| (s.code, s.pixels, s.part.clone())).collect();
        let part = |x, y| Part { x, y };
        assert_eq!(list, [(0, 2, part(3..4, 0..3)), (2, 3, part(1..3, 0..2)), (7, 1, part(0..1, 2..3))]);
        assert_eq!(maps.levels[1].codes[..4], [VOID, 2, 2, 0]);
        assert!(maps.levels[0].shown.is_empty());
        assert_eq!(maps.levels[1].part_of(|k| k != 0), Some(part(0..3, 0..3)));
        assert_eq!(maps.levels[1].part_of(|k| k == 5), None);
        assert!(CodeMaps::new(&[Image::filled(2, 1, 65_535)]).is_err());
        assert!(CodeMaps::new(&[Image::filled(2, 1, 0), Image::filled(1, 2, 0)]).is_err());
    }
}
