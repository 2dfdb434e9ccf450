//! Adam on the GPU (Kingma & Ba 2015). The host sets a learning rate per parameter class before
//! each step.
use super::sort::rows_of_groups;
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder, shaders};

/// β1, β2 of every 3D Gaussian splatting implementation.
pub const BETA: [f64; 2] = [shaders::shared::adam::BETA1, shaders::shared::adam::BETA2];
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

/// The moving averages of one parameter buffer: `[count]` pairs (m, v).
#[derive(Clone)]
pub struct Moments {
    /// (m, v) per parameter, `[count, 2]`.
    pub buffer: Buffer<f32>,
}

impl Moments {
    /// Fresh (zero) state for `count` parameters.
    pub fn new(device: &Device, count: usize) -> Result<Self> {
        Ok(Moments { buffer: device.buffer::<f32>("adam moments", 2 * count.max(1))? })
    }
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

/// Rates of the current step in GPU memory, one row per class, and the count of non-finite
/// gradients.
pub struct Schedule {
    pub(super) rates: Buffer<f32>,
    pub(super) faults: Buffer<u32>,
    rows: Vec<[f32; 4]>,
}

impl Schedule {
    /// Room for `classes` rows.
    pub fn new(device: &Device, classes: usize) -> Result<Self> {
        Ok(Schedule {
            rates: device.buffer::<f32>("adam rates", 4 * classes)?,
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
        Ok(self.rates.write(self.rows.as_flattened())?)
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

/// CPU reference of one step for one class with one rate; `moments` are (m, v).
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
        let mut reference: Vec<f64> = start.iter().map(|&v| f64::from(v)).collect();
        let mut state = vec![[0.0; 2]; count];
        for step in 1..=20 {
            let g: Vec<f32> =
                (0..count).map(|i| (random.normal() * 10f64.powi(i as i32 % 7 - 6)) as f32).collect();
            gradients.write(&g).unwrap();
            schedule.set(step, &[[0.0; 2], rates]).unwrap();
            let mut rec = Recorder::new(&device, "adam");
            let class = Class { slot: 1, count, stride: stride as u32, head: head as u32 };
            schedule.record(&mut rec, class, &parameters, &gradients, &moments, &guard);
            rec.run().unwrap();
            for i in 0..count {
                let rate = rates[usize::from(i % stride >= head)];
                let range = i..i + 1;
                let (value, g) = (&mut reference[range.clone()], [f64::from(g[i])]);
                adam(value, &g, &mut state[range], rate, epsilon, step);
            }
        }
        for (i, (p, t)) in parameters.read().unwrap().into_iter().zip(&reference).enumerate() {
            // 20 steps of 2e-3, each rounded in f32.
            assert!((f64::from(p) - t).abs() < 2e-6, "{i}: {p} {t}");
        }
        assert_eq!(schedule.faults().unwrap(), 0);
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
