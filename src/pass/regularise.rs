//! Regularisers of the RGB stage (docs/internals/method.md#regularisers): stereo depth, wanted
//! alpha, and a penalty on needles.
use super::frame::FrameBuffers;
use super::sort::rows_of_groups;
use crate::gpu::{Buffer, Recorder, shaders};

/// Records the gradients by D = Σwz and A of `weight · Σ |D − A·d|/d` over pixels with reference
/// depth d > 0, and of `weight · Σ |A − a|` over pixels with a wanted alpha a ≥ 0. Overwrites both
/// planes of gradients, with zeros without either. For a mean, `weight` is divided by the number of
/// pixels.
pub fn record_depth_and_alpha(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    depth: Option<(&Buffer<f32>, f64)>,
    alpha: Option<(&Buffer<f32>, f64)>,
) {
    rec.pass("regularisers");
    let pixels = frame.pixels();
    // The variant without a term does not read its buffer: any other one takes the place.
    let off = (&frame.planes, 0.0);
    let ((reference, depth_weight), (wanted, alpha_weight)) = (depth.unwrap_or(off), alpha.unwrap_or(off));
    let call = shaders::depth_and_alpha::call(
        shaders::depth_and_alpha::Variant { depth: depth.is_some().into(), alpha: alpha.is_some().into() },
        &shaders::depth_and_alpha::Bindings {
            reference,
            planes: &frame.planes,
            wanted,
            transmittance: &frame.transmittance,
            upstream: &frame.planes_grad,
        },
        &shaders::depth_and_alpha::Push {
            pixels,
            alpha_plane: 4 + frame.feature_dim as u32,
            depth_weight: depth_weight as f32,
            alpha_weight: alpha_weight as f32,
        },
    );
    rec.dispatch_threads(call, [pixels, 1, 1]);
}

/// CPU reference of the depth term of [`record_depth_and_alpha`]: (loss, gradients by D and by A).
pub fn depth_l1(depth: &[f64], alpha: &[f64], reference: &[f64], weight: f64) -> (f64, Vec<[f64; 2]>) {
    let mut loss = 0.0;
    let gradient = (0..depth.len()).map(|i| {
        let d = reference[i];
        if d <= 0.0 {
            return [0.0; 2];
        }
        let difference = depth[i] - alpha[i] * d;
        loss += weight * difference.abs() / d;
        [weight * difference.signum() / d, -weight * difference.signum()]
    });
    let gradient = gradient.collect();
    (loss, gradient)
}

/// CPU reference of the alpha term of [`record_depth_and_alpha`]: (loss, gradient by A).
pub fn alpha_l1(alpha: &[f64], wanted: &[f64], weight: f64) -> (f64, Vec<f64>) {
    let pairs = || alpha.iter().zip(wanted);
    let loss = pairs().filter(|(_, w)| **w >= 0.0).map(|(a, w)| weight * (a - w).abs()).sum();
    let slope = |(a, w): (&f64, &f64)| if *w < 0.0 || a == w { 0.0 } else { weight * (a - w).signum() };
    (loss, pairs().map(slope).collect())
}

/// Penalty on needles `weight · Σ max(0, s_max/s_min − limit)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RatioPenalty {
    /// Weight per splat.
    pub weight: f64,
    /// Ratio of the axes up to which a splat is no needle.
    pub limit: f32,
}

/// Records `gradients += ∂/∂log_scales (weight · Σ max(0, s_max/s_min − limit))`, both [N, 3].
pub fn record_ratio(
    rec: &mut Recorder,
    log_scales: &Buffer<f32>,
    gradients: &Buffer<f32>,
    count: usize,
    penalty: RatioPenalty,
) {
    rec.pass("regularisers");
    let call = shaders::ratio_penalty::call(
        &shaders::ratio_penalty::Bindings { log_scales, gradients },
        &shaders::ratio_penalty::Push {
            count: count as u32,
            weight: penalty.weight as f32,
            limit: penalty.limit,
        },
    );
    rec.dispatch(call, rows_of_groups(count.div_ceil(shaders::ratio_penalty::WORKGROUP[0] as usize)));
}

