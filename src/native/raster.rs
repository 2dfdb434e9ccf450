//! `raster_forward.comp` and `raster_backward.comp`. A row of eight pixels of a tile is a vector.
use super::scatter::Scattered;
use super::vectorised;
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::cutoffs::{ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::gpu::shaders::shared::layout::{BASE_CHANNELS, GRADIENT_FLOATS, MOMENTS, PROJECTED_FLOATS, TILE};
use crate::gpu::shaders::structs::CameraView;
use rayon::prelude::*;

const EDGE: usize = TILE as usize;
const FLOATS: usize = PROJECTED_FLOATS as usize;
const BASE: usize = BASE_CHANNELS as usize;
const COLOUR: usize = MOMENTS as usize;
const GRADIENT: usize = GRADIENT_FLOATS as usize;
const ALPHA_MOST: f32 = ALPHA_MAX as f32;
const POWER_LEAST: f32 = LOG2_ALPHA_MIN as f32;
const T_LEAST: f32 = TRANSMITTANCE_MIN as f32;

/// A row of pixels.
type Row = [f32; EDGE];
/// A tile of pixels.
type Plane = [Row; EDGE];

/// Push constants of both passes.
struct Push {
    width: usize,
    top: usize,
    rows: usize,
    first_row: usize,
    list_row: usize,
    tiles_x: usize,
    code_vectors: usize,
    first_vector: usize,
    first_plane: usize,
    features: usize,
}

impl Push {
    fn of(call: &NativeCall) -> Result<Push, String> {
        let words: [u32; 10] = call.words()?;
        let [
            width,
            top,
            rows,
            first_row,
            list_row,
            tiles_x,
            code_vectors,
            first_vector,
            first_plane,
            features,
        ] = words.map(|word| word as usize);
        Ok(Push {
            width,
            top,
            rows,
            first_row,
            list_row,
            tiles_x,
            code_vectors,
            first_vector,
            first_plane,
            features,
        })
    }

    /// Pixels of the planes.
    fn pixels(&self) -> usize {
        self.width * self.rows
    }

    /// Tiles of a dispatch.
    fn tiles(&self, groups: [u32; 3]) -> impl IndexedParallelIterator<Item = Tile> + '_ {
        let columns = groups[0] as usize;
        (0..columns * groups[1] as usize).into_par_iter().with_min_len(8).map(move |k| {
            let (column, row) = (k % columns, k / columns + self.first_row);
            Tile {
                list: (row - self.list_row) * self.tiles_x + column,
                x: column * EDGE,
                y: row * EDGE,
                columns: (self.width - column * EDGE).min(EDGE),
                rows: (self.top + self.rows).saturating_sub(row * EDGE).min(EDGE),
            }
        })
    }

    /// Place of a pixel of a tile in a plane.
    fn pixel(&self, tile: &Tile, row: usize) -> usize {
        (tile.y + row - self.top) * self.width + tile.x
    }
}

/// A tile, with the columns and rows that lie in the image.
struct Tile {
    list: usize,
    x: usize,
    y: usize,
    columns: usize,
    rows: usize,
}

impl Tile {
    /// Transmittance before the first splat; negative beyond the border.
    fn start(&self) -> Plane {
        std::array::from_fn(|y| {
            std::array::from_fn(|x| if x < self.columns && y < self.rows { 1.0 } else { -1.0 })
        })
    }
}

/// A splat as the loops read it, with the values of its channels.
#[derive(Clone, Copy)]
struct Splat<const C: usize> {
    u: f32,
    v: f32,
    a: f32,
    b: f32,
    c: f32,
    log2_opacity: f32,
    values: [f32; C],
}

impl<const C: usize> Splat<C> {
    /// `with_base`: whether the block of channels begins with RGB and depth.
    fn of(p: &[f32; FLOATS], codes: &[f32], with_base: bool) -> Splat<C> {
        let mut values = [0.0; C];
        let base = if with_base { BASE } else { 0 };
        values[..base].copy_from_slice(&p[8..8 + base]);
        let own = codes.len().min(C - base);
        values[base..base + own].copy_from_slice(&codes[..own]);
        Splat { u: p[0], v: p[1], a: p[2], b: p[3], c: p[4], log2_opacity: p[5], values }
    }
}

/// 2 to the power of numbers between −126 and 126, to two units of the last place.
#[inline(always)]
fn exp2(x: f32) -> f32 {
    // Adding 1.5 · 2²³ rounds to a whole number, which the low bits of the sum hold.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND);
    let p = 1.535_336_2e-4;
    let p = p * f + 1.339_887_4e-3;
    let p = p * f + 9.618_437e-3;
    let p = p * f + 5.550_332_5e-2;
    let p = p * f + 2.402_264_8e-1;
    let p = p * f + std::f32::consts::LN_2;
    let p = p * f + 1.0;
    let exponent = (shifted.to_bits() << 23).wrapping_sub(ROUND.to_bits() << 23);
    f32::from_bits(p.to_bits().wrapping_add(exponent))
}

