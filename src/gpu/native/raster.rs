//! `raster_forward.comp`, `raster_backward.comp` and `count_pairs.comp`.
use super::blend::{BASE, Blended, COLOUR, FLOATS, Splat, Sums, Upstream, blend, count, gradients};
use super::prefetch::prefetch;
use super::scatter::Scattered;
use super::tile::{EDGE, Row, Tile, TileRows};
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::layout::GRADIENT_FLOATS;
use crate::gpu::shaders::structs::CameraView;
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;

const GRADIENT: usize = GRADIENT_FLOATS as usize;

/// Push constants of both passes.
struct Push {
    rows: TileRows,
    code_vectors: usize,
    first_vector: usize,
    first_plane: usize,
    features: usize,
}

impl Push {
    fn of(call: &NativeCall) -> Result<Push, String> {
        let [code_vectors, first_vector, first_plane, features] =
            call.words_from(6)?.map(|word| word as usize);
        Ok(Push { rows: TileRows::of(call)?, code_vectors, first_vector, first_plane, features })
    }
}

pub(super) fn forward(call: &mut NativeCall) -> Result<(), String> {
    match call.variant()[0] {
        4 => forward_with::<4>(call),
        7 => forward_with::<7>(call),
        12 => forward_with::<12>(call),
        16 => forward_with::<16>(call),
        _ => forward_with::<20>(call),
    }
}

fn forward_with<const C: usize>(call: &mut NativeCall) -> Result<(), String> {
    let (push, groups, level) = (Push::of(call)?, call.groups(), Level::new());
    let with_base = C != 16;
    let base = if with_base { BASE } else { 0 };
    let [camera, projected, ranges, splats, codes, planes, transmittances] =
        call.optional([0, 1, 2, 3, 4, 5, 6]);
    let background = camera.of::<CameraView>().first().map_or([0.0; 3], |c| c.background);
    let (projected, ranges): (&[[f32; FLOATS]], &[u32]) = (projected.of(), ranges.of());
    let (splats, codes): (&[[u32; 2]], &[f32]) = (splats.of(), codes.of());
    let (planes, transmittances) =
        (Scattered::new(planes.of::<f32>()), Scattered::new(transmittances.of::<f32>()));
    let pixels = push.rows.pixels();
    let of: Vec<Splat<C>> = splats_of(projected, codes, &push, with_base);
    let (features, rows) = (push.features.min(C - base), groups[1] as usize);
    (0..rows).into_par_iter().flat_map_iter(|row| push.rows.tiles(groups, row)).for_each(|tile| {
        let list = &splats[ranges[tile.list] as usize..ranges[tile.list + 1] as usize];
        let blended: Blended<C> = dispatch!(level, simd => blended(simd, &tile, list, &of));
        for row in 0..tile.rows {
            let (first, sums) = (push.rows.pixel(&tile, row), &blended.channels[row]);
            let left = blended.pixels.t[row].map(f32::abs);
            let write = |planes: &Scattered<f32>, plane: usize, values: &Row| {
                // SAFETY: each pixel is of one tile.
                unsafe { planes.set_all(plane * pixels + first, &values[..tile.columns]) };
            };
            if with_base {
                for c in 0..3 {
                    write(&planes, c, &std::array::from_fn(|l| sums[c][l] + background[c] * left[l]));
                }
                write(&planes, 3, &sums[3]);
                write(&transmittances, 0, &left);
            }
            for feature in base..base + features {
                write(&planes, push.first_plane + feature, &sums[feature]);
            }
        }
    });
    Ok(())
}

#[inline(always)]
fn blended<S: Simd, const C: usize>(simd: S, tile: &Tile, list: &[[u32; 2]], of: &[Splat<C>]) -> Blended<C> {
    let mut state = Blended { pixels: tile.pixels(), channels: [[[0.0; EDGE]; C]; EDGE] };
    let at = [tile.x as f32, tile.y as f32];
    for (k, [_, splat]) in list.iter().enumerate() {
        fetch_ahead(list, k, of);
        blend(simd, &of[*splat as usize], at, &mut state);
        if state.pixels.open == 0 {
            break;
        }
    }
    state
}

/// Splats between the prefetch of one and its use.
const AHEAD: usize = 6;

/// Prefetches a splat that comes later in a list: lists name splats in any order of memory.
#[inline(always)]
fn fetch_ahead<const C: usize>(list: &[[u32; 2]], k: usize, of: &[Splat<C>]) {
    if let Some([_, splat]) = list.get(k + AHEAD) {
        prefetch(&of[*splat as usize]);
    }
}

