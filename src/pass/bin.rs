//! Tile lists: for every 8×8 tile the splats that can change it, nearest first.
//!
//! Every (splat, tile) entry gets its position by a scan of the numbers of tiles of the splats in
//! depth order. On a CPU device, three passes count, scan and write the entries, in lanes with
//! equal shares, and a stable grouping by tile follows with a counter per tile and lane. On a GPU,
//! one sweep counts, scans and writes, splats with many tiles are shared by all workgroups, and a
//! radix sort of the few bits of the tile groups the entries. No (tile, depth) pair is ever sorted.
//!
//! A splat is listed where `max over the tile's pixel centres of o e^p ≥ 1/255`:
//! `glsl/shared/tiles.glsl`.
use super::frame::{FrameBuffers, GradientReduction};
use super::project::Projected;
use super::sort::{Moves, Prepared, rows_of_groups};
use super::tile_lists::{CHUNK_SPLATS, Counting, Group, Lists, Sorting, TILE, tile_bits};
use crate::gpu::{Buffer, Recorder, shaders};
use std::ops::Range;

/// Workgroups that share the large splats: enough to fill any GPU, and few where there are none.
const LARGE_GROUPS: u32 = 512;
/// Places of the lists per thread: more would wait for memory one after the other.
const RANGES_PER_THREAD: u32 = 4;

/// Records counting, writing and grouping of the entries of up to `count` depth-sorted splats on
/// these rows of tiles; `splat_count` holds their number. Writes the lists to
/// `frame.lists`, the number of entries needed to `frame.status`.
pub(super) fn record(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    rows: &Range<u32>,
    (count, splat_count): (usize, &Buffer<u32>),
    state: Lists,
) {
    let (count, lists) = (count as u32, &frame.lists);
    match &lists.group {
        Group::Counting(group) => record_counting(rec, frame, rows, (count, splat_count), group),
        Group::Sorting(group) => {
            if state == Lists::Used {
                rec.fill(lists.zeros().0, 0);
            }
            record_sorting(rec, frame, rows, (count, splat_count), group);
        }
    }
}

fn record_counting(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    rows: &Range<u32>,
    (count, splat_count): (u32, &Buffer<u32>),
    Counting { scan, counters, lane_starts, lanes }: &Counting,
) {
    let (tiles_x, lists, lanes) = (frame.tiles()[0], &frame.lists, *lanes);
    let (first_row, end_row, tiles) = (rows.start, rows.end, tiles_x * (rows.end - rows.start));
    let call = shaders::bin_count::call(
        &shaders::bin_count::Bindings {
            projected: &frame.projected,
            depth_pairs: &frame.depth_pairs,
            tile_counts: &lists.counts,
            splat_count,
        },
        &shaders::bin_count::Push { tiles_x, first_row, end_row },
    );
    rec.dispatch(call, rows_of_groups((count as usize).div_ceil(shaders::bin_count::WORKGROUP[0] as usize)));
    scan.record(rec, &lists.counts, splat_count, &lists.starts, &frame.status);
    rec.fill(counters, 0);
    let call = shaders::bin_emit::call(
        &shaders::bin_emit::Bindings {
            projected: &frame.projected,
            depth_pairs: &frame.depth_pairs,
            starts: &lists.starts,
            status: &frame.status,
            entry_count: &lists.entry_count,
            entries: &lists.entries,
            counters,
            lane_starts,
            splat_count,
        },
        &shaders::bin_emit::Push { tiles_x, first_row, end_row, lanes, capacity: lists.capacity as u32 },
    );
    rec.dispatch_threads(call, [lanes, 1, 1]);
    group_by_counting(rec, frame, tiles, (counters, lane_starts), lanes);
}

fn group_by_counting(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    tiles: u32,
    (counters, lane_starts): (&Buffer<u32>, &Buffer<u32>),
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
            lane_starts,
        },
        &shaders::bin_scatter::Push { lanes },
    );
    rec.dispatch_threads(call, [lanes, 1, 1]);
}

/// Records one sweep over the splats that writes their entries, the sort, and the lists.
fn record_sorting(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    rows: &Range<u32>,
    (count, splat_count): (u32, &Buffer<u32>),
    group: &Sorting,
) {
    let (tiles_x, lists) = (frame.tiles()[0], &frame.lists);
    let (first_row, end_row, tiles) = (rows.start, rows.end, tiles_x * (rows.end - rows.start));
    let capacity = lists.capacity as u32;
    let Sorting { large_splats, entry_splats, sort } = group;
    let bits = tile_bits(tiles);
    let entries = sort.unsorted(&lists.entries, bits);
    let (zeros, _) = sort.zeros(bits);
    let (first_digit, passes) = sort.digits(bits);
    // Only sums per entry need its index: otherwise the sort moves the splats themselves.
    let indexed = u32::from(frame.summation == GradientReduction::Entries);
    let call = shaders::bin_sweep::call(
        shaders::bin_sweep::Variant { indexed },
        &shaders::bin_sweep::Bindings {
            projected: &frame.projected,
            depth_pairs: &frame.depth_pairs,
            status: &frame.status,
            entry_count: &lists.entry_count,
            entries,
            zeros,
            large_splats,
            entry_splats,
            tile_counts: &lists.counts,
            starts: &lists.starts,
            splat_count,
        },
        &shaders::bin_sweep::Push { tiles_x, first_row, end_row, capacity, first_digit, passes },
    );
    // At least one workgroup, which writes the number of entries.
    rec.dispatch(call, rows_of_groups((count as usize).div_ceil(CHUNK_SPLATS)));
    let most = capacity / shaders::bin_sweep::LARGE;
    let call = shaders::bin_large::call(
        shaders::bin_large::Variant { indexed },
        &shaders::bin_large::Bindings {
            projected: &frame.projected,
            large_splats,
            entries,
            zeros,
            entry_splats,
        },
        &shaders::bin_large::Push { tiles_x, first_row, end_row, capacity, first_digit, passes, most },
    );
    rec.dispatch(call, [most.clamp(1, LARGE_GROUPS), 1, 1]);
    let moves = (&lists.entry_count, Moves::All);
    sort.record_prepared(rec, &lists.entries, moves, bits, Prepared::Counted);
    let call = shaders::bin_ranges::call(
        shaders::bin_ranges::Variant { indexed },
        &shaders::bin_ranges::Bindings {
            entry_count: &lists.entry_count,
            entries: &lists.entries,
            tile_ranges: &lists.ranges,
            tile_splats: &lists.splats,
            entry_splats,
        },
        &shaders::bin_ranges::Push { tiles },
    );
    rec.dispatch_threads(call, [(capacity / RANGES_PER_THREAD).clamp(1 << 16, 1 << 22), 1, 1]);
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
