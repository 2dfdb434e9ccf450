//! Generated bindings on a device with validation on.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
use splatvk_gpu::{
    Device, Error, NATIVE_FLOAT_ATOMICS, Options, Recorder, Result, TestDevice, on_long_compilation,
};
use splatvk_gpu_test_shaders as shaders;
use std::sync::Mutex;

fn test_device() -> TestDevice {
    TestDevice::shared(&Options::default())
}

fn gathered(device: &Device, from: &[u32], index: &[u32]) -> Result<Vec<u32>> {
    let from_buffer = device.buffer_from("from", from)?;
    let index_buffer = device.buffer_from("index", index)?;
    let to = device.buffer::<u32>("to", index.len())?;
    let rows = index.len() as u32;
    let mut rec = Recorder::new(device, "gather");
    rec.dispatch_threads(
        shaders::gather::call(
            &shaders::gather::Bindings { index: &index_buffer, from: &from_buffer, to: &to },
            &shaders::gather::Push { rows },
        ),
        [rows, 1, 1],
    );
    rec.run()?;
    to.read()
}

/// Two prefix sums of ones in a row: a read-modify-write chain that needs its barrier.
fn check_prefix_sums(device: &Device) {
    use shaders::prefix_sum::{Bindings, Push, Variant, call};
    let values = device.buffer::<u32>("values", 512).unwrap();
    let total = device.buffer::<u32>("total", 1).unwrap();
    let mut rec = Recorder::new(device, "prefix sums");
    rec.fill(&values, 1);
    for _ in 0..2 {
        let bindings = Bindings { values: &values, total: &total };
        rec.dispatch(call(Variant { threads: 256 }, &bindings, &Push { count: 512 }), [1, 1, 1]);
    }
    let program = rec.compile().unwrap();
    assert_eq!(program.counts(), (3, 2));
    // Each run starts from the fill again.
    program.run().unwrap();
    program.run().unwrap();
    // 0, 1, 2, .. after the first; their sums 0, 0, 1, 3, 6, .. after the second.
    let expected: Vec<u32> = (0..512u32).map(|i| i * i.saturating_sub(1) / 2).collect();
    assert_eq!(values.read().unwrap(), expected);
    assert_eq!(total.read().unwrap(), [512 * 511 / 2]);
}

#[test]
fn a_shader_gathers() {
    assert_eq!(gathered(&test_device(), &[10, 20, 30], &[0, 2, 2, 1]).unwrap(), [10, 30, 30, 20]);
}

#[test]
fn a_chain_of_changes_is_ordered() {
    check_prefix_sums(&test_device());
}

#[test]
fn structures_have_the_layout_of_the_shader() {
    use shaders::move_particles::{Bindings, Push, call};
    use shaders::structs::Particle;
    assert_eq!((size_of::<Particle>(), shaders::move_particles::GROUP), (32, 64));
    let device = test_device();
    let particle =
        |x: f32| Particle { position: [x; 3], mass: 2.0, velocity: [1.0, 0.0, -1.0], padding: 0.0 };
    let particles = device.buffer_from("particles", &[particle(0.0), particle(5.0)]).unwrap();
    let mut rec = Recorder::new(&device, "move");
    let call = call(&Bindings { particles: &particles }, &Push { count: 2, seconds: 0.5 });
    rec.dispatch_threads(call, [2, 1, 1]);
    rec.run().unwrap();
    let moved = particles.read().unwrap();
    assert_eq!((moved[1].position, moved[1].mass), ([5.5, 5.0, 4.5], 2.0));
}

#[test]
fn float_atomics_native_and_emulated_agree() {
    use shaders::subgroup_sum::{Bindings, Push, call};
    let sum = |device: &Device| {
        let values = device.buffer_from("values", &[0.5f32; 1000]).unwrap();
        let sum = device.buffer::<f32>("sum", 1).unwrap();
        let mut rec = Recorder::new(device, "sum");
        rec.dispatch_threads(
            call(&Bindings { values: &values, sum: &sum }, &Push { count: 1000 }),
            [1000, 1, 1],
        );
        rec.run().unwrap();
        sum.read().unwrap()
    };
    assert_eq!(sum(&test_device()), [500.0]);
    let disabled = [NATIVE_FLOAT_ATOMICS.to_owned()].into();
    let emulating = TestDevice::open(&Options { disabled, ..Options::default() }).unwrap();
    assert!(!emulating.info().float_atomics);
    assert_eq!(sum(&emulating), [500.0]);
}

