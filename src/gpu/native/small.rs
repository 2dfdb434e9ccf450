//! Passes of one loop: `sum.comp`, `camera_sum.comp`, `depth_and_alpha.comp`, `ratio_penalty.comp`
//! and `features_forward.comp`.
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::layout::CAMERA_GRADIENTS;
use rayon::prelude::*;

/// Numbers of one task.
const CHUNK: usize = 1 << 14;
/// Partial sums of a range.
const PARTIALS: usize = crate::gpu::shaders::sum::PARTIALS as usize;

/// GLSL's `sign`, which is 0 for 0.
pub(super) fn sign(v: f32) -> f32 {
    f32::from(u8::from(v > 0.0)) - f32::from(u8::from(v < 0.0))
}

pub(super) fn sum(call: &mut NativeCall) -> Result<(), String> {
    let [first0, count0, first1, count1, slot] = call.words()?.map(|word| word as usize);
    let ranges = call.groups()[1] as usize;
    let [values, result] = call.memory([0, 1])?;
    let values: &[f32] = values.of();
    let result = result.of::<f32>()[PARTIALS * slot..].chunks_exact_mut(PARTIALS);
    for ((first, count), result) in [(first0, count0), (first1, count1)].into_iter().zip(result).take(ranges)
    {
        let values = &values[first..first + count];
        let share = count.div_ceil(PARTIALS).max(1);
        result.par_iter_mut().with_min_len(8).enumerate().for_each(|(part, sum)| {
            let own = &values[(part * share).min(count)..((part + 1) * share).min(count)];
            // Partial sums keep the rounding of long sums small.
            *sum = own.chunks(256).map(|part| part.iter().sum::<f32>()).sum();
        });
    }
    Ok(())
}

pub(super) fn camera_sum(call: &mut NativeCall) -> Result<(), String> {
    let [parts] = call.words()?.map(|word| word as usize);
    let [camera_parts, camera_grad] = call.memory([0, 1])?;
    let rows = camera_parts.of::<f32>().chunks_exact(parts.max(1)).take(CAMERA_GRADIENTS as usize);
    for (sum, row) in camera_grad.of::<f32>().iter_mut().zip(rows) {
        *sum = row.iter().sum();
    }
    Ok(())
}

pub(super) fn depth_and_alpha(call: &mut NativeCall) -> Result<(), String> {
    let [pixels, alpha_plane, depth_weight, alpha_weight] = call.words()?;
    let (pixels, alpha_plane) = (pixels as usize, alpha_plane as usize);
    let [depth_weight, alpha_weight] = [depth_weight, alpha_weight].map(f32::from_bits);
    // A term that is off has no buffers.
    let [reference, planes, wanted, transmittance, upstream] = call.optional([0, 1, 2, 3, 4]);
    let (reference, planes): (&[f32], &[f32]) = (reference.of(), planes.of());
    let (wanted, left): (&[f32], &[f32]) = (wanted.of(), transmittance.of());
    let (before, by_alpha) = upstream.of::<f32>().split_at_mut(alpha_plane * pixels);
    let by_depth = before[3 * pixels..4 * pixels].par_chunks_mut(CHUNK);
    by_depth.zip(by_alpha[..pixels].par_chunks_mut(CHUNK)).enumerate().for_each(
        |(chunk, (by_depth, by_alpha))| {
            let own = chunk * CHUNK..chunk * CHUNK + by_depth.len();
            by_depth.fill(0.0);
            by_alpha.fill(0.0);
            if !reference.is_empty() {
                let (depths, left) = (&planes[3 * pixels..][own.clone()], &left[own.clone()]);
                for (k, d) in reference[own.clone()].iter().enumerate().filter(|(_, d)| **d > 0.0) {
                    let slope = depth_weight * sign(depths[k] - (1.0 - left[k]) * d);
                    (by_depth[k], by_alpha[k]) = (slope / d, -slope);
                }
            }
            if !wanted.is_empty() {
                for ((by_alpha, a), left) in by_alpha.iter_mut().zip(&wanted[own.clone()]).zip(&left[own]) {
                    *by_alpha += if *a >= 0.0 { alpha_weight * sign((1.0 - left) - a) } else { 0.0 };
                }
            }
        },
    );
    Ok(())
}

pub(super) fn ratio_penalty(call: &mut NativeCall) -> Result<(), String> {
    let [count, weight, limit] = call.words()?;
    let (weight, limit) = (f32::from_bits(weight), f32::from_bits(limit).ln());
    let [log_scales, gradients] = call.memory([0, 1])?;
    let log_scales: &[[f32; 3]] = &log_scales.of()[..count as usize];
    let gradients = gradients.of::<[f32; 3]>()[..count as usize].par_iter_mut().with_min_len(CHUNK);
    gradients.zip(log_scales).for_each(|(gradient, s)| {
        let highest = s[0].max(s[1]).max(s[2]);
        let log_ratio = highest - s[0].min(s[1]).min(s[2]);
        if log_ratio <= limit || log_ratio.is_nan() {
            return;
        }
        let slope = weight * log_ratio.min(10.0).exp();
        // The first of equal scales is the highest, the last one the lowest, as in the shader.
        let high = if s[0] >= s[1] {
            if s[0] >= s[2] { 0 } else { 2 }
        } else if s[1] >= s[2] {
            1
        } else {
            2
        };
        let low = if s[0] < s[1] {
            if s[0] < s[2] { 0 } else { 2 }
        } else if s[1] < s[2] {
            1
        } else {
            2
        };
        gradient[high] += slope;
        gradient[low] -= slope;
    });
    Ok(())
}

pub(super) fn features_forward(call: &mut NativeCall) -> Result<(), String> {
    let [count, dim, stride, width, epsilon] = call.words()?;
    let [count, dim, stride, width] = [count, dim, stride, width].map(|word| word as usize);
    let epsilon = f32::from_bits(epsilon);
    let [features, codes] = call.memory([0, 1])?;
    let features: &[f32] = &features.of()[..count * dim];
    let codes = codes.of::<f32>()[..count * stride].par_chunks_exact_mut(stride).with_min_len(1024);
    codes.zip(features.par_chunks_exact(dim)).for_each(|(codes, features)| {
        for (out, block) in codes.chunks_mut(width).zip(features.chunks(width)) {
            let squares: f32 = block.iter().map(|f| f * f).sum();
            let scale = if epsilon < 0.0 { 1.0 } else { 1.0 / (squares.sqrt() + epsilon) };
            out.iter_mut().zip(block).for_each(|(out, f)| *out = f * scale);
        }
        codes[dim..].fill(0.0);
    });
    Ok(())
}
