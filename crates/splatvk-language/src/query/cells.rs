//! Connected groups of points through touching cells of a grid.
use ahash::{HashMap, HashMapExt};
use glam::{DVec3, IVec3};
use rayon::prelude::*;

/// Cells of a block along an axis: a block's cells are the bits of a word.
const EDGE: i32 = 4;

/// Items whose cells are collected by one task.
const CHUNK: usize = 4096;

/// Occupied cells in blocks of 4 × 4 × 4. Most points fall in the block of the point before, and
/// most neighbours of a cell lie in its own block, so that few look-ups need the hash.
struct Cells {
    index: HashMap<IVec3, usize>,
    blocks: Vec<Block>,
    /// Block of the last look-up.
    last: Option<(IVec3, usize)>,
}

struct Block {
    corner: IVec3,
    /// Occupied cells.
    bits: u64,
    /// Number of occupied cells of the blocks before.
    before: usize,
}

/// Block of a cell, and the cell's bit there.
fn place(cell: IVec3) -> (IVec3, u32) {
    let corner = IVec3::new(cell.x.div_euclid(EDGE), cell.y.div_euclid(EDGE), cell.z.div_euclid(EDGE));
    let inner = cell - corner * EDGE;
    (corner, (inner.x + EDGE * (inner.y + EDGE * inner.z)) as u32)
}

impl Cells {
    fn new() -> Cells {
        Cells { index: HashMap::new(), blocks: Vec::new(), last: None }
    }

    fn occupy(&mut self, corner: IVec3, bits: u64) {
        let block = match self.last.filter(|(known, _)| *known == corner) {
            Some((_, block)) => block,
            None => {
                let next = self.blocks.len();
                let block = *self.index.entry(corner).or_insert(next);
                if block == next {
                    self.blocks.push(Block { corner, bits: 0, before: 0 });
                }
                self.last = Some((corner, block));
                block
            }
        };
        self.blocks[block].bits |= bits;
    }

    /// Numbers the occupied cells; returns their count.
    fn number(&mut self) -> usize {
        let mut count = 0;
        for block in &mut self.blocks {
            block.before = count;
            count += block.bits.count_ones() as usize;
        }
        count
    }

    /// Number of an occupied cell.
    fn of(&self, block: usize, bit: u32) -> Option<usize> {
        let Block { bits, before, .. } = self.blocks[block];
        let is_occupied = bits >> bit & 1 == 1;
        is_occupied.then(|| before + (bits & ((1 << bit) - 1)).count_ones() as usize)
    }

    /// Joins the cells that touch.
    fn join(&self, union: &mut Union) {
        for (block, own) in self.blocks.iter().enumerate() {
            // Blocks at the offsets −1, 0 and 1 along each axis, the own one in the middle.
            let near: [Option<usize>; 27] = std::array::from_fn(|k| match k {
                13 => Some(block),
                k => self.index.get(&(own.corner + offset(k as i32))).copied(),
            });
            let mut rest = own.bits;
            let mut number = own.before;
            while rest != 0 {
                let bit = rest.trailing_zeros() as i32;
                let inner = IVec3::new(bit % EDGE, bit / EDGE % EDGE, bit / (EDGE * EDGE));
                // Half of the 26 neighbours: the other half visits the same pairs.
                for k in 14..27 {
                    let (step, bit) = place(inner + offset(k));
                    let other = near[((step.x + 1) + 3 * (step.y + 1) + 9 * (step.z + 1)) as usize];
                    if let Some(other) = other.and_then(|block| self.of(block, bit)) {
                        union.join(number, other);
                    }
                }
                rest &= rest - 1;
                number += 1;
            }
        }
    }
}

/// One of the 27 offsets of −1, 0 and 1 along each axis.
fn offset(k: i32) -> IVec3 {
    IVec3::new(k % 3, k / 3 % 3, k / 9) - IVec3::ONE
}

