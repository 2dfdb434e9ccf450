//! The engine on a device with validation on, without shaders.
use super::*;

fn test_device() -> TestDevice {
    TestDevice::shared(&Options::default())
}

fn staged() -> TestDevice {
    TestDevice::open(&Options { staging: true, ..Options::default() }).unwrap()
}

#[test]
fn transfers_share_a_submission() {
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
fn started_programs_run_in_order() {
    for device in [test_device(), staged()] {
        let words: Vec<u32> = (0..1000).collect();
        let buffers = [0, 1, 2].map(|_| device.buffer::<u32>("words", words.len()).unwrap());
        let copy = |from: usize, to: usize| {
            let mut rec = Recorder::new(&device, "copy");
            rec.copy_bytes(&buffers[from], 0, &buffers[to], 0, buffers[from].bytes());
            rec.download(&buffers[to]);
            rec.compile().unwrap()
        };
        let (mut first, mut second) = (copy(0, 1), copy(1, 2));
        for round in 1..4 {
            let numbers: Vec<u32> = words.iter().map(|word| word * round).collect();
            buffers[0].write(&numbers).unwrap();
            let before = device.submissions();
            let (a, b) = (first.start().unwrap(), second.start().unwrap());
            assert_eq!(device.submissions() - before, 2);
            (first, second) = (a.wait().unwrap(), b.wait().unwrap());
            assert_eq!(buffers[1].read().unwrap(), numbers);
            assert_eq!(buffers[2].read().unwrap(), numbers);
            assert_eq!(device.submissions() - before, 2, "results are downloaded");
        }
        // Dropped, a program that runs is waited for.
        drop(first.start().unwrap());
    }
}

#[test]
fn large_transfers_are_split() {
    let device = staged();
    let count = (2 * crate::staging::MOST as usize + 4096) / 4;
    let values: Vec<u32> = (0..count as u32).map(|i| i.wrapping_mul(2654435761)).collect();
    let buffer = device.buffer_from("large", &values).unwrap();
    assert!(buffer.read().unwrap() == values);
    // Two full pieces on the way there; the rest of it goes with the first of three on the way
    // back.
    assert_eq!(device.submissions(), 5);
    let (first, mut shown) = (1 << 20, 0);
    buffer
        .read_with(first..count, &mut |at, piece| {
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
fn buffers_drop_while_others_submit() {
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
    let too_long = device.info().max_buffer as usize + 1;
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
fn validation_messages_are_collected() {
    // A device of its own, since the mistake below is deliberate. Dropped as a plain Device, it
    // asserts nothing.
    let device = Device::open(&Options { validation: true, ..Options::default() }).unwrap();
    assert!(device.validation_messages().is_empty());
    let info = ash::vk::BufferCreateInfo::default().size(0).usage(ash::vk::BufferUsageFlags::STORAGE_BUFFER);
    // SAFETY: the layer must report a size of zero; nothing is done with the buffer.
    unsafe {
        if let Ok(raw) = device.0.device.create_buffer(&info, None) {
            device.0.device.destroy_buffer(raw, None);
        }
    }
    assert!(device.validation_messages().iter().any(|m| m.contains("VUID-VkBufferCreateInfo-size-00912")));
}

#[test]
fn synchronization_validation_is_on() {
    let device = Device::open(&Options { validation: true, ..Options::default() }).unwrap();
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
fn submissions_hold_the_hosts_queue_lock() {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};
    let options = Options::default();
    let entry = crate::select::load().unwrap();
    let instance = crate::select::instance(&entry, None).unwrap();
    let all = crate::select::candidates(&instance, &options).unwrap();
    let candidate = crate::choice::choose(all, options.choice.as_deref()).unwrap();
    let family = crate::select::queue_family(&instance, candidate.physical).unwrap();
    let (raw, _) = crate::features::create(&instance, &candidate, family, &options).unwrap();
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
    // SAFETY: the handles belong together, nothing else uses them, and they are destroyed after the
    // device.
    let device = unsafe { Device::adopt(host, &options) }.unwrap();
    let numbers = device.buffer::<u32>("numbers", 4).unwrap();
    let mut rec = Recorder::new(&device, "fill");
    rec.fill(&numbers, 7);
    rec.run().unwrap();
    assert_eq!(numbers.read().unwrap(), [7; 4]);
    assert!(device.submissions() > 0);
    assert_eq!(locked.load(Ordering::Relaxed), device.submissions());
    drop((numbers, device));
    // SAFETY: nothing made from them is left.
    unsafe {
        raw.destroy_device(None);
        instance.destroy_instance(None);
    }
}
