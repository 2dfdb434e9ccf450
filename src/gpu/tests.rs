//! The engine on a real device, with validation on.
use super::*;
use std::sync::Mutex;

fn gathered(device: &Device, from: &[u32], index: &[u32]) -> crate::Result<Vec<u32>> {
    let from_buffer = device.buffer_from("from", from)?;
    let index_buffer = device.buffer_from("index", index)?;
    let to = device.buffer::<u32>("to", index.len())?;
    let mut rec = Recorder::new(device, "gather");
    rec.dispatch_threads(
        shaders::gather::call(
            &shaders::gather::Bindings { index: &index_buffer, from: &from_buffer, to: &to },
            &shaders::gather::Push { rows: index.len() as u32, stride: 1 },
        ),
        [index.len() as u32, 1, 1],
    );
    rec.run()?;
    to.read()
}

/// An exclusive scan of ones, twice in a row so that a read-modify-write chain needs its barrier.
fn check_scans(device: &Device) {
    use shaders::scan_lanes::{Bindings, Push, call};
    let sums = device.buffer::<u32>("sums", 512).unwrap();
    let total = device.buffer::<u32>("total", 1).unwrap();
    let mut rec = Recorder::new(device, "scans");
    rec.fill(&sums, 1);
    for _ in 0..2 {
        rec.dispatch(call(&Bindings { sums: &sums, total: &total }, &Push { lanes: 512 }), [1, 1, 1]);
    }
    let program = rec.compile().unwrap();
    assert_eq!(program.counts(), (3, 2));
    // Replays start from the fill again.
    program.run().unwrap();
    program.run().unwrap();
    // 0, 1, 2, .. after the first scan; their sums 0, 0, 1, 3, 6, .. after the second.
    let expected: Vec<u32> = (0..512u32).map(|i| i * i.saturating_sub(1) / 2).collect();
    assert_eq!(sums.read().unwrap(), expected);
    assert_eq!(total.read().unwrap(), [512 * 511 / 2]);
}

#[test]
fn a_pass_computes_what_its_twin_says() {
    let device = test_device();
    assert_eq!(gathered(&device, &[10, 20, 30], &[0, 2, 2, 1]).unwrap(), [10, 30, 30, 20]);
}

#[test]
fn a_chain_of_changes_is_ordered() {
    check_scans(&test_device());
}

#[test]
fn staged_buffers_behave_like_mapped_ones() {
    let device = TestDevice::with(&Options { staging: true, ..Options::from_env(None) }).unwrap();
    assert!(!device.info().mapped);
    check_scans(&device);
    let buffer = device.buffer::<u32>("numbers", 5).unwrap();
    assert_eq!(buffer.read().unwrap(), [0; 5]);
    buffer.write_at(3, &[7u32, 8]).unwrap();
    buffer.write(&[1u32]).unwrap();
    assert_eq!(buffer.read().unwrap(), [1, 0, 0, 7, 8]);
    assert_eq!(buffer.cast::<u16>().read_range(6..7).unwrap(), [7]);
}

fn staged() -> TestDevice {
    TestDevice::with(&Options { staging: true, ..Options::from_env(None) }).unwrap()
}

#[test]
fn transfers_wait_for_a_submission_and_share_it() {
    let device = staged();
    let a = device.buffer::<u32>("a", 1000).unwrap();
    let b = device.buffer_from("b", &[1u32; 1000]).unwrap();
    // Overlapping writes take effect in their order.
    a.write(&[2u32; 700]).unwrap();
    a.write_at(500, &[3u32; 400]).unwrap();
    device.buffer_from("gone", &[9u32; 10]).unwrap();
    assert_eq!(device.submissions(), 0);
    let mut rec = Recorder::new(&device, "both");
    rec.copy_bytes(&a, 0, &b, 400, 3600);
    rec.download(&b);
    let program = rec.compile().unwrap();
    program.run().unwrap();
    let expected: Vec<u32> = [vec![1; 100], vec![2; 500], vec![3; 400]].concat();
    assert_eq!(b.read().unwrap(), expected);
    assert_eq!(device.submissions(), 1);
    // A change makes the copy on the host worthless, whoever made it.
    b.write(&[7u32]).unwrap();
    assert_eq!(b.read_range(0..2).unwrap(), [7, 1]);
    assert_eq!(device.submissions(), 2);
    program.run().unwrap();
    let mut rec = Recorder::new(&device, "fill");
    rec.fill(&b, 5);
    rec.run().unwrap();
    assert_eq!(b.read().unwrap(), [5; 1000]);
    assert_eq!(device.submissions(), 5);
}

