//! Renderer of a GPU-resident scene to images on the host.
use super::bands::Band;
use super::channels::BASE_CHANNELS;
use super::frame::FrameBuffers;
use super::metrics::planar;
use super::options::RasterOptions;
use super::rasterizer::Rasterizer;
use super::splat_buffers::SplatBuffers;
use super::view::View;
use crate::gpu::{Device, Recorder, shaders};
use crate::math::median;
use crate::scene::{Camera, Image, RgbImage, Splats};
use crate::{Error, Result};
use std::ops::Range;

/// Least alpha of a pixel with a depth: below it Σ w z describes no surface
/// (docs/internals/method.md#forward-rasterisation).
pub const DEPTH_ALPHA_MIN: f32 = shaders::pack::DEPTH_ALPHA_MIN as f32;

/// One rendered view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderedFrame {
    /// [H, W] RGB on the background, not clamped: values may exceed 1.
    pub rgb: RgbImage,
    /// [H, W] in [0, 1).
    pub alpha: Image<f32>,
    /// [H, W] expected camera z, Σ w z / alpha, world units; 0 where alpha < ½.
    pub depth: Image<f32>,
    /// d.
    pub feature_dim: usize,
    /// [H, W, d] blended features, not divided by alpha.
    pub features: Vec<f32>,
}

/// GPU-resident splats with their features. Views of one size share their buffers.
pub struct Renderer {
    device: Device,
    splats: SplatBuffers,
    options: RasterOptions,
    near: f64,
    background: [f64; 3],
    rasterizer: Option<Rasterizer>,
}

impl Renderer {
    /// Uploads splats and their raw features [N, d] (empty and 0 for none). All SH coefficients are
    /// used. Without [`Renderer::with_near`], the near plane is a hundredth of the median depth of
    /// the splats in front of the first rendered camera.
    pub fn new(device: &Device, splats: &Splats, features: &[f32], feature_dim: usize) -> Result<Renderer> {
        let buffers = SplatBuffers::upload(device, splats, features, feature_dim)?;
        Ok(Renderer::from_buffers(device, buffers))
    }

    /// Renders buffers with another owner, which may change them between views.
    pub fn from_buffers(device: &Device, splats: SplatBuffers) -> Renderer {
        let options = RasterOptions { sh_degree: splats.sh_degree, ..RasterOptions::default() };
        Renderer {
            device: device.clone(),
            splats,
            options,
            near: 0.0,
            background: [0.0; 3],
            rasterizer: None,
        }
    }

    /// Sets the near plane, world units.
    pub fn with_near(mut self, near: f64) -> Renderer {
        self.near = near;
        self
    }

    /// Sets the background colour.
    pub fn with_background(mut self, background: [f64; 3]) -> Renderer {
        self.background = background;
        self
    }

    /// Sets SH degree and feature parameterisation.
    pub fn with_options(mut self, options: RasterOptions) -> Renderer {
        self.options = options;
        self
    }

    /// Replaces the raw features [N, d].
    pub fn set_features(&mut self, features: &[f32]) -> Result<()> {
        Ok(self.splats.features.write(features)?)
    }

    /// d.
    pub fn feature_dim(&self) -> usize {
        self.splats.feature_dim
    }

    /// Renders one view and copies it to the host.
    pub fn render(&mut self, camera: &Camera) -> Result<RenderedFrame> {
        let mut out =
            RenderedFrame::empty(camera.width as usize, camera.height as usize, self.splats.feature_dim);
        self.draw_bands(camera, |frame, band| out.read_band(frame, band))?;
        Ok(out)
    }

    /// Renders one view to the device, which must hold it at once.
    pub fn draw(&mut self, camera: &Camera) -> Result<&Rasterizer> {
        let options = self.options;
        let (rasterizer, splats) = self.prepare(camera)?;
        rasterizer.forward(splats, &options)?;
        Ok(rasterizer)
    }

    /// Renders one view band by band and calls `visit` for each while it is on the device.
    pub fn draw_bands(
        &mut self,
        camera: &Camera,
        visit: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        let options = self.options;
        let (rasterizer, splats) = self.prepare(camera)?;
        rasterizer.forward_bands(splats, &options, visit)
    }

    /// [N] blending weight of each splat, summed over the pixels of a view; 0 for hidden splats and
    /// those outside.
    pub fn weights(&mut self, camera: &Camera) -> Result<Vec<f32>> {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let ones = RgbImage { width, height, data: vec![[1.0; 3]; width * height] };
        Ok(self.colour_sums(camera, &ones)?.iter().map(|sum| sum[0]).collect())
    }

    /// [N] colours of an image of this view, [H, W] RGB, summed over the pixels of each splat with
    /// its blending weights.
    ///
    /// `∂/∂c_i Σ_px C(px)·a(px) = Σ_px w_i(px) a(px)`: the gradient of a loss that is linear in the
    /// render.
    pub fn colour_sums(&mut self, camera: &Camera, image: &RgbImage) -> Result<Vec<[f32; 3]>> {
        let options = RasterOptions { sh_degree: 0, ..self.options };
        let device = self.device.clone();
        let (rasterizer, splats) = self.prepare(camera)?;
        rasterizer.allocate_gradients()?;
        let planes = planar(image);
        for index in 0..rasterizer.frame().bands.count() {
            let band = rasterizer.frame().bands.get(index);
            rasterizer.forward_band(splats, &options, &band)?;
            let upstream = rasterizer.frame().bands.cut_inner(&band, &planes, 0.0);
            rasterizer.frame().planes_grad.write_at(0, &upstream)?;
            let mut rec = Recorder::new(&device, "colour sums");
            rasterizer.record_band_backward(&mut rec, splats, &options, &band);
            rec.run()?;
        }
        let sums = rasterizer.frame().colour_gradients(splats.count)?;
        // Cleared, because a loss on other planes would leave these values.
        rasterizer.frame().planes_grad.write_at(0, &vec![0f32; 3 * rasterizer.frame().bands.pixels()])?;
        Ok(sums)
    }

