//! Sums of float buffers on the GPU, in a fixed order: the same bits on every run of one device.
use crate::gpu::{Buffer, Recorder, shaders};

/// Length of the scratch buffer of [`record`]; one workgroup computes each partial sum.
pub const PARTIALS: usize = 64;

/// Records `result[slot] = Σ values`. `partials` holds [`PARTIALS`] floats of scratch.
pub fn record(
    rec: &mut Recorder,
    values: &Buffer<f32>,
    partials: &Buffer<f32>,
    result: &Buffer<f32>,
    slot: u32,
) {
    let count = (values.bytes() / 4) as u32;
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

    /// More values than the threads of all partial sums.
    #[test]
    fn sum_of_many_values_is_complete() {
        let device = crate::gpu::test_device();
        let values = device.buffer_from("values", &[1.0f32; 40_000]).unwrap();
        let partials = device.buffer::<f32>("partials", PARTIALS).unwrap();
        let result = device.buffer_from("result", &[7.0f32; 3]).unwrap();
        let mut rec = Recorder::new(&device, "sum");
        record(&mut rec, &values, &partials, &result, 1);
        rec.run().unwrap();
        assert_eq!(result.read().unwrap(), [7.0, 40_000.0, 7.0]);
    }
}
