//! Tile lists by counting: `bin_count.comp`, `bin_emit.comp`, `bin_sum.comp`, `bin_scan.comp`,
//! `bin_base.comp` and `bin_scatter.comp`.
use super::scatter::Scattered;
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::cutoffs::LOG2_ALPHA_MIN;
use crate::gpu::shaders::shared::layout::{PROJECTED_FLOATS, TILE};
use crate::gpu::shaders::shared::tiles::{MARGIN, ROW_SLACK};
use rayon::prelude::*;
use std::ops::RangeInclusive;

const FLOATS: usize = PROJECTED_FLOATS as usize;
const EDGE: f32 = TILE as f32;

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
    fn of(p: &[f32; FLOATS], grid: Grid) -> Ellipse {
        let [u, v, a, b, c, log2_opacity, det, ..] = *p;
        let inv_a = 1.0 / a;
        let k = (log2_opacity - LOG2_ALPHA_MIN as f32 + MARGIN as f32).max(0.0) * a;
        let kc = k * inv_a * c;
        let (half_height, half_width) = ((-k / det).max(0.0).sqrt(), (-kc / det).max(0.0).sqrt());
        let (slope, slope_y) = (-0.5 * b * inv_a, -0.5 * b / c);
        let low = -u;
        let high = low + (grid.columns as f32 * EDGE - 1.0);
        let lowest = slope * half_height;
        let (bottom, top) = (clamped(lowest, low, high), clamped(-lowest, low, high));
        let chord = |at: f32| (-kc - det * at * at).max(0.0).sqrt() / c;
        let down = if bottom == lowest { half_height } else { slope_y * bottom - chord(bottom) };
        let up = if top == -lowest { -half_height } else { slope_y * top + chord(top) };
        let (begin, end) = (grid.first_row as f32, grid.end_row as f32);
        let slack = ROW_SLACK as f32;
        let first = clamped(((v + up - slack - (EDGE - 1.0)) / EDGE).ceil(), begin, end) as i32;
        let last = clamped(((v + down + slack) / EDGE).floor(), begin - 1.0, end - 1.0) as i32;
        let last = if log2_opacity < LOG2_ALPHA_MIN as f32 { first - 1 } else { last };
        Ellipse { u, v, inv_a, det, k, slope, right_dy: slope_y * half_width, rows: first..=last }
    }

    /// Tiles of a row.
    fn tiles(&self, row: i32, columns: u32) -> RangeInclusive<i32> {
        let low = row as f32 * EDGE - self.v;
        let high = low + (EDGE - 1.0);
        let (right, left) = (clamped(self.right_dy, low, high), clamped(-self.right_dy, low, high));
        let chord = |at: f32| (-self.k - self.det * at * at).max(0.0).sqrt();
        let x1 = self.u + self.slope * right - self.inv_a * chord(right);
        let x0 = self.u + self.slope * left + self.inv_a * chord(left);
        let last = columns as f32 - 1.0;
        let from = clamped(((x0 - (EDGE - 1.0)) / EDGE).ceil(), 0.0, last + 1.0) as i32;
        from..=clamped((x1 / EDGE).floor(), -1.0, last) as i32
    }
}

/// GLSL's `clamp`, which gives a number also for a NaN.
fn clamped(value: f32, low: f32, high: f32) -> f32 {
    value.max(low).min(high)
}

fn width(tiles: &RangeInclusive<i32>) -> u32 {
    (tiles.end() - tiles.start() + 1).max(0) as u32
}

pub(super) fn count(call: &mut NativeCall) -> Result<(), String> {
    let [count, columns, first_row, end_row] = call.words()?;
    let grid = Grid { columns, first_row, end_row };
    let [projected, pairs, counts] = call.memory([0, 1, 2])?;
    let (projected, pairs): (&[[f32; FLOATS]], &[[u32; 2]]) = (projected.of(), pairs.of());
    let counts = counts.of::<u32>()[..count as usize].par_iter_mut().with_min_len(1024).enumerate();
    counts.for_each(|(rank, count)| {
        let ellipse = Ellipse::of(&projected[pairs[rank][1] as usize], grid);
        *count = ellipse.rows.clone().map(|row| width(&ellipse.tiles(row, columns))).sum();
    });
    Ok(())
}

pub(super) fn emit(call: &mut NativeCall) -> Result<(), String> {
    let [count, columns, first_row, end_row, lanes, capacity] = call.words()?;
    let grid = Grid { columns, first_row, end_row };
    let (count, lanes) = (count as usize, lanes as usize);
    let [projected, pairs, starts, status, entry_count, entries, counters, lane_starts] =
        call.memory([0, 1, 2, 3, 4, 5, 6, 7])?;
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
            let mut out = out.iter_mut();
            for pair in &pairs[ranks] {
                let ellipse = Ellipse::of(&projected[pair[1] as usize], grid);
                for row in ellipse.rows.clone() {
                    for x in ellipse.tiles(row, columns) {
                        let tile = (row as u32 - first_row) * columns + x as u32;
                        if let Some(entry) = out.next() {
                            *entry = [tile, pair[1]];
                            counts[tile as usize] += 1;
                        }
                    }
                }
            }
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
                splats.set(place as usize, [splat, i]);
            }
        }
    });
    Ok(())
}
