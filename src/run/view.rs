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
                decode_map(&level.codebook, &part, &spoken_for(&part, d, &frame.alpha))?
            });
            first += d;
        }
        Ok(DecodedFrame { frame, codes })
    }
}

/// Alpha where splats with features are what the pixel shows, 0 elsewhere: surfaces continued beyond the photos carry
/// none, and a blend of nothing has no code. Splat features are unit vectors, so |F| is the alpha they contribute, less
/// what differing codes cancel (√½ where two meet); a quarter separates that from stray contributions.
fn spoken_for(features: &[f32], dim: usize, alpha: &Plane<f32>) -> Plane<f32> {
    let norm = |f: &[f32]| f.iter().map(|v| v * v).sum::<f32>().sqrt();
    let pixels = alpha.data.iter().zip(features.chunks_exact(dim));
    let data = pixels.map(|(&a, f)| if norm(f) < 0.25 * a { 0.0 } else { a }).collect();
    Plane { data, ..*alpha }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_without_features_has_no_alpha_for_words() {
        let alpha = Plane { width: 4, height: 1, data: vec![0.9, 0.9, 0.9, 0.0] };
        let mixed = 0.9 * 0.5;
        let features = [0.9, 0.0, mixed, mixed, 0.0, 0.1, 0.0, 0.0];
        assert_eq!(spoken_for(&features, 2, &alpha).data, [0.9, 0.9, 0.0, 0.0]);
    }
}
