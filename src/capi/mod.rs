//! The C ABI: `include/splatvk.h`, generated from this folder by cbindgen. Thin: what it does is in [`crate::run::live`].
//!
//! Rules that hold for every function are in the header's introduction (`cbindgen.toml`). Structures begin with their
//! size, so that hosts built against an older header go on working; fields are only ever added at the end, and numbers of
//! retired codes are not used again.
// C callers find the contract of the pointers in the header's introduction; repeating it on every function would hide what
// is special about each.
#![allow(clippy::missing_safety_doc)]

mod boundary;
mod context;
mod progress;
mod render;
mod scene;
mod train;
mod types;

pub use context::*;
pub use render::*;
pub use scene::*;
pub use train::*;
pub use types::*;