/// CPU reference of [`record_ratio`]: (loss, gradient by the log-scales of one splat). The shader
/// is exact for ratios up to e^10.
pub fn ratio_penalty(log_scales: [f64; 3], weight: f64, limit: f64) -> (f64, [f64; 3]) {
    let (mut high, mut low) = (0, 0);
    for k in 1..3 {
        high = if log_scales[k] > log_scales[high] { k } else { high };
        low = if log_scales[k] < log_scales[low] { k } else { low };
    }
    let ratio = (log_scales[high] - log_scales[low]).exp();
    let mut gradient = [0.0; 3];
    if ratio > limit {
        gradient[high] = weight * ratio;
        gradient[low] = -weight * ratio;
    }
    (weight * (ratio - limit).max(0.0), gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn ratio_gradient_matches_differences_and_device() {
        let device = crate::gpu::test_device();
        let mut random = Random::new(2);
        let rows: Vec<[f32; 3]> = (0..97).map(|_| [0; 3].map(|_| random.normal() as f32 * 2.0)).collect();
        let log_scales = device.buffer_from("log scales", rows.as_flattened()).unwrap();
        let gradients = device.buffer_from("gradients", &[1.0f32; 3 * 97]).unwrap();
        let mut rec = Recorder::new(&device, "ratio");
        let penalty = RatioPenalty { weight: 0.5, limit: 8.0 };
        record_ratio(&mut rec, &log_scales, &gradients, 97, penalty);
        rec.run().unwrap();
        let mut active = 0;
        for (row, got) in rows.iter().zip(gradients.read().unwrap().chunks_exact(3)) {
            let row = row.map(f64::from);
            let (_, gradient) = ratio_penalty(row, 0.5, 8.0);
            active += usize::from(gradient != [0.0; 3]);
            for k in 0..3 {
                let loss_at = |s: f64| {
                    let mut r = row;
                    r[k] += s;
                    ratio_penalty(r, 0.5, 8.0).0
                };
                let difference = (loss_at(1e-6) - loss_at(-1e-6)) / 2e-6;
                assert!((difference - gradient[k]).abs() < 1e-5 * (1.0 + gradient[k].abs()));
                assert!((f64::from(got[k]) - 1.0 - gradient[k]).abs() < 1e-5 * (1.0 + gradient[k].abs()));
            }
        }
        assert!(active > 20, "the sample must contain needles");
    }

    #[test]
    fn ratio_of_degenerate_splat_is_capped() {
        let device = crate::gpu::test_device();
        // A ratio of e^90, more than f32 holds.
        let log_scales = device.buffer_from("log scales", &[45.0f32, 0.0, -45.0]).unwrap();
        let gradients = device.buffer::<f32>("gradients", 3).unwrap();
        let mut rec = Recorder::new(&device, "degenerate");
        let penalty = RatioPenalty { weight: 0.5, limit: 8.0 };
        record_ratio(&mut rec, &log_scales, &gradients, 1, penalty);
        rec.run().unwrap();
        let got = gradients.read().unwrap();
        let capped = 0.5 * 10f32.exp();
        assert!((got[0] / capped - 1.0).abs() < 1e-4 && got[1] == 0.0 && got[2] == -got[0], "{got:?}");
    }

    #[test]
    fn depth_gradient_matches_differences_and_device() {
        let device = crate::gpu::test_device();
        let mut random = Random::new(6);
        let (width, height) = (13u32, 9u32);
        let pixels = (width * height) as usize;
        let raster = crate::pass::Rasterizer::new(&device, 1, 0, width, height).unwrap();
        let frame = raster.frame();
        let mut numbers = |low: f64| (0..pixels).map(|_| low + random.uniform()).collect::<Vec<f64>>();
        let (depth, alpha, mut reference) = (numbers(0.0), numbers(0.0), numbers(0.5));
        reference[7] = 0.0;
        let narrow = |v: &[f64]| v.iter().map(|&a| a as f32).collect::<Vec<f32>>();
        let see_through: Vec<f64> = alpha.iter().map(|a| 1.0 - a).collect();
        frame.planes.write_at(3 * pixels, &narrow(&depth)).unwrap();
        frame.transmittance.write(&narrow(&see_through)).unwrap();
        let buffer = device.buffer_from("reference", &narrow(&reference)).unwrap();
        let mut rec = Recorder::new(&device, "depth");
        record_depth_and_alpha(&mut rec, frame, Some((&buffer, 0.25)), None);
        rec.run().unwrap();
        let upstream = frame.planes_grad.read().unwrap();
        let (_, gradient) = depth_l1(&depth, &alpha, &reference, 0.25);
        for i in 0..pixels {
            let loss = |d: f64, a: f64| depth_l1(&[d], &[a], &[reference[i]], 0.25).0;
            let by_depth = (loss(depth[i] + 1e-7, alpha[i]) - loss(depth[i] - 1e-7, alpha[i])) / 2e-7;
            let by_alpha = (loss(depth[i], alpha[i] + 1e-7) - loss(depth[i], alpha[i] - 1e-7)) / 2e-7;
            for (k, difference) in [by_depth, by_alpha].into_iter().enumerate() {
                assert!((difference - gradient[i][k]).abs() < 1e-6);
                let got = f64::from(upstream[(3 + k) * pixels + i]);
                assert!((got - gradient[i][k]).abs() < 1e-6, "pixel {i}");
            }
        }
        let mut rec = Recorder::new(&device, "clear");
        record_depth_and_alpha(&mut rec, frame, None, None);
        rec.run().unwrap();
        assert!(frame.planes_grad.read().unwrap().iter().all(|&g| g == 0.0));
    }

    #[test]
    fn alpha_gradient_matches_differences_and_device() {
        let device = crate::gpu::test_device();
        let mut random = Random::new(7);
        let (width, height) = (13u32, 9u32);
        let pixels = (width * height) as usize;
        let raster = crate::pass::Rasterizer::new(&device, 1, 0, width, height).unwrap();
        let frame = raster.frame();
        let mut numbers = || (0..pixels).map(|_| random.uniform()).collect::<Vec<f64>>();
        let (alpha, mut wanted) = (numbers(), numbers());
        (wanted[3], wanted[40]) = (-1.0, 0.0);
        let narrow = |v: &[f64]| v.iter().map(|&a| a as f32).collect::<Vec<f32>>();
        let see_through: Vec<f64> = alpha.iter().map(|a| 1.0 - a).collect();
        frame.transmittance.write(&narrow(&see_through)).unwrap();
        let buffer = device.buffer_from("wanted", &narrow(&wanted)).unwrap();
        let mut rec = Recorder::new(&device, "alpha");
        record_depth_and_alpha(&mut rec, frame, None, Some((&buffer, 0.75)));
        rec.run().unwrap();
        let upstream = frame.planes_grad.read().unwrap();
        let (_, gradient) = alpha_l1(&alpha, &wanted, 0.75);
        for i in 0..pixels {
            let loss = |a: f64| alpha_l1(&[a], &[wanted[i]], 0.75).0;
            let difference = (loss(alpha[i] + 1e-7) - loss(alpha[i] - 1e-7)) / 2e-7;
            assert!((difference - gradient[i]).abs() < 1e-6, "pixel {i}");
            assert!((f64::from(upstream[4 * pixels + i]) - gradient[i]).abs() < 1e-6, "pixel {i}");
        }
        assert!(upstream[..4 * pixels].iter().all(|g| *g == 0.0) && gradient[3] == 0.0);
    }
}
