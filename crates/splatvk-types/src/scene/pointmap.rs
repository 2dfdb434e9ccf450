//! Output of geometry networks: a 3-D point for every pixel, in the camera frame of one view of a
//! pair.
//!
//! Positions are continuous pixels of the network's input ("model pixels"); the centre of the first
//! pixel is 0.5.
use super::{Affine, Camera, Pose, RgbImage};
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

/// One view as input of the network.
#[derive(Clone, Debug)]
pub struct ModelView {
    /// Name of the photo, for cameras and messages.
    pub name: String,
    /// Working-resolution photo; its size is the output size.
    pub image: RgbImage,
    /// Width of the network's input.
    pub width: usize,
    /// Height of the network's input.
    pub height: usize,
    /// Working pixels → model pixels.
    pub from_working: Affine,
    /// Focal length from EXIF in model pixels.
    pub exif_focal: Option<f64>,
    /// Shared by photos of one camera and size.
    pub camera_group: usize,
}

impl ModelView {
    /// Principal point of the network's input: its centre, model pixels.
    pub fn centre(&self) -> DVec2 {
        DVec2::new(self.width as f64, self.height as f64) * 0.5
    }

    /// Camera of the working-resolution photo; `focal` in model pixels.
    pub fn working_camera(&self, focal: f64, pose: &Pose) -> Camera {
        let c = self.centre();
        let model = Camera {
            name: self.name.clone(),
            width: self.width as u32,
            height: self.height as u32,
            fx: focal,
            fy: focal,
            cx: c.x,
            cy: c.y,
            pose: *pose,
        };
        self.from_working.inverse().camera(&model, (self.image.width as u32, self.image.height as u32))
    }
}

/// A point and a confidence per pixel. A confidence of 1 means none; the range above it depends on
/// the network.
#[derive(Clone, Debug, Default)]
pub struct Pointmap {
    /// [H, W] points in the OpenCV axes of the camera that the field of the pair names.
    pub points: Vec<[f32; 3]>,
    /// [H, W] confidence ≥ 1.
    pub confidence: Vec<f32>,
}

impl Pointmap {
    /// Point of pixel `k`.
    pub fn point(&self, k: usize) -> DVec3 {
        Vec3::from(self.points[k]).as_dvec3()
    }
}

/// Dense descriptors of one image.
#[derive(Clone, Debug, Default)]
pub struct Descriptors {
    /// Descriptor length.
    pub dim: usize,
    /// [H, W, dim] unit vectors.
    pub data: Vec<f32>,
    /// [H, W] descriptor confidence ≥ 0.
    pub confidence: Vec<f32>,
}

impl Descriptors {
    /// For each of the pixels `rows` the pixel of `other` with the largest dot product; ties take
    /// the lowest.
    pub fn nearest(&self, rows: &[usize], other: &Descriptors) -> Vec<usize> {
        let d = self.dim;
        // Sixteen queries share each pass over the other image, which is far larger than the
        // caches.
        rows.par_chunks(16)
            .flat_map_iter(|chunk| {
                let mut best = vec![(f32::NEG_INFINITY, 0usize); chunk.len()];
                for (k, theirs) in other.data.chunks_exact(d).enumerate() {
                    for (slot, &row) in best.iter_mut().zip(chunk) {
                        let own = &self.data[row * d..(row + 1) * d];
                        let dot: f32 = own.iter().zip(theirs).map(|(x, y)| x * y).sum();
                        if dot > slot.0 {
                            *slot = (dot, k);
                        }
                    }
                }
                best.into_iter().map(|s| s.1)
            })
            .collect()
    }
}

/// Output of a network for a pair of views, decoded in both directions. The two directions, and
/// different pairs, may have different scales.
#[derive(Clone, Debug, Default)]
pub struct PairPointmaps {
    /// Index of the first view.
    pub first: usize,
    /// Index of the second view.
    pub second: usize,
    /// First view's pixels in the first camera.
    pub x11: Pointmap,
    /// Second view's pixels in the first camera.
    pub x21: Pointmap,
    /// Second view's pixels in the second camera.
    pub x22: Pointmap,
    /// First view's pixels in the second camera.
    pub x12: Pointmap,
    /// Descriptors D11, D21 (first decoding) and D12, D22 (second decoding), if the network has
    /// them.
    pub descriptors: Option<[Descriptors; 4]>,
}

/// Output of a geometry network for a set of photos.
#[derive(Clone, Debug, Default)]
pub struct Pointmaps {
    /// Photos as inputs of the network.
    pub views: Vec<ModelView>,
    /// Pointmaps of pairs of them.
    pub pairs: Vec<PairPointmaps>,
    /// Cameras that the network estimates jointly, one per view at the size of its input, in the
    /// unit of the pointmaps; empty where it estimates none.
    pub cameras: Vec<Camera>,
    /// Smallest confidence of a usable point on the network's own scale, if known.
    pub confidence_floor: Option<f64>,
}
