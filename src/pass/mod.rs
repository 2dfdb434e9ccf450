//! One file per GPU pass, each with its CPU twin.
pub mod adam;
pub mod bands;
pub mod bin;
pub mod close;
pub mod codes;
pub mod compact;
pub mod decode;
pub mod metrics;
pub mod pack;
pub mod pairs;
pub mod plane_sweep;
pub mod plane_sweep_cpu;
pub mod project;
pub mod project_backward;
pub mod raster_backward;
pub mod raster_forward;
pub mod rasterizer;
pub mod regularise;
pub mod renderer;
pub mod scan;
pub mod seeded;
pub mod sh;
pub mod sort;
pub mod ssim_l1;
pub mod sum;
pub mod twin;
pub mod view;

pub use rasterizer::{RasterOptions, Rasterizer, SplatBuffers, Ways};
pub use renderer::{Frame, Renderer};
pub use twin::FeatureMode;
pub use view::View;

#[cfg(test)]
mod twin_tests;
