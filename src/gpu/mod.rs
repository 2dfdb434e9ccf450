//! The Vulkan engine: device, buffers, shaders with typed bindings, and a recorder that derives the barriers.
//!
//! # A pass in full
//! `glsl/gather.comp` declares blocks `Index`, `From`, `To` and a push block with `uint rows, stride`.
//! build.rs turns that into `shaders::gather` and the host call is
//!
//! ```no_run
//! # fn main() -> splatvk::Result<()> {
//! use splatvk::gpu::{Device, Recorder, shaders};
//! let device = Device::open(None)?;
//! let index = device.buffer_from("index", &[2u32, 0])?;
//! let from = device.buffer_from("from", &[10u32, 20, 30])?;
//! let to = device.buffer::<u32>("to", 2)?;
//!
//! let mut rec = Recorder::new(&device, "gather");
//! rec.dispatch_threads(
//!     shaders::gather::call(
//!         &shaders::gather::Bindings { index: &index, from: &from, to: &to },
//!         &shaders::gather::Push { rows: 2, stride: 1 },
//!     ),
//!     [2, 1, 1],
//! );
//! rec.run()?;
//! assert_eq!(to.read()?, [30, 10]);
//! # Ok(())
//! # }
//! ```
//!
//! A buffer of another element does not compile:
//!
//! ```compile_fail,E0308
//! # fn main() -> splatvk::Result<()> {
//! # use splatvk::gpu::{Device, shaders};
//! # let device = Device::open(None)?;
//! # let index = device.buffer_from("index", &[2u32, 0])?;
//! # let to = device.buffer::<u32>("to", 2)?;
//! let from = device.buffer_from("from", &[10.0f32, 20.0, 30.0])?;
//! let bindings = shaders::gather::Bindings { index: &index, from: &from, to: &to };
//! # Ok(())
//! # }
//! ```
//!
//! # What build.rs generates for `glsl/NAME.comp` (only storage buffers in set 0 and push constants are allowed)
//! - `shaders::NAME::Bindings<'a> { block_name: &'a Buffer<T>, .. }`: one field per buffer block, the block's name in snake
//!   case; `T` is the scalar or the structure that it holds (see [`Buffer`]). Read / write access comes from what the compiled code does, bounded by `readonly` / `writeonly`.
//! - `shaders::NAME::Push { .. }`: the push constant block (float, int, uint, vectors, matrices, arrays; at most 128 bytes)
//!   with natural Rust types; the reflected offsets are applied when it is written, so there is no padding to keep in step.
//! - `shaders::NAME::call(&Bindings, &Push) -> Call`; without a push block `call(&Bindings)`.
//! - `shaders::NAME::CONSTANT`, and `shaders::shared::FILE::CONSTANT` for `glsl/shared/FILE.glsl`: every `const` and
//!   `#define` at file scope whose value is known at build time. Floats come in f64 with the digits of the source. No other
//!   Rust file repeats one (tests/shaders.rs).
//! - `shaders::structs::NAME`: the structures of storage buffers as [`bytemuck::Pod`], laid out as reflected.
//! - `shaders::NAME::WORKGROUP: [u32; 3]` (left out when variants differ; `dispatch_threads` always knows it).
//! - `// variants: CHANNELS=3,4,20` (one line per macro, combined as a product; first column): a struct
//!   `Variant { channels: u32 }` and `call(Variant { channels: 4 }, &Bindings, &Push)`. A value that was not compiled is an
//!   error at `run` / `compile` that lists the values there are. Blocks that a variant leaves out are ignored there.
//! - `// subgroups: 8,16,32,64`: compiled per subgroup size (macro `SUBGROUP_SIZE`, usable as `local_size_x`); the device
//!   picks the size it runs at, and pins it where it can. For "workgroup = one subgroup" kernels.
//! - `#include "shared/atomic_float.glsl"`: compiled with native float atomics and with a CAS loop; the device picks.
//! - Workgroup sizes are literal, never specialisation constants: naga validates every module (tests/shaders.rs).
//!
//! # Signatures
//! - [`Device::open`]`(choice: Option<&str>)`: name part or index; [`Device::info`]; tests use [`test_device`]`()`.
//! - [`Device::buffer`]`::<T>(name, len)` (zero-filled), [`Device::buffer_from`]`(name, &[T])`; [`Buffer::read`]`()`,
//!   [`Buffer::read_range`], [`Buffer::write`]`(&[T])`, [`Buffer::write_at`]`(first, &[T])`, [`Buffer::cast`]`::<U>()`.
//!   Element types are [`bytemuck::Pod`]; lengths count elements. `Buffer<T>` is a cheap clone of a handle.
//! - [`Recorder::download`]`(&buffer)` at the end of a recording brings small results to the host with its submission.
//! - [`Recorder::new`]`(&device, label)`; [`Recorder::fill`]`(&buffer, u32)`, [`Recorder::copy`]`(&from, &to)`,
//!   [`Recorder::dispatch`]`(call, groups)`, [`Recorder::dispatch_threads`]`(call, threads)`,
//!   [`Recorder::dispatch_indirect`]`(call, &args, byte_offset)` with three `u32` group counts in `args`.
//!   Recording never fails; the first mistake is returned by `run` or `compile`.
//! - [`Recorder::run`]`()` submits and waits; [`Recorder::run_timed`]`()` also returns milliseconds per command;
//!   [`Recorder::compile`]`()` gives a [`Program`] whose [`Program::run`]`()` may be repeated thousands of times (per-step
//!   values go through a small buffer written between runs).
//!
//! # What has to be installed
//! A Vulkan loader and a driver for Vulkan 1.2 with `VK_KHR_synchronization2`; on Debian and Ubuntu `libvulkan1` and
//! `mesa-vulkan-drivers` (which includes the CPU device lavapipe). The tests also need `vulkan-validationlayers`.
//! At build time: libshaderc (see `.cargo/config.toml`), nothing of Vulkan.
mod adopt;
mod barrier;
mod buffer;
mod call;
mod command;
mod compile_time;
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
mod open;
mod pipeline;
mod pipeline_cache;
mod program;
mod recorder;
pub mod report;
mod select;
mod staging;
mod testing;
mod transfer;
mod validation;
mod ways;

pub use adopt::HostDevice;
/// The Vulkan bindings whose handles [`HostDevice`] and [`external`] take.
pub use ash::vk;
pub use buffer::Buffer;
pub use call::Call;
#[doc(hidden)]
pub use command::{Groups, Op};
pub use compile_time::on_long_compilation;
pub use device::{Device, QueueLock};
pub use enabled::EnabledFeatures;
#[doc(hidden)]
pub use executor::Executor;
pub use info::{DeviceInfo, LOOP_ROUNDS, Options};
pub use memory::Memory;
pub use module::{Access, Binding, Capability, Family, Module};
pub use program::Program;
pub use recorder::Recorder;
#[doc(hidden)]
pub use testing::{TestDevice, test_device};
pub use ways::Way;

/// The shaders, generated by build.rs from `glsl/*.comp`.
#[allow(clippy::approx_constant)] // LN2 and the like stand in the sources with as many digits as they need
pub mod shaders {
    include!(concat!(env!("OUT_DIR"), "/shaders.rs"));
}

#[cfg(test)]
mod tests;
