//! Exclusive prefix sum of `u32`. Sums that overflow stay at the largest number, so that a frame
//! with more tile-list entries than `u32` counts is one that does not fit.
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder, shaders};

/// Scratch space of the scan. The device reads the length of the input.
pub struct Scan {
    sums: Buffer<u32>,
    lanes: u32,
}

impl Scan {
    /// Allocates one word per lane.
    pub fn new(device: &Device) -> Result<Scan> {
        // Each lane walks a contiguous chunk twice. Step 2 is one workgroup of 256 threads: 256
        // lanes keep it short on the CPU, while a GPU needs thousands of threads.
        let lanes = if device.info().is_cpu { 256 } else { 16384 };
        Ok(Scan { sums: device.buffer::<u32>("scan sums", lanes as usize)?, lanes })
    }

    /// Records `starts[i] = values[0] + .. + values[i - 1]` for the first `count[0]` elements, and
    /// their sum in `total[0]`. `values` and `starts` are different buffers. Reference:
    /// [`exclusive_scan`].
    pub fn record(
        &self,
        rec: &mut Recorder,
        values: &Buffer<u32>,
        count: &Buffer<u32>,
        starts: &Buffer<u32>,
        total: &Buffer<u32>,
    ) {
        let (lanes, sums) = (self.lanes, &self.sums);
        rec.dispatch_threads(
            shaders::scan_sums::call(
                &shaders::scan_sums::Bindings { values, count, sums },
                &shaders::scan_sums::Push { lanes },
            ),
            [lanes, 1, 1],
        );
        rec.dispatch(
            shaders::scan_lanes::call(
                &shaders::scan_lanes::Bindings { sums, total },
                &shaders::scan_lanes::Push { lanes },
            ),
            [1, 1, 1],
        );
        rec.dispatch_threads(
            shaders::scan_apply::call(
                &shaders::scan_apply::Bindings { values, count, sums, starts },
                &shaders::scan_apply::Push { lanes },
            ),
            [lanes, 1, 1],
        );
    }
}

/// CPU reference of [`Scan::record`]: the starts and the total.
pub fn exclusive_scan(values: &[u32]) -> (Vec<u32>, u32) {
    let mut sum = 0u32;
    let starts = values
        .iter()
        .map(|&v| {
            let start = sum;
            sum = sum.saturating_add(v);
            start
        })
        .collect();
    (starts, sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::test_device;

    #[test]
    fn scan_at_odd_sizes_matches_reference() {
        let device = test_device();
        let scan = Scan::new(&device).unwrap();
        // Without the shift, sums overflow.
        let sizes = [0usize, 1, 2, 255, 256, 257, 1000, 70_001];
        for (n, shift) in sizes.into_iter().flat_map(|n| [(n, 20), (n, 0)]) {
            let values: Vec<u32> = (0..n).map(|i| (i as u32).wrapping_mul(2654435761) >> shift).collect();
            // One more element than counted, which must not change.
            let buffer = device.buffer_from("values", &[values.as_slice(), &[7]].concat()).unwrap();
            let count = device.buffer_from("count", &[n as u32]).unwrap();
            let starts = device.buffer_from("starts", &vec![99u32; n + 1]).unwrap();
            let total = device.buffer::<u32>("total", 1).unwrap();
            let mut rec = Recorder::new(&device, "scan");
            scan.record(&mut rec, &buffer, &count, &starts, &total);
            rec.run().unwrap();
            let (mut expected, sum) = exclusive_scan(&values);
            expected.push(99);
            assert_eq!(starts.read().unwrap(), expected, "{n} values >> {shift}");
            assert_eq!(total.read().unwrap(), [sum], "{n} values >> {shift}");
        }
    }
}
