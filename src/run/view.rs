//! A scene with language seen from cameras: rendered and decoded.
use crate::Result;
use crate::gpu::Device;
use crate::language::codebook::decode_map;
use crate::pass::renderer::{Frame, Renderer};
use crate::scene::{Camera, LanguageField, Plane, Splats};

/// A rendered frame and the code of every pixel per level (−1 = none).
#[derive(Clone, Debug)]
pub struct DecodedFrame {
    /// Colour, depth, features.
    pub frame: Frame,
    /// Per level, index as in [`crate::scene::LEVEL_NAMES`]; levels without codes are −1 everywhere.
    pub codes: Vec<Plane<i32>>,
}

/// Renders and decodes one camera after the other.
pub struct Viewer<'a> {
    renderer: Renderer,
    field: &'a LanguageField,
    /// Features per level; 0 for a level without codes.
    dims: Vec<usize>,
}

impl<'a> Viewer<'a> {
    /// Uploads the scene with the features of all its levels side by side.
    pub fn new(device: &Device, splats: &Splats, field: &'a LanguageField) -> Result<Self> {
        let dims: Vec<usize> = field.levels.iter().map(|l| l.features.len() / splats.len().max(1)).collect();
        let total: usize = dims.iter().sum();
        let mut features = Vec::with_capacity(total * splats.len());
        for i in 0..splats.len() {
            for (level, &d) in field.levels.iter().zip(&dims) {
                features.extend_from_slice(&level.features[i * d..(i + 1) * d]);
            }
        }
        Ok(Viewer { renderer: Renderer::new(device, splats, &features, total)?, field, dims })
    }

    /// The scene from one camera.
    pub fn view(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        let frame = self.renderer.render(camera)?;
        let mut first = 0;
        let mut codes = Vec::with_capacity(self.dims.len());
        for (level, &d) in self.field.levels.iter().zip(&self.dims) {
            codes.push(if d == 0 {
                Plane::filled(frame.alpha.width, frame.alpha.height, -1)
            } else {
                let pixels = frame.features.chunks_exact(frame.feature_dim);
                let part: Vec<f32> = pixels.flat_map(|f| f[first..first + d].iter().copied()).collect();
                decode_map(&level.codebook, &part, &frame.alpha)?
            });
            first += d;
        }
        Ok(DecodedFrame { frame, codes })
    }
}

/// The scene from every camera.
pub fn decode_all(
    device: &Device,
    splats: &Splats,
    field: &LanguageField,
    cameras: &[Camera],
) -> Result<Vec<DecodedFrame>> {
    let mut viewer = Viewer::new(device, splats, field)?;
    cameras.iter().map(|c| viewer.view(c)).collect()
}
