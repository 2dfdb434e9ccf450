//! The shipped SPIR-V, interpreted: every pass against its CPU twin at subgroup sizes that no device at hand has, with
//! what no driver reports. See docs/trust.md#shaders-without-a-device.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod alu;
mod code;
mod dispatch;
mod executor;
mod faults;
mod lower;
mod lower_alu;
mod memory;
mod module;
mod passes;
mod subgroup;
#[path = "../support/mod.rs"]
mod support;
mod together;
mod types;

use dispatch::{Order, Schedule};
use executor::Interpreted;
use std::sync::Arc;

fn interpreted(subgroup_size: usize, float_atomics: bool) -> Interpreted {
    let schedule = Schedule { subgroup_size, order: Order::Random, in_flight: 3, scattered: false, seed: 1 };
    Interpreted { schedule, float_atomics, scratch: &[], change: None, ran: Arc::default() }
}

/// Runs a scene; what it says if it fails.
fn outcome(scene: passes::Scene, on: &Interpreted) -> Result<(), String> {
    let run = std::panic::AssertUnwindSafe(|| scene(&on.open()));
    std::panic::catch_unwind(run).map_err(|payload| {
        let text = payload.downcast_ref::<String>().map(String::as_str);
        text.or(payload.downcast_ref::<&str>().copied()).unwrap_or("a panic").to_owned()
    })
}

#[test]
fn all() {
    for size in [4, 8, 16, 32, 64] {
        for (name, scene) in passes::PLAIN {
            let t = std::time::Instant::now();
            let o = outcome(*scene, &interpreted(size, true));
            println!("{size} {name}: {o:?} {:?}", t.elapsed());
        }
        for native in [true, false] {
            for (name, scene) in passes::ADDING {
                let t = std::time::Instant::now();
                let o = outcome(*scene, &interpreted(size, native));
                println!("{size} {native} {name}: {o:?} {:?}", t.elapsed());
            }
        }
    }
}
