//! Box sums of parts of a map in whole numbers (docs/internals/method.md#smoothing).
//!
//! Relevancy is rounded to multiples of 1 / [`UNIT`]. Sums over the 30 × 30 box of up to
//! [`MOST_LEVELS`] levels are exact in 32 bits, so that they do not depend on their order: parts of
//! a frame, threads and devices give the same bits.
use super::filter::{BOX, reflect_101};
use fearless_simd::{Level, Simd, dispatch};
use std::ops::Range;

/// Number of the relevancy 1. Rounding moves a relevancy by at most 5e-7; the sum of 900 pixels of
/// four levels stays below 2³².
pub const UNIT: u32 = 1 << 20;

/// Levels whose sum over a box fits in 32 bits.
pub const MOST_LEVELS: usize = 4;

/// Pixels of a box.
pub const AREA: u32 = (BOX * BOX) as u32;

/// Columns or rows of the box before its pixel.
const BEFORE: usize = BOX / 2;

/// Rows that are kept while the box passes over them; a power of two above the box's.
const KEPT: usize = 64;

/// A relevancy in whole numbers; 0 if it is no number.
pub fn whole(relevancy: f32) -> u32 {
    (relevancy.clamp(0.0, 1.0) * UNIT as f32).round() as u32
}

/// Relevancy of the codes of a level in whole numbers, [K + 1]; the last is that of pixels without a
/// code.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Table(Vec<u32>);

impl Table {
    /// Table of relevancies [K].
    pub fn new(relevancy: &[f32]) -> Table {
        Table(relevancy.iter().map(|r| whole(*r)).chain([0]).collect())
    }

    /// Excess over a canonical phrase, `max(0, 2·rel − 1)`.
    pub(super) fn excess(&self) -> Table {
        Table(self.0.iter().map(|v| (2 * v).saturating_sub(UNIT)).collect())
    }

    /// [K + 1] values.
    pub fn values(&self) -> &[u32] {
        &self.0
    }

    pub(super) fn at(&self, code: usize) -> u32 {
        self.0.get(code).copied().unwrap_or(0)
    }

    /// Values of pixels.
    pub(super) fn gather(&self, codes: &[u16], out: &mut [u32]) {
        let last = self.0.len() - 1;
        for (out, code) in out.iter_mut().zip(codes) {
            *out = self.0[usize::from(*code).min(last)];
        }
    }

    pub(super) fn gather_more(&self, codes: &[u16], out: &mut [u32]) {
        let last = self.0.len() - 1;
        for (out, code) in out.iter_mut().zip(codes) {
            *out += self.0[usize::from(*code).min(last)];
        }
    }
}

/// `½ (box + raw)` from 900 times the value and the sum of the box.
pub(super) fn blended(sum: u32) -> f32 {
    const SCALE: f64 = 1.0 / (2.0 * AREA as f64 * UNIT as f64);
    (f64::from(sum) * SCALE) as f32
}

/// A rectangle of pixels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Part {
    /// Columns.
    pub x: Range<usize>,
    /// Rows.
    pub y: Range<usize>,
}

impl Part {
    /// The smallest part with both.
    pub fn joined(self, other: &Part) -> Part {
        let both = |a: Range<usize>, b: &Range<usize>| a.start.min(b.start)..a.end.max(b.end);
        Part { x: both(self.x, &other.x), y: both(self.y, &other.y) }
    }

    /// Whether all pixels of another part are in this one.
    pub fn contains(&self, other: &Part) -> bool {
        let within = |a: &Range<usize>, b: &Range<usize>| a.start <= b.start && b.end <= a.end;
        within(&self.x, &other.x) && within(&self.y, &other.y)
    }

    /// Divides the rows into at most `count` parts of at least `least` rows.
    pub fn bands(&self, count: usize, least: usize) -> impl Iterator<Item = Part> + use<> {
        let (x, y) = (self.x.clone(), self.y.clone());
        let rows = y.len().div_ceil(count.max(1)).max(least).max(1);
        let starts = y.clone().step_by(rows);
        starts.map(move |top| Part { x: x.clone(), y: top..(top + rows).min(y.end) })
    }
}

/// The indices of one axis that boxes of the outputs `out` read: the indices `from`, contiguous, and
/// reflections at the borders of the image.
struct Axis {
    out: Range<usize>,
    from: Range<usize>,
}

impl Axis {
    /// Widens `out` near a border so that reflections of the border are in `from`.
    fn new(out: &Range<usize>, size: usize) -> Axis {
        let mut out = out.clone();
        if out.start <= BEFORE {
            out.start = 0;
        }
        if out.end + BEFORE >= size {
            out.end = size;
        }
        if out.start == 0 {
            out.end = out.end.max(2).min(size);
        }
        if size <= BOX + 2 {
            out = 0..size;
        }
        let from = out.start.saturating_sub(BEFORE)..(out.end + BOX - BEFORE - 1).min(size);
        Axis { out, from }
    }
}

/// Passes the rows of a part of an image of `size` (columns, rows) to `visit(y, x, values, sums)`:
/// its values and their box sums from column `x` on. `fill(y, x, row)` writes the values of row `y`
/// from column `x` on. Near a border the part grows by up to half a box.
pub fn box_rows(
    size: (usize, usize),
    part: &Part,
    fill: impl FnMut(usize, usize, &mut [u32]),
    visit: impl FnMut(usize, usize, &[u32], &[u32]),
) {
    // Compiled once per set of vector instructions, with `fill` and `visit` inlined.
    dispatch!(Level::new(), simd => box_rows_with(simd, size, part, fill, visit));
}

