//! Renders a scene that stays on the GPU to images on the host.
use super::raster_forward::BASE_CHANNELS;
use super::rasterizer::{RasterOptions, Rasterizer, SplatBuffers};
use super::view::View;
use crate::gpu::Device;
use crate::scene::{Camera, Plane, RgbImage, Splats};
use crate::{Error, Result};

/// Alpha from which a pixel has a depth: below, Σ w z says little about any surface (ALGORITHMS 7.4).
pub const DEPTH_ALPHA_MIN: f32 = 0.5;

/// One rendered view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// [H, W] RGB on the background. Not clamped: values may pass 1.
    pub rgb: RgbImage,
    /// [H, W] in [0, 1).
    pub alpha: Plane<f32>,
    /// [H, W] expected camera z, Σ w z / alpha, world units; 0 where alpha < ½.
    pub depth: Plane<f32>,
    /// [H, W] camera z at which the light is half used up, world units; 0 where it is not.
    pub median_depth: Plane<f32>,
    /// d.
    pub feature_dim: usize,
    /// [H, W, d] blended features, not divided by alpha.
    pub features: Vec<f32>,
}

/// GPU-resident splats with their features. Cheap to call for many views of one size.
pub struct Renderer {
    device: Device,
    splats: SplatBuffers,
    options: RasterOptions,
    near: f64,
    background: [f64; 3],
    rasterizer: Option<Rasterizer>,
}

impl Renderer {
    /// Uploads splats and their raw features [N, d] (empty and 0 for none). All SH coefficients are used; the near
    /// plane is a hundredth of the median depth that the first rendered camera sees, unless [`Renderer::with_near`].
    pub fn new(device: &Device, splats: &Splats, features: &[f32], feature_dim: usize) -> Result<Renderer> {
        let buffers = SplatBuffers::upload(device, splats, features, feature_dim)?;
        Ok(Renderer::from_buffers(device, buffers))
    }

    /// Renders buffers that something else (training) owns and may change between views.
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

    /// Sets the colour behind everything.
    pub fn with_background(mut self, background: [f64; 3]) -> Renderer {
        self.background = background;
        self
    }

    /// Sets SH degree and feature parameterisation.
    pub fn with_options(mut self, options: RasterOptions) -> Renderer {
        self.options = options;
        self
    }

    /// Renders one view and copies it to the host.
    pub fn render(&mut self, camera: &Camera) -> Result<Frame> {
        read_frame(self.draw(camera)?, true)
    }

    /// Renders one view, which stays on the device.
    pub fn draw(&mut self, camera: &Camera) -> Result<&Rasterizer> {
        if self.near <= 0.0 {
            self.near = 0.01 * self.median_depth(camera)?;
        }
        let fits = self
            .rasterizer
            .as_ref()
            .is_some_and(|r| r.frame().width == camera.width && r.frame().height == camera.height);
        if !fits {
            let (count, dim) = (self.splats.count, self.splats.feature_dim);
            self.rasterizer = Some(Rasterizer::new(&self.device, count, dim, camera.width, camera.height)?);
        }
        let Some(rasterizer) = &mut self.rasterizer else {
            return Err(Error::work("the renderer lost its rasterizer"));
        };
        rasterizer.set_view(&View::new(camera, self.near).with_background(self.background))?;
        rasterizer.forward(&self.splats, &self.options)?;
        Ok(rasterizer)
    }

    /// Median camera z of the splats in front of the camera; 1 when there are none.
    fn median_depth(&self, camera: &Camera) -> Result<f64> {
        let means = self.splats.means.read_range::<f32>(0..3 * self.splats.count)?;
        let axis = camera.pose.rotation.row(2);
        let depth = |m: &[f32]| {
            axis.x * f64::from(m[0])
                + axis.y * f64::from(m[1])
                + axis.z * f64::from(m[2])
                + camera.pose.translation.z
        };
        let mut depths: Vec<f64> = means.chunks_exact(3).map(depth).filter(|&z| z > 0.0).collect();
        if depths.is_empty() {
            return Ok(1.0);
        }
        let middle = depths.len() / 2;
        Ok(*depths.select_nth_unstable_by(middle, f64::total_cmp).1)
    }
}

/// Copies the planes of the last forward pass to the host; without `features` the frame has none.
pub fn read_frame(rasterizer: &Rasterizer, features: bool) -> Result<Frame> {
    let frame = rasterizer.frame();
    let (width, height) = (frame.width as usize, frame.height as usize);
    let dim = if features { frame.feature_dim } else { 0 };
    let pixels = width * height;
    let planes = frame.planes.read_range::<f32>(0..(BASE_CHANNELS + dim) * pixels)?;
    let transmittance = frame.transmittance.read::<f32>()?;
    let plane = |data| Plane { width, height, data };
    let rgb = (0..pixels).map(|p| [planes[p], planes[pixels + p], planes[2 * pixels + p]]).collect();
    let alpha: Vec<f32> = transmittance.iter().map(|t| 1.0 - t).collect();
    let depth = alpha
        .iter()
        .zip(&planes[3 * pixels..4 * pixels])
        .map(|(&a, &z)| if a >= DEPTH_ALPHA_MIN { z / a } else { 0.0 })
        .collect();
    let mut features = vec![0.0; pixels * dim];
    for (k, source) in planes[BASE_CHANNELS * pixels..].chunks_exact(pixels).enumerate() {
        for (p, &value) in source.iter().enumerate() {
            features[p * dim + k] = value;
        }
    }
    Ok(Frame {
        rgb: RgbImage { width, height, data: rgb },
        alpha: plane(alpha),
        depth: plane(depth),
        median_depth: plane(frame.median_depth.read::<f32>()?),
        feature_dim: dim,
        features,
    })
}
