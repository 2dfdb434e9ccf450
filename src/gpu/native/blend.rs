//! Splats over a tile of pixels, forward and backward. A row of eight pixels is a vector.
use super::tile::{EDGE, Pixels, Plane, Row};
use crate::gpu::shaders::shared::cutoffs::{ALPHA_MAX, LOG2_ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::gpu::shaders::shared::layout::{BASE_CHANNELS, MOMENTS, PROJECTED_FLOATS};
use crate::gpu::shaders::shared::tiles::{MARGIN, ROW_SLACK};
use fearless_simd::{Simd, f32x4, f32x8, f64x2, i32x8, mask32x8, prelude::*};

pub(super) const FLOATS: usize = PROJECTED_FLOATS as usize;
pub(super) const BASE: usize = BASE_CHANNELS as usize;
pub(super) const COLOUR: usize = MOMENTS as usize;
const ALPHA_MOST: f32 = ALPHA_MAX as f32;
const POWER_LEAST: f32 = LOG2_ALPHA_MIN as f32;
const T_LEAST: f32 = TRANSMITTANCE_MIN as f32;

/// A splat as the loops read it, with the values of its channels; those of RGB and depth are in one
/// cache line.
#[repr(align(64))]
pub(super) struct Splat<const C: usize> {
    u: f32,
    v: f32,
    a: f32,
    b: f32,
    c: f32,
    log2_opacity: f32,
    /// No pixel farther above or below the centre reaches the least alpha.
    half_height: f32,
    pub values: [f32; C],
}

impl<const C: usize> Splat<C> {
    /// `with_base`: whether the block of channels begins with RGB and depth.
    #[inline(always)]
    pub fn of(p: &[f32; FLOATS], codes: &[f32], with_base: bool) -> Splat<C> {
        let mut values = [0.0; C];
        let base = if with_base { BASE.min(C) } else { 0 };
        values[..base].copy_from_slice(&p[8..8 + base]);
        let own = codes.len().min(C - base);
        values[base..base + own].copy_from_slice(&codes[..own]);
        let [u, v, a, b, c, log2_opacity, det, ..] = *p;
        let k = (log2_opacity - POWER_LEAST + MARGIN as f32).max(0.0) * a;
        let half_height = (-k / det).max(0.0).sqrt() + ROW_SLACK as f32;
        Splat { u, v, a, b, c, log2_opacity, half_height, values }
    }
}

/// The numbers of a row's pixels.
const STEPS: Row = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];

/// Rows of the tile at `y`: centre − row, and a bit for each row that the splat may reach.
#[inline(always)]
fn rows<S: Simd, const C: usize>(simd: S, s: &Splat<C>, y: f32) -> (Row, u32) {
    let dy = f32x8::simd_from(simd, s.v - y) - f32x8::simd_from(simd, STEPS);
    (dy.to_array(), dy.abs().simd_le(s.half_height).to_bitmask() as u32)
}

/// 2 to the power of numbers between −126 and 126, to two units of the last place.
#[inline(always)]
pub(super) fn exp2<S: Simd>(x: f32x8<S>) -> f32x8<S> {
    let simd = x.token();
    let number = |value: f32| f32x8::simd_from(simd, value);
    // Adding 1.5 · 2²³ rounds to a whole number, which the low bits of the sum hold.
    let round = number(12_582_912.0);
    let shifted = x + round;
    let f = x - (shifted - round);
    let p = f.mul_add(number(1.535_336_2e-4), number(1.339_887_4e-3));
    let p = p.mul_add(f, number(9.618_437e-3));
    let p = p.mul_add(f, number(5.550_332_5e-2));
    let p = p.mul_add(f, number(2.402_264_8e-1));
    let p = p.mul_add(f, number(std::f32::consts::LN_2));
    let p = p.mul_add(f, number(1.0));
    // The bits of 1.5 · 2²³ itself leave the word.
    let exponent: i32x8<S> = shifted.bitcast::<i32x8<S>>() << 23;
    (p.bitcast::<i32x8<S>>() + exponent).bitcast()
}

/// Terms of log2(opacity × Gaussian) that the rows of a tile share.
struct Columns<S: Simd> {
    dx: f32x8<S>,
    /// The power at dy = 0.
    constant: f32x8<S>,
    /// Its derivative by dy there.
    linear: f32x8<S>,
    quadratic: f32x8<S>,
}

