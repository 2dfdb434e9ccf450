//! Gradients of the blended image by every screen-space splat (ALGORITHMS 7.5).
//!
//! Upstream planes [(4 + d) + 1, H, W]: ∂L/∂(RGB on background), ∂L/∂Σwz, ∂L/∂features, ∂L/∂alpha (alpha = 1 − T_f).
//! For a contributor with w = αT, own = c·g: `∂c += w g`, `∂α = T own − (S − g_A T_f)/(1 − α)` with S the
//! weighted upstream sum of everything behind it, background included. The pass walks front to back and gets S as
//! (pixel total) − (what it has already passed), so that T needs no division and no list of contributors.
//!
//! With σ = ∂α · α (0 where α was clamped), the shader only sums six moments: Σσ, Σσdx, Σσdy, Σσdx², Σσdxdy, Σσdy².
//! Every geometry gradient follows per splat: ∂o = m₀/o, ∂(u, v) = −(A m₁ + B m₂, C m₂ + B m₁),
//! ∂(A, B, C) = (−½ m₃, −m₄, −½ m₅).
use super::raster_forward::{BASE_CHANNELS, Cutoffs, TwinScene, blocks, channels_of, walk};
use super::rasterizer::FrameBuffers;
use crate::gpu::{Recorder, shaders};

/// Floats of one splat in the gradient buffer: six moments, RGB, z.
pub const MOMENTS: usize = 6;

/// Records the way from `frame.planes_grad` to `frame.projected_grad` and `frame.codes_grad`, which it clears first.
/// `features_move_geometry` = false keeps the features' part of the loss away from everything but the features.
pub fn record(rec: &mut Recorder, frame: &FrameBuffers, features_move_geometry: bool) {
    rec.fill(&frame.projected_grad, 0);
    if frame.feature_dim > 0 {
        rec.fill(&frame.codes_grad, 0);
    }
    let tiles = frame.tiles();
    for block in blocks(frame.feature_dim as u32) {
        let call = shaders::raster_backward::call(
            shaders::raster_backward::Variant { channels: block.channels },
            &shaders::raster_backward::Bindings {
                projected: &frame.projected,
                tile_ranges: &frame.lists.ranges,
                tile_splats: &frame.lists.splats,
                codes: &frame.codes,
                codes_grad: &frame.codes_grad,
                planes: &frame.planes,
                planes_grad: &frame.planes_grad,
                transmittance: &frame.transmittance,
                projected_grad: &frame.projected_grad,
            },
            &shaders::raster_backward::Push {
                width: frame.width,
                height: frame.height,
                tiles_x: tiles[0],
                code_vectors: frame.code_stride() / 4,
                first_vector: block.first_vector,
                first_plane: block.first_plane,
                features: block.features,
                alpha_plane: (BASE_CHANNELS + frame.feature_dim) as u32,
                coupling: if features_move_geometry { 1.0 } else { 0.0 },
            },
        );
        rec.dispatch(call, [tiles[0], tiles[1], 1]);
    }
}

/// What flows back to one splat, in the layout of the GPU gradient buffer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatGradient {
    /// Σσ, Σσdx, Σσdy, Σσdx², Σσdxdy, Σσdy².
    pub moments: [f64; MOMENTS],
    /// By RGB and z.
    pub channels: [f64; BASE_CHANNELS],
}

/// Gradients by all splats on the screen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ScreenGradients {
    /// [N].
    pub geometry: Vec<SplatGradient>,
    /// [N, d] by the rendered features.
    pub features: Vec<f64>,
}

/// Back-propagates `upstream` [(4 + d) + 1, H, W].
pub fn twin(scene: &TwinScene, cutoffs: &Cutoffs, upstream: &[f64]) -> ScreenGradients {
    let [width, height] = scene.view.size;
    let pixels = width as usize * height as usize;
    let dim = scene.feature_dim;
    let channels = BASE_CHANNELS + dim;
    let values: Vec<_> = (0..scene.projected.len()).map(|i| channels_of(scene, i)).collect();
    let mut out = ScreenGradients {
        geometry: vec![SplatGradient::default(); scene.projected.len()],
        features: vec![0.0; scene.projected.len() * dim],
    };
    for pixel in 0..pixels {
        let (list, last) =
            walk(scene, cutoffs, (pixel % width as usize) as u32, (pixel / width as usize) as u32);
        let g = |channel: usize| upstream[channel * pixels + pixel];
        let mut behind = last * (0..3).map(|k| scene.view.background[k] * g(k)).sum::<f64>();
        for c in list.iter().rev() {
            let weight = c.alpha * c.transmittance;
            let own: f64 = values[c.splat].iter().enumerate().map(|(k, v)| v * g(k)).sum();
            let target = &mut out.geometry[c.splat];
            for k in 0..BASE_CHANNELS {
                target.channels[k] += weight * g(k);
            }
            for k in 0..dim {
                out.features[c.splat * dim + k] += weight * g(BASE_CHANNELS + k);
            }
            let by_alpha =
                c.transmittance * own - behind / (1.0 - c.alpha) + g(channels) * last / (1.0 - c.alpha);
            behind += weight * own;
            if c.clamped {
                continue;
            }
            let sigma = by_alpha * c.alpha;
            let [dx, dy] = c.d;
            for (m, factor) in target.moments.iter_mut().zip([1.0, dx, dy, dx * dx, dx * dy, dy * dy]) {
                *m += sigma * factor;
            }
        }
    }
    out
}
