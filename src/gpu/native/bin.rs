//! Tile lists by counting: `bin_count.comp`, `bin_emit.comp`, `bin_sum.comp`, `bin_scan.comp`,
//! `bin_base.comp` and `bin_scatter.comp`.
use super::prefetch::prefetch;
use super::scatter::Scattered;
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::cutoffs::LOG2_ALPHA_MIN;
use crate::gpu::shaders::shared::layout::{PROJECTED_FLOATS, TILE};
use crate::gpu::shaders::shared::tiles::{MARGIN, ROW_SLACK};
use fearless_simd::{Level, Simd, dispatch, f32x8, i32x8, prelude::*};
use rayon::prelude::*;
use std::ops::RangeInclusive;

const FLOATS: usize = PROJECTED_FLOATS as usize;
const EDGE: f32 = TILE as f32;
/// Rows of tiles whose intervals are computed at once.
const LANES: usize = 8;
const STEPS: [f32; LANES] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];

/// Rows of tiles that are binned, and the number of columns.
#[derive(Clone, Copy)]
struct Grid {
    columns: u32,
    first_row: u32,
    end_row: u32,
}

/// Ellipse of a splat, as in `glsl/shared/tiles.glsl`.
struct Ellipse {
    u: f32,
    v: f32,
    inv_a: f32,
    det: f32,
    k: f32,
    slope: f32,
    right_dy: f32,
    rows: RangeInclusive<i32>,
}

impl Ellipse {
    /// Ellipses of eight splats.
    #[inline(always)]
    fn of<S: Simd>(simd: S, splats: [&[f32; FLOATS]; LANES], grid: Grid) -> [Ellipse; LANES] {
        let number = |value: f32| f32x8::simd_from(simd, value);
        let field = |k: usize| f32x8::simd_from(simd, std::array::from_fn(|lane| splats[lane][k]));
        let root = |square: f32x8<S>| square.max_precise(0.0).sqrt();
        let [u, v, a, b] = [field(0), field(1), field(2), field(3)];
        let [c, log2_opacity, det] = [field(4), field(5), field(6)];
        let inv_a = number(1.0) / a;
        let k = (log2_opacity - LOG2_ALPHA_MIN as f32 + MARGIN as f32).max_precise(0.0) * a;
        let kc = k * inv_a * c;
        let (half_height, half_width) = (root(-k / det), root(-kc / det));
        let (slope, slope_y) = (b * -0.5 * inv_a, b * -0.5 / c);
        let low = -u;
        let high = low + (grid.columns as f32 * EDGE - 1.0);
        let lowest = slope * half_height;
        let within = |at: f32x8<S>| at.max_precise(low).min_precise(high);
        let (bottom, top) = (within(lowest), within(-lowest));
        let chord = |at: f32x8<S>| root(-kc - det * at * at) / c;
        let down = bottom.simd_eq(lowest).select(half_height, slope_y * bottom - chord(bottom));
        let up = top.simd_eq(-lowest).select(-half_height, slope_y * top + chord(top));
        let (begin, end) = (grid.first_row as f32, grid.end_row as f32);
        let slack = ROW_SLACK as f32;
        let first = (v + up - slack - (EDGE - 1.0)) * (1.0 / EDGE);
        let last = (v + down + slack) * (1.0 / EDGE);
        let first = first.ceil().max_precise(begin).min_precise(end);
        let last = last.floor().max_precise(begin - 1.0).min_precise(end - 1.0);
        let last = log2_opacity.simd_lt(LOG2_ALPHA_MIN as f32).select(first - 1.0, last);
        let right_dy = slope_y * half_width;
        std::array::from_fn(|lane| Ellipse {
            u: u[lane],
            v: v[lane],
            inv_a: inv_a[lane],
            det: det[lane],
            k: k[lane],
            slope: slope[lane],
            right_dy: right_dy[lane],
            rows: first[lane] as i32..=last[lane] as i32,
        })
    }

    /// First and last tile of eight rows, beginning at `row`.
    #[inline(always)]
    fn tiles<S: Simd>(&self, simd: S, row: i32, columns: u32) -> [[i32; LANES]; 2] {
        let number = |value: f32| f32x8::simd_from(simd, value);
        let low = f32x8::simd_from(simd, STEPS) * EDGE + row as f32 * EDGE - self.v;
        let high = low + (EDGE - 1.0);
        let within = |value: f32| number(value).max_precise(low).min_precise(high);
        let chord = |at: f32x8<S>| (-(at * self.det * at) - self.k).max_precise(0.0).sqrt();
        let (right, left) = (within(self.right_dy), within(-self.right_dy));
        let x1 = right * self.slope + self.u - chord(right) * self.inv_a;
        let x0 = left * self.slope + self.u + chord(left) * self.inv_a;
        let last = columns as f32 - 1.0;
        let from = ((x0 - (EDGE - 1.0)) * (1.0 / EDGE)).ceil().max_precise(0.0).min_precise(last + 1.0);
        let to = (x1 * (1.0 / EDGE)).floor().max_precise(-1.0).min_precise(last);
        [from, to].map(|ends| ends.to_int::<i32x8<S>>().to_array())
    }

