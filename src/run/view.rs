//! A scene with language seen from cameras: rendered and decoded.
use super::border::Border;
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder};
use crate::pass::bands::Band;
use crate::pass::decode::Codes;
use crate::pass::raster_forward::BASE_CHANNELS;
use crate::pass::rasterizer::FrameBuffers;
use crate::pass::renderer::{RenderedFrame, Renderer};
use crate::progress::Progress;
use crate::scene::{Camera, Image, LanguageField, SH_C0, Seen, Splats};
use std::ops::Range;

/// A rendered frame and the code of every pixel per level (−1 = none).
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct DecodedFrame {
    /// Colour and depth; features only from [`Viewer::view_with_features`].
    pub rendered: RenderedFrame,
    /// Per level, index as in [`crate::scene::LEVEL_NAMES`]; levels without codes are −1
    /// everywhere.
    pub codes: Vec<Image<i32>>,
}

/// Renders and decodes one camera after the other, both on the device.
pub struct Viewer {
    device: Device,
    /// First the scene's own splats, then those of the levels that have others.
    models: Vec<Model>,
    /// Of the field.
    levels: usize,
    /// Decoded codes, of the size of the last view.
    output: Option<Buffer<i32>>,
}

/// Splats on the device, with the levels whose features they carry.
struct Model {
    renderer: Renderer,
    levels: Vec<CarriedLevel>,
}

/// A level's codes, and where its features are among the channels of its model and of all models.
struct CarriedLevel {
    level: usize,
    codes: Codes,
    /// Of short codes, which of them a pixel may have.
    border: Option<Border>,
    channels: Range<usize>,
    shown: Range<usize>,
}

/// Where the features of a level are rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FeatureChannels {
    /// For [`Viewer::draw_bands`].
    pub model: usize,
    /// First of its feature channels.
    pub first: usize,
    /// How many.
    pub count: usize,
}

/// The model of [`Viewer::draw_bands`] that shows the scene: its colours, its depth.
pub const SCENE_MODEL: usize = 0;

impl Model {
    /// Uploads splats with the features of some levels side by side; `shown` has the channels of
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
            let codes = Codes::upload(device, &field.levels[level].codebook.codes, d)?;
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
        let (own, shared): (Vec<usize>, Vec<usize>) = (0..shown.len())
            .filter(|&l| !shown[l].is_empty())
            .partition(|&l| field.levels[l].splats.is_some());
        let mut models = vec![Model::new(device, splats, field, &shared, &shown)?];
        for level in own {
            let carrier = field.levels[level].carrier(splats);
            models.push(Model::new(device, carrier, field, &[level], &shown)?);
        }
        Ok(Viewer { device: device.clone(), models, levels: shown.len(), output: None })
    }

    /// The scene from one camera.
    pub fn view(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        self.seen(camera, false)
    }

    /// The scene from one camera, with the blended features: about ten times the data.
    pub fn view_with_features(&mut self, camera: &Camera) -> Result<DecodedFrame> {
        self.seen(camera, true)
    }

    /// Where [`Viewer::draw_bands`] renders the features of a level; `None` where it has none.
    pub fn features(&self, level: usize) -> Option<FeatureChannels> {
        self.models.iter().enumerate().find_map(|(model, m)| {
            let channels = &m.levels.iter().find(|l| l.level == level)?.channels;
            Some(FeatureChannels { model, first: channels.start, count: channels.len() })
        })
    }

    /// Renders one camera that the device holds at once, as the scene's own splats show it. The
    /// frame stays on the device, and valid until the next call.
    pub fn draw(&mut self, camera: &Camera) -> Result<&FrameBuffers> {
        Ok(self.models[SCENE_MODEL].renderer.draw(camera)?.frame())
    }

    /// Renders one camera band by band and shows every band while it is on the device. `model` is
    /// [`SCENE_MODEL`] or that of [`Viewer::features`].
    pub fn draw_bands(
        &mut self,
        model: usize,
        camera: &Camera,
        seen: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        self.models[model].renderer.draw_bands(camera, seen)
    }

    /// Only the codes of one camera, as [`DecodedFrame::codes`].
    pub fn codes(&mut self, camera: &Camera) -> Result<Vec<Image<i32>>> {
        self.decoded(camera, None)
    }

    fn seen(&mut self, camera: &Camera, features: bool) -> Result<DecodedFrame> {
        let width: usize = self.models.iter().map(|m| m.renderer.feature_dim()).sum();
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut rendered = RenderedFrame::empty(w, h, if features { width } else { 0 });
        let codes = self.decoded(camera, Some(&mut rendered))?;
        Ok(DecodedFrame { rendered, codes })
    }

    /// Renders every model that `shown` or the codes need, and reads what `shown` has room for.
    fn decoded(&mut self, camera: &Camera, mut shown: Option<&mut RenderedFrame>) -> Result<Vec<Image<i32>>> {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut codes = vec![Image::filled(w, h, -1); self.levels];
        let (device, output) = (&self.device, &mut self.output);
        for (m, Model { renderer, levels }) in self.models.iter_mut().enumerate() {
            if levels.is_empty() && !(m == SCENE_MODEL && shown.is_some()) {
                continue;
            }
            let short = |l: &CarriedLevel| if l.border.is_some() { l.channels.len() } else { 0 };
            let mut kept: Vec<_> = levels.iter().map(|l| RenderedFrame::empty(w, h, short(l))).collect();
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
                    border.settle(camera, &kept.features, &mut codes[level.level])?;
                }
            }
        }
        Ok(codes)
    }
}

/// Decodes the levels of a band into `codes`; `output` keeps the buffers for the next one of the
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
        let mut rec = Recorder::new(device, "decode");
        let at = (BASE_CHANNELS + level.channels.start) as u32;
        let (planes, transmittance) = (&frame.planes, &frame.transmittance);
        level.codes.record(&mut rec, planes, at, transmittance, pixels, &decoded);
        rec.run()?;
        let (stored, inner) = (frame.bands.stored(band), frame.bands.inner(band));
        codes[level.level].data[inner].copy_from_slice(&decoded.read_range(stored)?);
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

/// Share of every pixel that splats blend into it which no photo shows; alpha, without them, is
/// what is known of it.
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
    pub fn view(&mut self, camera: &Camera) -> Result<Image<f32>> {
        let rgb = self.0.render(camera)?.rgb;
        Ok(Image { width: rgb.width, height: rgb.height, data: rgb.data.iter().map(|c| c[0]).collect() })
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
