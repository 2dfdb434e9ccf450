//! `label_weights.comp`.
use super::blend::{FLOATS, Splat, label_weights};
use super::scatter::Scattered;
use super::tile::{EDGE, TileRows};
use crate::gpu::NativeCall;
use crate::gpu::shaders::label_weights::SLOTS;
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;

/// Sums of an entry of a tile list.
type Weights = [f32; SLOTS as usize];

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    let (rows, groups, level) = (TileRows::of(call)?, call.groups(), Level::new());
    let [first_slot] = call.words_from(6)?;
    let [projected, ranges, splats, slots, counts, weights] = call.memory([0, 1, 2, 3, 4, 5])?;
    let (projected, ranges): (&[[f32; FLOATS]], &[u32]) = (projected.of(), ranges.of());
    let (splats, slots, counts): (&[[u32; 2]], &[i32], &[u32]) = (splats.of(), slots.of(), counts.of());
    let weights = Scattered::new(weights.of::<Weights>());
    let tiles = (0..groups[1] as usize).into_par_iter().flat_map_iter(|row| rows.tiles(groups, row));
    tiles.for_each(|tile| {
        let place = (tile.y - rows.top) / EDGE * rows.tiles_x + tile.x / EDGE;
        if counts[place] <= first_slot {
            return;
        }
        let mut own = [[-1; EDGE]; EDGE];
        for row in 0..tile.rows {
            let first = rows.pixel(&tile, row);
            for (own, slot) in own[row].iter_mut().zip(&slots[first..first + tile.columns]) {
                *own = if *slot < 0 { -1 } else { slot - first_slot as i32 };
            }
        }
        let list = ranges[tile.list] as usize..ranges[tile.list + 1] as usize;
        let sums = dispatch!(level, simd => {
            sums_of(simd, &splats[list.clone()], projected, [tile.x as f32, tile.y as f32], tile.pixels(), &own)
        });
        // SAFETY: each entry is of one tile.
        unsafe { weights.set_all(list.start, &sums) };
    });
    Ok(())
}

#[inline(always)]
fn sums_of<S: Simd>(
    simd: S,
    list: &[[u32; 2]],
    projected: &[[f32; FLOATS]],
    at: [f32; 2],
    mut pixels: super::tile::Pixels,
    slots: &[[i32; EDGE]; EDGE],
) -> Vec<Weights> {
    // Entries behind the last splat that any pixel sees are 0.
    let mut sums = vec![Weights::default(); list.len()];
    for (sum, [_, splat]) in sums.iter_mut().zip(list) {
        let splat = Splat::of(&projected[*splat as usize], &[], false);
        *sum = label_weights(simd, &splat, at, &mut pixels, slots);
        if pixels.open == 0 {
            break;
        }
    }
    sums
}
