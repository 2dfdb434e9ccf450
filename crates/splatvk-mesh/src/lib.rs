//! Meshes from posed depth maps, on the CPU.

// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

mod accuracy;
mod build;
mod collider;
mod distance;
mod extract;
mod frame;
mod labels;
mod surface;
#[cfg(test)]
mod tests;
mod tsdf;

pub use accuracy::{Accuracy, TrueView, WITHIN, Within, accuracy};
pub use build::{Built, Simplify, build};
pub use collider::Collider;
pub use distance::{Nearest, samples};
pub use frame::Frame;
pub use surface::{Surface, border_edges};
pub use tsdf::{Tsdf, TsdfOptions};
