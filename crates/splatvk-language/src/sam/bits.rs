//! A mask with one bit per pixel, row after row.
use std::ops::Range;

/// Bits of an image, 64 to a word.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Bits {
    pub width: usize,
    pub height: usize,
    words: Vec<u64>,
    /// Bounding box, ends excluded: (columns, rows).
    pub bounds: (Range<usize>, Range<usize>),
    count: usize,
}

impl Bits {
    /// Decodes run lengths; the first run is outside the mask.
    pub fn from_runs(width: usize, height: usize, runs: &[u32]) -> Bits {
        let mut bits = Bits::from_fn(width, height, |_| false);
        let mut start = 0usize;
        for (k, run) in runs.iter().enumerate() {
            let end = (start + *run as usize).min(width * height);
            if k % 2 == 1 {
                bits.fill(start..end);
            }
            start = end;
        }
        bits.measure();
        bits
    }

    /// Sets the pixels for which `inside` is true.
    pub fn from_fn(width: usize, height: usize, inside: impl Fn(usize) -> bool) -> Bits {
        let mut words = vec![0u64; (width * height).div_ceil(64)];
        for p in (0..width * height).filter(|p| inside(*p)) {
            words[p / 64] |= 1 << (p % 64);
        }
        let mut bits = Bits { width, height, words, bounds: (0..0, 0..0), count: 0 };
        bits.measure();
        bits
    }

    fn fill(&mut self, range: Range<usize>) {
        let mut p = range.start;
        while p < range.end {
            let last = range.end.min((p / 64 + 1) * 64);
            let ones = if last - p == 64 { u64::MAX } else { ((1u64 << (last - p)) - 1) << (p % 64) };
            self.words[p / 64] |= ones;
            p = last;
        }
    }

    fn measure(&mut self) {
        self.count = self.words.iter().map(|w| w.count_ones() as usize).sum();
        let (mut x, mut y) = ((usize::MAX, 0), (usize::MAX, 0));
        for p in self.ones() {
            let (c, r) = (p % self.width, p / self.width);
            x = (x.0.min(c), x.1.max(c + 1));
            y = (y.0.min(r), y.1.max(r + 1));
        }
        self.bounds = if self.count == 0 { (0..0, 0..0) } else { (x.0..x.1, y.0..y.1) };
    }

    /// Pixels in the mask.
    pub fn count(&self) -> usize {
        self.count
    }

    pub fn has(&self, p: usize) -> bool {
        self.words[p / 64] >> (p % 64) & 1 == 1
    }

    /// Indices of the pixels in the mask, in order.
    pub fn ones(&self) -> impl Iterator<Item = usize> + '_ {
        self.words.iter().enumerate().flat_map(|(k, word)| {
            let mut rest = *word;
            std::iter::from_fn(move || {
                let bit = (rest != 0).then(|| rest.trailing_zeros() as usize)?;
                rest &= rest - 1;
                Some(64 * k + bit)
            })
        })
    }

    /// Pixels in both masks.
    pub fn shared(&self, other: &Bits) -> usize {
        let rows = self.bounds.1.start.max(other.bounds.1.start)..self.bounds.1.end.min(other.bounds.1.end);
        let columns =
            self.bounds.0.start.max(other.bounds.0.start)..self.bounds.0.end.min(other.bounds.0.end);
        if rows.is_empty() || columns.is_empty() {
            return 0;
        }
        let words = rows.start * self.width / 64..(rows.end * self.width).div_ceil(64);
        let pairs = self.words[words.clone()].iter().zip(&other.words[words]);
        pairs.map(|(a, b)| (a & b).count_ones() as usize).sum()
    }

    /// Fills holes and removes islands (8-connected) smaller than `least`; keeps the largest island
    /// if all are small. True when something changed.
    pub fn clean(&mut self, least: usize) -> bool {
        let mut grid: Vec<bool> = (0..self.width * self.height).map(|p| self.has(p)).collect();
        let mut changed = false;
        for island in [false, true] {
            let (pieces, sizes) = self.components(&grid, island);
            let small: Vec<bool> = sizes.iter().map(|s| *s < least).collect();
            if !small.contains(&true) {
                continue;
            }
            let largest = (0..sizes.len()).max_by_key(|k| sizes[*k]);
            // If all islands are small, the largest one stays; small holes are always filled.
            let all_small = island && !small.contains(&false);
            for (value, piece) in grid.iter_mut().zip(&pieces) {
                let Some(k) = piece else { continue };
                if small[*k] && !(all_small && Some(*k) == largest) {
                    *value = !*value;
                    changed = true;
                }
            }
        }
        if changed {
            *self = Bits::from_fn(self.width, self.height, |p| grid[p]);
        }
        changed
    }

    /// Labels the 8-connected components of the pixels equal to `value`: component per pixel, size
    /// per component.
    fn components(&self, grid: &[bool], value: bool) -> (Vec<Option<usize>>, Vec<usize>) {
        let (mut piece, mut sizes) = (vec![None; grid.len()], Vec::new());
        let mut stack = Vec::new();
        for start in 0..grid.len() {
            if grid[start] != value || piece[start].is_some() {
                continue;
            }
            let index = sizes.len();
            let mut size = 0;
            piece[start] = Some(index);
            stack.push(start);
            while let Some(p) = stack.pop() {
                size += 1;
                let (x, y) = (p % self.width, p / self.width);
                for v in y.saturating_sub(1)..(y + 2).min(self.height) {
                    for u in x.saturating_sub(1)..(x + 2).min(self.width) {
                        let q = v * self.width + u;
                        if grid[q] == value && piece[q].is_none() {
                            piece[q] = Some(index);
                            stack.push(q);
                        }
                    }
                }
            }
            sizes.push(size);
        }
        (piece, sizes)
    }
}