impl<S: Simd> Columns<S> {
    #[inline(always)]
    fn of<const C: usize>(simd: S, s: &Splat<C>, x: f32) -> Columns<S> {
        let dx = f32x8::simd_from(simd, s.u - x) - f32x8::simd_from(simd, STEPS);
        let constant = (dx * s.a).mul_add(dx, f32x8::simd_from(simd, s.log2_opacity));
        Columns { dx, constant, linear: dx * s.b, quadratic: f32x8::simd_from(simd, s.c) }
    }

    /// Powers in the row whose centre is `dy` above that of the splat, and where they suffice.
    #[inline(always)]
    fn powers(&self, dy: f32x8<S>) -> (f32x8<S>, mask32x8<S>) {
        let powers = self.quadratic.mul_add(dy, self.linear).mul_add(dy, self.constant);
        (powers, powers.simd_ge(POWER_LEAST))
    }
}

/// A splat over a row of pixels.
struct Cover<S: Simd> {
    /// opacity × Gaussian.
    raw: f32x8<S>,
    alpha: f32x8<S>,
    /// alpha × transmittance before the splat; 0 where the pixel stops or has stopped.
    weight: f32x8<S>,
    /// Transmittance behind the splat; negative where the pixel has stopped.
    t: f32x8<S>,
    stops: mask32x8<S>,
}

impl<S: Simd> Cover<S> {
    #[inline(always)]
    fn of(powers: f32x8<S>, shown: mask32x8<S>, t: f32x8<S>) -> Cover<S> {
        let zero = f32x8::simd_from(powers.token(), 0.0);
        let raw = exp2(powers);
        let alpha = shown.select(raw.min(ALPHA_MOST), zero);
        let weight = alpha * t;
        let next = t - weight;
        let stops = next.simd_lt(T_LEAST);
        Cover { raw, alpha, weight: stops.select(zero, weight), t: stops.select(-t.abs(), next), stops }
    }
}

impl Pixels {
    /// Calls `f` with each row that the splat changes, the dy of the row, and the cover there.
    #[inline(always)]
    fn cover<S: Simd, const C: usize>(
        &mut self,
        columns: &Columns<S>,
        s: &Splat<C>,
        y: f32,
        mut f: impl FnMut(usize, f32x8<S>, &Cover<S>),
    ) {
        let simd = columns.dx.token();
        let (dy, reached) = rows(simd, s, y);
        let mut left = reached & self.open;
        while left != 0 {
            let row = left.trailing_zeros() as usize % EDGE;
            left &= left - 1;
            let dy = f32x8::simd_from(simd, dy[row]);
            let (powers, shown) = columns.powers(dy);
            let cover = Cover::of(powers, shown, f32x8::simd_from(simd, self.t[row]));
            cover.t.store_array(&mut self.t[row]);
            f(row, dy, &cover);
            if cover.stops.any_true() && cover.t.simd_lt(0.0).all_true() {
                self.open &= !(1 << row);
            }
        }
    }
}

/// A tile while splats are blended.
pub(super) struct Blended<const C: usize> {
    pub pixels: Pixels,
    /// Sums of the channels of each row.
    pub channels: [[Row; C]; EDGE],
}

/// Blends a splat into the tile at (`x`, `y`).
#[inline(always)]
pub(super) fn blend<S: Simd, const C: usize>(simd: S, s: &Splat<C>, [x, y]: [f32; 2], tile: &mut Blended<C>) {
    tile.pixels.cover(&Columns::of(simd, s, x), s, y, |row, _, cover| {
        for (channel, value) in tile.channels[row].iter_mut().zip(s.values) {
            let sum = cover.weight.mul_add(f32x8::simd_from(simd, value), f32x8::simd_from(simd, *channel));
            sum.store_array(channel);
        }
    });
}

/// Adds the pairs of a splat with the pixels of the tile at (`x`, `y`): evaluated, blended, and in
/// rows with a blended one.
#[inline(always)]
pub(super) fn count<S: Simd>(
    simd: S,
    s: &Splat<0>,
    [x, y]: [f32; 2],
    pixels: &mut Pixels,
    counts: &mut [u32; 3],
) {
    let (_, reached) = rows(simd, s, y);
    counts[0] += EDGE as u32 * (reached & pixels.open).count_ones();
    pixels.cover(&Columns::of(simd, s, x), s, y, |_, _, cover| {
        let blended = cover.weight.simd_gt(0.0).to_bitmask().count_ones();
        counts[1] += blended;
        counts[2] += EDGE as u32 * blended.min(1);
    });
}

