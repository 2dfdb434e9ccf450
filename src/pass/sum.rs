//! Sums of float buffers, in a fixed order: the same bits on every run of one device. The device
//! leaves partial sums, which the host adds in f64.
use crate::gpu::{Buffer, Recorder, shaders};
use std::ops::Range;

/// Partial sums of a range; one workgroup computes each.
pub const PARTIALS: usize = shaders::sum::PARTIALS as usize;

/// Records the partial sums of one or two ranges of `values`. Those of range r are
/// `result[PARTIALS·(slot + r)..][..PARTIALS]`; see [`total`].
pub fn record(
    rec: &mut Recorder,
    values: &Buffer<f32>,
    (first, second): (Range<usize>, Option<Range<usize>>),
    (result, slot): (&Buffer<f32>, u32),
) {
    let number = 1 + u32::from(second.is_some());
    let second = second.unwrap_or_default();
    let [first0, count0, first1, count1] =
        [first.start, first.len(), second.start, second.len()].map(|word| word as u32);
    let call = shaders::sum::call(
        &shaders::sum::Bindings { values, result },
        &shaders::sum::Push { first0, count0, first1, count1, slot },
    );
    rec.dispatch(call, [PARTIALS as u32, number, 1]);
}

/// The sum in slot `slot` of a buffer of partial sums.
pub fn total(partials: &[f32], slot: usize) -> f64 {
    partials[PARTIALS * slot..][..PARTIALS].iter().map(|v| f64::from(*v)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// More values than the threads of all partial sums, and some that do not count.
    #[test]
    fn sums_of_ranges_are_complete() {
        let device = crate::gpu::test_device();
        let values = device.buffer_from("values", &[1.0f32; 41_000]).unwrap();
        let result = device.buffer_from("result", &[7.0f32; 4 * PARTIALS]).unwrap();
        let mut rec = Recorder::new(&device, "sum");
        record(&mut rec, &values, (10..40_010, Some(40_990..41_000)), (&result, 1));
        rec.run().unwrap();
        let result = result.read().unwrap();
        let sums = [0, 1, 2, 3].map(|slot| total(&result, slot));
        assert_eq!(sums, [448.0, 40_000.0, 10.0, 448.0]);
    }
}
