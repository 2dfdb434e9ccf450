//! Runs the shipped SPIR-V in the interpreter: every pass against its CPU reference, at subgroup
//! sizes that no available device has, with detection of faults that no driver reports. See
//! docs/internals/trust.md#shaders-without-a-device.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod costs;
mod executor;
mod mutations;
mod operations;
mod passes;
#[path = "../support/mod.rs"]
mod support;

use executor::Interpreted;
use passes::Scene;
use spirv_interpreter::{Order, Schedule};
use splatvk::gpu::{Module, shaders};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Scratch buffers of passes within one program, whose previous content must not matter.
const SCRATCH: &[&str] = &[
    "entries",
    "entry splats",
    "large splats",
    "loss sums of strips",
    "scan sums",
    "sort histogram",
    "sort scratch",
    "sort zeros",
    "ssim cross slopes",
    "ssim means",
    "ssim moments",
    "ssim slopes",
    "tile counters",
];

fn interpreted(subgroup_size: usize, float_atomics: bool) -> Interpreted {
    let schedule = Schedule { subgroup_size, order: Order::Random, in_flight: 3, scattered: false, seed: 1 };
    let (ran, counts) = (Arc::default(), Arc::default());
    Interpreted { schedule, float_atomics, max_binding: None, scratch: SCRATCH, change: None, ran, counts }
}

/// Runs a scene; returns the panic message if it fails.
fn outcome(scene: Scene, on: &Interpreted) -> Result<(), String> {
    let run = std::panic::AssertUnwindSafe(|| scene.run(&on.open()));
    std::panic::catch_unwind(run).map_err(|payload| {
        let text = payload.downcast_ref::<String>().map(String::as_str);
        text.or(payload.downcast_ref::<&str>().copied()).unwrap_or("a panic").to_owned()
    })
}

/// Runs all scenes at a subgroup size, those with atomic additions also without native float
/// atomics. Returns the modules and scratch buffers that were used.
fn run_all(schedule: Schedule) -> BTreeSet<&'static str> {
    let mut failed = Vec::new();
    let mut ran = BTreeSet::new();
    for native in [true, false] {
        let on = Interpreted { schedule, ..interpreted(schedule.subgroup_size, native) };
        for scene in passes::all(native) {
            if let Err(e) = outcome(scene, &on) {
                let name = scene.name();
                failed.push(format!("{name}, {schedule:?}, native float atomics {native}: {e}"));
            }
        }
        ran.extend(on.ran.lock().unwrap().iter());
    }
    assert!(failed.is_empty(), "{}", failed.join("\n"));
    ran
}

/// Modules that run on a device, with the scenes that run them: the small ones, or the checks of
/// passes that no small scene runs. Not those of benchmarks.
fn runs(subgroup_size: usize, float_atomics: bool) -> Vec<(&'static Module, Vec<Scene>)> {
    let scenes = passes::all(float_atomics).into_iter().map(|scene| {
        let on = interpreted(subgroup_size, float_atomics);
        assert_eq!(outcome(scene, &on), Ok(()));
        (scene, on.ran.lock().unwrap().clone())
    });
    let scenes: Vec<_> = scenes.collect();
    let modules = shaders::FAMILIES.iter().filter(|f| !f.name.starts_with("bench")).flat_map(|f| f.modules);
    let with_scenes = |m: &'static Module| {
        let runs = |small: bool| {
            let kind = move |scene: &Scene| matches!(scene, Scene::Own(..)) == small;
            let fits = scenes.iter().filter(move |(scene, ran)| kind(scene) && ran.contains(m.name));
            fits.map(|(scene, _)| *scene).collect::<Vec<_>>()
        };
        let small = runs(true);
        (m, if small.is_empty() { runs(false) } else { small })
    };
    modules.map(with_scenes).filter(|(_, scenes)| !scenes.is_empty()).collect()
}

/// Compares every pass with its reference; no shader file may be left out.
fn check_passes_at(subgroup_size: usize) {
    let ran = run_all(interpreted(subgroup_size, true).schedule);
    let forgotten: Vec<&str> = shaders::FAMILIES
        .iter()
        .filter(|f| !f.modules.iter().any(|m| ran.contains(m.name)))
        .map(|f| f.name)
        .collect();
    assert!(
        forgotten.is_empty(),
        "no case of src/check and no scene of tests/spirv/passes runs {forgotten:?}"
    );
    let unknown: Vec<_> = SCRATCH.iter().filter(|name| !ran.contains(*name)).collect();
    assert!(unknown.is_empty(), "no pass has buffers named {unknown:?}");
}

#[test]
fn passes_match_reference_at_subgroup_4() {
    check_passes_at(4);
}

#[test]
fn passes_match_reference_at_subgroup_8() {
    check_passes_at(8);
}

#[test]
fn passes_match_reference_at_subgroup_16() {
    check_passes_at(16);
}

#[test]
fn passes_match_reference_at_subgroup_32() {
    check_passes_at(32);
}

#[test]
fn passes_match_reference_at_subgroup_64() {
    check_passes_at(64);
}

/// For devices that do not bind a whole image.
#[test]
fn bands_stay_within_buffers() {
    let on = Interpreted { max_binding: Some(1 << 17), ..interpreted(32, true) };
    assert_eq!(outcome(Scene::Own("bands", passes::bands), &on), Ok(()));
}

/// Vulkan does not specify which invocations form a subgroup.
#[test]
fn subgroups_may_hold_any_invocations() {
    run_all(Schedule { scattered: true, seed: 6, ..interpreted(32, true).schedule });
}

/// A frame depends only on its program, not on the splats and lists of the last frame.
#[test]
fn frame_ignores_previous_buffers() {
    let scratch = &[
        "codes",
        "depth_pairs",
        "entries",
        "entry splats",
        "entry_count",
        "planes",
        "projected",
        "scan sums",
        "sort scratch",
        "sort zeros",
        "tile_counts",
        "tile_ranges",
        "tile_splats",
        "tile_starts",
        "transmittance",
    ];
    let on = Interpreted { scratch, ..interpreted(32, true) };
    assert_eq!(outcome(Scene::Own("image", passes::image), &on), Ok(()));
    let unknown: Vec<_> = scratch.iter().filter(|name| !on.ran.lock().unwrap().contains(*name)).collect();
    assert!(unknown.is_empty(), "no pass has buffers named {unknown:?}");
}

/// Every shipped module, with and without native float atomics; workgroups one by one in either
/// order and many at once; invocations assigned to subgroups in order and at random.
#[test]
#[ignore = "takes long: tools/test-long"]
fn every_module_in_every_order() {
    let mut ran = BTreeSet::new();
    for subgroup_size in [4, 8, 16, 32, 64] {
        for (seed, order, in_flight, scattered) in [
            (2, Order::Rising, 1, false),
            (3, Order::Falling, 1, false),
            (4, Order::Random, 20, false),
            (5, Order::Random, 5, true),
        ] {
            ran.extend(run_all(Schedule { subgroup_size, order, in_flight, scattered, seed }));
        }
    }
    let modules = shaders::FAMILIES.iter().flat_map(|f| f.modules);
    let forgotten: Vec<&str> = modules.map(|m| m.name).filter(|name| !ran.contains(name)).collect();
    assert!(
        forgotten.is_empty(),
        "no case of src/check and no scene of tests/spirv/passes runs {forgotten:?}"
    );
}
