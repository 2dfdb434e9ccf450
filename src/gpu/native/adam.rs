//! `adam.comp`.
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::adam::{BETA1, BETA2, SIGN_AND_M, SPREAD, STIR, V_BITS, V_SHIFT};
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};

/// Parameters of one task.
const CHUNK: usize = 1 << 14;
/// Periods of the two rates in the pattern of rates: whole vectors for every stride.
const PERIODS: usize = 16;

/// Numbers that all parameters of a step share.
struct Step {
    /// Rates of [`PERIODS`] periods.
    rates: Vec<f32>,
    second: f32,
    eps: f32,
    seed: u32,
}

/// `rounding_noise` of `adam.glsl`.
#[inline(always)]
fn noise(index: u32, seed: u32) -> u32 {
    let hash = (index ^ (seed ^ (seed >> 16))).wrapping_mul(SPREAD);
    let hash = (hash ^ (hash >> 15)).wrapping_mul(STIR);
    hash ^ (hash >> 13)
}

/// Moves the parameters from number `first` on, whole periods but at the end, and returns how many
/// gradients are not finite. A loop without branches, which the compiler turns into vectors.
#[inline(always)]
fn advance(step: &Step, first: usize, parameters: &mut [f32], gradients: &[f32], moments: &mut [u32]) -> u32 {
    let (beta1, beta2, mut bad) = (BETA1 as f32, BETA2 as f32, 0);
    let length = step.rates.len();
    let all = parameters.chunks_mut(length).zip(gradients.chunks(length)).zip(moments.chunks_mut(length));
    for (part, ((parameters, gradients), moments)) in all.enumerate() {
        let first = (first + part * length) as u32;
        let numbers = parameters.iter_mut().zip(gradients).zip(moments).zip(&step.rates);
        for (k, (((p, &g), word), rate)) in numbers.enumerate() {
            let finite = g.is_finite();
            let [old_m, old_v] = crate::pass::adam::unpacked(*word);
            let m = beta1 * old_m + (1.0 - beta1) * g;
            let v = beta2 * old_v + (1.0 - beta2) * g * g;
            let noise = noise(first.wrapping_add(k as u32), step.seed);
            let upper = m.to_bits().wrapping_add(noise & 0xffff) & SIGN_AND_M;
            let lower = v.to_bits().wrapping_add(noise >> 17) >> V_SHIFT & V_BITS;
            let moved = *p - rate * m / (v.sqrt() * step.second + step.eps);
            *word = if finite { upper | lower } else { *word };
            *p = if finite { moved } else { *p };
            bad += u32::from(!finite);
        }
    }
    bad
}

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    let [count, stride, head, slot] = call.words()?;
    let [parameters, gradients, moments, faults, rates, guard] = call.memory([0, 1, 2, 3, 4, 5])?;
    if guard.of::<u32>()[1] != 0 {
        return Ok(());
    }
    let rates: &[[f32; 4]] = rates.of();
    let [head_rate, tail_rate, second, eps] = rates[1 + slot as usize];
    let rate = |k: usize| if (k % stride as usize) < head as usize { head_rate } else { tail_rate };
    let seed = (rates[0][0] as u32).wrapping_mul(STIR).wrapping_add(slot.wrapping_mul(SPREAD));
    let rates: Vec<f32> = (0..PERIODS * stride as usize).map(rate).collect();
    let chunk = (CHUNK / rates.len()).max(1) * rates.len();
    let step = Step { rates, second, eps, seed };
    let (count, bad, level) = (count as usize, AtomicU32::new(0), Level::new());
    let parameters = parameters.of::<f32>()[..count].par_chunks_mut(chunk);
    let gradients = gradients.of::<f32>()[..count].par_chunks(chunk);
    let moments = moments.of::<u32>()[..count].par_chunks_mut(chunk);
    parameters.zip(gradients).zip(moments).enumerate().for_each(|(k, ((parameters, gradients), moments))| {
        let own = dispatch!(level, _simd => advance(&step, k * chunk, parameters, gradients, moments));
        bad.fetch_add(own, Ordering::Relaxed);
    });
    faults.of::<u32>()[0] += bad.into_inner();
    Ok(())
}
