//! Adam on the GPU (Kingma & Ba 2015). The host sets a learning rate per parameter class before
//! each step.
use super::sort::rows_of_groups;
use crate::Result;
use crate::gpu::shaders::shared::adam as shared;
use crate::gpu::{Buffer, Device, Recorder, shaders};

/// β1, β2 of every 3D Gaussian splatting implementation.
pub const BETA: [f64; 2] = [shared::BETA1, shared::BETA2];
/// ε of every class unless [`Schedule::set_epsilon`] states another: tiny, since gradients are
/// (Kerbl et al. 2023).
pub const EPSILON: f64 = 1e-15;
/// Threads per workgroup in `glsl/adam.comp` and `glsl/gather.comp`.
const GROUP: usize = shaders::adam::WORKGROUP[0] as usize;

/// Workgroup counts for `threads` in a shader with workgroups of this size that numbers them row by
/// row.
pub(crate) fn rows_of_threads(threads: usize) -> [u32; 3] {
    rows_of_groups(threads.div_ceil(GROUP))
}

/// The moving averages (m, v) of one parameter buffer, of which each has 16 bits.
#[derive(Clone)]
pub struct Moments {
    /// `[count]`, one word per parameter; [`unpacked`] gives (m, v).
    pub buffer: Buffer<u32>,
}

impl Moments {
    /// Fresh (zero) state for `count` parameters.
    pub fn new(device: &Device, count: usize) -> Result<Self> {
        Ok(Moments { buffer: device.buffer::<u32>("adam moments", count.max(1))? })
    }

    /// Reads (m, v) of the first `count` parameters.
    pub fn read(&self, count: usize) -> Result<Vec<[f32; 2]>> {
        Ok(self.buffer.read_range(0..count)?.into_iter().map(unpacked).collect())
    }
}

/// (m, v) of a word of [`Moments`]. Their rounding is relative: below 2⁻⁷ of m, and below 2⁻⁸ of v.
pub fn unpacked(word: u32) -> [f32; 2] {
    [f32::from_bits(word & shared::SIGN_AND_M), f32::from_bits((word & shared::V_BITS) << shared::V_SHIFT)]
}

/// One parameter class: `head` of every `stride` values use the head rate, the rest the tail rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Class {
    /// Row of the [`Schedule`].
    pub slot: u32,
    /// Number of values.
    pub count: usize,
    /// Period of the two rates.
    pub stride: u32,
    /// Number of values of each period with the head rate.
    pub head: u32,
}

/// Number of the current step and its rates in GPU memory, one row per class, and the count of
/// non-finite gradients.
pub struct Schedule {
    pub(super) rates: Buffer<f32>,
    pub(super) faults: Buffer<u32>,
    rows: Vec<[f32; 4]>,
}

impl Schedule {
    /// Room for `classes` rows.
    pub fn new(device: &Device, classes: usize) -> Result<Self> {
        Ok(Schedule {
            rates: device.buffer::<f32>("adam rates", 4 * (1 + classes))?,
            faults: device.buffer::<u32>("adam faults", 1)?,
            rows: vec![[0.0, 0.0, 0.0, EPSILON as f32]; classes],
        })
    }

    /// Sets ε of a class: parameters whose gradients are smaller hardly move.
    pub fn set_epsilon(&mut self, slot: u32, epsilon: f64) {
        self.rows[slot as usize][3] = epsilon as f32;
    }

    /// Writes the rates (head, tail) of every class for the 1-based `step` of the moments.
    pub fn set(&mut self, step: usize, rates: &[[f64; 2]]) -> Result<()> {
        for (row, rate) in self.rows.iter_mut().zip(rates) {
            *row = row_of(step, *rate, row[3]);
        }
        let all = [&[[step as f32, 0.0, 0.0, 0.0]], self.rows.as_slice()].concat();
        Ok(self.rates.write(all.as_flattened())?)
    }

    /// A buffer for the rates of other steps: steps that the device has at once must not share one.
    pub fn new_rates(&self, device: &Device) -> Result<Buffer<f32>> {
        Ok(device.buffer::<f32>("adam rates", self.rates.len())?)
    }

    /// Uses this buffer for the rates of later recordings and steps.
    pub fn use_rates(&mut self, rates: &Buffer<f32>) {
        self.rates = rates.clone();
    }

    /// Number of non-finite gradients that the steps so far have skipped.
    pub fn faults(&self) -> Result<u32> {
        Ok(self.faults.read()?.first().copied().unwrap_or(0))
    }