fn splats_of<const C: usize>(
    projected: &[[f32; FLOATS]],
    codes: &[f32],
    push: &Push,
    with_base: bool,
) -> Vec<Splat<C>> {
    let stride = 4 * push.code_vectors;
    let of = |(k, p): (usize, &[f32; FLOATS])| {
        let first = k * stride + (4 * push.first_vector).min(stride);
        let codes = codes.get(first..(k + 1) * stride).unwrap_or_default();
        Splat::of(p, codes, with_base)
    };
    projected.par_iter().with_min_len(1 << 12).enumerate().map(of).collect()
}

pub(super) fn backward(call: &mut NativeCall) -> Result<(), String> {
    match call.variant()[0] {
        4 => backward_with::<4>(call),
        7 => backward_with::<7>(call),
        12 => backward_with::<12>(call),
        16 => backward_with::<16>(call),
        _ => backward_with::<20>(call),
    }
}

/// Rows of tiles whose sums one task gathers. It does not depend on the number of threads, so that
/// the rounding of the sums does not.
const BAND: usize = 2;

fn backward_with<const C: usize>(call: &mut NativeCall) -> Result<(), String> {
    let (push, groups, level) = (Push::of(call)?, call.groups(), Level::new());
    let [alpha_plane, coupling] = call.words_from(10)?;
    let (alpha_plane, coupling) = (alpha_plane as usize, f32::from_bits(coupling));
    let with_base = C != 16;
    let base = if with_base { BASE } else { 0 };
    let coupled: [f32; C] = std::array::from_fn(|c| if c < base { 1.0 } else { coupling });
    let [projected, ranges, splats, codes, codes_grad, planes, planes_grad, transmittances, projected_grad] =
        call.optional([0, 1, 2, 3, 4, 5, 6, 7, 8]);
    let (projected, ranges): (&[[f32; FLOATS]], &[u32]) = (projected.of(), ranges.of());
    let (splats, codes): (&[[u32; 2]], &[f32]) = (splats.of(), codes.of());
    let (planes, planes_grad): (&[f32], &[f32]) = (planes.of(), planes_grad.of());
    let transmittances: &[f32] = transmittances.of();
    let pixels = push.rows.pixels();
    let features = push.features.min(C - base);
    let of: Vec<Splat<C>> = splats_of(projected, codes, &push, with_base);
    let rows: Vec<usize> = (0..groups[1] as usize).collect();
    // Places of the splats among the sums of a band.
    let places = || vec![NONE; of.len()];
    let bands: Vec<Vec<Sums<C>>> = rows
        .par_chunks(BAND)
        .map_init(places, |places, rows| {
            let mut gathered = Gathered { places, sums: Vec::new() };
            for tile in rows.iter().flat_map(|row| push.rows.tiles(groups, *row)) {
                let mut state = Upstream {
                    pixels: tile.pixels(),
                    behind: [[0.0; EDGE]; EDGE],
                    channels: [[[0.0; EDGE]; C]; EDGE],
                };
                for row in 0..tile.rows {
                    let first = push.rows.pixel(&tile, row);
                    let part = |of: &[f32], plane: usize| -> Row {
                        let of = &of[plane * pixels + first..];
                        // A whole row is one vector.
                        of.first_chunk().filter(|_| tile.columns == EDGE).copied().unwrap_or_else(|| {
                            std::array::from_fn(|l| if l < tile.columns { of[l] } else { 0.0 })
                        })
                    };
                    let behind = &mut state.behind[row];
                    for c in 0..base + features {
                        let plane = if c < base { c } else { push.first_plane + c };
                        let (by, value) = (part(planes_grad, plane), part(planes, plane));
                        (0..EDGE).for_each(|l| behind[l] += coupled[c] * by[l] * value[l]);
                        state.channels[row][c] = by;
                    }
                    if with_base {
                        let (by, left) = (part(planes_grad, alpha_plane), part(transmittances, 0));
                        (0..EDGE).for_each(|l| behind[l] -= by[l] * left[l]);
                    }
                }
                let list = &splats[ranges[tile.list] as usize..ranges[tile.list + 1] as usize];
                dispatch!(level, simd => differentiate(simd, &tile, list, &of, &coupled, &mut state, &mut gathered));
            }
            gathered.finish()
        })
        .collect();
    let stride = 4 * push.code_vectors;
    let (geometry, codes) = (projected_grad.of::<[f32; GRADIENT]>(), codes_grad.of::<f32>());
    let count = of.len().min(geometry.len());
    let share = count.div_ceil(rayon::current_num_threads()).max(1);
    let add = |first: usize, geometry: &mut [[f32; GRADIENT]], codes: &mut [f32]| {
        let own = first..first + geometry.len();
        for sum in bands.iter().flatten().filter(|sum| own.contains(&(sum.splat as usize))) {
            let splat = sum.splat as usize - first;
            let by = sum.moments.iter().chain(&sum.channels[..base]);
            geometry[splat].iter_mut().zip(by).for_each(|(sum, v)| *sum += v);
            let at = splat * stride + 4 * push.first_vector;
            let by = sum.channels[base..].iter();
            codes.iter_mut().skip(at).take(features).zip(by).for_each(|(sum, v)| *sum += v);
        }
    };
    let geometry = geometry[..count].par_chunks_mut(share).enumerate();
    if features == 0 {
        geometry.for_each(|(task, geometry)| add(task * share, geometry, &mut []));
    } else {
        let codes = codes[..count * stride].par_chunks_mut(share * stride);
        geometry.zip(codes).for_each(|((task, geometry), codes)| add(task * share, geometry, codes));
    }
    Ok(())
}