/// log2 of opacity × Gaussian in a row of pixels; `dy` is centre − row.
#[inline(always)]
fn powers<const C: usize>(s: &Splat<C>, x: f32, dy: f32) -> Row {
    std::array::from_fn(|l| {
        let dx = (s.u - x) - l as f32;
        (s.c * dy + s.b * dx) * dy + (s.a * dx * dx + s.log2_opacity)
    })
}

#[inline(always)]
fn reaches(powers: &Row) -> bool {
    powers.iter().fold(f32::MIN, |m, p| if *p > m { *p } else { m }) >= POWER_LEAST
}

/// Defines [`blend_row`] for a number of channels.
macro_rules! blend_of {
    ($name:ident, $channels:literal) => {
        vectorised! {
        fn $name(splats: &[Splat<$channels>], x: f32, y: f32, t: &mut Row, sums: &mut [Row; $channels]) {
            blend_row(splats, x, y, t, sums);
        }
        }
    };
}
blend_of!(blend_row4, 4);
blend_of!(blend_row7, 7);
blend_of!(blend_row12, 12);
blend_of!(blend_row16, 16);
blend_of!(blend_row20, 20);

/// Blends splats, nearest first, into a row of pixels; `t` is negative where a pixel has stopped.
#[inline(always)]
fn blend_row<const C: usize>(splats: &[Splat<C>], x: f32, y: f32, t: &mut Row, sums: &mut [Row; C]) {
    let (mut own_t, mut own) = (*t, *sums);
    for s in splats {
        let powers = powers(s, x, s.v - y);
        if !reaches(&powers) {
            continue;
        }
        let mut weights = [0.0; EDGE];
        for l in 0..EDGE {
            let alpha = exp2(powers[l]).min(ALPHA_MOST);
            let alpha = if powers[l] >= POWER_LEAST { alpha } else { 0.0 };
            let w = alpha * own_t[l];
            let next = own_t[l] - w;
            let stops = next < T_LEAST;
            weights[l] = if stops { 0.0 } else { w };
            own_t[l] = if stops { -own_t[l].abs() } else { next };
        }
        for (channel, value) in own.iter_mut().zip(s.values) {
            for l in 0..EDGE {
                channel[l] += weights[l] * value;
            }
        }
        if own_t.iter().fold(f32::MIN, |m, t| if *t > m { *t } else { m }) < 0.0 {
            break;
        }
    }
    (*t, *sums) = (own_t, own);
}

/// Blends a row of pixels: see [`blend_row`].
type BlendRow<const C: usize> = fn(&[Splat<C>], f32, f32, &mut Row, &mut [Row; C]);

pub(super) fn forward(call: &mut NativeCall) -> Result<(), String> {
    match call.variant()[0] {
        4 => forward_with::<4>(call, blend_row4),
        7 => forward_with::<7>(call, blend_row7),
        12 => forward_with::<12>(call, blend_row12),
        16 => forward_with::<16>(call, blend_row16),
        _ => forward_with::<20>(call, blend_row20),
    }
}

fn forward_with<const C: usize>(call: &mut NativeCall, blend: BlendRow<C>) -> Result<(), String> {
    let (push, groups) = (Push::of(call)?, call.groups());
    let with_base = C != 16;
    let base = if with_base { BASE } else { 0 };
    let [camera, projected, ranges, splats, codes, planes, transmittances] =
        call.optional([0, 1, 2, 3, 4, 5, 6]);
    let background = camera.of::<CameraView>().first().map_or([0.0; 3], |c| c.background);
    let (projected, ranges): (&[[f32; FLOATS]], &[u32]) = (projected.of(), ranges.of());
    let (splats, codes): (&[[u32; 2]], &[f32]) = (splats.of(), codes.of());
    let (planes, transmittances) =
        (Scattered::new(planes.of::<f32>()), Scattered::new(transmittances.of::<f32>()));
    let pixels = push.pixels();
    push.tiles(groups).for_each_init(Vec::new, |list: &mut Vec<Splat<C>>, tile| {
        let range = ranges[tile.list] as usize..ranges[tile.list + 1] as usize;
        list.clear();
        list.extend(splats[range].iter().map(|s| splat_of(s[0], projected, codes, &push, with_base)));
        let mut t = tile.start();
        for row in 0..tile.rows {
            let mut sums = [[0.0; EDGE]; C];
            blend(list, tile.x as f32, (tile.y + row) as f32, &mut t[row], &mut sums);
            let first = push.pixel(&tile, row);
            for l in 0..tile.columns {
                let left = t[row][l].abs();
                let write = |plane: usize, value: f32| {
                    // SAFETY: each pixel is of one tile.
                    unsafe { planes.set(plane * pixels + first + l, value) };
                };
                if with_base {
                    (0..3).for_each(|c| write(c, sums[c][l] + background[c] * left));
                    write(3, sums[3][l]);
                    // SAFETY: as above.
                    unsafe { transmittances.set(first + l, left) };
                }
                for feature in 0..push.features.min(C - base) {
                    write(push.first_plane + base + feature, sums[base + feature][l]);
                }
            }
        }
    });
    Ok(())
}

