//! `adam.comp`.
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::adam::{BETA1, BETA2};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};

/// Parameters of one task.
const CHUNK: usize = 1 << 14;

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    let [count, stride, head, slot] = call.words()?.map(|word| word as usize);
    let [parameters, gradients, moments, faults, rates, guard] = call.memory([0, 1, 2, 3, 4, 5])?;
    if guard.of::<u32>()[1] != 0 {
        return Ok(());
    }
    let rates = &rates.of::<f32>()[4 * slot..4 * slot + 4];
    let (rate, second, eps) = ([rates[0], rates[1]], rates[2], rates[3]);
    let (beta1, beta2) = (BETA1 as f32, BETA2 as f32);
    let bad = AtomicU32::new(0);
    // Whole periods of the two rates.
    let chunk = CHUNK / stride * stride;
    let parameters = parameters.of::<f32>()[..count].par_chunks_mut(chunk);
    let gradients = gradients.of::<f32>()[..count].par_chunks(chunk);
    let moments = moments.of::<[f32; 2]>()[..count].par_chunks_mut(chunk);
    parameters.zip(gradients).zip(moments).for_each(|((parameters, gradients), moments)| {
        let mut own_bad = 0;
        for (k, ((p, g), mv)) in parameters.iter_mut().zip(gradients).zip(moments).enumerate() {
            let rate = rate[usize::from(k % stride >= head)];
            if !g.is_finite() {
                own_bad += 1;
                continue;
            }
            let m = beta1 * mv[0] + (1.0 - beta1) * g;
            let v = beta2 * mv[1] + (1.0 - beta2) * g * g;
            *mv = [m, v];
            *p -= rate * m / (v.sqrt() * second + eps);
        }
        bad.fetch_add(own_bad, Ordering::Relaxed);
    });
    faults.of::<u32>()[0] += bad.into_inner();
    Ok(())
}
