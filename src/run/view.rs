//! A scene with language seen from cameras: rendered and decoded.
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder};
use crate::pass::decode::Codes;
use crate::pass::raster_forward::BASE_CHANNELS;
use crate::pass::rasterizer::FrameBuffers;
use crate::pass::renderer::{Frame, Renderer, read_frame};
use crate::scene::{Camera, LanguageField, Plane, Splats};

/// A rendered frame and the code of every pixel per level (−1 = none).
#[derive(Clone, Debug)]
pub struct DecodedFrame {
    /// Colour and depth; features only from [`Viewer::view_with_features`].
    pub frame: Frame,
    /// Per level, index as in [`crate::scene::LEVEL_NAMES`]; levels without codes are −1 everywhere.
    pub codes: Vec<Plane<i32>>,
}

/// Renders and decodes one camera after the other, both on the device.
pub struct Viewer {
    device: Device,
    renderer: Renderer,
    /// Per level its first feature channel and its codes; `None` for a level without codes.
    levels: Vec<Option<(usize, Codes)>>,
    /// Decoded codes and their margins, of the size of the last view.
    output: Option<(Buffer, Buffer)>,
}

impl Viewer {
    /// Uploads the scene with the features of all its levels side by side.
    pub fn new(device: &Device, splats: &Splats, field: &LanguageField) -> Result<Self> {
        let dims: Vec<usize> = field.levels.iter().map(|l| l.features.len() / splats.len().max(1)).collect();
        let total: usize = dims.iter().sum();
        let mut features = Vec::with_capacity(total * splats.len());
        for i in 0..splats.len() {
            for (level, &d) in field.levels.iter().zip(&dims) {
                features.extend_from_slice(&level.features[i * d..(i + 1) * d]);
            }
        }
        let mut levels = Vec::with_capacity(dims.len());
        let mut first = 0;
        for (level, &d) in field.levels.iter().zip(&dims) {
            levels.push(match d {
                0 => None,
                _ => Some((first, Codes::upload(device, &level.codebook.codes, d)?)),
            });
            first += d;
        }
        let renderer = Renderer::new(device, splats, &features, total)?;
        Ok(Viewer { device: device.clone(), renderer, levels, output: None })
    }

    /// The scene from one camera.
    pub fn view(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        self.seen(camera, false)
    }

    /// The scene from one camera, with the blended features: about ten times the data.
    pub fn view_with_features(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        self.seen(camera, true)
    }

    /// Renders one camera. The frame stays on the device, and valid until the next call.
    pub fn draw(&mut self, camera: &Camera) -> Result<&FrameBuffers> {
        Ok(self.renderer.draw(camera)?.frame())
    }

    /// Only the codes of one camera, as [`DecodedFrame::codes`].
    pub fn codes(&mut self, camera: &Camera) -> Result<Vec<Plane<i32>>> {
        let rasterizer = self.renderer.draw(camera)?;
        decode(&self.device, &self.levels, &mut self.output, rasterizer.frame())
    }

    fn seen(&mut self, camera: &Camera, features: bool) -> Result<DecodedFrame> {
        let rasterizer = self.renderer.draw(camera)?;
        let codes = decode(&self.device, &self.levels, &mut self.output, rasterizer.frame())?;
        Ok(DecodedFrame { frame: read_frame(rasterizer, features)?, codes })
    }
}

/// Decodes every level of a rendered frame; `output` keeps the buffers for the next frame of the same size.
fn decode(
    device: &Device,
    levels: &[Option<(usize, Codes)>],
    output: &mut Option<(Buffer, Buffer)>,
    frame: &FrameBuffers,
) -> Result<Vec<Plane<i32>>> {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let pixels = width * height;
    let (decoded, margin) = match output.take().filter(|o| o.0.bytes() == 4 * pixels as u64) {
        Some(fits) => fits,
        None => (device.buffer::<i32>("decoded", pixels)?, device.buffer::<f32>("margin", pixels)?),
    };
    let mut codes = Vec::with_capacity(levels.len());
    for level in levels {
        let data = match level {
            None => vec![-1; pixels],
            Some((first, table)) => {
                let mut rec = Recorder::new(device, "decode");
                let plane = (BASE_CHANNELS + first) as u32;
                let (planes, transmittance) = (&frame.planes, &frame.transmittance);
                table.record(&mut rec, planes, plane, transmittance, pixels as u32, &decoded, &margin);
                rec.run()?;
                decoded.read::<i32>()?
            }
        };
        codes.push(Plane { width, height, data });
    }
    *output = Some((decoded, margin));
    Ok(codes)
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