fn splat_of<const C: usize>(
    splat: u32,
    projected: &[[f32; FLOATS]],
    codes: &[f32],
    push: &Push,
    with_base: bool,
) -> Splat<C> {
    let stride = 4 * push.code_vectors;
    let first = splat as usize * stride + (4 * push.first_vector).min(stride);
    let end = ((splat as usize + 1) * stride).max(first);
    Splat::of(&projected[splat as usize], codes.get(first..end).unwrap_or_default(), with_base)
}

/// State of a tile in the backward pass.
struct Upstream<const C: usize> {
    t: Plane,
    /// Upstream sum of everything behind the splats so far.
    behind: Plane,
    channels: [Plane; C],
}

#[inline(always)]
fn gradients_of<const C: usize>(
    s: &Splat<C>,
    [x, y]: [f32; 2],
    rows: usize,
    coupled: [f32; C],
    tile: &mut Upstream<C>,
) -> ([f32; COLOUR], [f32; C]) {
    let (mut m0, mut m1, mut m2) = ([0.0; EDGE], [0.0; EDGE], [0.0; EDGE]);
    let mut channels = [[0.0f32; EDGE]; C];
    for row in 0..rows {
        let dy = s.v - (y + row as f32);
        let powers = powers(s, x, dy);
        if !reaches(&powers) {
            continue;
        }
        let (mut weights, mut ratios) = ([0.0; EDGE], [0.0; EDGE]);
        let t = &mut tile.t[row];
        for l in 0..EDGE {
            let raw = exp2(powers[l]);
            let alpha = if powers[l] >= POWER_LEAST { raw.min(ALPHA_MOST) } else { 0.0 };
            let w = alpha * t[l];
            let next = t[l] - w;
            let stops = next < T_LEAST;
            weights[l] = if stops { 0.0 } else { w };
            ratios[l] = if stops || raw > ALPHA_MOST { 0.0 } else { alpha / (1.0 - alpha) };
            t[l] = if stops { -t[l].abs() } else { next };
        }
        let mut own = [0.0; EDGE];
        for c in 0..C {
            let (up, felt) = (&tile.channels[c][row], s.values[c] * coupled[c]);
            for l in 0..EDGE {
                own[l] += felt * up[l];
                channels[c][l] += weights[l] * up[l];
            }
        }
        for l in 0..EDGE {
            tile.behind[row][l] -= weights[l] * own[l];
            let sigma = ratios[l] * (t[l] * own[l] - tile.behind[row][l]);
            m0[l] += sigma;
            m1[l] += sigma * dy;
            m2[l] += sigma * dy * dy;
        }
    }
    let mut moments = [0.0; COLOUR];
    for l in 0..EDGE {
        let dx = (s.u - x) - l as f32;
        moments[0] += m0[l];
        moments[1] += m0[l] * dx;
        moments[2] += m1[l];
        moments[3] += m0[l] * dx * dx;
        moments[4] += m1[l] * dx;
        moments[5] += m2[l];
    }
    (moments, channels.map(|lanes| lanes.iter().sum()))
}

/// Defines [`gradients_of`] for a number of channels.
macro_rules! backward_of {
    ($name:ident, $channels:literal) => {
        vectorised! {
        fn $name(
            s: &Splat<$channels>,
            at: [f32; 2],
            rows: usize,
            coupled: [f32; $channels],
            tile: &mut Upstream<$channels>,
        ) -> ([f32; COLOUR], [f32; $channels]) {
            gradients_of(s, at, rows, coupled, tile)
        }
        }
    };
}
backward_of!(gradients4, 4);
backward_of!(gradients7, 7);
backward_of!(gradients12, 12);
backward_of!(gradients16, 16);
backward_of!(gradients20, 20);

type Gradients<const C: usize> =
    fn(&Splat<C>, [f32; 2], usize, [f32; C], &mut Upstream<C>) -> ([f32; COLOUR], [f32; C]);

