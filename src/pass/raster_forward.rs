//! Alpha blending of depth-sorted splats (docs/internals/method.md#forward-rasterisation).
//!
//! Per pixel, front to back, with d = centre − pixel: `p = −½(A dx² + C dy²) − B dx dy`, `α =
//! min(0.99, o eᵖ)`; a splat with α < 1/255 is skipped; the pixel stops before the splat that would
//! bring T below 1e-4; every channel adds `c α T`, then `T ← T(1 − α)`. Channels: RGB (plus T_f ·
//! background), Σ w z (expected depth, not yet divided by alpha), d features (no background).
use super::channels::blocks;
use super::frame::{FrameBuffers, Tiles};
use super::project::Projected;
use super::view::View;
use crate::gpu::shaders::shared::cutoffs::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN};
use crate::gpu::shaders::structs::CameraView;
use crate::gpu::{Buffer, Recorder, shaders};

pub use super::channels::BASE_CHANNELS;

/// Push constants of a raster shader, followed by fields that only some have.
macro_rules! push {
    ($shader:ident, $frame:expr, $tiles:expr, $block:expr $(, $field:ident: $value:expr)*) => {
        shaders::$shader::Push {
            width: $frame.width,
            top: $tiles.top,
            rows: $frame.bands.rows as u32,
            first_row: $tiles.rows.start,
            list_row: $tiles.list_row,
            tiles_x: $frame.tiles()[0],
            code_vectors: $frame.code_stride() / 4,
            first_vector: $block.first_vector,
            first_plane: $block.first_plane,
            features: $block.features,
            $($field: $value,)*
        }
    };
}
pub(super) use push;

/// Records the blending of the listed splats into `frame.planes` and `frame.transmittance`.
pub(super) fn record(rec: &mut Recorder, camera: &Buffer<CameraView>, frame: &FrameBuffers, tiles: &Tiles) {
    for block in blocks(frame.feature_dim as u32) {
        let call = shaders::raster_forward::call(
            shaders::raster_forward::Variant { channels: block.channels },
            &shaders::raster_forward::Bindings {
                camera,
                projected: &frame.projected,
                tile_ranges: &frame.lists.ranges,
                tile_splats: &frame.lists.splats,
                codes: &frame.codes,
                planes: &frame.planes,
                transmittance: &frame.transmittance,
            },
            &push!(raster_forward, frame, tiles, block),
        );
        rec.dispatch(call, [frame.tiles()[0], tiles.rows.len() as u32, 1]);
    }
}

/// Thresholds of the blending rule. Tests with finite differences disable its discontinuities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cutoffs {
    /// Contributions with a lower α are skipped.
    pub alpha_min: f64,
    /// Upper bound of α, so that T never reaches 0.
    pub alpha_max: f64,
    /// A pixel stops before T would fall below this.
    pub transmittance_min: f64,
}

impl Cutoffs {
    /// Values of every 3DGS renderer and of the shaders here.
    pub const STANDARD: Cutoffs =
        Cutoffs { alpha_min: ALPHA_MIN, alpha_max: ALPHA_MAX, transmittance_min: TRANSMITTANCE_MIN };
    /// Without the two discontinuities; the α clamp is continuous and stays.
    pub const SMOOTH: Cutoffs = Cutoffs { alpha_min: 0.0, alpha_max: ALPHA_MAX, transmittance_min: 0.0 };
}

/// Inputs of the raster references.
pub struct ReferenceScene<'a> {
    /// [N].
    pub projected: &'a [Option<Projected>],
    /// [N, d] as rendered.
    pub features: &'a [f64],
    /// d.
    pub feature_dim: usize,
    /// Indices of splats, nearest first.
    pub order: &'a [u32],
    /// Size and background.
    pub view: &'a View,
}

/// Output planes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RenderedImage {
    /// [4 + d, H, W]: RGB on the background, Σ w z, features.
    pub planes: Vec<f64>,
    /// [H, W] T_f; alpha is 1 − T_f.
    pub transmittance: Vec<f64>,
}

/// One contribution to a pixel.
pub struct Contribution {
    /// Index of the splat.
    pub splat: usize,
    /// α after the clamp.
    pub alpha: f64,
    /// True where α was clamped: no gradient to the geometry.
    pub clamped: bool,
    /// T before the splat.
    pub transmittance: f64,
    /// centre − pixel.
    pub d: [f64; 2],
}

/// Contributions to pixel (x, y), front to back, and the final T.
pub fn walk(scene: &ReferenceScene, cutoffs: &Cutoffs, x: u32, y: u32) -> (Vec<Contribution>, f64) {
    let mut list = Vec::new();
    let mut transmittance = 1.0;
    for &i in scene.order {
        let Some(p) = &scene.projected[i as usize] else { continue };
        let d = [p.centre[0] - f64::from(x), p.centre[1] - f64::from(y)];
        let [a, b, c] = p.conic;
        let power = -0.5 * (a * d[0] * d[0] + c * d[1] * d[1]) - b * d[0] * d[1];
        let raw = p.opacity * power.exp();
        let alpha = raw.min(cutoffs.alpha_max);
        if alpha < cutoffs.alpha_min {
            continue;
        }
        let next = transmittance * (1.0 - alpha);
        if next < cutoffs.transmittance_min {
            break;
        }
        list.push(Contribution {
            splat: i as usize,
            alpha,
            clamped: raw > cutoffs.alpha_max,
            transmittance,
            d,
        });
        transmittance = next;
    }
    (list, transmittance)
}

/// Channel values (RGB, z, features) of one splat.
pub(super) fn channels_of(scene: &ReferenceScene, splat: usize) -> Vec<f64> {
    let Some(p) = &scene.projected[splat] else { return Vec::new() };
    let mut values = vec![p.colour.x, p.colour.y, p.colour.z, p.depth];
    values.extend_from_slice(&scene.features[splat * scene.feature_dim..(splat + 1) * scene.feature_dim]);
    values
}

/// CPU reference: walks all splats at every pixel.
pub fn reference(scene: &ReferenceScene, cutoffs: &Cutoffs) -> RenderedImage {
    let [width, height] = scene.view.size;
    let pixels = width as usize * height as usize;
    let channels = BASE_CHANNELS + scene.feature_dim;
    let values: Vec<_> = (0..scene.projected.len()).map(|i| channels_of(scene, i)).collect();
    let mut image = RenderedImage { planes: vec![0.0; channels * pixels], transmittance: vec![1.0; pixels] };
    for y in 0..height {
        for x in 0..width {
            let pixel = (y * width + x) as usize;
            let (list, last) = walk(scene, cutoffs, x, y);
            for c in &list {
                let weight = c.alpha * c.transmittance;
                for (k, value) in values[c.splat].iter().enumerate() {
                    image.planes[k * pixels + pixel] += weight * value;
                }
            }
            for k in 0..3 {
                image.planes[k * pixels + pixel] += last * scene.view.background[k];
            }
            image.transmittance[pixel] = last;
        }
    }
    image
}
