//! Language loss: L1 between rendered features and the code of each labelled pixel
//! (docs/internals/method.md#language-loss).
use super::frame::FrameBuffers;
use crate::gpu::{Buffer, Recorder, shaders};

/// Targets of one view.
pub struct Targets<'a> {
    /// [levels, H·W] rows of `codes`, −1 = none.
    pub labels: &'a Buffer<i32>,
    /// [ΣK, width] codes of all levels.
    pub codes: &'a Buffer<f32>,
    /// [levels] weight of one labelled value.
    pub weights: &'a Buffer<f32>,
    /// Number of levels.
    pub levels: u32,
    /// Code length d.
    pub width: u32,
}

/// Records the loss of the band in the planes of a frame: writes the feature planes of
/// `frame.planes_grad` and the loss per pixel, `loss` [H·W].
pub fn record(rec: &mut Recorder, targets: &Targets, frame: &FrameBuffers, loss: &Buffer<f32>) {
    rec.pass("feature loss");
    let pixels = frame.pixels();
    record_planes(rec, targets, &frame.planes, &frame.planes_grad, loss, pixels);
}

fn record_planes(
    rec: &mut Recorder,
    targets: &Targets,
    planes: &Buffer<f32>,
    upstream: &Buffer<f32>,
    loss: &Buffer<f32>,
    pixels: u32,
) {
    let call = shaders::code_l1::call(
        &shaders::code_l1::Bindings {
            labels: targets.labels,
            codes: targets.codes,
            weights: targets.weights,
            planes,
            upstream,
            loss,
        },
        &shaders::code_l1::Push { pixels, levels: targets.levels, width: targets.width },
    );
    rec.dispatch_threads(call, [pixels, 1, 1]);
}

/// CPU reference of the loss for one level: (loss per pixel, gradient [width, pixels]) of planar
/// features.
pub fn code_l1(
    labels: &[i32],
    codes: &[f64],
    width: usize,
    weight: f64,
    features: &[f64],
) -> (Vec<f64>, Vec<f64>) {
    let pixels = labels.len();
    let (mut loss, mut gradient) = (vec![0.0; pixels], vec![0.0; width * pixels]);
    for (p, &label) in labels.iter().enumerate().filter(|(_, l)| **l >= 0) {
        for k in 0..width {
            let difference = features[k * pixels + p] - codes[label as usize * width + k];
            loss[p] += weight * difference.abs();
            gradient[k * pixels + p] = if difference == 0.0 { 0.0 } else { weight * difference.signum() };
        }
    }
    (loss, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn code_l1_on_device_matches_reference() {
        let device = crate::gpu::test_device();
        let mut random = Random::new(21);
        let (pixels, levels, width, codes) = (301usize, 2usize, 5usize, 4usize);
        // Level 0 uses rows −1..4 of the table, level 1 rows 3..8 or none.
        let mut labels: Vec<i32> = (0..levels * pixels).map(|_| random.below(codes + 1) as i32 - 1).collect();
        for label in &mut labels[pixels..] {
            *label = if random.uniform() < 0.3 { -1 } else { *label + codes as i32 };
        }
        let table: Vec<f32> = (0..2 * codes * width).map(|_| random.normal() as f32).collect();
        let mut planes: Vec<f32> =
            (0..(4 + levels * width) * pixels).map(|_| random.normal() as f32).collect();
        let weights = [0.5f32, 0.25];
        let buffers = (
            device.buffer_from("labels", &labels).unwrap(),
            device.buffer_from("codes", &table).unwrap(),
            device.buffer_from("weights", &weights).unwrap(),
        );
        let targets = Targets {
            labels: &buffers.0,
            codes: &buffers.1,
            weights: &buffers.2,
            levels: levels as u32,
            width: width as u32,
        };
        let run = |planes: &[f32]| {
            let planes = device.buffer_from("planes", planes).unwrap();
            let upstream = device.buffer::<f32>("upstream", (5 + levels * width) * pixels).unwrap();
            let loss = device.buffer::<f32>("loss", pixels).unwrap();
            let mut rec = Recorder::new(&device, "codes");
            record_planes(&mut rec, &targets, &planes, &upstream, &loss, pixels as u32);
            rec.run().unwrap();
            (upstream.read().unwrap(), loss.read().unwrap())
        };
        let (upstream, loss) = run(&planes);
        let wide = |v: &[f32]| v.iter().map(|&a| f64::from(a)).collect::<Vec<_>>();
        let mut expected = vec![0.0; pixels];
        for level in 0..levels {
            let planes_of = (4 + level * width) * pixels..(4 + (level + 1) * width) * pixels;
            let (part, gradient) = code_l1(
                &labels[level * pixels..(level + 1) * pixels],
                &wide(&table),
                width,
                f64::from(weights[level]),
                &wide(&planes[planes_of.clone()]),
            );
            expected.iter_mut().zip(part).for_each(|(e, p)| *e += p);
            assert_eq!(wide(&upstream[planes_of]), gradient);
        }
        assert!(loss.iter().zip(&expected).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-5));
        // Rendered features of unlabelled pixels do not change a bit of the upstream.
        for level in 0..levels {
            for p in (0..pixels).filter(|p| labels[level * pixels + p] < 0) {
                (0..width).for_each(|k| planes[(4 + level * width + k) * pixels + p] = 1e6);
            }
        }
        assert_eq!(run(&planes), (upstream, loss));
    }
}
