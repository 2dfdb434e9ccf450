//! A scene with language seen from cameras: rendered and decoded.
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder};
use crate::pass::bands::Band;
use crate::pass::decode::Codes;
use crate::pass::raster_forward::BASE_CHANNELS;
use crate::pass::rasterizer::FrameBuffers;
use crate::pass::renderer::{RenderedFrame, Renderer};
use crate::progress::Progress;
use crate::scene::{Camera, LanguageField, Plane, SH_C0, Seen, Splats};

/// A rendered frame and the code of every pixel per level (−1 = none).
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct DecodedFrame {
    /// Colour and depth; features only from [`Viewer::view_with_features`].
    pub rendered: RenderedFrame,
    /// Per level, index as in [`crate::scene::LEVEL_NAMES`]; levels without codes are −1 everywhere.
    pub codes: Vec<Plane<i32>>,
}

/// Renders and decodes one camera after the other, both on the device.
pub struct Viewer {
    device: Device,
    renderer: Renderer,
    /// Per level its first feature channel and its codes; `None` for a level without codes.
    levels: Vec<Option<(usize, Codes)>>,
    /// Decoded codes, of the size of the last view.
    output: Option<Buffer<i32>>,
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

    /// Renders one camera that the device holds at once. The frame stays on the device, and valid until the next call.
    pub fn draw(&mut self, camera: &Camera) -> Result<&FrameBuffers> {
        Ok(self.renderer.draw(camera)?.frame())
    }

    /// Renders one camera band by band and shows every band while it is on the device.
    pub fn draw_bands(
        &mut self,
        camera: &Camera,
        seen: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        self.renderer.draw_bands(camera, seen)
    }

    /// Only the codes of one camera, as [`DecodedFrame::codes`].
    pub fn codes(&mut self, camera: &Camera) -> Result<Vec<Plane<i32>>> {
        let mut codes = empty(self.levels.len(), camera);
        let (device, levels, output) = (&self.device, &self.levels, &mut self.output);
        self.renderer
            .draw_bands(camera, |frame, band| decode(device, levels, output, frame, band, &mut codes))?;
        Ok(codes)
    }

    fn seen(&mut self, camera: &Camera, features: bool) -> Result<DecodedFrame> {
        let mut codes = empty(self.levels.len(), camera);
        let dim = if features { self.renderer.feature_dim() } else { 0 };
        let mut shown = RenderedFrame::empty(camera.width as usize, camera.height as usize, dim);
        let (device, levels, output) = (&self.device, &self.levels, &mut self.output);
        self.renderer.draw_bands(camera, |frame, band| {
            decode(device, levels, output, frame, band, &mut codes)?;
            shown.read_band(frame, band)
        })?;
        Ok(DecodedFrame { rendered: shown, codes })
    }
}

/// Codes of no pixel yet.
fn empty(levels: usize, camera: &Camera) -> Vec<Plane<i32>> {
    vec![Plane::filled(camera.width as usize, camera.height as usize, -1); levels]
}

/// Decodes every level of a band into `codes`; `output` keeps the buffers for the next one of the same size.
fn decode(
    device: &Device,
    levels: &[Option<(usize, Codes)>],
    output: &mut Option<Buffer<i32>>,
    frame: &FrameBuffers,
    band: &Band,
    codes: &mut [Plane<i32>],
) -> Result<()> {
    let pixels = frame.pixels();
    let decoded = match output.take().filter(|o| o.bytes() == 4 * u64::from(pixels)) {
        Some(fits) => fits,
        None => device.buffer::<i32>("decoded", pixels as usize)?,
    };
    for (plane, level) in codes.iter_mut().zip(levels) {
        let Some((first, table)) = level else { continue };
        let mut rec = Recorder::new(device, "decode");
        let at = (BASE_CHANNELS + first) as u32;
        let (planes, transmittance) = (&frame.planes, &frame.transmittance);
        table.record(&mut rec, planes, at, transmittance, pixels, &decoded);
        rec.run()?;
        let (stored, inner) = (frame.bands.stored(band), frame.bands.inner(band));
        plane.data[inner].copy_from_slice(&decoded.read_range(stored)?);
    }
    *output = Some(decoded);
    Ok(())
}

/// How much of the photos, taken by these cameras, every splat shows.
pub fn seen(device: &Device, splats: &Splats, cameras: &[Camera], progress: &dyn Progress) -> Result<Seen> {
    progress.begin("seen", cameras.len() as u64);
    let mut renderer = Renderer::new(device, splats, &[], 0)?;
    let mut pixels = vec![0.0; splats.len()];
    for (done, camera) in cameras.iter().enumerate() {
        progress.check()?;
        pixels.iter_mut().zip(renderer.weights(camera)?).for_each(|(sum, w)| *sum += w);
        progress.step(done as u64 + 1, "");
    }
    progress.end();
    Ok(Seen { pixels })
}

/// Share of every pixel that splats blend into it which no photo shows; alpha, without them, is what is known of it.
pub struct UnseenShare(Renderer);

impl UnseenShare {
    /// Uploads the scene in two colours.
    pub fn new(device: &Device, splats: &Splats, seen: &Seen) -> Result<UnseenShare> {
        let dc = |i: usize| (f32::from(u8::from(seen.is_unseen(i))) - 0.5) / SH_C0;
        let sh = (0..splats.len()).flat_map(|i| [dc(i); 3]).collect();
        let two = Splats { sh, sh_degree: 0, ..splats.clone() };
        Ok(UnseenShare(Renderer::new(device, &two, &[], 0)?))
    }

    /// [H, W] in [0, 1).
    pub fn view(&mut self, camera: &Camera) -> Result<Plane<f32>> {
        let rgb = self.0.render(camera)?.rgb;
        Ok(Plane { width: rgb.width, height: rgb.height, data: rgb.data.iter().map(|c| c[0]).collect() })
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
