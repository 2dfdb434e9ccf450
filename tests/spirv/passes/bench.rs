//! The shaders of `splatvk bench`.
use splatvk::gpu::{Device, Recorder, shaders};

pub fn bench(device: &Device) {
    let n = 4 * 256 * shaders::bench_copy::STEPS as usize;
    let data: Vec<f32> = (0..n).map(|k| k as f32).collect();
    let source = device.buffer_from("copy source", &data).unwrap();
    let target = device.buffer::<f32>("copy target", n).unwrap();
    let values = device.buffer_from("fma values", &data[..128]).unwrap();
    let mut rec = Recorder::new(device, "bench");
    rec.dispatch(
        shaders::bench_copy::call(&shaders::bench_copy::Bindings { source: &source, target: &target }),
        [1, 1, 1],
    );
    rec.dispatch(shaders::bench_fma::call(&shaders::bench_fma::Bindings { values: &values }), [2, 1, 1]);
    rec.run().unwrap();
    assert!(target.read().unwrap() == data);
    // x / 2 + 1 / 4 tends to 1 / 2, in each of 16 chains.
    assert!(values.read().unwrap().iter().all(|v| (v - 8.0).abs() < 1e-4));
    for (exponentials, fixed) in [(0, 0.5), (1, 0.641_186)] {
        let mut rec = Recorder::new(device, "arithmetic");
        let call = shaders::bench_arithmetic::call(
            shaders::bench_arithmetic::Variant { exponentials },
            &shaders::bench_arithmetic::Bindings { values: &values },
            &shaders::bench_arithmetic::Push { rounds: 8 },
        );
        rec.dispatch(call, [2, 1, 1]);
        rec.run().unwrap();
        assert!(values.read().unwrap().iter().all(|v| (v / 16.0 - fixed).abs() < 1e-4));
    }
}
