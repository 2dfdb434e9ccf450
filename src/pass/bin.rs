//! Tile lists: for every 8×8 tile the splats that can change it, nearest first.
//!
//! The first pass counts the tiles of each splat in depth order. A scan of these counts gives every
//! (splat, tile) entry its position, and lanes with equal shares of the entries write them. A
//! stable grouping by tile follows: on a CPU device by counting, with a counter per tile and lane,
//! on a GPU by a radix sort of the few bits of the tile. No (tile, depth) pair is ever sorted.
//!
//! A splat is listed where `max over the tile's pixel centres of o e^p ≥ 1/255`:
//! `glsl/shared/tiles.glsl`.
use super::frame::FrameBuffers;
use super::project::Projected;
use super::sort::Sort;
use super::tile_lists::{Group, SORTING_LANES, TILE, TileLists};
use crate::gpu::{Buffer, Recorder, shaders};
use std::ops::Range;

/// Records counting, writing and grouping of the entries of `count` depth-sorted splats on these
/// rows of tiles; `splat_count` holds the same number on the device. Writes the lists to
/// `frame.lists`, the number of entries needed to `frame.status`.
pub(super) fn record(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    rows: &Range<u32>,
    count: usize,
    splat_count: &Buffer<u32>,
) {
    let (tiles_x, count, lists) = (frame.tiles()[0], count as u32, &frame.lists);
    let (first_row, end_row, tiles) = (rows.start, rows.end, tiles_x * (rows.end - rows.start));
    let call = shaders::bin_count::call(
        &shaders::bin_count::Bindings {
            projected: &frame.projected,
            depth_pairs: &frame.depth_pairs,
            tile_counts: &lists.counts,
        },
        &shaders::bin_count::Push { count, tiles_x, first_row, end_row },
    );
    rec.dispatch_threads(call, [count, 1, 1]);
    lists.scan.record(rec, &lists.counts, splat_count, &lists.starts, &frame.status);
    let (grouping, lanes) = match &lists.group {
        Group::Counting { counters, lanes } => {
            rec.fill(counters, 0);
            (0, *lanes)
        }
        Group::Sorting { .. } => (1, SORTING_LANES),
    };
    // The shader does not use the buffers of the other grouping; any buffer may be bound there.
    let (counters, entry_splats) = match &lists.group {
        Group::Counting { counters, .. } => (counters, counters),
        Group::Sorting { entry_splats, .. } => (entry_splats, entry_splats),
    };
    let call = shaders::bin_emit::call(
        shaders::bin_emit::Variant { grouping },
        &shaders::bin_emit::Bindings {
            projected: &frame.projected,
            depth_pairs: &frame.depth_pairs,
            starts: &lists.starts,
            status: &frame.status,
            entry_count: &lists.entry_count,
            entries: &lists.entries,
            counters,
            entry_splats,
        },
        &shaders::bin_emit::Push {
            count,
            tiles_x,
            first_row,
            end_row,
            lanes,
            capacity: lists.capacity as u32,
        },
    );
    rec.dispatch_threads(call, [lanes, 1, 1]);
    match &lists.group {
        Group::Counting { counters, lanes } => group_by_counting(rec, frame, tiles, counters, *lanes),
        Group::Sorting { entry_splats, sort } => group_by_sorting(rec, lists, tiles, entry_splats, sort),
    }
}

fn group_by_counting(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    tiles: u32,
    counters: &Buffer<u32>,
    lanes: u32,
) {
    let (lists, status) = (&frame.lists, &frame.status);
    let tile_ranges = &lists.ranges;
    let call = shaders::bin_sum::call(
        &shaders::bin_sum::Bindings { counters, tile_ranges },
        &shaders::bin_sum::Push { tiles, lanes },
    );
    rec.dispatch_threads(call, [tiles, 1, 1]);
    let call = shaders::bin_scan::call(
        &shaders::bin_scan::Bindings { tile_ranges, status },
        &shaders::bin_scan::Push { tiles },
    );
    rec.dispatch(call, [1, 1, 1]);
    let call = shaders::bin_base::call(
        &shaders::bin_base::Bindings { tile_ranges, counters },
        &shaders::bin_base::Push { tiles, lanes },
    );
    rec.dispatch_threads(call, [tiles, 1, 1]);
    let call = shaders::bin_scatter::call(
        &shaders::bin_scatter::Bindings {
            entry_count: &lists.entry_count,
            entries: &lists.entries,
            counters,
            tile_splats: &lists.splats,
        },
        &shaders::bin_scatter::Push { lanes },
    );
    rec.dispatch_threads(call, [lanes, 1, 1]);
}

fn group_by_sorting(
    rec: &mut Recorder,
    lists: &TileLists,
    tiles: u32,
    entry_splats: &Buffer<u32>,
    sort: &Sort,
) {
    let bits = u32::BITS - tiles.leading_zeros();
    sort.record(rec, &lists.entries, &lists.entry_count, bits);
    let call = shaders::bin_ranges::call(
        &shaders::bin_ranges::Bindings {
            entry_count: &lists.entry_count,
            entries: &lists.entries,
            entry_splats,
            tile_ranges: &lists.ranges,
            tile_splats: &lists.splats,
        },
        &shaders::bin_ranges::Push { tiles, lanes: SORTING_LANES },
    );
    rec.dispatch_threads(call, [SORTING_LANES, 1, 1]);
}

/// CPU reference of the lists, `[tiles]`, each in the order of `order`: tests every splat against
/// every tile.
pub fn reference(projected: &[Option<Projected>], order: &[u32], size: [u32; 2]) -> Vec<Vec<u32>> {
    let tiles = size.map(|s| s.div_ceil(TILE));
    let mut lists = vec![Vec::new(); (tiles[0] * tiles[1]) as usize];
    for &i in order {
        let Some(p) = &projected[i as usize] else { continue };
        for (t, list) in lists.iter_mut().enumerate() {
            let (x0, y0) = (t as u32 % tiles[0] * TILE, t as u32 / tiles[0] * TILE);
            if largest_alpha(p, x0, y0) >= shaders::shared::cutoffs::ALPHA_MIN {
                list.push(i);
            }
        }
    }
    lists
}

/// Largest o e^p over the rectangle spanned by the 8×8 pixel centres, not only at the centres.
fn largest_alpha(p: &Projected, x0: u32, y0: u32) -> f64 {
    let [a, b, c] = p.conic;
    let power = |dx: f64, dy: f64| -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy;
    let (x0, y0, side) = (f64::from(x0) - p.centre[0], f64::from(y0) - p.centre[1], f64::from(TILE - 1));
    let (x1, y1) = (x0 + side, y0 + side);
    if x0 <= 0.0 && x1 >= 0.0 && y0 <= 0.0 && y1 >= 0.0 {
        return p.opacity;
    }
    // Outside, the maximum lies on the boundary, on each edge at the vertex of a parabola.
    let on_vertical = |dx: f64| power(dx, (-b * dx / c).clamp(y0, y1));
    let on_horizontal = |dy: f64| power((-b * dy / a).clamp(x0, x1), dy);
    let best = on_vertical(x0).max(on_vertical(x1)).max(on_horizontal(y0)).max(on_horizontal(y1));
    p.opacity * best.exp()
}