#[test]
fn large_transfers_go_in_pieces() {
    let device = staged();
    let count = (2 * super::staging::MOST as usize + 4096) / 4;
    let values: Vec<u32> = (0..count as u32).map(|i| i.wrapping_mul(2654435761)).collect();
    let buffer = device.buffer_from("large", &values).unwrap();
    assert!(buffer.read().unwrap() == values);
    // Two full pieces on the way there; the rest of it goes with the first of three on the way back.
    assert_eq!(device.submissions(), 5);
    let (first, mut shown) = (1 << 20, 0);
    buffer
        .show(first..count, &mut |at, piece| {
            assert!(at == shown && *piece == values[first + at..][..piece.len()]);
            shown += piece.len();
        })
        .unwrap();
    assert_eq!(shown, count - first);
    let again = || {
        buffer.write(&values).unwrap();
        assert!(buffer.read().unwrap() == values);
        device.memory().allocations
    };
    // Once more, until both ways have memory of that size.
    assert_eq!(again(), again(), "the memory is used again");
}

#[test]
fn buffers_may_go_while_another_thread_submits_their_writes() {
    let device = staged();
    let kept = device.buffer::<u32>("kept", 1 << 16).unwrap();
    let mut rec = Recorder::new(&device, "fill");
    rec.fill(&kept, 1);
    let program = rec.compile().unwrap();
    std::thread::scope(|scope| {
        let runs = scope.spawn(|| (0..200).for_each(|_| program.run().unwrap()));
        for i in 0..2000u32 {
            let buffer = device.buffer_from("short-lived", &[i; 64]).unwrap();
            if i % 100 == 0 {
                assert_eq!(buffer.read().unwrap(), [i; 64]);
            }
        }
        runs.join().unwrap();
    });
}

#[test]
fn buffers_check_their_bounds_and_sizes() {
    let device = test_device();
    let buffer = device.buffer_from("five", &[1u8, 2, 3, 4, 5]).unwrap();
    assert_eq!((buffer.len(), buffer.read().unwrap()), (5, vec![1, 2, 3, 4, 5]));
    let words = buffer.cast::<u32>();
    assert_eq!((words.len(), words.read_range(0..1).unwrap()), (1, vec![u32::from_le_bytes([1, 2, 3, 4])]));
    assert!(words.read().unwrap_err().to_string().contains("`five`"));
    assert!(buffer.write_at(4, &[1u8, 2]).is_err());
    assert!(buffer.read_range(4..6).is_err());
    assert!(device.buffer::<f32>("empty", 0).unwrap().read().unwrap().is_empty());
    let too_long = device.info().max_storage_range as usize + 1;
    let message = device.buffer::<u8>("huge", too_long).unwrap_err().to_string();
    assert!(message.contains("huge") && message.contains("MiB"), "{message}");
}

#[test]
fn copies_and_timestamps() {
    let device = test_device();
    let a = device.buffer_from("a", &[1u32, 2, 3, 4]).unwrap();
    let b = device.buffer::<u32>("b", 6).unwrap();
    let mut rec = Recorder::new(&device, "copies");
    rec.copy(&a, &b);
    rec.copy_bytes(&b, 4, &a, 0, 8);
    let times = rec.run_timed().unwrap();
    assert_eq!(a.read().unwrap(), [2, 3, 3, 4]);
    assert_eq!(b.read().unwrap(), [1, 2, 3, 4, 0, 0]);
    assert_eq!(times.len(), 2);
    assert_eq!(times[0].0, "copy a to b");
    assert!(times.iter().all(|(_, ms)| (0.0..10_000.0).contains(ms)), "{times:?}");
}

#[test]
fn indirect_dispatch_reads_its_size_on_the_device() {
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
        &shaders::gather::Push { rows: 1000, stride: 1 },
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
            &shaders::gather::Push { rows: 4, stride: 1 },
        )
    };
    assert!(run(&|r| r.dispatch(call(), [1; 3])).contains("`a` twice"));
    assert!(run(&|r| r.copy(&a, &a)).contains("`a` twice"));
    assert!(run(&|r| r.dispatch(call(), [u32::MAX, 1, 1])).contains("workgroups"));
    assert!(run(&|r| r.dispatch_indirect(call(), &a, 8)).contains("misplaced"));
    let small = device.buffer::<u32>("small", 1).unwrap();
    assert!(run(&|r| r.copy(&a, &small)).contains("beyond the end"));
    let other = TestDevice::with(&Options::from_env(None)).unwrap();
    let foreign = other.buffer::<u32>("foreign", 4).unwrap();
    assert!(run(&|r| r.fill(&foreign, 0)).contains("another device"));
    let unknown = Device::open(Some("no such device")).unwrap_err();
    assert_eq!(unknown.exit_code(), 2);
}

