//! Statistics that decide where splats multiply: see `glsl/gradient_stats.comp` and [`crate::fit::densify`].
use super::compact;
use super::rasterizer::FrameBuffers;
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder, shaders};

/// Accumulated screen gradients of N splats.
pub struct GradientStats {
    count: usize,
    /// [N] (sum of norms, number of views).
    stats: Buffer,
}

impl GradientStats {
    /// Zero statistics for `count` splats.
    pub fn new(device: &Device, count: usize) -> Result<Self> {
        Ok(GradientStats { count, stats: device.buffer::<[f32; 2]>("gradient stats", count.max(1))? })
    }

    /// Adds the frame whose backward pass was recorded before.
    pub fn record(&self, rec: &mut Recorder, frame: &FrameBuffers, count: usize) {
        rec.pass("densification statistics");
        let call = shaders::gradient_stats::call(
            &shaders::gradient_stats::Bindings {
                projected: &frame.projected,
                projected_grad: &frame.projected_grad,
                stats: &self.stats,
            },
            &shaders::gradient_stats::Push {
                count: count as u32,
                half_width: 0.5 * frame.width as f32,
                half_height: 0.5 * frame.height as f32,
            },
        );
        rec.dispatch_threads(call, [count as u32, 1, 1]);
    }

    /// Keeps the given rows.
    pub fn keep(&mut self, device: &Device, rows: &[u32]) -> Result<()> {
        let index = device.buffer_from("kept rows", rows)?;
        self.stats = compact::gather(device, "gradient stats", &self.stats, &index, rows.len(), 2)?;
        self.count = rows.len();
        Ok(())
    }

    /// [N, 2] sums and numbers of views.
    pub fn values(&self) -> Result<Vec<f32>> {
        self.stats.read_range::<f32>(0..2 * self.count)
    }

    /// Goes on from [`GradientStats::values`] of as many splats.
    pub fn restore(&mut self, values: &[f32]) -> Result<()> {
        self.stats.write(values)
    }

    /// [N] mean over the views that saw each splat, 0 where none did.
    pub fn mean(&self) -> Result<Vec<f32>> {
        let stats = self.stats.read_range::<[f32; 2]>(0..self.count)?;
        Ok(stats.iter().map(|s| if s[1] > 0.0 { s[0] / s[1] } else { 0.0 }).collect())
    }
}
