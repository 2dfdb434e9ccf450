//! Adaptive density control (Kerbl et al. 2023): where the loss pulls hard at the place of a splat,
//! a small splat gets a copy, and a large one becomes two smaller ones
//! (docs/internals/method.md#density-control).
use super::model::Model;
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder};
use crate::math::Random;
use crate::pass::FrameBuffers;
use crate::pass::screen_gradients;
use glam::{DQuat, DVec3};

/// Divides the axes of a splat that becomes two.
const SHRINK: f32 = 1.6;

/// Options of density control.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DensifyOptions {
    /// Interval, steps; none after the last step.
    pub every: usize,
    /// Mean length of the gradient by the centre, in normalised device coordinates, from which on a
    /// splat grows.
    pub gradient: f32,
    /// Largest axis up to which a splat is copied and not divided, in units of the scene extent.
    pub size: f64,
    /// Most splats, in units of their number at the start: buffers have room for them.
    pub growth: usize,
}

impl DensifyOptions {
    /// The constants of 3DGS; its growth has no bound.
    pub const PUBLISHED: DensifyOptions =
        DensifyOptions { every: 100, gradient: 2e-4, size: 0.01, growth: 2 };
}

/// Statistics of the splats since the last growth.
pub(super) struct Density {
    options: DensifyOptions,
    most: usize,
    /// [N, 2], see [`screen_gradients`].
    sums: Buffer<f32>,
}

/// Splats that grow, ascending.
#[derive(Debug, Default, PartialEq)]
struct Growth {
    copied: Vec<u32>,
    divided: Vec<u32>,
}

impl Density {
    /// Statistics of `start` splats.
    pub(super) fn new(device: &Device, options: DensifyOptions, start: usize) -> Result<Density> {
        let sums = device.buffer::<f32>("screen gradients", 2 * start.max(1))?;
        Ok(Density { options, most: options.growth * start, sums })
    }

    /// Records the addition of a frame.
    pub(super) fn record(&self, rec: &mut Recorder, frame: &FrameBuffers, splats: usize) {
        screen_gradients::record(rec, frame, splats, &self.sums);
    }

    /// Sums of `splats` splats, for checkpoints.
    pub(super) fn state(&self, splats: usize) -> Result<Vec<f32>> {
        Ok(self.sums.read_range(0..2 * splats)?)
    }

    /// Restores sums.
    pub(super) fn restore(&mut self, device: &Device, sums: &[f32]) -> Result<()> {
        self.sums = device.buffer_from("screen gradients", sums)?;
        Ok(())
    }

    /// Begins new sums for `splats` splats.
    pub(super) fn reset(&mut self, device: &Device, splats: usize) -> Result<()> {
        self.sums = device.buffer::<f32>("screen gradients", 2 * splats.max(1))?;
        Ok(())
    }

    /// Whether density control is due after `step` of `steps`.
    pub(super) fn is_due(&self, step: usize, steps: usize) -> bool {
        step > 0 && step < steps && step.is_multiple_of(self.options.every)
    }

    /// Lets splats grow. Copies and halves begin without optimiser state.
    pub(super) fn grow(&self, model: &mut Model, extent: f64, seed: u64) -> Result<()> {
        let count = model.count();
        let sums = self.sums.read_range(0..2 * count)?;
        let log_scales = model.values.log_scales.read_range(0..3 * count)?;
        let room = self.most.saturating_sub(count);
        let Growth { copied, divided } = growth(&sums, &log_scales, &self.options, extent, room);
        let mut kept = vec![true; count];
        divided.iter().for_each(|&i| kept[i as usize] = false);
        let kept: Vec<u32> = (0..count as u32).filter(|&i| kept[i as usize]).collect();
        let (first, added) = (kept.len() + copied.len(), [&copied[..], &divided, &divided].concat());
        if added.is_empty() {
            return Ok(());
        }
        model.replace(&kept, &added)?;
        let halves = 2 * divided.len();
        let mut means = model.values.means.read_range(3 * first..3 * (first + halves))?;
        let mut log_scales = model.values.log_scales.read_range(3 * first..3 * (first + halves))?;
        let quats = model.values.quats.read_range(4 * first..4 * (first + halves))?;
        let mut random = Random::new(seed);
        let rows = means.as_chunks_mut().0.iter_mut().zip(log_scales.as_chunks_mut().0);
        for ((mean, scale), quat) in rows.zip(quats.as_chunks().0) {
            shrink_beside(mean, scale, quat, &mut random);
        }
        model.values.means.write_at(3 * first, &means)?;
        Ok(model.values.log_scales.write_at(3 * first, &log_scales)?)
    }
}

