//! The C ABI. cbindgen generates `include/splatvk.h` from this folder; the work is done in
//! [`crate::run`].
//!
//! The header's introduction (`cbindgen.toml`) holds the rules of all functions. Structures begin
//! with their size, so that hosts built against an older header keep working. Fields are only added
//! at the end, and numbers of retired codes are not reused.
// The contract of the pointers is in the header's introduction.
#![allow(clippy::missing_safety_doc)]

mod boundary;
mod context;
mod edit;
mod files;
mod label;
mod options;
mod progress;
mod render;
mod scene;
mod train;
mod types;

pub use context::*;
pub use edit::*;
pub use files::*;
pub use label::*;
pub use options::*;
pub use render::*;
pub use scene::*;
pub use train::*;
pub use types::*;
