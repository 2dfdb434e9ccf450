//! Interface to the plane sweep, which a GPU or its CPU reference computes.
use crate::Result;
use glam::Vec4;

/// Most source views of one reference view: a fifth adds cost but hardly accuracy.
pub const MAX_SOURCES: usize = 4;

/// Source view relative to a reference view, in the layout of the shader.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct SourceView {
    /// Rows of K_s [R | t]: (ray, 1/z) of the reference to the homogeneous pixel of the source,
    /// scaled by the inverse depth.
    pub forward: [[f32; 4]; 3],
    /// Rows of the inverse map: (ray, 1/z) of the source to the homogeneous pixel of the reference.
    pub back: [[f32; 4]; 3],
    /// Source camera centre in the reference frame; w unused.
    pub centre: [f32; 4],
    /// fx, fy, cx, cy of the source, pixels.
    pub intrinsics: [f32; 4],
    /// Width, height, index of the view's first pixel in the shared buffers, unused.
    pub size: [u32; 4],
}

/// Reference view and search parameters of one pass.
#[derive(Clone, Copy, Debug, Default)]
pub struct ReferenceView {
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
    /// Weight of the difference to the neighbours' surfaces.
    pub smoothness: f32,
}

/// Matching of all views at one resolution. A hypothesis is the plane `π·X = 1` in the frame of its
/// reference camera.
pub trait Matcher {
    /// Initial sweep over all pixels of one view.
    fn sweep(&mut self, reference: &ReferenceView) -> Result<()>;
    /// One propagation step over one checkerboard colour of one view.
    fn refine(&mut self, reference: &ReferenceView) -> Result<()>;
    /// (π, cost) per pixel of all views.
    fn planes(&self) -> Result<Vec<Vec4>>;
}

impl Matcher for Box<dyn Matcher> {
    fn sweep(&mut self, reference: &ReferenceView) -> Result<()> {
        (**self).sweep(reference)
    }
    fn refine(&mut self, reference: &ReferenceView) -> Result<()> {
        (**self).refine(reference)
    }
    fn planes(&self) -> Result<Vec<Vec4>> {
        (**self).planes()
    }
}

/// Factory of matchers: a device that computes the plane sweep.
pub trait PlaneSweep {
    /// Most bytes of one binding: larger photos are matched at half their size, or less.
    fn binding(&self) -> u64;
    /// Matcher of all views. `luma` and `planes` (π, cost) hold the views one after the other, at
    /// the offsets of the references.
    fn matcher(
        &self,
        luma: &[f32],
        references: &[ReferenceView],
        sources: &[SourceView],
        planes: &[Vec4],
    ) -> Result<Box<dyn Matcher>>;
}

/// Bytes of one plane with its cost.
pub const PLANE_BYTES: usize = size_of::<[f32; 4]>();

/// Bytes of the largest buffer for matching: `groups` are the pixels of each reference with its
/// sources, `all` those of all views.
pub fn binding(all: usize, groups: impl Iterator<Item = usize>) -> usize {
    PLANE_BYTES * groups.max().unwrap_or(0).min(all)
}
