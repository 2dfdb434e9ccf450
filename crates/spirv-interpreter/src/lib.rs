//! Interpreter of SPIR-V compute shaders, for tests.
//!
//! A device has one subgroup size and one scheduler. This interpreter supports any subgroup size
//! and any order of workgroups, and reports faults that no driver reports:
//!
//! - **data races**, between invocations and between workgroups, by the memory model of Vulkan;
//! - **reads of unwritten words**, in initially empty buffers, workgroup and private memory;
//! - **accesses out of bounds** of buffers, arrays and vectors;
//! - **subgroup operations** in which not all invocations take part, and shuffles from inactive
//!   lanes;
//! - **barriers** that some invocations never reach, and waits that never end.
//!
//! ```no_run
//! use spirv_interpreter::{Memory, Order, Schedule, Shader, words};
//!
//! # fn main() -> Result<(), spirv_interpreter::Error> {
//! # let spirv = std::fs::read("double.spv").unwrap_or_default();
//! let shader = Shader::new(&words(&spirv));
//! // Binding 0 contains two floats.
//! let mut buffers = vec![Some(Memory::of(vec![1f32.to_bits(), 2f32.to_bits()]))];
//! let schedule = Schedule {
//!     subgroup_size: 16,
//!     order: Order::Random,
//!     in_flight: 3,
//!     scattered: false,
//!     seed: 1,
//! };
//! shader.dispatch(&mut buffers, &[2], [1, 1, 1], &schedule)?;
//! let doubled = buffers[0].as_ref().map(|b| f32::from_bits(b.words[1]));
//! assert_eq!(doubled, Some(4.0));
//! # Ok(())
//! # }
//! ```
//!
//! # Scope
//! Compute shaders for Vulkan with logical addressing and 32-bit numbers: storage buffers of
//! descriptor set 0, push constants, workgroup and private memory, atomics, subgroup vote, ballot,
//! shuffle and arithmetic, most of GLSL.std.450. No images, no other number widths, no functions
//! that the compiler has not inlined. For other modules [`Shader::new`] panics with the name of the
//! unsupported feature: this is a test tool, and a panic fails a test.
//!
//! [`module`] disassembles and reassembles modules, for mutation tests of single instructions.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails

mod alu;
mod code;
mod counts;
mod dispatch;
mod faults;
mod lower;
mod lower_alu;
mod memory;
pub mod module;
mod subgroup;
mod subgroup_ops;
mod types;

pub use code::GARBAGE;
pub use counts::Counts;
pub use dispatch::{Order, Random, Schedule};
pub use faults::{Error, Fault, Found};
pub use memory::Memory;
pub use rspirv::spirv;

/// Little-endian words of a SPIR-V file or a buffer.
pub fn words(bytes: &[u8]) -> Vec<u32> {
    bytes.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect()
}

/// An executable shader.
pub struct Shader(code::Code);

impl Shader {
    /// Reads a module with one entry point.
    ///
    /// # Panics
    /// If the module is invalid or uses an unsupported feature; the message names it.
    pub fn new(spirv: &[u32]) -> Shader {
        Shader(lower::lower(spirv))
    }

    /// Invocations per workgroup: `local_size`.
    pub fn workgroup(&self) -> [u32; 3] {
        self.0.workgroup
    }

    /// Runs all workgroups. `buffers` are indexed by binding number; `push` has the words of the
    /// push constants. Returns the counts of the executed instructions.
    ///
    /// # Errors
    /// [`Error::Stuck`] if a barrier is not reached by all or a loop never ends, [`Error::Faulty`]
    /// with each kind of fault once per instruction.
    pub fn dispatch(
        &self,
        buffers: &mut [Option<Memory>],
        push: &[u32],
        groups: [u32; 3],
        schedule: &Schedule,
    ) -> Result<Counts, Error> {
        let mut faults = faults::Faults::default();
        let counts =
            dispatch::run(&self.0, buffers, push, groups, schedule, &mut faults).map_err(Error::Stuck)?;
        faults.report().map(|()| counts)
    }
}
