//! Sums of float buffers on the GPU, in a fixed order: the same bits on every run of one device.
use crate::gpu::{Buffer, Recorder, shaders};

/// Length of the scratch buffer of [`record`]; one workgroup computes each partial sum.
pub const PARTIALS: usize = 64;

/// Records `result[slot] = Σ values` of the first `count` values. `partials` holds [`PARTIALS`]
/// floats of scratch.
pub fn record(
    rec: &mut Recorder,
    (values, count): (&Buffer<f32>, usize),
    partials: &Buffer<f32>,
    (result, slot): (&Buffer<f32>, u32),
) {
    let count = count as u32;
    let call = shaders::sum::call(
        &shaders::sum::Bindings { values, result: partials },
        &shaders::sum::Push { count, slot: 0 },
    );
    rec.dispatch(call, [PARTIALS as u32, 1, 1]);
    let call = shaders::sum::call(
        &shaders::sum::Bindings { values: partials, result },
        &shaders::sum::Push { count: PARTIALS as u32, slot },
    );
    rec.dispatch(call, [1, 1, 1]);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// More values than the threads of all partial sums, and some that do not count.
    #[test]
    fn sum_of_many_values_is_complete() {
        let device = crate::gpu::test_device();
        let values = device.buffer_from("values", &[1.0f32; 41_000]).unwrap();
        let partials = device.buffer::<f32>("partials", PARTIALS).unwrap();
        let result = device.buffer_from("result", &[7.0f32; 3]).unwrap();
        let mut rec = Recorder::new(&device, "sum");
        record(&mut rec, (&values, 40_000), &partials, (&result, 1));
        rec.run().unwrap();
        assert_eq!(result.read().unwrap(), [7.0, 40_000.0, 7.0]);
    }
}