/// Chooses the splats that grow; of more than `room`, those with the largest gradients.
fn growth(sums: &[f32], log_scales: &[f32], options: &DensifyOptions, extent: f64, room: usize) -> Growth {
    let pull = |i: &u32| {
        let [sum, frames] = [sums[2 * *i as usize], sums[2 * *i as usize + 1]];
        sum / frames.max(1.0)
    };
    let mut chosen: Vec<u32> = (0..(sums.len() / 2) as u32).filter(|i| pull(i) >= options.gradient).collect();
    if chosen.len() > room {
        chosen.sort_by(|a, b| pull(b).total_cmp(&pull(a)).then(a.cmp(b)));
        chosen.truncate(room);
        chosen.sort_unstable();
    }
    let limit = (options.size * extent).ln() as f32;
    let is_small = |i: &u32| log_scales[3 * *i as usize..][..3].iter().all(|s| *s <= limit);
    let (copied, divided) = chosen.into_iter().partition(is_small);
    Growth { copied, divided }
}

/// Moves a splat to a sample of its own distribution and shrinks it.
fn shrink_beside(mean: &mut [f32; 3], log_scales: &mut [f32; 3], quat: &[f32; 4], random: &mut Random) {
    let [w, x, y, z] = quat.map(f64::from);
    let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
    let offset = DVec3::from(log_scales.map(|s| f64::from(s).exp() * random.normal()));
    let offset = (rotation * offset).as_vec3();
    *mean = (glam::Vec3::from(*mean) + offset).into();
    log_scales.iter_mut().for_each(|s| *s -= SHRINK.ln());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::test_device;
    use crate::scene::Splats;

    #[test]
    fn strongest_pulls_grow_within_room() {
        let options = DensifyOptions::PUBLISHED;
        // Mean lengths 3e-4, 1e-4, 9e-4, none, 5e-4.
        let sums = [6e-4, 2.0, 3e-4, 3.0, 9e-4, 1.0, 0.0, 0.0, 1e-3, 2.0];
        let scale = |s: f32| [(0.1 * s).ln(), s.ln(), (0.5 * s).ln()];
        let log_scales = [0.005, 0.05, 0.05, 0.05, 0.01].map(scale).concat();
        let grown = |room| growth(&sums, &log_scales, &options, 1.0, room);
        assert_eq!(grown(9), Growth { copied: vec![0, 4], divided: vec![2] });
        assert_eq!(grown(2), Growth { copied: vec![4], divided: vec![2] });
        assert_eq!(grown(0), Growth::default());
    }

    #[test]
    fn growth_keeps_rows_and_optimiser_state_together() {
        let device = test_device();
        let splats = Splats {
            means: (0..4).map(|i| [i as f32, 0.0, 5.0]).collect(),
            log_scales: [0.005f32, 0.3, 0.005, 0.3]
                .map(|s| [s.ln(), (0.01 * s).ln(), (0.01 * s).ln()])
                .into(),
            quats: vec![[2f32.sqrt(), 0.0, 0.0, 2f32.sqrt()]; 4],
            opacity_logits: vec![0.0, 1.0, 2.0, 3.0],
            sh_degree: 0,
            sh: (0..12).map(|i| i as f32).collect(),
            antialiased: false,
        };
        let mut model = Model::new(&device, &splats, 0).unwrap();
        let mut density = Density::new(&device, DensifyOptions::PUBLISHED, 4).unwrap();
        density.restore(&device, &[1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0]).unwrap();
        assert!(density.is_due(100, 1000) && !density.is_due(1000, 1000) && !density.is_due(0, 1000));
        density.grow(&mut model, 1.0, 7).unwrap();
        let grown = model.splats().unwrap();
        // Kept: 0, 2, 3; a copy of 0; two halves of 1.
        assert_eq!(grown.opacity_logits, [0.0, 2.0, 3.0, 0.0, 1.0, 1.0]);
        assert_eq!(grown.means[..4], [0.0, 2.0, 3.0, 0.0].map(|x| [x, 0.0, 5.0]));
        for half in 4..6 {
            assert_eq!(grown.sh[3 * half..][..3], [3.0, 4.0, 5.0]);
            let shrunk = splats.log_scales[1].map(|s| s - SHRINK.ln());
            assert_eq!(grown.log_scales[half], shrunk);
            // A quarter turn about z takes the long axis to y.
            let [x, y, z] = grown.means[half];
            assert!((x - 1.0).abs() < 0.03 && y.abs() < 1.5 && (z - 5.0).abs() < 0.03, "{x} {y} {z}");
        }
        assert!(grown.means[4] != grown.means[5]);
    }
}
