//! Slanted-plane multi-view matching on the device. What the shaders compute is written down in the CPU twin,
//! [`super::plane_sweep_cpu`].
use crate::Result;
use crate::gpu::shaders::{plane_sweep, plane_sweep_refine};
use crate::gpu::{Buffer, Device, Recorder};
use glam::Vec4;

/// Most source views that one reference view is matched against: a fifth adds cost, hardly accuracy.
pub const MAX_SOURCES: usize = 4;
/// One source view as seen from a reference view; the layout of the shader's `sources` buffer.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Source {
    /// Rows of `K_s [R | t]`: `(ray, 1/z)` of the reference → homogeneous source pixel, scaled by the inverse depth.
    pub forward: [[f32; 4]; 3],
    /// Rows of the inverse mapping: `(ray, 1/z)` of the source → homogeneous reference pixel.
    pub back: [[f32; 4]; 3],
    /// Source camera centre in the reference frame; w unused.
    pub centre: [f32; 4],
    /// fx, fy, cx, cy of the source, pixels.
    pub intrinsics: [f32; 4],
    /// Width, height, index of the view's first pixel in the shared image and plane buffers, unused.
    pub size: [u32; 4],
}

/// The reference view and the search; the shader's push constants.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reference {
    /// fx, fy, cx, cy, pixels.
    pub intrinsics: [f32; 4],
    /// Smallest and largest inverse depth searched.
    pub range: [f32; 2],
    /// Weight of the geometric term per pixel of reprojection error; 0 = photometric only.
    pub geometric: f32,
    /// Seed of the hash that replaces a random-number generator.
    pub seed: u32,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Index of the view's first pixel in the shared buffers.
    pub first: u32,
    /// Index of the view's first entry in the `sources` buffer.
    pub first_source: u32,
    /// Number of source views, at most [`MAX_SOURCES`].
    pub sources: u32,
    /// 0 or 1: the checkerboard colour to update.
    pub parity: u32,
    /// Hypotheses of the initial sweep.
    pub planes: u32,
    /// Weight of the disagreement with the neighbours' surfaces.
    pub smoothness: f32,
}

/// What the matching schedule needs of the device and of its twin.
pub trait Matcher {
    /// Initial sweep over all pixels of one view.
    fn sweep(&mut self, reference: &Reference) -> Result<()>;
    /// One propagation step over one checkerboard colour of one view.
    fn refine(&mut self, reference: &Reference) -> Result<()>;
    /// (π, cost) per pixel of all views.
    fn planes(&self) -> Result<Vec<Vec4>>;
}

/// Matching at one resolution on the device.
pub struct GpuMatcher {
    device: Device,
    quads: Buffer,
    sources: Buffer,
    planes: Buffer,
}

impl GpuMatcher {
    /// `luma` and `planes` (π, cost) hold all views one after the other, `widths` one entry per view and its pixels.
    pub fn new(
        device: &Device,
        luma: &[f32],
        references: &[Reference],
        sources: &[Source],
        planes: &[Vec4],
    ) -> Result<Self> {
        let planes: Vec<[f32; 4]> = planes.iter().map(Vec4::to_array).collect();
        Ok(GpuMatcher {
            device: device.clone(),
            quads: device.buffer_from("stereo quads", &quads(luma, references))?,
            sources: device.buffer_from("stereo sources", sources)?,
            planes: device.buffer_from("stereo planes", &planes)?,
        })
    }
}

/// Per pixel its own luma and that of the pixels to the right, below and diagonally below, 16 bits each.
fn quads(luma: &[f32], references: &[Reference]) -> Vec<[u32; 2]> {
    let word = |a: f32, b: f32| ((b * 65535.0).round() as u32) << 16 | (a * 65535.0).round() as u32;
    let mut out = Vec::with_capacity(luma.len());
    for r in references {
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        for y in 0..height {
            let (top, bottom) = (first + y * width, first + (y + 1).min(height - 1) * width);
            for x in 0..width {
                let right = (x + 1).min(width - 1);
                out.push([
                    word(luma[top + x], luma[top + right]),
                    word(luma[bottom + x], luma[bottom + right]),
                ]);
            }
        }
    }
    out
}

macro_rules! push {
    ($shader:ident, $r:expr) => {
        $shader::Push {
            intrinsics: $r.intrinsics,
            range: $r.range,
            geometric: $r.geometric,
            seed: $r.seed,
            width: $r.width,
            height: $r.height,
            first: $r.first,
            first_source: $r.first_source,
            sources: $r.sources,
            parity: $r.parity,
            planes: $r.planes,
            smoothness: $r.smoothness,
        }
    };
}

impl Matcher for GpuMatcher {
    fn sweep(&mut self, r: &Reference) -> Result<()> {
        let bindings =
            plane_sweep::Bindings { quads: &self.quads, sources: &self.sources, planes: &self.planes };
        let mut rec = Recorder::new(&self.device, "plane sweep");
        rec.dispatch_threads(plane_sweep::call(&bindings, &push!(plane_sweep, r)), [r.width, r.height, 1]);
        rec.run()
    }

    fn refine(&mut self, r: &Reference) -> Result<()> {
        let bindings =
            plane_sweep_refine::Bindings { quads: &self.quads, sources: &self.sources, planes: &self.planes };
        let mut rec = Recorder::new(&self.device, "plane refinement");
        let call = plane_sweep_refine::call(&bindings, &push!(plane_sweep_refine, r));
        rec.dispatch_threads(call, [r.width.div_ceil(2), r.height, 1]);
        rec.run()
    }

    fn planes(&self) -> Result<Vec<Vec4>> {
        Ok(self.planes.read::<[f32; 4]>()?.into_iter().map(Vec4::from).collect())
    }
}