    /// Returns a rasteriser set to the camera, and the splats.
    fn prepare(&mut self, camera: &Camera) -> Result<(&mut Rasterizer, &SplatBuffers)> {
        if self.near <= 0.0 {
            self.near = 0.01 * self.median_depth(camera)?;
        }
        let fits = self
            .rasterizer
            .as_ref()
            .is_some_and(|r| r.frame().width == camera.width && r.frame().height == camera.height);
        if !fits {
            let (count, dim) = (self.splats.count, self.splats.feature_dim);
            // Buffers of another size go first: two sets may not fit.
            self.rasterizer = None;
            let size = [camera.width, camera.height];
            self.rasterizer = Some(Rasterizer::for_viewing(&self.device, count, dim, &[size])?);
        }
        let Some(rasterizer) = &mut self.rasterizer else {
            return Err(Error::work("the renderer lost its rasterizer"));
        };
        rasterizer.set_view(&View::new(camera, self.near).with_background(self.background))?;
        Ok((rasterizer, &self.splats))
    }

    /// Median camera z of the splats in front of the camera; 1 when there are none.
    fn median_depth(&self, camera: &Camera) -> Result<f64> {
        let means = self.splats.means.read_range(0..3 * self.splats.count)?;
        let axis = camera.pose.rotation.row(2);
        let depth = |m: &[f32]| {
            axis.x * f64::from(m[0])
                + axis.y * f64::from(m[1])
                + axis.z * f64::from(m[2])
                + camera.pose.translation.z
        };
        let mut depths: Vec<f64> = means.chunks_exact(3).map(depth).filter(|&z| z > 0.0).collect();
        Ok(median(&mut depths).unwrap_or(1.0))
    }
}

impl RenderedFrame {
    /// A frame of zeros.
    pub fn empty(width: usize, height: usize, feature_dim: usize) -> RenderedFrame {
        RenderedFrame {
            rgb: RgbImage { width, height, data: vec![[0.0; 3]; width * height] },
            alpha: Image::filled(width, height, 0.0),
            depth: Image::filled(width, height, 0.0),
            feature_dim,
            features: vec![0.0; width * height * feature_dim],
        }
    }

    /// Copies the inner pixels of a band to the host, with the features of this frame.
    pub fn read_band(&mut self, frame: &FrameBuffers, band: &Band) -> Result<()> {
        self.read_surface(frame, band)?;
        self.read_features(frame, band, 0, 0..self.feature_dim)
    }

    /// [`RenderedFrame::read_band`] without features.
    pub fn read_surface(&mut self, frame: &FrameBuffers, band: &Band) -> Result<()> {
        let (stored, inner) = (frame.bands.stored(band), frame.bands.inner(band));
        let stride = frame.bands.pixels();
        let plane = |k: usize| k * stride + stored.start..k * stride + stored.end;
        for channel in 0..3 {
            let rgb = &mut self.rgb.data[inner.clone()];
            frame.planes.read_with(plane(channel), &mut |at, values| {
                rgb[at..].iter_mut().zip(values).for_each(|(out, v)| out[channel] = *v);
            })?;
        }
        let alpha = &mut self.alpha.data[inner.clone()];
        frame.transmittance.read_with(stored.clone(), &mut |at, values| {
            alpha[at..].iter_mut().zip(values).for_each(|(alpha, t)| *alpha = 1.0 - t);
        })?;
        let depth = &mut self.depth.data[inner];
        frame.planes.read_with(plane(3), &mut |at, values| {
            let outputs = depth[at..].iter_mut().zip(&alpha[at..]);
            for ((depth, alpha), z) in outputs.zip(values) {
                *depth = if *alpha >= DEPTH_ALPHA_MIN { z / *alpha } else { 0.0 };
            }
        })?;
        Ok(())
    }

    /// Copies feature channels of a band, from number `first` on, to the channels `into` of this
    /// frame.
    pub fn read_features(
        &mut self,
        frame: &FrameBuffers,
        band: &Band,
        first: usize,
        into: Range<usize>,
    ) -> Result<()> {
        let (stored, inner) = (frame.bands.stored(band), frame.bands.inner(band));
        for (k, to) in into.enumerate() {
            let at = (BASE_CHANNELS + first + k) * frame.bands.pixels();
            let (dim, features) = (self.feature_dim, &mut self.features[inner.start * self.feature_dim..]);
            frame.planes.read_with(at + stored.start..at + stored.end, &mut |first, values| {
                let pixels = features[first * dim..].chunks_exact_mut(dim);
                pixels.zip(values).for_each(|(out, v)| out[to] = *v);
            })?;
        }
        Ok(())
    }
}
