//! One file per GPU pass, each with its CPU twin.
pub mod adam;
pub mod close;
pub mod compact;
pub mod metrics;
pub mod project;
pub mod project_backward;
pub mod raster_backward;
pub mod raster_forward;
pub mod scan;
pub mod seeded;
pub mod sh;
pub mod sort;
pub mod ssim_l1;
pub mod sum;
pub mod twin;
#[cfg(test)]
mod twin_tests;
pub mod view;