/// Sums of the splats that a band of tiles shows.
struct Gathered<'a, const C: usize> {
    /// Place of each splat's sums, or [`NONE`].
    places: &'a mut [u32],
    sums: Vec<Sums<C>>,
}

const NONE: u32 = u32::MAX;

impl<const C: usize> Gathered<'_, C> {
    #[inline(always)]
    fn of(&mut self, splat: u32) -> &mut Sums<C> {
        let place = &mut self.places[splat as usize];
        if *place == NONE {
            *place = self.sums.len() as u32;
            self.sums.push(Sums { splat, moments: [0.0; COLOUR], channels: [0.0; C] });
        }
        &mut self.sums[*place as usize]
    }

    fn finish(self) -> Vec<Sums<C>> {
        self.sums.iter().for_each(|sum| self.places[sum.splat as usize] = NONE);
        self.sums
    }
}

#[inline(always)]
fn differentiate<S: Simd, const C: usize>(
    simd: S,
    tile: &Tile,
    list: &[[u32; 2]],
    of: &[Splat<C>],
    coupled: &[f32; C],
    state: &mut Upstream<C>,
    gathered: &mut Gathered<C>,
) {
    let at = [tile.x as f32, tile.y as f32];
    for (k, &[_, splat]) in list.iter().enumerate() {
        fetch_ahead(list, k, of);
        gradients(simd, &of[splat as usize], at, coupled, state, gathered.of(splat));
        if state.pixels.open == 0 {
            break;
        }
    }
}

/// Pairs of each tile, (evaluated, blended, in rows, 0) for its first pixel.
pub(super) fn count_pairs(call: &mut NativeCall) -> Result<(), String> {
    let ([width, height, tiles_x], groups, level) = (call.words()?, call.groups(), Level::new());
    let rows = TileRows::of_image(width as usize, height as usize, tiles_x as usize);
    let [projected, ranges, splats, counts] = call.memory([0, 1, 2, 3])?;
    let (projected, ranges): (&[[f32; FLOATS]], &[u32]) = (projected.of(), ranges.of());
    let splats: &[[u32; 2]] = splats.of();
    let counts = counts.of::<[u32; 4]>().par_chunks_exact_mut(EDGE * EDGE * groups[0] as usize);
    counts.take(groups[1] as usize).enumerate().for_each(|(row, counts)| {
        counts.fill([0; 4]);
        for (tile, counts) in rows.tiles(groups, row).zip(counts.chunks_exact_mut(EDGE * EDGE)) {
            let (mut pixels, mut sums) = (tile.pixels(), [0; 3]);
            let at = [tile.x as f32, tile.y as f32];
            for [_, splat] in &splats[ranges[tile.list] as usize..ranges[tile.list + 1] as usize] {
                let splat = Splat::of(&projected[*splat as usize], &[], false);
                dispatch!(level, simd => count(simd, &splat, at, &mut pixels, &mut sums));
                if pixels.open == 0 {
                    break;
                }
            }
            counts[0][..3].copy_from_slice(&sums);
        }
    });
    Ok(())
}
