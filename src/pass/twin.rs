//! f64 twins of the whole render: raw parameters in, images out, and back. What the GPU passes are tested
//! against, composed of the twins that stand beside each pass.
use super::project::{self, Projected};
use super::project_backward;
use super::raster_backward;
use super::raster_forward::{self, Cutoffs, Image};
use super::view::View;
use crate::scene::{Splats, sh_coefficients};
use glam::{DVec3, DVec4};

/// How stored features become rendered ones (docs/method.md#feature-gauge).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FeatureMode {
    /// f̂ = f / (‖f‖ + ε), the parameterisation of the paper, for each of several blocks of equal length (one per level).
    Gauge {
        /// ε
        epsilon: f32,
        /// Blocks.
        blocks: usize,
    },
    /// f̂ = f.
    Linear,
}

impl FeatureMode {
    /// As the shaders take it: ε, negative for [`FeatureMode::Linear`].
    pub fn epsilon(self) -> f32 {
        match self {
            FeatureMode::Gauge { epsilon, .. } => epsilon,
            FeatureMode::Linear => -1.0,
        }
    }

    /// Length of a block of `dim` features.
    pub fn width(self, dim: usize) -> usize {
        match self {
            FeatureMode::Gauge { blocks, .. } => dim / blocks,
            FeatureMode::Linear => dim,
        }
        .max(1)
    }
}

/// Raw (pre-activation) parameters of N splats in f64, layout as in [`Splats`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Params {
    /// [N, 3] world units.
    pub means: Vec<DVec3>,
    /// [N, 3] natural logs.
    pub log_scales: Vec<DVec3>,
    /// [N, 4] as (w, x, y, z) = (x, y, z, w) fields of the vector.
    pub quats: Vec<DVec4>,
    /// [N].
    pub opacity_logits: Vec<f64>,
    /// 0–3.
    pub sh_degree: u32,
    /// [N, (degree+1)²] RGB coefficients.
    pub sh: Vec<DVec3>,
    /// d.
    pub feature_dim: usize,
    /// [N, d] raw features.
    pub features: Vec<f64>,
}

impl Params {
    /// Widens host splats and their features ([N, d], may be empty with d = 0).
    pub fn new(splats: &Splats, features: &[f32], feature_dim: usize) -> Params {
        let wide = |v: &[f32; 3]| DVec3::new(v[0].into(), v[1].into(), v[2].into());
        Params {
            means: splats.means.iter().map(wide).collect(),
            log_scales: splats.log_scales.iter().map(wide).collect(),
            quats: splats.quats.iter().map(|q| DVec4::from_array(q.map(f64::from))).collect(),
            opacity_logits: splats.opacity_logits.iter().map(|&o| o.into()).collect(),
            sh_degree: splats.sh_degree,
            sh: splats
                .sh
                .chunks_exact(3)
                .map(|c| DVec3::new(c[0].into(), c[1].into(), c[2].into()))
                .collect(),
            feature_dim,
            features: features.iter().map(|&f| f.into()).collect(),
        }
    }

    /// Zeros of the same shape: the gradient accumulator.
    pub fn zeros_like(&self) -> Params {
        let n = self.means.len();
        Params {
            means: vec![DVec3::ZERO; n],
            log_scales: vec![DVec3::ZERO; n],
            quats: vec![DVec4::ZERO; n],
            opacity_logits: vec![0.0; n],
            sh_degree: self.sh_degree,
            sh: vec![DVec3::ZERO; self.sh.len()],
            feature_dim: self.feature_dim,
            features: vec![0.0; self.features.len()],
        }
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True without splats.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// SH coefficients of one splat.
    pub fn sh_of(&self, splat: usize) -> &[DVec3] {
        let k = sh_coefficients(self.sh_degree);
        &self.sh[splat * k..(splat + 1) * k]
    }
}

/// Everything the forward pass produced.
#[derive(Clone, Debug)]
pub struct Forward {
    /// [N] screen-space splats; `None` where dropped.
    pub projected: Vec<Option<Projected>>,
    /// [N, d] features as rendered.
    pub rendered_features: Vec<f64>,
    /// Visible splats, nearest first, ties by index.
    pub order: Vec<u32>,
    /// Planes.
    pub image: Image,
}

/// Gradients of a scalar loss.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By the raw parameters.
    pub params: Params,
    /// By the left pose twist (ρ, θ).
    pub twist: [f64; 6],
    /// By (fx, fy, cx, cy).
    pub intrinsics: [f64; 4],
}

/// Renders in f64.
pub fn forward(params: &Params, view: &View, mode: FeatureMode, cutoffs: &Cutoffs) -> Forward {
    forward_in_order(params, view, mode, cutoffs, None)
}

/// Renders in f64, in a given depth order instead of the true one: finite differences must not see two splats
/// change places, which is a jump of the image.
pub fn forward_in_order(
    params: &Params,
    view: &View,
    mode: FeatureMode,
    cutoffs: &Cutoffs,
    given: Option<&[u32]>,
) -> Forward {
    let projected: Vec<_> =
        (0..params.len()).map(|i| project::twin(params, i, view, cutoffs.alpha_min)).collect();
    let rendered_features = project::features_twin(&params.features, params.feature_dim, mode);
    let mut order: Vec<u32> = (0..params.len() as u32).filter(|&i| projected[i as usize].is_some()).collect();
    // f32 depth, as the sort keys on the GPU are: equal keys keep index order (the sort is stable).
    let depth = |i: u32| projected[i as usize].as_ref().map_or(0.0, |p| p.depth) as f32;
    order.sort_by(|&a, &b| depth(a).total_cmp(&depth(b)));
    let order = given.map_or(order, <[u32]>::to_vec);
    let scene = raster_forward::TwinScene {
        projected: &projected,
        features: &rendered_features,
        feature_dim: params.feature_dim,
        order: &order,
        view,
    };
    let image = raster_forward::twin(&scene, cutoffs);
    Forward { projected, rendered_features, order, image }
}

/// Back-propagates upstream plane gradients: `upstream` [(4 + d) + 1, H, W] as documented at
/// [`raster_backward`], the last plane being ∂L/∂alpha.
pub fn backward(
    params: &Params,
    view: &View,
    mode: FeatureMode,
    cutoffs: &Cutoffs,
    forward: &Forward,
    upstream: &[f64],
) -> Gradients {
    let scene = raster_forward::TwinScene {
        projected: &forward.projected,
        features: &forward.rendered_features,
        feature_dim: params.feature_dim,
        order: &forward.order,
        view,
    };
    let splat = raster_backward::twin(&scene, cutoffs, upstream);
    let mut out = Gradients { params: params.zeros_like(), twist: [0.0; 6], intrinsics: [0.0; 4] };
    for i in 0..params.len() {
        if forward.projected[i].is_some() {
            project_backward::twin(params, i, view, &splat.geometry[i], &mut out);
        }
    }
    out.params.features =
        project_backward::features_twin(&params.features, &splat.features, params.feature_dim, mode);
    out
}