    /// Records one step of one class. The step is void where `guard[1] ≠ 0` on the GPU; the guard
    /// is the status of the rasteriser.
    pub fn record(
        &self,
        rec: &mut Recorder,
        class: Class,
        parameters: &Buffer<f32>,
        gradients: &Buffer<f32>,
        moments: &Moments,
        guard: &Buffer<u32>,
    ) {
        rec.pass("Adam");
        let call = shaders::adam::call(
            &shaders::adam::Bindings {
                parameters,
                gradients,
                moments: &moments.buffer,
                faults: &self.faults,
                rates: &self.rates,
                guard,
            },
            &shaders::adam::Push {
                count: class.count as u32,
                stride: class.stride,
                head: class.head,
                slot: class.slot,
            },
        );
        rec.dispatch(call, rows_of_threads(class.count.div_ceil(4)));
    }
}

/// (head, tail, second-moment correction, ε) for a 1-based step.
fn row_of(step: usize, rate: [f64; 2], epsilon: f32) -> [f32; 4] {
    let t = step.max(1) as f64;
    let first = 1.0 / (1.0 - BETA[0].powf(t));
    let second = 1.0 / (1.0 - BETA[1].powf(t)).sqrt();
    [(rate[0] * first) as f32, (rate[1] * first) as f32, second as f32, epsilon]
}

