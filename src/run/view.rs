//! Views of a scene with language: rendered and decoded.
use super::border::Border;
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder};
use crate::pass::bands::Band;
use crate::pass::decode::{Codes, LONGEST_CODE, decode_pixels};
use crate::pass::raster_forward::BASE_CHANNELS;
use crate::pass::rasterizer::FrameBuffers;
use crate::pass::renderer::{RenderedFrame, Renderer};
use crate::progress::Progress;
use crate::query::maps::CodeMaps;
use crate::scene::{Camera, Image, LanguageField, RgbImage, SH_C0, Seen, Splats};
use std::ops::Range;
use std::sync::Arc;

/// A rendered frame and the code of every pixel per level (−1 = none).
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct DecodedFrame {
    /// Colour and depth; features only from [`Viewer::view_with_features`].
    pub rendered: RenderedFrame,
    /// Per level, index as in [`crate::scene::LEVEL_NAMES`]; levels without codes are −1
    /// everywhere.
    pub codes: Vec<Image<i32>>,
    /// The codes, prepared for queries.
    pub maps: Arc<CodeMaps>,
    /// Colours with the backdrop behind them, from a viewer with one.
    pub filled: Option<RgbImage>,
}

impl DecodedFrame {
    /// Prepares the codes of a rendered frame for queries.
    pub fn new(rendered: RenderedFrame, codes: Vec<Image<i32>>, filled: Option<RgbImage>) -> Result<Self> {
        let maps = Arc::new(CodeMaps::new(&codes)?);
        Ok(DecodedFrame { rendered, codes, maps, filled })
    }

    /// The picture for people: with the backdrop, where there is one.
    pub fn picture(&self) -> &RgbImage {
        self.filled.as_ref().unwrap_or(&self.rendered.rgb)
    }
}

/// Renders and decodes cameras one by one, both on the device.
pub struct Viewer {
    device: Device,
    /// The scene's own splats first, then those of levels with splats of their own.
    models: Vec<Model>,
    /// Splats behind the scene.
    backdrop: Option<Renderer>,
    /// Splats that edits took away.
    holes: Option<Renderer>,
    /// Number of levels of the field.
    levels: usize,
    /// Decoded codes at the size of the last view.
    output: Option<Buffer<i32>>,
}

/// Splats on the device, with the levels whose features they carry.
struct Model {
    renderer: Renderer,
    levels: Vec<CarriedLevel>,
}

/// Codes of a level, with its feature channels in its model (`channels`) and in the frame of all
/// models (`shown`).
struct CarriedLevel {
    level: usize,
    codes: LevelCodes,
    /// Restriction of short codes to those in the pixel.
    border: Option<Border>,
    channels: Range<usize>,
    shown: Range<usize>,
}

/// Codes of a level where they are compared with pixels.
enum LevelCodes {
    Device(Codes),
    /// Longer than the device decodes: embeddings without reduction.
    Host(Vec<f32>),
}

impl LevelCodes {
    fn new(device: &Device, codes: &[f32], dim: usize) -> Result<LevelCodes> {
        match dim <= LONGEST_CODE {
            true => Codes::upload(device, codes, dim).map(LevelCodes::Device),
            false => Ok(LevelCodes::Host(codes.to_vec())),
        }
    }
}

impl CarriedLevel {
    /// Number of features per pixel that the border rule reads.
    fn border_channels(&self) -> usize {
        if self.border.is_some() { self.channels.len() } else { 0 }
    }
}

/// Place of a level's features in the output of [`Viewer::draw_bands`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FeatureChannels {
    /// Model for [`Viewer::draw_bands`].
    pub model: usize,
    /// First feature channel of the level.
    pub first: usize,
    /// Number of channels.
    pub count: usize,
}

/// Model of [`Viewer::draw_bands`] with the scene's colours and depth.
pub const SCENE_MODEL: usize = 0;

