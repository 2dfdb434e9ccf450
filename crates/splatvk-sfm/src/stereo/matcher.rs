//! The interface to the plane sweep: a GPU, or its reference implementation, computes the matching.
use crate::Result;
use glam::Vec4;

/// Most source views that one reference view is matched against: a fifth adds cost, hardly
/// accuracy.
pub const MAX_SOURCES: usize = 4;

/// A source view as a reference view sees it, laid out as in the shader.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct SourceView {
    /// Rows of K_s [R | t]: (ray, 1/z) of the reference to the homogeneous source pixel, scaled by
    /// the inverse depth.
    pub forward: [[f32; 4]; 3],
    /// Rows of the inverse mapping: (ray, 1/z) of the source to the homogeneous reference pixel.
    pub back: [[f32; 4]; 3],
    /// Source camera centre in the reference frame; w unused.
    pub centre: [f32; 4],
    /// fx, fy, cx, cy of the source, pixels.
    pub intrinsics: [f32; 4],
    /// Width, height, index of the view's first pixel in the shared buffers, unused.
    pub size: [u32; 4],
}

/// The reference view and the search of one pass.
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
    /// Weight of the disagreement with the neighbours' surfaces.
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

/// Makes matchers: the device that computes the plane sweep.
pub trait PlaneSweep {
    /// Bytes that a pass binds at once: larger photos are matched at half their size, or less.
    fn binding(&self) -> u64;
    /// A matcher. `luma` and `planes` (π, cost) hold all views one after the other, as the
    /// references say.
    fn matcher(
        &self,
        luma: &[f32],
        references: &[ReferenceView],
        sources: &[SourceView],
        planes: &[Vec4],
    ) -> Result<Box<dyn Matcher>>;
}

/// Bytes of a plane.
pub const PLANE_BYTES: usize = size_of::<[f32; 4]>();

/// Bytes of the largest buffer that matching needs for these views: `groups` are the pixels of each
/// reference and its sources together, `all` those of all views.
pub fn binding(all: usize, groups: impl Iterator<Item = usize>) -> usize {
    PLANE_BYTES * groups.max().unwrap_or(0).min(all)
}
