//! `bench_arithmetic.comp`: the limits of native code.
use super::blend::exp2;
use crate::gpu::NativeCall;
use crate::gpu::shaders::bench_arithmetic::{INDEPENDENT, PER_ROUND, WORKGROUP};
use fearless_simd::{Level, Simd, dispatch, f32x8, prelude::*};
use rayon::prelude::*;

/// Numbers of a vector.
const LANES: usize = 8;
/// Chains at once: their registers are those of AVX2.
const CHAINS_AT_ONCE: usize = 8;

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    let [rounds] = call.words()?;
    let exponentials = call.variant()[0] == 1;
    let count = call.groups()[0] as usize * WORKGROUP[0] as usize;
    let [values] = call.memory([0])?;
    let (values, level) = (&mut values.of::<f32>()[..count], Level::new());
    values.par_chunks_exact_mut(WORKGROUP[0] as usize).for_each(|values| {
        dispatch!(level, simd => chains(simd, values, rounds, exponentials));
    });
    Ok(())
}

#[inline(always)]
fn chains<S: Simd>(simd: S, values: &mut [f32], rounds: u32, exponentials: bool) {
    let number = |value: f32| f32x8::simd_from(simd, value);
    for values in values.chunks_exact_mut(LANES) {
        let start = f32x8::from_slice(simd, values);
        let mut sum = number(0.0);
        for first in (0..INDEPENDENT as usize).step_by(CHAINS_AT_ONCE) {
            let mut chain: [f32x8<S>; CHAINS_AT_ONCE] =
                std::array::from_fn(|k| start / number((first + k + 1) as f32));
            for _ in 0..rounds * PER_ROUND as u32 {
                for x in &mut chain {
                    *x = if exponentials { exp2(-*x) } else { x.mul_add(number(0.5), number(0.25)) };
                }
            }
            chain.into_iter().for_each(|x| sum += x);
        }
        sum.store_slice(values);
    }
}