impl Model {
    /// Uploads splats with the features of some levels side by side; `shown` holds the channels of
    /// every level.
    fn new(
        device: &Device,
        splats: &Splats,
        field: &LanguageField,
        carried: &[usize],
        shown: &[Range<usize>],
    ) -> Result<Model> {
        let total = carried.iter().map(|&l| shown[l].len()).sum();
        let mut features = Vec::with_capacity(total * splats.len());
        for i in 0..splats.len() {
            for &l in carried {
                let d = shown[l].len();
                features.extend_from_slice(&field.levels[l].features[i * d..(i + 1) * d]);
            }
        }
        let mut levels: Vec<CarriedLevel> = Vec::with_capacity(carried.len());
        for &level in carried {
            let (first, d) = (levels.last().map_or(0, |l| l.channels.end), shown[level].len());
            let codes = LevelCodes::new(device, &field.levels[level].codebook.codes, d)?;
            let border = Border::new(device, splats, &field.levels[level])?;
            let (channels, shown) = (first..first + d, shown[level].clone());
            levels.push(CarriedLevel { level, codes, border, channels, shown });
        }
        Ok(Model { renderer: Renderer::new(device, splats, &features, total)?, levels })
    }
}

impl Viewer {
    /// Uploads the scene, each level's features on the splats that carry them
    /// ([`LevelField::carrier`]).
    pub fn new(device: &Device, splats: &Splats, field: &LanguageField) -> Result<Self> {
        let mut shown: Vec<Range<usize>> = Vec::with_capacity(field.levels.len());
        for level in &field.levels {
            let first = shown.last().map_or(0, |r| r.end);
            shown.push(first..first + level.features.len() / splats.len().max(1));
        }
        let (mut own, mut shared) = (Vec::new(), Vec::new());
        // A level whose features the device cannot bind with those of the others gets a model, too.
        let mut room = device.info().max_storage_range / 4 / splats.len().max(1) as u64;
        for level in (0..shown.len()).filter(|&l| !shown[l].is_empty()) {
            let channels = shown[level].len() as u64;
            if field.levels[level].splats.is_none() && (shared.is_empty() || channels <= room) {
                shared.push(level);
                room = room.saturating_sub(channels);
            } else {
                own.push(level);
            }
        }
        let mut models = vec![Model::new(device, splats, field, &shared, &shown)?];
        for level in own {
            let carrier = field.levels[level].carrier(splats);
            models.push(Model::new(device, carrier, field, &[level], &shown)?);
        }
        Ok(Viewer {
            device: device.clone(),
            models,
            backdrop: None,
            holes: None,
            levels: shown.len(),
            output: None,
        })
    }

    /// Draws the splats of a backdrop behind the scene in [`DecodedFrame::picture`]; depth, opacity
    /// and codes stay those of the scene.
    pub fn with_backdrop(mut self, backdrop: &Splats) -> Result<Self> {
        if !backdrop.is_empty() {
            self.backdrop = Some(Renderer::new(&self.device, backdrop, &[], 0)?);
        }
        Ok(self)
    }

    /// Hatches [`DecodedFrame::picture`] where the scene shows nothing in front of these splats. Edits
    /// took them away.
    pub fn with_holes(mut self, holes: &Splats) -> Result<Self> {
        if !holes.is_empty() {
            self.holes = Some(Renderer::new(&self.device, holes, &[], 0)?);
        }
        Ok(self)
    }

    /// Renders and decodes the scene from one camera.
    pub fn view(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        self.render_and_decode(camera, false)
    }

    /// Like [`Viewer::view`], with the blended features: about ten times the data.
    pub fn view_with_features(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        self.render_and_decode(camera, true)
    }

    /// Place of a level's features in [`Viewer::draw_bands`]; `None` for a level without features.
    pub fn features(&self, level: usize) -> Option<FeatureChannels> {
        self.models.iter().enumerate().find_map(|(model, m)| {
            let channels = &m.levels.iter().find(|l| l.level == level)?.channels;
            Some(FeatureChannels { model, first: channels.start, count: channels.len() })
        })
    }

    /// Renders the scene's own splats from one camera whose frame fits on the device. The frame
    /// stays on the device and is valid until the next call.
    pub fn draw(&mut self, camera: &Camera) -> Result<&FrameBuffers> {
        Ok(self.models[SCENE_MODEL].renderer.draw(camera)?.frame())
    }

