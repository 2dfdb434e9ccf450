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
mod together;
mod types;

use dispatch::{Order, Schedule};
use executor::Interpreted;
use std::sync::Arc;

fn interpreted(subgroup_size: usize, float_atomics: bool) -> Interpreted {
    let schedule = Schedule { subgroup_size, order: Order::Random, in_flight: 3, scattered: false, seed: 1 };
    Interpreted { schedule, float_atomics, scratch: &[], change: None, ran: Arc::default() }
}

#[test]
fn passes_over_arrays_match_their_twins() {
    for size in [4, 8, 16, 32, 64] {
        for (name, scene) in passes::ALL {
            let outcome = scene(&interpreted(size, true).open());
            assert_eq!(outcome, Ok(()), "{name}, subgroups of {size}");
        }
    }
}