/// Blending weights of a splat over the tile at (`x`, `y`), summed over the pixels of each of `N`
/// label sets; `slots` has the set of each pixel.
#[inline(always)]
pub(super) fn label_weights<S: Simd, const N: usize>(
    simd: S,
    s: &Splat<0>,
    [x, y]: [f32; 2],
    pixels: &mut Pixels,
    slots: &[[i32; EDGE]; EDGE],
) -> [f32; N] {
    let zero = f32x8::simd_from(simd, 0.0);
    let mut sums = [zero; N];
    pixels.cover(&Columns::of(simd, s, x), s, y, |row, _, cover| {
        let slots = i32x8::simd_from(simd, slots[row]);
        for (set, sum) in sums.iter_mut().enumerate() {
            *sum += slots.simd_eq(set as i32).select(cover.weight, zero);
        }
    });
    let mut out = [0.0; N];
    add_sums(&mut out, &sums);
    out
}

/// A tile during the backward pass.
pub(super) struct Upstream<const C: usize> {
    pub pixels: Pixels,
    /// Upstream sum of everything behind the splats so far.
    pub behind: Plane,
    /// Upstream gradients of the channels of each row.
    pub channels: [[Row; C]; EDGE],
}

/// Gradient sums of a splat over some tiles.
#[derive(Clone, Copy)]
pub(super) struct Sums<const C: usize> {
    pub splat: u32,
    /// By the moments of the splat's power.
    pub moments: [f32; COLOUR],
    pub channels: [f32; C],
}

/// Adds the sums over the pixels of the tile at (`x`, `y`); `coupled` couples the channels with
/// the splat.
#[inline(always)]
pub(super) fn gradients<S: Simd, const C: usize>(
    simd: S,
    s: &Splat<C>,
    [x, y]: [f32; 2],
    coupled: &[f32; C],
    tile: &mut Upstream<C>,
    sums: &mut Sums<C>,
) {
    let zero = f32x8::simd_from(simd, 0.0);
    let columns = Columns::of(simd, s, x);
    let (mut m0, mut m1, mut m2) = (zero, zero, zero);
    let mut channels = [zero; C];
    tile.pixels.cover(&columns, s, y, |row, dy, cover| {
        let flat = cover.stops | cover.raw.simd_gt(ALPHA_MOST);
        let ratio = flat.select(zero, cover.alpha / (-cover.alpha + 1.0));
        let mut own = zero;
        for c in 0..C {
            let up = f32x8::simd_from(simd, tile.channels[row][c]);
            own = up.mul_add(f32x8::simd_from(simd, s.values[c] * coupled[c]), own);
            channels[c] = cover.weight.mul_add(up, channels[c]);
        }
        let behind = f32x8::simd_from(simd, tile.behind[row]) - cover.weight * own;
        behind.store_array(&mut tile.behind[row]);
        let sigma = ratio * (cover.t * own - behind);
        let by_y = sigma * dy;
        m0 += sigma;
        m1 += by_y;
        m2 = by_y.mul_add(dy, m2);
    });
    let m0_x = m0 * columns.dx;
    add_sums(&mut sums.moments, &[m0, m0_x, m1, m0_x * columns.dx, m1 * columns.dx, m2]);
    add_sums(&mut sums.channels, &channels);
}

/// Adds the sum of each vector.
#[inline(always)]
fn add_sums<S: Simd, const N: usize>(sums: &mut [f32; N], vectors: &[f32x8<S>; N]) {
    let zero = f32x8::simd_from(vectors[0].token(), 0.0);
    for (sums, vectors) in sums.chunks_mut(4).zip(vectors.chunks(4)) {
        let mut four = [zero; 4];
        four[..vectors.len()].copy_from_slice(vectors);
        let four = sums_of(four);
        for (k, sum) in sums.iter_mut().enumerate() {
            *sum += four[k];
        }
    }
}

/// The sum of each of four vectors.
#[inline(always)]
fn sums_of<S: Simd>(vectors: [f32x8<S>; 4]) -> f32x4<S> {
    let halved = |k: usize| {
        let (low, high) = vectors[k].split();
        low + high
    };
    let folded = |a: f32x4<S>, b: f32x4<S>| -> f64x2<S> { (a.zip_low(b) + a.zip_high(b)).bitcast() };
    let (ab, cd) = (folded(halved(0), halved(1)), folded(halved(2), halved(3)));
    ab.zip_low(cd).bitcast::<f32x4<S>>() + ab.zip_high(cd).bitcast::<f32x4<S>>()
}