    /// Renders one camera band by band and passes each band to `visit` while it is on the device.
    /// `model` is [`SCENE_MODEL`] or that of [`Viewer::features`].
    pub fn draw_bands(
        &mut self,
        model: usize,
        camera: &Camera,
        visit: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        self.models[model].renderer.draw_bands(camera, visit)
    }

    /// Codes of one camera, as [`DecodedFrame::codes`].
    pub fn codes(&mut self, camera: &Camera) -> Result<Vec<Image<i32>>> {
        self.decode_view(camera, None)
    }

    fn render_and_decode(&mut self, camera: &Camera, features: bool) -> Result<DecodedFrame> {
        let width: usize = self.models.iter().map(|m| m.renderer.feature_dim()).sum();
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut rendered = RenderedFrame::empty(w, h, if features { width } else { 0 });
        let codes = self.decode_view(camera, Some(&mut rendered))?;
        let behind = self.backdrop.as_mut().map(|backdrop| backdrop.render(camera)).transpose()?;
        let behind = match &mut self.holes {
            Some(holes) => {
                let holes = hatched(holes.render(camera)?);
                Some(behind.map_or_else(|| holes.rgb.clone(), |behind| over(&holes, &behind.rgb)))
            }
            None => behind.map(|behind| behind.rgb),
        };
        let filled = behind.map(|behind| over(&rendered, &behind));
        DecodedFrame::new(rendered, codes, filled)
    }

    /// Renders the models that `shown` or the codes need, and reads the parts that `shown` has room
    /// for.
    fn decode_view(
        &mut self,
        camera: &Camera,
        mut shown: Option<&mut RenderedFrame>,
    ) -> Result<Vec<Image<i32>>> {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut codes = vec![Image::filled(w, h, -1); self.levels];
        let (device, output) = (&self.device, &mut self.output);
        for (m, Model { renderer, levels }) in self.models.iter_mut().enumerate() {
            if levels.is_empty() && !(m == SCENE_MODEL && shown.is_some()) {
                continue;
            }
            let mut kept: Vec<_> =
                levels.iter().map(|l| RenderedFrame::empty(w, h, l.border_channels())).collect();
            renderer.draw_bands(camera, |frame, band| {
                decode(device, levels, output, frame, band, &mut codes)?;
                if let Some(shown) = shown.as_deref_mut() {
                    if m == SCENE_MODEL {
                        shown.read_surface(frame, band)?;
                    }
                    let features = shown.feature_dim > 0;
                    for level in levels.iter().filter(|_| features) {
                        shown.read_features(frame, band, level.channels.start, level.shown.clone())?;
                    }
                }
                for (level, kept) in levels.iter().zip(&mut kept) {
                    kept.read_features(frame, band, level.channels.start, 0..kept.feature_dim)?;
                }
                Ok(())
            })?;
            for (level, kept) in levels.iter_mut().zip(kept) {
                if let Some(border) = &mut level.border {
                    border.decode_again(camera, &kept.features, &mut codes[level.level])?;
                }
            }
        }
        Ok(codes)
    }
}

/// Brightness of the two stripes of a hatched area.
const HATCHING: [f32; 2] = [0.35, 0.65];
/// Width of a stripe along the rows, pixels.
const STRIPE: usize = 6;

/// The frame of holes as stripes of its opacity.
fn hatched(mut holes: RenderedFrame) -> RenderedFrame {
    let width = holes.rgb.width;
    for (i, (colour, alpha)) in holes.rgb.data.iter_mut().zip(&holes.alpha.data).enumerate() {
        let stripe = (i % width + i / width) / STRIPE % 2;
        *colour = [HATCHING[stripe] * alpha; 3];
    }
    holes
}

