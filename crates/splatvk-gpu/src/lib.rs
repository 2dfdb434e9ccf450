//! Vulkan compute in which the compiler checks the bindings and the recorder derives the barriers.
//!
//! `splatvk-gpu-build` compiles a folder of GLSL shaders in `build.rs` and generates a module per
//! shader. For a shader with the buffer blocks `Index`, `From`, `To` and a push constant `rows`:
//!
//! ```no_run
//! # fn main() -> splatvk_gpu::Result<()> {
//! use splatvk_gpu::{Device, Options, Recorder};
//! # use splatvk_gpu_test_shaders as shaders;
//! let device = Device::open(&Options::default())?;
//! let index = device.buffer_from("index", &[2u32, 0])?;
//! let from = device.buffer_from("from", &[10u32, 20, 30])?;
//! let to = device.buffer::<u32>("to", 2)?;
//!
//! let mut recorder = Recorder::new(&device, "gather");
//! recorder.dispatch_threads(
//!     shaders::gather::call(
//!         &shaders::gather::Bindings { index: &index, from: &from, to: &to },
//!         &shaders::gather::Push { rows: 2 },
//!     ),
//!     [2, 1, 1],
//! );
//! recorder.run()?;
//! assert_eq!(to.read()?, [30, 10]);
//! # Ok(())
//! # }
//! ```
//!
//! A buffer of another element type does not compile:
//!
//! ```compile_fail,E0308
//! # fn main() -> splatvk_gpu::Result<()> {
//! # use splatvk_gpu::{Device, Options};
//! # use splatvk_gpu_test_shaders as shaders;
//! # let device = Device::open(&Options::default())?;
//! # let index = device.buffer_from("index", &[2u32, 0])?;
//! # let to = device.buffer::<u32>("to", 2)?;
//! let from = device.buffer_from("from", &[10.0f32, 20.0, 30.0])?;
//! let bindings = shaders::gather::Bindings { index: &index, from: &from, to: &to };
//! # Ok(())
//! # }
//! ```
//!
//! # Parts
//! - [`Device::open`] opens a device of its own, [`Device::adopt`] works on one of the host
//!   program.
//! - [`Device::buffer`] and [`Device::buffer_from`] make storage buffers. [`Buffer`] is a handle;
//!   clones share the memory.
//! - [`Recorder`] records fills, copies and dispatches. Recording never fails; [`Recorder::run`]
//!   and [`Recorder::compile`] return the first mistake.
//! - [`Program`] is a compiled recording, to be run any number of times. Values that change between
//!   runs go through a small buffer.
//! - [`Family`] and [`Module`] are the tables that `splatvk-gpu-build` generates. They can be
//!   written by hand for SPIR-V from elsewhere ([`Call::new`]).
//!
//! # Barriers
//! The tables state which buffers each module reads and writes, from its SPIR-V. A recording is
//! split into commands with minimal barriers between them, and an independent check by the memory
//! model of Vulkan accepts the result before it is encoded.
//!
//! # Requirements
//! A Vulkan loader and a driver for Vulkan 1.2 with `VK_KHR_synchronization2`. On Debian and Ubuntu
//! these are `libvulkan1` and `mesa-vulkan-drivers`, which includes the CPU device lavapipe. The
//! tests also need `vulkan-validationlayers`, and libshaderc to compile their shaders.
mod adopt;
mod barrier;
mod buffer;
mod cache;
mod call;
mod choice;
mod command;
mod compile_time;
mod counts;
mod device;
mod enabled;
mod error;
mod executor;
pub mod external;
mod features;
mod hazard;
mod info;
mod memory;
mod module;
mod native;
mod open;
mod pipeline;
mod program;
mod recorder;
mod select;
mod staging;
mod survey;
mod sync;
#[cfg(feature = "testing")]
mod testing;
mod transfer;
mod validation;

pub use adopt::HostDevice;
/// The Vulkan bindings whose handles [`HostDevice`] and [`external`] take.
pub use ash::vk;
pub use buffer::Buffer;
/// The element types of buffers are [`bytemuck::Pod`]; generated structures derive it.
pub use bytemuck;
pub use cache::Cache;
pub use call::Call;
pub use choice::INSTALL;
#[cfg(feature = "testing")]
pub use command::{Groups, Op};
pub use compile_time::on_long_compilation;
pub use counts::WorkCounts;
pub use device::{Device, QueueLock};
pub use enabled::EnabledFeatures;
pub use error::{Error, Result, VulkanError};
#[cfg(feature = "testing")]
pub use executor::Executor;
pub use info::{DeviceInfo, LOOP_ROUNDS, NATIVE_FLOAT_ATOMICS, Options};
pub use memory::Memory;
pub use module::{Access, Binding, Capability, Family, Module};
pub use native::{Memory as NativeMemory, Native, NativeCall};
pub use program::{Program, Running};
pub use recorder::Recorder;
pub use survey::{Survey, Surveyed, survey};
#[cfg(feature = "testing")]
pub use testing::{InMemoryCache, TestDevice};

#[cfg(test)]
mod tests;
