//! GPU passes, one file each with its CPU reference; buffers, views and options that passes share.
pub mod adam;
pub mod bands;
pub mod bin;
pub mod channels;
pub mod choices;
pub mod close;
pub mod codes;
pub mod compact;
pub mod decode;
pub mod first_step;
pub mod frame;
pub mod fused_update;
pub mod label_weights;
pub mod metrics;
pub mod options;
pub mod pack;
pub mod pairs;
pub mod params;
pub mod plane_sweep;
pub mod plane_sweep_cpu;
pub mod project;
pub mod project_backward;
pub mod query_peaks;
pub mod raster_backward;
pub mod raster_forward;
pub mod rasterizer;
pub mod reference;
pub mod regularise;
pub mod renderer;
pub mod scan;
pub mod screen_gradients;
pub mod sort;
pub mod splat_buffers;
pub mod ssim_l1;
pub mod sum;
mod sweep_window;
pub mod tile_lists;
pub mod view;
pub mod view_buffers;

pub use choices::DeviceChoices;
pub use frame::{FrameBuffers, GradientReduction, TileSums};
pub use fused_update::UpdateKernel;
pub use options::{FeatureMode, RasterOptions};
pub use project_backward::ShGradientKernel;
pub use rasterizer::Rasterizer;
pub use renderer::{RenderedFrame, Renderer};
pub use splat_buffers::SplatBuffers;
pub use tile_lists::TileBinning;
pub use view::View;

#[cfg(test)]
mod reference_tests;
#[cfg(test)]
mod stereo_tests;
#[cfg(test)]
mod viewing_costs;
