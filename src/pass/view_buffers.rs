//! Buffers through which the host exchanges numbers with a run.
use super::frame::CAMERA_GRADIENTS;
use super::rasterizer::Rasterizer;
use crate::Result;
use crate::gpu::shaders::structs::CameraView;
use crate::gpu::{Buffer, Device};

/// Camera, status and camera gradients of one view: runs that the device has at once must not share
/// them.
#[derive(Clone)]
pub struct ViewBuffers {
    camera: Buffer<CameraView>,
    status: Buffer<u32>,
    camera_grad: Buffer<f32>,
}

impl ViewBuffers {
    /// Allocates a few hundred bytes.
    pub fn new(device: &Device) -> Result<ViewBuffers> {
        Ok(ViewBuffers {
            camera: device.buffer::<CameraView>("camera", 1)?,
            status: device.buffer::<u32>("status", 3)?,
            camera_grad: device.buffer::<f32>("camera_grad", CAMERA_GRADIENTS)?,
        })
    }
}

impl Rasterizer {
    /// Uses these buffers in later recordings, runs and reads; a recording keeps its own.
    pub fn use_buffers(&mut self, buffers: &ViewBuffers) {
        let ViewBuffers { camera, status, camera_grad } = buffers.clone();
        (self.camera, self.frame.status, self.frame.camera_grad) = (camera, status, camera_grad);
    }
}
