//! `decode.comp`.
use crate::gpu::NativeCall;
use crate::gpu::shaders::decode::{MIN_FEATURE_SHARE, VOID_ALPHA};
use fearless_simd::{Level, Simd, dispatch, f32x8, i32x8, prelude::*};
use rayon::prelude::*;

const LANES: usize = 8;
/// Pixels of one task.
const CHUNK: usize = 128 * LANES;

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    match call.variant()[0] {
        4 => run_with::<4>(call),
        8 => run_with::<8>(call),
        16 => run_with::<16>(call),
        _ => run_with::<32>(call),
    }
}

/// `D`: components of a code, of which `dim` are not padding.
fn run_with<const D: usize>(call: &mut NativeCall) -> Result<(), String> {
    let [pixels, count, dim, first_plane] = call.words()?.map(|word| word as usize);
    let [features, transmittance, codes, decoded] = call.memory([0, 1, 2, 3])?;
    let features: &[f32] = &features.of()[first_plane * pixels..(first_plane + dim) * pixels];
    let (transmittance, codes): (&[f32], &[f32]) = (transmittance.of(), codes.of());
    let codes = &codes.as_chunks::<D>().0[..count];
    let level = Level::new();
    let chunks = decoded.of::<i32>()[..pixels].par_chunks_mut(CHUNK).enumerate();
    chunks.for_each(|(chunk, decoded)| {
        for (block, decoded) in decoded.chunks_mut(LANES).enumerate() {
            let first = chunk * CHUNK + block * LANES;
            // Behind the last pixel are zeros.
            let mut feature = [[0.0; LANES]; D];
            for (c, feature) in feature.iter_mut().enumerate().take(dim) {
                let own = &features[c * pixels + first..][..decoded.len()];
                feature[..own.len()].copy_from_slice(own);
            }
            let (chosen, norm) = dispatch!(level, simd => best(simd, &feature, codes));
            for (lane, code) in decoded.iter_mut().enumerate() {
                let alpha = 1.0 - transmittance[first + lane];
                let shown = alpha >= VOID_ALPHA as f32 && norm[lane] >= MIN_FEATURE_SHARE as f32 * alpha;
                *code = if shown { chosen[lane] } else { -1 };
            }
        }
    });
    Ok(())
}

/// The code of each of eight pixels, −1 without codes, and the norms of their features.
#[inline(always)]
fn best<S: Simd, const D: usize>(
    simd: S,
    feature: &[[f32; LANES]; D],
    codes: &[[f32; D]],
) -> ([i32; LANES], [f32; LANES]) {
    let zero = f32x8::simd_from(simd, 0.0);
    let feature: [f32x8<S>; D] = std::array::from_fn(|c| f32x8::simd_from(simd, feature[c]));
    let (mut best, mut chosen) = (f32x8::simd_from(simd, f32::MIN), i32x8::simd_from(simd, -1));
    for (k, code) in codes.iter().enumerate() {
        // Two sums, so that an addition need not wait for the one before it.
        let mut scores = [zero; 2];
        for c in 0..D {
            scores[c % 2] = feature[c].mul_add(f32x8::simd_from(simd, code[c]), scores[c % 2]);
        }
        let score = scores[0] + scores[1];
        let better = score.simd_gt(best);
        best = better.select(score, best);
        chosen = better.select(i32x8::simd_from(simd, k as i32), chosen);
    }
    let mut squares = zero;
    for f in feature {
        squares = f.mul_add(f, squares);
    }
    (chosen.to_array(), squares.sqrt().to_array())
}
