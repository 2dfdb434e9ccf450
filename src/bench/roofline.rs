//! Limits of the device, measured with small shaders in the same run as the passes.
use super::least::Limits;
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
/// Rounds of a thread in `glsl/bench_arithmetic.comp`, and operations of a round.
const ROUNDS: u32 = 32;
const OPERATIONS: usize =
    (shaders::bench_arithmetic::INDEPENDENT * shaders::bench_arithmetic::PER_ROUND) as usize;
/// Launches of a chain, each of which waits for the one before.
const LAUNCHES: usize = 256;

/// Measures both limits. The best run counts, since a limit is the most that the device can do.
pub fn measure(device: &Device, budget: &Budget) -> Result<(Roofline, Section)> {
    let mut section = Section::new("roofline", "copies and arithmetic");
    let bytes_per_second = copy(device, budget, &mut section)?;
    let flops_per_second = multiply_adds(device, budget, &mut section)?;
    let limits = limits(device, budget, &mut section, bytes_per_second)?;
    section.figure("copy bandwidth", bytes_per_second / 1e9, "GB/s (read + written)");
    section.figure("fused multiply-add rate", flops_per_second / 1e9, "GFLOP/s by shaders, two per slot");
    section.figure("slot rate", limits.slots_per_second / 1e9, "G/s, where the passes run");
    section.figure("exponential rate", limits.exponentials_per_second / 1e9, "G/s, where the passes run");
    section.figure("dependent launch", limits.launch_seconds * 1e6, "µs");
    Ok((Roofline { bytes_per_second, flops_per_second, limits }, section))
}

/// Limits of the second floor. Native code of the passes has native code for their limits, too.
fn limits(device: &Device, budget: &Budget, section: &mut Section, bytes_per_second: f64) -> Result<Limits> {
    let threads = arithmetic_threads(device);
    let values = device.buffer::<f32>("values", threads)?;
    let call = |exponentials, rounds| {
        shaders::bench_arithmetic::call(
            shaders::bench_arithmetic::Variant { exponentials },
            &shaders::bench_arithmetic::Bindings { values: &values },
            &shaders::bench_arithmetic::Push { rounds },
        )
    };
    let mut rate = |name, exponentials| -> Result<f64> {
        let record = || {
            let mut rec = Recorder::new(device, "arithmetic");
            rec.pass(name);
            rec.dispatch_threads(call(exponentials, ROUNDS), [threads as u32, 1, 1]);
            rec
        };
        let operations = threads * ROUNDS as usize * OPERATIONS;
        Ok(operations as f64 / (fastest(device, &record, budget, section)? / 1e3))
    };
    let (slots_per_second, exponentials_per_second) = (rate("slots", 0)?, rate("exponentials", 1)?);
    let chain = |launches: usize| {
        let mut rec = Recorder::new(device, "launches");
        (0..launches).for_each(|_| rec.dispatch(call(0, 0), [1, 1, 1]));
        let program = rec.compile()?;
        Ok::<_, crate::Error>(budget.wall(|| Ok(program.run()?))?.best / 1e3)
    };
    let launch_seconds = (chain(LAUNCHES + 1)? - chain(1)?).max(0.0) / LAUNCHES as f64;
    Ok(Limits { bytes_per_second, slots_per_second, exponentials_per_second, launch_seconds })
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
fn arithmetic_threads(device: &Device) -> usize {
    if device.info().is_cpu { 1 << 17 } else { 1 << 22 }
}

/// Floating-point operations per second of fused multiply-adds.
fn multiply_adds(device: &Device, budget: &Budget, section: &mut Section) -> Result<f64> {
    let threads = arithmetic_threads(device);
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
        assert_eq!(section.rows.len(), 5);
        let Limits { slots_per_second, exponentials_per_second, launch_seconds, .. } = roofline.limits;
        for rate in [slots_per_second, exponentials_per_second] {
            assert!(rate > 1e6 && rate.is_finite(), "{roofline:?}");
        }
        assert!((0.0..1e-2).contains(&launch_seconds), "{roofline:?}");
        // A multiplication and an addition each, in the fastest run.
        let operations = 2.0 * (arithmetic_threads(&device) * FMA_PER_THREAD) as f64;
        let seconds = section.row("fused multiply-adds").unwrap().ms.best / 1e3;
        assert!((roofline.flops_per_second * seconds / operations - 1.0).abs() < 1e-9, "{roofline:?}");
        let r = Roofline { bytes_per_second: 1e9, flops_per_second: 1e10, ..roofline };
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
        // x ← 2^−x converges to the solution of x = 2^−x.
        for (exponentials, fixed) in [(0, 0.5), (1, 0.641_186)] {
            values.write(&[4.0f32; 64]).unwrap();
            let mut rec = Recorder::new(&device, "arithmetic");
            let call = shaders::bench_arithmetic::call(
                shaders::bench_arithmetic::Variant { exponentials },
                &shaders::bench_arithmetic::Bindings { values: &values },
                &shaders::bench_arithmetic::Push { rounds: ROUNDS },
            );
            rec.dispatch(call, [1, 1, 1]);
            rec.run().unwrap();
            assert!(values.read().unwrap().iter().all(|v| (v / 16.0 - fixed).abs() < 1e-5));
        }
    }
}