/// CPU reference of one step for one class with one rate; `moments` are (m, v), not rounded.
pub fn adam(
    parameters: &mut [f64],
    gradients: &[f64],
    moments: &mut [[f64; 2]],
    rate: f64,
    epsilon: f64,
    step: usize,
) {
    let t = step.max(1) as f64;
    for ((p, &g), mv) in parameters.iter_mut().zip(gradients).zip(moments) {
        if !g.is_finite() {
            continue;
        }
        mv[0] = BETA[0] * mv[0] + (1.0 - BETA[0]) * g;
        mv[1] = BETA[1] * mv[1] + (1.0 - BETA[1]) * g * g;
        let (m, v) = (mv[0] / (1.0 - BETA[0].powf(t)), mv[1] / (1.0 - BETA[1].powf(t)));
        *p -= rate * m / (v.sqrt() + epsilon);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    /// Moments on the device after a step from those before, and the numbers that they round.
    #[track_caller]
    fn assert_rounded(kept: [f32; 2], exact: [f64; 2]) {
        for ((kept, exact), bits) in kept.into_iter().zip(exact).zip([7, 8]) {
            let (kept, unit) = (f64::from(kept), 2f64.powi(-bits));
            assert!((kept - exact).abs() <= 1.001 * unit * exact.abs() + 1e-37, "{kept} {exact}");
        }
    }

    #[test]
    fn adam_on_device_matches_reference() {
        let device = crate::gpu::test_device();
        let mut random = Random::new(4);
        // 9 values per row: 3 at the head rate, 6 at the tail rate; not a multiple of the
        // workgroup.
        let (rows, stride, head, rates) = (101usize, 9usize, 3usize, [2e-3, 1e-4]);
        let count = rows * stride;
        let start: Vec<f32> = (0..count).map(|_| random.normal() as f32).collect();
        let parameters = device.buffer_from("p", &start).unwrap();
        let gradients = device.buffer::<f32>("g", count).unwrap();
        let moments = Moments::new(&device, count).unwrap();
        let guard = device.buffer::<u32>("guard", 2).unwrap();
        let mut schedule = Schedule::new(&device, 2).unwrap();
        // Of the magnitude of the middle gradients.
        let epsilon = 1e-3;
        schedule.set_epsilon(1, epsilon);
        for step in 1..=20 {
            let g: Vec<f32> =
                (0..count).map(|i| (random.normal() * 10f64.powi(i as i32 % 7 - 6)) as f32).collect();
            gradients.write(&g).unwrap();
            schedule.set(step, &[[0.0; 2], rates]).unwrap();
            let (before, kept) = (parameters.read().unwrap(), moments.read(count).unwrap());
            let mut rec = Recorder::new(&device, "adam");
            let class = Class { slot: 1, count, stride: stride as u32, head: head as u32 };
            schedule.record(&mut rec, class, &parameters, &gradients, &moments, &guard);
            rec.run().unwrap();
            let (after, now) = (parameters.read().unwrap(), moments.read(count).unwrap());
            for i in 0..count {
                let rate = rates[usize::from(i % stride >= head)];
                let (mut value, mut mv) = ([f64::from(before[i])], [kept[i].map(f64::from)]);
                adam(&mut value, &[f64::from(g[i])], &mut mv, rate, epsilon, step);
                // A step of 2e-3 of a number below 4, rounded to f32.
                assert!((f64::from(after[i]) - value[0]).abs() < 5e-7, "{i}: {} {}", after[i], value[0]);
                assert_rounded(now[i], mv[0]);
            }
        }
        assert_eq!(schedule.faults().unwrap(), 0);
    }

    /// Many parameters with one gradient: the mean of their moments stays that of the reference,
    /// although a step changes v by less than its rounding.
    #[test]
    fn rounded_moments_have_no_bias() {
        let device = crate::gpu::test_device();
        let count = 1 << 14;
        let parameters = device.buffer::<f32>("p", count).unwrap();
        let gradients = device.buffer_from("g", &vec![0.3f32; count]).unwrap();
        let moments = Moments::new(&device, count).unwrap();
        let guard = device.buffer::<u32>("guard", 2).unwrap();
        let mut schedule = Schedule::new(&device, 1).unwrap();
        let (mut value, mut exact) = ([0.0], [[0.0; 2]]);
        for step in 1..=200 {
            if step == 100 {
                gradients.write(&vec![0.001f32; count]).unwrap();
            }
            let g = if step < 100 { 0.3f32 } else { 0.001 };
            schedule.set(step, &[[1e-3; 2]]).unwrap();
            let mut rec = Recorder::new(&device, "adam");
            let class = Class { slot: 0, count, stride: 1, head: 1 };
            schedule.record(&mut rec, class, &parameters, &gradients, &moments, &guard);
            rec.run().unwrap();
            adam(&mut value, &[f64::from(g)], &mut exact, 1e-3, EPSILON, step);
        }
        let kept = moments.read(count).unwrap();
        for k in 0..2 {
            let mean = kept.iter().map(|pair| f64::from(pair[k])).sum::<f64>() / count as f64;
            let error = mean / exact[0][k] - 1.0;
            // 2^14 numbers, each with an error of about 2e-3 (m) and 1e-2 (v, over 100 steps).
            assert!(error.abs() < 3e-4, "{}: {error:.2e}", ["m", "v"][k]);
            let distinct =
                kept.iter().map(|pair| pair[k].to_bits()).collect::<std::collections::BTreeSet<_>>();
            assert!(distinct.len() > 1, "{distinct:?}");
        }
        let moved = parameters.read().unwrap().iter().map(|p| f64::from(*p)).sum::<f64>() / count as f64;
        assert!((moved / value[0] - 1.0).abs() < 3e-4, "{moved} {}", value[0]);
    }

    #[test]
    fn adam_skips_and_counts_non_finite() {
        let device = crate::gpu::test_device();
        let parameters = device.buffer_from("p", &[1.0f32, 2.0, 3.0]).unwrap();
        let gradients = device.buffer_from("g", &[f32::NAN, f32::NEG_INFINITY, 1.0]).unwrap();
        let moments = Moments::new(&device, 3).unwrap();
        let guard = device.buffer_from("guard", &[0u32, 1]).unwrap();
        let mut schedule = Schedule::new(&device, 1).unwrap();
        schedule.set(1, &[[0.5, 0.5]]).unwrap();
        let class = Class { slot: 0, count: 3, stride: 1, head: 1 };
        let step = || {
            let mut rec = Recorder::new(&device, "adam");
            schedule.record(&mut rec, class, &parameters, &gradients, &moments, &guard);
            rec.run().unwrap();
        };
        step();
        assert_eq!(parameters.read().unwrap(), [1.0, 2.0, 3.0], "a guarded step is void");
        guard.write(&[0u32, 0]).unwrap();
        step();
        let p = parameters.read().unwrap();
        assert_eq!((p[0], p[1]), (1.0, 2.0));
        assert!((p[2] - 2.5).abs() < 1e-6, "the first Adam step has the length of the rate");
        assert_eq!(schedule.faults().unwrap(), 2);
    }

    #[test]
    fn rows_of_workgroups_cover_all_threads() {
        for threads in [1, 256, 257, 8_388_608, 8_388_609, 50_000_000] {
            let [x, y, _] = rows_of_threads(threads);
            assert!(x as usize * y as usize * GROUP >= threads && x <= 32768 && y <= 65535);
        }
    }
}