#[test]
fn validation_messages_are_caught() {
    // A device of its own, since the mistake below is deliberate. Dropped as a plain Device, it asserts nothing.
    let device = Device::with(&Options { validation: true, ..Options::from_env(None) }).unwrap();
    assert!(device.validation_messages().is_empty());
    let info = ash::vk::BufferCreateInfo::default().size(0).usage(ash::vk::BufferUsageFlags::STORAGE_BUFFER);
    // SAFETY: a size of zero is what the layer must object to; nothing is done with the buffer.
    unsafe {
        if let Ok(raw) = device.0.device.create_buffer(&info, None) {
            device.0.device.destroy_buffer(raw, None);
        }
    }
    assert!(device.validation_messages().iter().any(|m| m.contains("VUID-VkBufferCreateInfo-size-00912")));
}

#[test]
fn gpu_assisted_validation_sees_a_shader_read_beyond_a_buffer() {
    let options = Options { validation: true, gpu_assisted: true, cache: None, ..Options::from_env(None) };
    let device = Device::with(&options).unwrap();
    let values = device.buffer_from("values", &[1.0f32; 64]).unwrap();
    let result = device.buffer::<f32>("sum", 1).unwrap();
    let bindings = shaders::sum::Bindings { values: &values, result: &result };
    let sum = |count| {
        let mut rec = Recorder::new(&device, "sum");
        rec.dispatch(shaders::sum::call(&bindings, &shaders::sum::Push { count, slot: 0 }), [1, 1, 1]);
        rec.run().unwrap();
        device.validation_messages()
    };
    assert_eq!(sum(64), [""; 0]);
    let messages = sum(65);
    assert!(messages.iter().any(|m| m.contains("out of bounds")), "{messages:?}");
}

#[test]
fn a_host_is_told_of_long_compilations() {
    static TOLD: Mutex<Vec<String>> = Mutex::new(Vec::new());
    on_long_compilation(|name| TOLD.lock().unwrap().push(name.to_owned()));
    // Of its own, so that it has pipelines to make.
    let device = TestDevice::with(&Options::from_env(None)).unwrap();
    device.0.compile_time.use_up();
    gathered(&device, &[1], &[0]).unwrap();
    assert!(TOLD.lock().unwrap().contains(&device.info().name));
}

#[test]
fn synchronization_validation_is_on() {
    let device = Device::with(&Options { validation: true, ..Options::from_env(None) }).unwrap();
    let a = device.buffer::<u32>("a", 4).unwrap();
    let b = device.buffer::<u32>("b", 4).unwrap();
    let mut rec = Recorder::new(&device, "deliberate hazard");
    rec.fill(&a, 1);
    rec.copy(&a, &b);
    // Encoding is enough for the layer; it is not run.
    let program = rec.compile_without_barriers().unwrap();
    assert_eq!(program.counts(), (2, 0));
    let messages = device.validation_messages();
    // Layers write it with hyphens (1.3.239) or underscores (1.4.309).
    let hazard = |m: &String| m.replace('_', "-").contains("READ-AFTER-WRITE");
    assert!(messages.iter().any(hazard), "{messages:?}");
}

#[test]
fn what_is_submitted_to_a_hosts_queue_is_submitted_under_its_lock() {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};
    let options = Options::from_env(None);
    let entry = super::select::load().unwrap();
    let instance = super::select::instance(&entry, None).unwrap();
    let all = super::select::candidates(&instance).unwrap();
    let candidate = super::select::choose(all, options.choice.as_deref()).unwrap();
    let family = super::select::queue_family(&instance, candidate.physical).unwrap();
    let (raw, _) = super::features::create(&instance, &candidate, family, &options).unwrap();
    // SAFETY: the queue was requested in `create`.
    let queue = unsafe { raw.get_device_queue(family, 0) };
    let locked = Arc::new(AtomicU64::new(0));
    let count = locked.clone();
    let host = HostDevice {
        get_instance_proc_addr: None,
        instance: instance.handle(),
        physical_device: candidate.physical,
        device: raw.handle(),
        queue,
        queue_family: family,
        extensions: vec![ash::khr::synchronization2::NAME.to_owned()],
        features: EnabledFeatures { synchronization2: true, ..EnabledFeatures::default() },
        queue_lock: Some(Box::new(move |submit: &mut dyn FnMut()| {
            count.fetch_add(1, Ordering::Relaxed);
            submit();
        })),
    };
    // SAFETY: the handles belong together, nothing else uses them, and they are destroyed after the device.
    let device = unsafe { Device::adopt(host, &options) }.unwrap();
    assert_eq!(gathered(&device, &[10, 20, 30], &[0, 2, 2, 1]).unwrap(), [10, 30, 30, 20]);
    assert!(device.submissions() > 0);
    assert_eq!(locked.load(Ordering::Relaxed), device.submissions());
    drop(device);
    // SAFETY: nothing made from them is left.
    unsafe {
        raw.destroy_device(None);
        instance.destroy_instance(None);
    }
}
