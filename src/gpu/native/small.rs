//! Passes of one loop: `sum.comp`, `camera_sum.comp`, `depth_l1.comp`, `alpha_l1.comp`,
//! `clear_depth_gradient.comp`, `ratio_penalty.comp` and `features_forward.comp`.
use crate::gpu::NativeCall;
use crate::gpu::shaders::shared::layout::CAMERA_GRADIENTS;
use rayon::prelude::*;

/// Numbers of one task.
const CHUNK: usize = 1 << 14;

/// GLSL's `sign`, which is 0 for 0.
pub(super) fn sign(v: f32) -> f32 {
    f32::from(u8::from(v > 0.0)) - f32::from(u8::from(v < 0.0))
}

pub(super) fn sum(call: &mut NativeCall) -> Result<(), String> {
    let ([count, slot], groups) = (call.words()?.map(|word| word as usize), call.groups()[0] as usize);
    let [values, result] = call.memory([0, 1])?;
    let values: &[f32] = &values.of()[..count];
    let share = count.div_ceil(groups.max(1)).max(1);
    let sums = result.of::<f32>()[slot..slot + groups].par_iter_mut().enumerate();
    sums.for_each(|(group, sum)| {
        let own = &values[(group * share).min(count)..((group + 1) * share).min(count)];
        // Partial sums keep the rounding of long sums small.
        *sum = own.chunks(256).map(|part| part.iter().sum::<f32>()).sum();
    });
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

/// Planes of an upstream stack: of depth, and of alpha.
fn depth_and_alpha(upstream: &mut [f32], pixels: usize, alpha_plane: usize) -> [&mut [f32]; 2] {
    let (before, alpha) = upstream.split_at_mut(alpha_plane * pixels);
    [&mut before[3 * pixels..4 * pixels], &mut alpha[..pixels]]
}

pub(super) fn depth_l1(call: &mut NativeCall) -> Result<(), String> {
    let [pixels, alpha_plane, weight] = call.words()?;
    let (pixels, alpha_plane, weight) = (pixels as usize, alpha_plane as usize, f32::from_bits(weight));
    let [reference, planes, transmittance, upstream] = call.memory([0, 1, 2, 3])?;
    let (reference, planes): (&[f32], &[f32]) = (reference.of(), planes.of());
    let (depths, left): (&[f32], &[f32]) = (&planes[3 * pixels..4 * pixels], transmittance.of());
    let [by_depth, by_alpha] = depth_and_alpha(upstream.of(), pixels, alpha_plane);
    let out = by_depth.par_iter_mut().zip(by_alpha).with_min_len(CHUNK);
    out.zip(reference).zip(depths.par_iter().zip(left)).for_each(|((out, d), (depth, left))| {
        let slope = if *d > 0.0 { weight * sign(depth - (1.0 - left) * d) } else { 0.0 };
        *out.0 = if *d > 0.0 { slope / d } else { 0.0 };
        *out.1 = -slope;
    });
    Ok(())
}

pub(super) fn alpha_l1(call: &mut NativeCall) -> Result<(), String> {
    let [pixels, alpha_plane, weight] = call.words()?;
    let (pixels, alpha_plane, weight) = (pixels as usize, alpha_plane as usize, f32::from_bits(weight));
    let [wanted, transmittance, upstream] = call.memory([0, 1, 2])?;
    let (wanted, left): (&[f32], &[f32]) = (wanted.of(), transmittance.of());
    let [_, by_alpha] = depth_and_alpha(upstream.of(), pixels, alpha_plane);
    let out = by_alpha.par_iter_mut().with_min_len(CHUNK);
    out.zip(wanted).zip(left).for_each(|((out, a), left)| {
        if *a >= 0.0 {
            *out += weight * sign((1.0 - left) - a);
        }
    });
    Ok(())
}

pub(super) fn clear_depth_gradient(call: &mut NativeCall) -> Result<(), String> {
    let [pixels, alpha_plane] = call.words()?.map(|word| word as usize);
    let [upstream] = call.memory([0])?;
    depth_and_alpha(upstream.of(), pixels, alpha_plane).into_iter().for_each(|plane| plane.fill(0.0));
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
