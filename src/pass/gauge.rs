//! The paper's parameterisation of language features, per block of `width` channels: `f̂ = f/(‖f‖+ε)` and its gradient
//! `∂f = (∂f̂ − u(u·∂f̂)·‖f‖/(‖f‖+ε))/(‖f‖+ε)` with u = f/‖f‖, `∂f̂/ε` at f = 0 (ALGORITHMS 8.4).
use crate::gpu::{Buffer, Recorder, shaders};

/// Workgroups of 64 in rows of at most 32768, since one dimension may end at 65535.
fn groups(blocks: usize) -> [u32; 3] {
    let groups = blocks.div_ceil(64).max(1);
    let row = groups.min(32768);
    [row as u32, groups.div_ceil(row) as u32, 1]
}

/// Records `features = gauge(raw)`, both `[blocks, width]`.
pub fn record(
    rec: &mut Recorder,
    raw: &Buffer,
    features: &Buffer,
    blocks: usize,
    width: usize,
    epsilon: f32,
) {
    rec.pass("feature gauge");
    let call = shaders::feature_gauge::call(
        &shaders::feature_gauge::Bindings { raw, features },
        &shaders::feature_gauge::Push { blocks: blocks as u32, width: width as u32, epsilon },
    );
    rec.dispatch(call, groups(blocks));
}

/// Records, in place, gradients by the rendered features → gradients by the raw ones.
pub fn record_backward(
    rec: &mut Recorder,
    raw: &Buffer,
    gradients: &Buffer,
    blocks: usize,
    width: usize,
    epsilon: f32,
) {
    rec.pass("feature gauge");
    let call = shaders::feature_gauge_backward::call(
        &shaders::feature_gauge_backward::Bindings { raw, gradients },
        &shaders::feature_gauge_backward::Push { blocks: blocks as u32, width: width as u32, epsilon },
    );
    rec.dispatch(call, groups(blocks));
}

/// The CPU twin of one block.
pub fn gauge(raw: &[f64], epsilon: f64) -> Vec<f64> {
    let norm = raw.iter().map(|v| v * v).sum::<f64>().sqrt();
    raw.iter().map(|v| v / (norm + epsilon)).collect()
}

/// The CPU twin of the gradient of one block.
pub fn gauge_backward(raw: &[f64], gradient: &[f64], epsilon: f64) -> Vec<f64> {
    let norm = raw.iter().map(|v| v * v).sum::<f64>().sqrt();
    let product: f64 = raw.iter().zip(gradient).map(|(f, g)| f * g).sum();
    let along = if norm > 0.0 { product / (norm * (norm + epsilon)) } else { 0.0 };
    raw.iter().zip(gradient).map(|(f, g)| (g - f * along) / (norm + epsilon)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::schedule::Random;

    #[test]
    fn gradient_matches_central_differences_also_at_zero() {
        let mut random = Random::new(8);
        let epsilon = 1e-3;
        let mut numbers = |scale: f64| (0..5).map(|_| random.normal() * scale).collect::<Vec<f64>>();
        for raw in [numbers(1.0), numbers(1e-3), vec![0.0; 5]] {
            let upstream = numbers(1.0);
            let gradient = gauge_backward(&raw, &upstream, epsilon);
            for k in 0..5 {
                // At zero the map is smooth only along rays: a step far below ε keeps the kink's O(h/ε) error small.
                let h = 1e-9;
                let at = |s: f64| {
                    let mut f = raw.clone();
                    f[k] += s;
                    gauge(&f, epsilon).iter().zip(&upstream).map(|(a, b)| a * b).sum::<f64>()
                };
                let difference = (at(h) - at(-h)) / (2.0 * h);
                assert!((difference - gradient[k]).abs() < 1e-5 * (1.0 + gradient[k].abs()), "{raw:?} {k}");
            }
        }
    }

    #[test]
    fn gpu_equals_the_twin() {
        let device = crate::gpu::test_device();
        let mut random = Random::new(3);
        let (blocks, width, epsilon) = (131, 7, 1e-3f32);
        let mut raw: Vec<f32> = (0..blocks * width).map(|_| random.normal() as f32).collect();
        raw[..width].fill(0.0);
        raw[width..2 * width].iter_mut().for_each(|v| *v *= 1e-4);
        let upstream: Vec<f32> = (0..blocks * width).map(|_| random.normal() as f32).collect();
        let raw_buffer = device.buffer_from("raw", &raw).unwrap();
        let features = device.buffer::<f32>("features", raw.len()).unwrap();
        let gradients = device.buffer_from("gradients", &upstream).unwrap();
        let mut rec = Recorder::new(&device, "gauge");
        record(&mut rec, &raw_buffer, &features, blocks, width, epsilon);
        record_backward(&mut rec, &raw_buffer, &gradients, blocks, width, epsilon);
        rec.run().unwrap();
        let (features, gradients) = (features.read::<f32>().unwrap(), gradients.read::<f32>().unwrap());
        let wide = |v: &[f32]| v.iter().map(|&a| f64::from(a)).collect::<Vec<_>>();
        for block in 0..blocks {
            let r = block * width..(block + 1) * width;
            let f = gauge(&wide(&raw[r.clone()]), f64::from(epsilon));
            let g = gauge_backward(&wide(&raw[r.clone()]), &wide(&upstream[r.clone()]), f64::from(epsilon));
            let scale = g.iter().fold(1.0f64, |m, v| m.max(v.abs()));
            for k in 0..width {
                assert!((f64::from(features[r.start + k]) - f[k]).abs() < 1e-5);
                assert!((f64::from(gradients[r.start + k]) - g[k]).abs() < 1e-5 * scale, "block {block}");
            }
        }
    }
}