#[test]
fn staged_buffers_behave_like_mapped_ones() {
    let device = TestDevice::open(&Options { staging: true, ..Options::default() }).unwrap();
    assert!(!device.info().mapped);
    check_prefix_sums(&device);
    let buffer = device.buffer::<u32>("numbers", 5).unwrap();
    assert_eq!(buffer.read().unwrap(), [0; 5]);
    buffer.write_at(3, &[7u32, 8]).unwrap();
    buffer.write(&[1u32]).unwrap();
    assert_eq!(buffer.read().unwrap(), [1, 0, 0, 7, 8]);
    assert_eq!(buffer.cast::<u16>().read_range(6..7).unwrap(), [7]);
}

#[test]
fn indirect_dispatches_read_their_size() {
    let device = test_device();
    let index = device.buffer_from("index", &[0u32; 1000]).unwrap();
    let from = device.buffer_from("from", &[1u32]).unwrap();
    let out = device.buffer::<u32>("out", 1000).unwrap();
    let source = device.buffer_from("source", &[9u32, 2, 1, 1]).unwrap();
    let args = device.buffer::<u32>("args", 4).unwrap();
    let mut rec = Recorder::new(&device, "indirect");
    rec.copy(&source, &args);
    let call = shaders::gather::call(
        &shaders::gather::Bindings { index: &index, from: &from, to: &out },
        &shaders::gather::Push { rows: 1000 },
    );
    rec.dispatch_indirect(call, &args, 4);
    rec.run().unwrap();
    let reached = 2 * shaders::gather::WORKGROUP[0] as usize;
    let out = out.read().unwrap();
    assert!(out[..reached].iter().all(|&v| v == 1));
    assert!(out[reached..].iter().all(|&v| v == 0));
}

#[test]
fn mistakes_are_reported_not_run() {
    let device = test_device();
    let a = device.buffer_from("a", &[0u32; 4]).unwrap();
    let run = |f: &dyn Fn(&mut Recorder)| {
        let mut rec = Recorder::new(&device, "mistake");
        f(&mut rec);
        rec.run().unwrap_err().to_string()
    };
    let call = || {
        shaders::gather::call(
            &shaders::gather::Bindings { index: &a, from: &a, to: &a },
            &shaders::gather::Push { rows: 4 },
        )
    };
    assert!(run(&|r| r.dispatch(call(), [1; 3])).contains("`a` twice"));
    assert!(run(&|r| r.copy(&a, &a)).contains("`a` twice"));
    assert!(run(&|r| r.dispatch(call(), [u32::MAX, 1, 1])).contains("workgroups"));
    assert!(run(&|r| r.dispatch_indirect(call(), &a, 8)).contains("misplaced"));
    let small = device.buffer::<u32>("small", 1).unwrap();
    assert!(run(&|r| r.copy(&a, &small)).contains("beyond the end"));
    let other = TestDevice::open(&Options::default()).unwrap();
    let foreign = other.buffer::<u32>("foreign", 4).unwrap();
    assert!(run(&|r| r.fill(&foreign, 0)).contains("another device"));
    let choice = Some("no such device".to_owned());
    let unknown = Device::open(&Options { choice, ..Options::default() }).unwrap_err();
    assert!(matches!(unknown, Error::Choice(_)));
}

#[test]
fn gpu_assisted_validation_sees_wild_writes() {
    let options = Options { validation: true, gpu_assisted: true, cache: None, ..Options::default() };
    let device = Device::open(&options).unwrap();
    let index = device.buffer::<u32>("index", 65).unwrap();
    let from = device.buffer_from("from", &[1u32; 64]).unwrap();
    let to = device.buffer::<u32>("to", 64).unwrap();
    let gather = |rows| {
        let mut rec = Recorder::new(&device, "gather");
        let bindings = shaders::gather::Bindings { index: &index, from: &from, to: &to };
        rec.dispatch_threads(shaders::gather::call(&bindings, &shaders::gather::Push { rows }), [rows, 1, 1]);
        rec.run().unwrap();
        device.validation_messages()
    };
    assert_eq!(gather(64), [""; 0]);
    let messages = gather(65);
    assert!(messages.iter().any(|m| m.contains("out of bounds")), "{messages:?}");
}

#[test]
fn long_compilations_call_the_listener() {
    static TOLD: Mutex<Vec<String>> = Mutex::new(Vec::new());
    on_long_compilation(|name| TOLD.lock().unwrap().push(name.to_owned()));
    // Of its own, so that it has pipelines to make.
    let device = TestDevice::open(&Options::default()).unwrap();
    device.expect_long_compilations();
    gathered(&device, &[1], &[0]).unwrap();
    assert!(TOLD.lock().unwrap().contains(&device.info().name));
}
