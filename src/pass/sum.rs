//! Sums of float buffers on the GPU, in a fixed order: the same bits on every run of one device.
use crate::gpu::{Buffer, Recorder, shaders};

/// Length of the scratch buffer that [`record`] needs; one workgroup makes each partial sum.
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