/// Groups `items` whose cells of edge `cell` are connected through touching cells: `covered` gives
/// the points of an item, `centre` the one by which it joins a group. Groups are in the order of
/// their first item, items in the given order.
pub(super) fn groups<P: Iterator<Item = DVec3>>(
    items: &[usize],
    cell: f64,
    covered: impl Fn(usize) -> P + Sync,
    centre: impl Fn(usize) -> DVec3,
) -> Vec<Vec<usize>> {
    let cell_of = |p: DVec3| (p / cell).floor().as_ivec3();
    let parts: Vec<Cells> = items
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut cells = Cells::new();
            for point in chunk.iter().flat_map(|&i| covered(i)) {
                let (corner, bit) = place(cell_of(point));
                cells.occupy(corner, 1 << bit);
            }
            cells
        })
        .collect();
    let cells = parts.into_iter().reduce(|mut all, part| {
        part.blocks.iter().for_each(|b| all.occupy(b.corner, b.bits));
        all
    });
    let Some(mut cells) = cells else { return Vec::new() };
    let mut union = Union::new(cells.number());
    cells.join(&mut union);
    let mut group_of = vec![usize::MAX; union.0.len()];
    let mut groups: Vec<Vec<usize>> = Vec::new();
    let mut last = None;
    for &i in items {
        let (corner, bit) = place(cell_of(centre(i)));
        let block = match last {
            Some((known, block)) if known == corner => Some(block),
            _ => cells.index.get(&corner).copied(),
        };
        let Some(number) = block.and_then(|block| cells.of(block, bit)) else { continue };
        last = block.map(|block| (corner, block));
        let root = union.root(number);
        if group_of[root] == usize::MAX {
            group_of[root] = groups.len();
            groups.push(Vec::new());
        }
        groups[group_of[root]].push(i);
    }
    groups
}

/// Disjoint sets.
struct Union(Vec<usize>);

impl Union {
    fn new(count: usize) -> Union {
        Union((0..count).collect())
    }
    fn root(&mut self, mut i: usize) -> usize {
        while self.0[i] != i {
            self.0[i] = self.0[self.0[i]];
            i = self.0[i];
        }
        i
    }
    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    /// Groups by comparing every pair of cells.
    fn by_pairs(points: &[Vec<DVec3>], cell: f64) -> Vec<Vec<usize>> {
        let cells: Vec<Vec<IVec3>> =
            points.iter().map(|p| p.iter().map(|p| (*p / cell).floor().as_ivec3()).collect()).collect();
        let touch =
            |a: &[IVec3], b: &[IVec3]| a.iter().any(|a| b.iter().any(|b| (*a - *b).abs().max_element() <= 1));
        let mut union = Union::new(points.len());
        for i in 0..points.len() {
            (0..i).filter(|&j| touch(&cells[i], &cells[j])).for_each(|j| union.join(i, j));
        }
        let mut groups: Vec<Vec<usize>> = vec![Vec::new(); points.len()];
        (0..points.len()).for_each(|i| groups[union.root(i)].push(i));
        groups.retain(|g| !g.is_empty());
        groups
    }

    #[test]
    fn groups_match_pairs_of_cells() {
        let mut counts = Vec::new();
        for (seed, extent) in [(1u64, 3.0f64), (2, 12.0), (3, 40.0)] {
            let mut random = Random::new(seed);
            // One point per item beside its centre, as far as a cell: items are connected.
            let points: Vec<Vec<DVec3>> = (0..500)
                .map(|_| {
                    let mut vector =
                        |scale: f64| DVec3::from_array(std::array::from_fn(|_| scale * random.normal()));
                    let centre = vector(extent);
                    vec![centre + vector(0.2).clamp_length_max(0.5), centre]
                })
                .collect();
            let items: Vec<usize> = (0..points.len()).collect();
            let got = groups(&items, 0.5, |i| points[i].iter().copied(), |i| points[i][1]);
            let mut sorted = got.clone();
            sorted.sort();
            let expected = by_pairs(&points, 0.5);
            assert_eq!(sorted, expected);
            counts.push(got.len());
        }
        // From large groups to nearly none.
        assert!(counts[0] < 250 && counts[2] > 450, "{counts:?}");
        assert!(groups(&[], 1.0, |_| std::iter::empty(), |_| DVec3::ZERO).is_empty());
    }
}