pub(super) fn backward(call: &mut NativeCall) -> Result<(), String> {
    match call.variant()[0] {
        4 => backward_with::<4>(call, gradients4),
        7 => backward_with::<7>(call, gradients7),
        12 => backward_with::<12>(call, gradients12),
        16 => backward_with::<16>(call, gradients16),
        _ => backward_with::<20>(call, gradients20),
    }
}

fn backward_with<const C: usize>(call: &mut NativeCall, gradients: Gradients<C>) -> Result<(), String> {
    let (push, groups) = (Push::of(call)?, call.groups());
    let words: [u32; 12] = call.words()?;
    let (alpha_plane, coupling) = (words[10] as usize, f32::from_bits(words[11]));
    let with_base = C != 16;
    let base = if with_base { BASE } else { 0 };
    let coupled: [f32; C] = std::array::from_fn(|c| if c < base { 1.0 } else { coupling });
    let [projected, ranges, splats, codes, codes_grad, planes, planes_grad, transmittances, projected_grad] =
        call.optional([0, 1, 2, 3, 4, 5, 6, 7, 8]);
    let (projected, ranges): (&[[f32; FLOATS]], &[u32]) = (projected.of(), ranges.of());
    let (splats, codes): (&[[u32; 2]], &[f32]) = (splats.of(), codes.of());
    let (planes, planes_grad): (&[f32], &[f32]) = (planes.of(), planes_grad.of());
    let transmittances: &[f32] = transmittances.of();
    let pixels = push.pixels();
    let features = push.features.min(C - base);
    // Per tile the sums of the splats on its list.
    let sums: Vec<Vec<(u32, [f32; COLOUR], [f32; C])>> = push
        .tiles(groups)
        .map(|tile| {
            let mut state =
                Upstream { t: tile.start(), behind: [[0.0; EDGE]; EDGE], channels: [[[0.0; EDGE]; EDGE]; C] };
            for row in 0..tile.rows {
                let first = push.pixel(&tile, row);
                for l in 0..tile.columns {
                    for c in 0..base + features {
                        let plane = if c < base && with_base { c } else { push.first_plane + c };
                        let g = planes_grad[plane * pixels + first + l];
                        state.channels[c][row][l] = g;
                        state.behind[row][l] += coupled[c] * g * planes[plane * pixels + first + l];
                    }
                    if with_base {
                        state.behind[row][l] -=
                            planes_grad[alpha_plane * pixels + first + l] * transmittances[first + l];
                    }
                }
            }
            let range = ranges[tile.list] as usize..ranges[tile.list + 1] as usize;
            let mut own = Vec::with_capacity(range.len());
            for [splat, _] in &splats[range] {
                let s = splat_of(*splat, projected, codes, &push, with_base);
                let (moments, channels) =
                    gradients(&s, [tile.x as f32, tile.y as f32], tile.rows, coupled, &mut state);
                own.push((*splat, moments, channels));
                if state.t.iter().flatten().all(|t| *t < 0.0) {
                    break;
                }
            }
            own
        })
        .collect();
    // Each task adds the sums of its share of the splats, in the order of the tiles.
    let count = projected.len();
    let share = count.div_ceil(4 * rayon::current_num_threads()).max(1);
    let stride = 4 * push.code_vectors;
    let geometry = projected_grad.of::<[f32; GRADIENT]>();
    let count = count.min(geometry.len());
    let geometry = geometry[..count].par_chunks_mut(share);
    let add = |first: usize, geometry: &mut [[f32; GRADIENT]], codes: &mut [f32]| {
        for (splat, moments, channels) in sums.iter().flatten() {
            let Some(k) = (*splat as usize).checked_sub(first).filter(|k| *k < geometry.len()) else {
                continue;
            };
            geometry[k].iter_mut().zip(moments).for_each(|(sum, m)| *sum += m);
            geometry[k][COLOUR..].iter_mut().zip(&channels[..base]).for_each(|(sum, c)| *sum += c);
            let at = k * stride + 4 * push.first_vector;
            let own = codes.get_mut(at..at + features).unwrap_or_default();
            own.iter_mut().zip(&channels[base..]).for_each(|(sum, c)| *sum += c);
        }
    };
    if features == 0 {
        geometry.enumerate().for_each(|(task, geometry)| add(task * share, geometry, &mut []));
    } else {
        let codes = codes_grad.of::<f32>()[..count * stride].par_chunks_mut(share * stride);
        geometry
            .zip(codes)
            .enumerate()
            .for_each(|(task, (geometry, codes))| add(task * share, geometry, codes));
    }
    Ok(())
}