#[inline(always)]
fn box_rows_with<S: Simd>(
    _: S,
    size: (usize, usize),
    part: &Part,
    mut fill: impl FnMut(usize, usize, &mut [u32]),
    mut visit: impl FnMut(usize, usize, &[u32], &[u32]),
) {
    if part.x.is_empty() || part.y.is_empty() {
        return;
    }
    let (columns, rows) = (Axis::new(&part.x, size.0), Axis::new(&part.y, size.1));
    let (width, count) = (columns.from.len(), columns.out.len());
    let kept = KEPT.min(size.1);
    let mut ring = vec![0u32; kept * width];
    let mut filled = rows.from.start;
    // Sums over the rows of the box, of the columns that the boxes of a row read.
    let mut padded = vec![0u32; count + BOX];
    let first = columns.out.start as isize - BEFORE as isize;
    let own = (columns.from.start as isize - first) as usize..(columns.from.end as isize - first) as usize;
    let source = |k: usize| own.start + reflect_101(first + k as isize, size.0) - columns.from.start;
    let outside: Vec<(usize, usize)> =
        (0..own.start).chain(own.end..count + BOX - 1).map(|k| (k, source(k))).collect();
    let mut sums = vec![0u32; count];
    let mut need = |y: usize, ring: &mut [u32]| {
        while filled <= y {
            fill(filled, columns.from.start, &mut ring[filled % kept * width..][..width]);
            filled += 1;
        }
    };
    let row_at = |y: isize| reflect_101(y, size.1);
    let top = rows.out.start as isize - BEFORE as isize;
    for y in (top..top + BOX as isize).map(row_at) {
        need(y, &mut ring);
        let row = &ring[y % kept * width..][..width];
        padded[own.clone()].iter_mut().zip(row).for_each(|(s, v)| *s += v);
    }
    for y in rows.out.clone() {
        outside.iter().for_each(|&(k, from)| padded[k] = padded[from]);
        let mut sum: u32 = padded[..BOX].iter().sum();
        for ((out, new), gone) in sums.iter_mut().zip(&padded[BOX..]).zip(&padded) {
            *out = sum;
            sum = sum.wrapping_add(new.wrapping_sub(*gone));
        }
        let values = &ring[y % kept * width + columns.out.start - columns.from.start..][..count];
        visit(y, columns.out.start, values, &sums);
        if y + 1 == rows.out.end {
            break;
        }
        let gone = row_at(y as isize - BEFORE as isize);
        let new = row_at((y + BOX - BEFORE) as isize);
        need(new, &mut ring);
        let row = |y: usize| &ring[y % kept * width..][..width];
        for ((s, new), gone) in padded[own.clone()].iter_mut().zip(row(new)).zip(row(gone)) {
            *s = s.wrapping_add(new.wrapping_sub(*gone));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Image;

    #[test]
    fn box_rows_match_direct_sums() {
        // Images narrower than the box reflect more than once; parts touch every border or none.
        for (w, h) in [(97usize, 140usize), (70, 40), (29, 33), (8, 50), (31, 5), (1, 1), (640, 3)] {
            let image = Image { width: w, height: h, data: (0..w * h).map(value).collect() };
            let spans = |n: usize| [0..n, 0..1, n - 1..n, n / 3..n / 2 + 1, n.min(20)..n];
            for (x, y) in spans(w).into_iter().flat_map(|x| spans(h).map(|y| (x.clone(), y))) {
                let part = Part { x: x.clone(), y: y.clone() };
                let mut seen = Image::filled(w, h, None);
                let fill = |y: usize, x: usize, row: &mut [u32]| {
                    row.copy_from_slice(&image.data[y * w + x..][..row.len()]);
                };
                box_rows((w, h), &part, fill, |y, x, values, sums| {
                    for (k, pair) in values.iter().zip(sums).enumerate() {
                        seen.data[y * w + x + k] = Some((*pair.0, *pair.1));
                    }
                });
                for p in 0..w * h {
                    let inside = x.contains(&(p % w)) && y.contains(&(p / w));
                    let expected = || (image.data[p], direct(&image, (p % w, p / w)));
                    assert!(seen.data[p].map_or(!inside, |got| got == expected()), "{part:?} {p}");
                }
            }
        }
    }

    fn value(i: usize) -> u32 {
        (i as u32).wrapping_mul(2654435761) >> 12
    }

    fn direct(image: &Image<u32>, (x, y): (usize, usize)) -> u32 {
        let near = |c: usize, n: usize| (-15..15).map(move |k| reflect_101(c as isize + k, n));
        near(y, image.height).map(|j| near(x, image.width).map(|i| image.at(i, j)).sum::<u32>()).sum()
    }

    #[test]
    fn bands_cover_every_row_once() {
        let part = Part { x: 2..5, y: 7..40 };
        let rows: Vec<usize> = part.bands(4, 8).flat_map(|b| b.y).collect();
        assert_eq!(rows, (7..40).collect::<Vec<_>>());
        assert_eq!(
            (part.bands(4, 8).count(), part.bands(4, 20).count(), part.bands(0, 0).count()),
            (4, 2, 1)
        );
    }
}
