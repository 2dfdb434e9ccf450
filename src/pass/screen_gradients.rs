//! Sums of the gradients of splats by their centres on the screen, the measure of adaptive density
//! control (Kerbl et al. 2023): a splat that views pull far stands for more than it can show.
//!
//! `∂u = −(A Σσdx + B Σσdy)`, `∂v = −(C Σσdy + B Σσdx)` with the conic (A, B, C) and the moments of
//! [`super::raster_backward`]; its length is measured in normalised device coordinates, pixels times
//! half of the image size.
use super::frame::FrameBuffers;
use super::project::Projected;
use super::raster_backward::SplatGradient;
use super::sort::rows_of_groups;
use crate::gpu::{Buffer, Recorder, shaders};

/// Records the addition of a frame's gradients, after its backward pass, to `sums` [N, 2]: per splat
/// the sum of the lengths, and the number of frames that show it. Void where the frame overflowed.
pub fn record(rec: &mut Recorder, frame: &FrameBuffers, splats: usize, sums: &Buffer<f32>) {
    let call = shaders::screen_gradients::call(
        &shaders::screen_gradients::Bindings {
            projected: &frame.projected,
            projected_grad: &frame.projected_grad,
            guard: &frame.status,
            sums,
        },
        &shaders::screen_gradients::Push {
            count: splats as u32,
            half_width: 0.5 * frame.width as f32,
            half_height: 0.5 * frame.height as f32,
        },
    );
    rec.dispatch(call, rows_of_groups(splats.div_ceil(shaders::screen_gradients::WORKGROUP[0] as usize)));
}

/// CPU reference: length of the gradient of one splat in an image of `size` pixels.
pub fn reference(projected: &Projected, gradient: &SplatGradient, size: [u32; 2]) -> f64 {
    let ([a, b, c], [_, dx, dy, ..]) = (projected.conic, gradient.moments);
    let by_centre = [a * dx + b * dy, c * dy + b * dx];
    (0.5 * f64::from(size[0]) * by_centre[0]).hypot(0.5 * f64::from(size[1]) * by_centre[1])
}
