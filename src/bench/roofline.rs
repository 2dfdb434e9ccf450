//! Limits of the device, measured with small shaders in the same run as the passes.
use super::measure::Budget;
use super::model::Roofline;
use super::report::Section;
use crate::Result;
use crate::gpu::{Device, Recorder, shaders};
use crate::pass::adam::rows_of_threads;

/// vec4 per thread in `glsl/bench_copy.comp`.
const COPY_STEPS: usize = shaders::bench_copy::STEPS as usize;
/// Fused multiply-adds per thread in `glsl/bench_fma.comp`.
const FMA_PER_THREAD: usize = (shaders::bench_fma::CHAINS * shaders::bench_fma::STEPS) as usize;

/// Measures both limits. The best run counts, since a limit is the most that the device can do.
pub fn measure(device: &Device, budget: &Budget) -> Result<(Roofline, Section)> {
    let mut section = Section::new("roofline", "copies and fused multiply-adds");
    let bytes_per_second = copy(device, budget, &mut section)?;
    let flops_per_second = arithmetic(device, budget, &mut section)?;
    section.figure("copy bandwidth", bytes_per_second / 1e9, "GB/s (read + written)");
    section.figure("fused multiply-add rate", flops_per_second / 1e9, "GFLOP/s");
    Ok((Roofline { bytes_per_second, flops_per_second }, section))
}

/// Bytes per second of the faster of a copy shader and the copy command of the driver.
fn copy(device: &Device, budget: &Budget, section: &mut Section) -> Result<f64> {
    // Several times the last-level cache: 128 MiB in all on a CPU, 512 on a GPU.
    let mib = if device.info().is_cpu { 64 } else { 256 };
    let limit = device.info().max_storage_range as usize;
    let vectors = (mib << 16).min(limit / 16).next_multiple_of(256 * COPY_STEPS);
    let from = device.buffer::<f32>("copy source", 4 * vectors)?;
    let to = device.buffer::<f32>("copy target", 4 * vectors)?;
    let record = || {
        let mut rec = Recorder::new(device, "copy bandwidth");
        rec.pass("copy by shader");
        let bindings = shaders::bench_copy::Bindings { source: &from, target: &to };
        rec.dispatch(shaders::bench_copy::call(&bindings), rows_of_threads(vectors / COPY_STEPS));
        rec.pass("copy by command");
        rec.copy(&from, &to);
        rec
    };
    Ok(32.0 * vectors as f64 / (fastest(device, &record, budget, section)? / 1e3))
}

/// Measures the passes and returns the milliseconds of the fastest.
fn fastest(
    device: &Device,
    record: &dyn Fn() -> Recorder,
    budget: &Budget,
    section: &mut Section,
) -> Result<f64> {
    let before = section.rows.len();
    section.passes(device, record, budget)?;
    Ok(section.rows[before..].iter().map(|r| r.ms.best).fold(f64::INFINITY, f64::min))
}

/// Number of threads for about 14 ms on lavapipe and 1 ms on a large GPU, long against the launch.
fn fma_threads(device: &Device) -> usize {
    if device.info().is_cpu { 1 << 17 } else { 1 << 22 }
}

/// Floating-point operations per second of fused multiply-adds.
fn arithmetic(device: &Device, budget: &Budget, section: &mut Section) -> Result<f64> {
    let threads = fma_threads(device);
    let values = device.buffer::<f32>("fma values", threads)?;
    let record = || {
        let mut rec = Recorder::new(device, "arithmetic");
        rec.pass("fused multiply-adds");
        let call = shaders::bench_fma::call(&shaders::bench_fma::Bindings { values: &values });
        rec.dispatch_threads(call, [threads as u32, 1, 1]);
        rec
    };
    Ok(2.0 * (threads * FMA_PER_THREAD) as f64 / (fastest(device, &record, budget, section)? / 1e3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measured_limits_are_positive() {
        let device = crate::gpu::test_device();
        let budget = Budget { seconds: 0.0, repeats: Some(2) };
        let (roofline, section) = measure(&device, &budget).unwrap();
        assert!(roofline.bytes_per_second > 1e6 && roofline.bytes_per_second.is_finite(), "{roofline:?}");
        assert!(roofline.flops_per_second > 1e6 && roofline.flops_per_second.is_finite(), "{roofline:?}");
        assert_eq!(section.rows.len(), 3);
        // A multiplication and an addition each, in the fastest run.
        let operations = 2.0 * (fma_threads(&device) * FMA_PER_THREAD) as f64;
        let seconds = section.row("fused multiply-adds").unwrap().ms.best / 1e3;
        assert!((roofline.flops_per_second * seconds / operations - 1.0).abs() < 1e-9, "{roofline:?}");
        let r = Roofline { bytes_per_second: 1e9, flops_per_second: 1e10 };
        assert_eq!(r.floor_ms(1e6, 0.0), 1.0);
        assert_eq!(r.floor_ms(1e6, 5e7), 5.0);
    }

    #[test]
    fn limit_shaders_do_the_counted_work() {
        let device = crate::gpu::test_device();
        let n = 3 * 256 * COPY_STEPS;
        let from = device.buffer_from("from", &(0..4 * n).map(|i| i as f32).collect::<Vec<_>>()).unwrap();
        let to = device.buffer::<f32>("to", 4 * n).unwrap();
        let values = device.buffer_from("values", &[4.0f32; 64]).unwrap();
        let mut rec = Recorder::new(&device, "limits");
        let bindings = shaders::bench_copy::Bindings { source: &from, target: &to };
        rec.dispatch(shaders::bench_copy::call(&bindings), rows_of_threads(n / COPY_STEPS));
        let bindings = shaders::bench_fma::Bindings { values: &values };
        rec.dispatch(shaders::bench_fma::call(&bindings), [1, 1, 1]);
        rec.run().unwrap();
        assert_eq!(to.read().unwrap(), from.read().unwrap());
        // x ← x/2 + 1/4 converges to 1/2 in each of the 16 chains.
        assert!(values.read().unwrap().iter().all(|v| (v - 8.0).abs() < 1e-5));
    }
}
