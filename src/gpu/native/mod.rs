//! Native passes: the work of shaders in native code, where the device is the processor.
//!
//! A driver on the processor, as lavapipe, reads and writes every number of a shader's buffers by
//! itself and takes a microsecond per barrier; native code works on rows. The shaders remain the
//! reference of a pass, and tests run on them; each native pass is compared with its
//! shader.
mod adam;
mod arithmetic;
mod bin;
mod blend;
mod decode;
mod label_weights;
mod lanes;
mod prefetch;
mod project;
mod project_backward;
mod raster;
mod scatter;
mod sh;
mod small;
mod sort;
mod splat;
mod ssim;
#[cfg(test)]
mod tests;
mod tile;

use crate::gpu::Native;

/// All native passes.
pub static ALL: &[Native] = &[
    Native { family: "adam", run: adam::run },
    Native { family: "bench_arithmetic", run: arithmetic::run },
    Native { family: "bin_base", run: bin::base },
    Native { family: "bin_count", run: bin::count },
    Native { family: "bin_emit", run: bin::emit },
    Native { family: "bin_scan", run: bin::scan },
    Native { family: "bin_scatter", run: bin::scatter },
    Native { family: "bin_sum", run: bin::sum },
    Native { family: "camera_sum", run: small::camera_sum },
    Native { family: "count_pairs", run: raster::count_pairs },
    Native { family: "decode", run: decode::run },
    Native { family: "depth_and_alpha", run: small::depth_and_alpha },
    Native { family: "features_forward", run: small::features_forward },
    Native { family: "label_weights", run: label_weights::run },
    Native { family: "project", run: project::run },
    Native { family: "project_backward", run: project_backward::run },
    Native { family: "raster_backward", run: raster::backward },
    Native { family: "raster_forward", run: raster::forward },
    Native { family: "ratio_penalty", run: small::ratio_penalty },
    Native { family: "scan_apply", run: sort::scan_apply },
    Native { family: "scan_lanes", run: sort::scan_lanes },
    Native { family: "scan_sums", run: sort::scan_sums },
    Native { family: "sort_count", run: sort::count },
    Native { family: "sort_offsets", run: sort::offsets },
    Native { family: "sort_scatter", run: sort::scatter },
    Native { family: "ssim_columns", run: ssim::nothing },
    Native { family: "ssim_rows", run: ssim::nothing },
    Native { family: "ssim_rows_shared", run: ssim::nothing },
    Native { family: "ssim_gradient", run: ssim::gradient },
    Native { family: "sum", run: small::sum },
];