    /// Calls `f` with each row of tiles and its first and last tile.
    #[inline(always)]
    fn each_row<S: Simd>(&self, simd: S, columns: u32, mut f: impl FnMut(i32, i32, i32)) {
        let (mut row, end) = (*self.rows.start(), *self.rows.end());
        while row <= end {
            let [from, to] = self.tiles(simd, row, columns);
            for lane in 0..LANES.min((end - row + 1) as usize) {
                f(row + lane as i32, from[lane], to[lane]);
            }
            row += LANES as i32;
        }
    }
}

/// Calls `f` with the place of each splat of `pairs`, each of its rows of tiles, and the first and
/// last tile there.
#[inline(always)]
fn each_row<S: Simd>(
    simd: S,
    pairs: &[[u32; 2]],
    projected: &[[f32; FLOATS]],
    grid: Grid,
    mut f: impl FnMut(usize, i32, i32, i32),
) {
    let all = pairs;
    for (group, pairs) in pairs.chunks(LANES).enumerate() {
        // The order by depth is any order of memory.
        let later = all.iter().skip((group + 2) * LANES).take(LANES);
        later.for_each(|pair| prefetch(&projected[pair[1] as usize]));
        let splats = std::array::from_fn(|lane| &projected[pairs[lane.min(pairs.len() - 1)][1] as usize]);
        for (lane, ellipse) in Ellipse::of(simd, splats, grid)[..pairs.len()].iter().enumerate() {
            ellipse.each_row(simd, grid.columns, |row, from, to| f(group * LANES + lane, row, from, to));
        }
    }
}

/// Writes the entries of splats, and counts those of each tile.
#[inline(always)]
fn emit_all<S: Simd>(
    simd: S,
    pairs: &[[u32; 2]],
    projected: &[[f32; FLOATS]],
    grid: Grid,
    out: &mut [[u32; 2]],
    counts: &mut [u32],
) {
    let mut out = out.iter_mut();
    each_row(simd, pairs, projected, grid, |k, row, from, to| {
        let first = (row as u32 - grid.first_row) * grid.columns;
        for (x, entry) in (from..=to).zip(&mut out) {
            let tile = first + x as u32;
            *entry = [tile, pairs[k][1]];
            counts[tile as usize] += 1;
        }
    });
}

#[inline(always)]
fn count_all<S: Simd>(
    simd: S,
    pairs: &[[u32; 2]],
    projected: &[[f32; FLOATS]],
    grid: Grid,
    counts: &mut [u32],
) {
    counts.fill(0);
    each_row(simd, pairs, projected, grid, |k, _, from, to| counts[k] += (to - from + 1).max(0) as u32);
}

pub(super) fn count(call: &mut NativeCall) -> Result<(), String> {
    let [columns, first_row, end_row] = call.words()?;
    let grid = Grid { columns, first_row, end_row };
    let [projected, pairs, counts, count] = call.memory([0, 1, 2, 3])?;
    let count = count.of::<u32>()[0];
    let (projected, pairs): (&[[f32; FLOATS]], &[[u32; 2]]) = (projected.of(), pairs.of());
    let counts = counts.of::<u32>()[..count as usize].par_chunks_mut(1024);
    let level = Level::new();
    counts.zip(pairs.par_chunks(1024)).for_each(|(counts, pairs)| {
        dispatch!(level, simd => count_all(simd, &pairs[..counts.len()], projected, grid, counts));
    });
    Ok(())
}