/// Colours of a frame over those behind it.
fn over(front: &RenderedFrame, behind: &RgbImage) -> RgbImage {
    let blend = |((c, a), b): ((&[f32; 3], &f32), &[f32; 3])| [0, 1, 2].map(|k| c[k] + (1.0 - a) * b[k]);
    let pixels = front.rgb.data.iter().zip(&front.alpha.data).zip(&behind.data);
    RgbImage { data: pixels.map(blend).collect(), ..front.rgb }
}

/// Decodes the levels of a band into `codes`; `output` keeps the buffer for the next band of the
/// same size.
fn decode(
    device: &Device,
    levels: &[CarriedLevel],
    output: &mut Option<Buffer<i32>>,
    frame: &FrameBuffers,
    band: &Band,
    codes: &mut [Image<i32>],
) -> Result<()> {
    let pixels = frame.pixels();
    let decoded = match output.take().filter(|o| o.bytes() == 4 * u64::from(pixels)) {
        Some(fits) => fits,
        None => device.buffer::<i32>("decoded", pixels as usize)?,
    };
    for level in levels {
        let first_plane = BASE_CHANNELS + level.channels.start;
        let (planes, transmittance) = (&frame.planes, &frame.transmittance);
        let (stored, inner) = (frame.bands.stored(band), frame.bands.inner(band));
        let found = match &level.codes {
            LevelCodes::Device(codes) => {
                let mut rec = Recorder::new(device, "decode");
                codes.record(&mut rec, planes, first_plane as u32, transmittance, pixels, &decoded);
                rec.run()?;
                decoded.read_range(stored)?
            }
            LevelCodes::Host(codes) => {
                let (pixels, dim) = (pixels as usize, level.channels.len());
                let features = planes.read_range(first_plane * pixels..(first_plane + dim) * pixels)?;
                let alpha: Vec<f32> =
                    transmittance.read_range(0..pixels)?.into_iter().map(|t| 1.0 - t).collect();
                decode_pixels(codes, dim, &features, &alpha).0[stored].to_vec()
            }
        };
        codes[level.level].data[inner].copy_from_slice(&found);
    }
    *output = Some(decoded);
    Ok(())
}

/// Blending weight of every splat, summed over the pixels of these cameras.
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

/// Renders a number per splat, blended per pixel.
pub struct BlendedValues(Renderer);

impl BlendedValues {
    /// Uploads the scene with the values [N], in 0..1, as colours.
    pub fn new(device: &Device, splats: &Splats, values: &[f32]) -> Result<BlendedValues> {
        let sh = values.iter().flat_map(|v| [(v - 0.5) / SH_C0; 3]).collect();
        let grey = Splats { sh, sh_degree: 0, ..splats.clone() };
        Ok(BlendedValues(Renderer::new(device, &grey, &[], 0)?))
    }

    /// [H, W] `Σ w v` in [0, 1): not divided by alpha.
    pub fn view(&mut self, camera: &Camera) -> Result<Image<f32>> {
        let rgb = self.0.render(camera)?.rgb;
        Ok(Image { width: rgb.width, height: rgb.height, data: rgb.data.iter().map(|c| c[0]).collect() })
    }
}

/// Renders the blended share of unseen splats per pixel; alpha minus this share is shown by photos.
pub struct UnseenShare(BlendedValues);

impl UnseenShare {
    /// Uploads the scene with colour 1 for unseen splats and 0 for the others.
    pub fn new(device: &Device, splats: &Splats, seen: &Seen) -> Result<UnseenShare> {
        let values: Vec<f32> = (0..splats.len()).map(|i| f32::from(u8::from(seen.is_unseen(i)))).collect();
        Ok(UnseenShare(BlendedValues::new(device, splats, &values)?))
    }

    /// [H, W] in [0, 1).
    pub fn view(&mut self, camera: &Camera) -> Result<Image<f32>> {
        self.0.view(camera)
    }
}

/// Renders and decodes the scene from every camera.
pub fn decode_all(
    device: &Device,
    splats: &Splats,
    field: &LanguageField,
    cameras: &[Camera],
) -> Result<Vec<DecodedFrame>> {
    let mut viewer = Viewer::new(device, splats, field)?;
    cameras.iter().map(|c| viewer.view(c)).collect()
}