pub(super) fn emit(call: &mut NativeCall) -> Result<(), String> {
    let [columns, first_row, end_row, lanes, capacity] = call.words()?;
    let grid = Grid { columns, first_row, end_row };
    let [projected, pairs, starts, status, entry_count, entries, counters, lane_starts, count] =
        call.memory([0, 1, 2, 3, 4, 5, 6, 7, 8])?;
    let (count, lanes) = (count.of::<u32>()[0] as usize, lanes as usize);
    let (projected, pairs): (&[[f32; FLOATS]], &[[u32; 2]]) = (projected.of(), pairs.of());
    let (starts, status): (&[u32], _) = (&starts.of::<u32>()[..count], status.of::<u32>());
    let total = status[0];
    let fits = total <= capacity;
    entry_count.of::<u32>()[0] = if fits { total } else { 0 };
    if !fits {
        status[1] = status[1].max(total);
    }
    // Splats whose entries begin in the share of each lane.
    let share = (total as usize).div_ceil(lanes).max(1) as u32;
    let rank_at = |entry: u32| starts.partition_point(|start| *start < entry);
    let ranks: Vec<usize> = (0..=lanes as u32)
        .map(|lane| if lane as usize == lanes { count } else { rank_at(lane * share) })
        .collect();
    let first_entry = |rank: usize| starts.get(rank).copied().unwrap_or(total);
    let lane_starts = lane_starts.of::<u32>();
    for (lane, start) in lane_starts[..lanes].iter_mut().enumerate() {
        *start = first_entry(ranks[lane]);
    }
    if !fits {
        return Ok(());
    }
    let level = Level::new();
    let tiles = (columns * (end_row - first_row)) as usize;
    let mut parts = Vec::with_capacity(lanes);
    let mut rest = &mut entries.of::<[u32; 2]>()[..total as usize];
    for lane in 0..lanes {
        let length = first_entry(ranks[lane + 1]) - first_entry(ranks[lane]);
        let (own, others) = rest.split_at_mut(length as usize);
        parts.push((ranks[lane]..ranks[lane + 1], own));
        rest = others;
    }
    let by_lane: Vec<Vec<u32>> = parts
        .into_par_iter()
        .map(|(ranks, out)| {
            let mut counts = vec![0; tiles];
            dispatch!(level, simd => emit_all(simd, &pairs[ranks], projected, grid, out, &mut counts));
            counts
        })
        .collect();
    let counters = counters.of::<u32>()[..tiles * lanes].par_chunks_mut(lanes).with_min_len(64).enumerate();
    counters.for_each(|(tile, row)| {
        row.iter_mut().zip(&by_lane).for_each(|(counter, counts)| *counter = counts[tile]);
    });
    Ok(())
}

pub(super) fn sum(call: &mut NativeCall) -> Result<(), String> {
    let [tiles, lanes] = call.words()?.map(|word| word as usize);
    let [counters, ranges] = call.memory([0, 1])?;
    let counters = counters.of::<u32>()[..tiles * lanes].par_chunks(lanes);
    let ranges = ranges.of::<u32>()[..tiles].par_iter_mut().with_min_len(64);
    ranges.zip(counters).for_each(|(sum, row)| *sum = row.iter().sum());
    Ok(())
}

pub(super) fn scan(call: &mut NativeCall) -> Result<(), String> {
    let [tiles] = call.words()?.map(|word| word as usize);
    let [ranges, status] = call.memory([0, 1])?;
    let (ranges, status) = (ranges.of::<u32>(), status.of::<u32>());
    let (mut start, mut longest) = (0, 0);
    for range in &mut ranges[..tiles] {
        longest = longest.max(*range);
        (*range, start) = (start, start + *range);
    }
    ranges[tiles] = start;
    status[2] = status[2].max(longest);
    Ok(())
}

pub(super) fn base(call: &mut NativeCall) -> Result<(), String> {
    let [tiles, lanes] = call.words()?.map(|word| word as usize);
    let [ranges, counters] = call.memory([0, 1])?;
    let ranges: &[u32] = ranges.of();
    let counters = counters.of::<u32>()[..tiles * lanes].par_chunks_mut(lanes).with_min_len(64).enumerate();
    counters.for_each(|(tile, row)| {
        let mut position = ranges[tile];
        for counter in row {
            (*counter, position) = (position, position + *counter);
        }
    });
    Ok(())
}

pub(super) fn scatter(call: &mut NativeCall) -> Result<(), String> {
    let [lanes] = call.words()?.map(|word| word as usize);
    let [entry_count, entries, counters, splats, lane_starts] = call.memory([0, 1, 2, 3, 4])?;
    let total = entry_count.of::<u32>()[0];
    let (entries, lane_starts): (&[[u32; 2]], &[u32]) = (entries.of(), &lane_starts.of::<u32>()[..lanes]);
    let (counters, splats) = (Scattered::new(counters.of::<u32>()), Scattered::new(splats.of::<[u32; 2]>()));
    (0..lanes).into_par_iter().for_each(|lane| {
        let end = lane_starts.get(lane + 1).map_or(total, |end| (*end).min(total));
        for i in lane_starts[lane]..end {
            let [tile, splat] = entries[i as usize];
            let at = tile as usize * lanes + lane;
            // SAFETY: the counters of a lane are its own, and the places that they count are
            // different for all lanes and tiles.
            unsafe {
                let place = counters.get(at);
                counters.set(at, place + 1);
                splats.set(place as usize, [i, splat]);
            }
        }
    });
    Ok(())
}
