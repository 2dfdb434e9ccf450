//! f64 references of the whole render, forward and backward. The GPU passes are tested against
//! these compositions of the references beside each pass.
use super::options::FeatureMode;
use super::params::{Gradients, Params};
use super::project::{self, Projected};
use super::project_backward;
use super::raster_backward;
use super::raster_forward::{self, Cutoffs, RenderedImage};
use super::view::View;

/// Outputs of the forward pass.
#[derive(Clone, Debug)]
pub struct Forward {
    /// [N] screen-space splats; `None` where culled.
    pub projected: Vec<Option<Projected>>,
    /// [N, d] features as rendered.
    pub rendered_features: Vec<f64>,
    /// Visible splats, nearest first, ties by index.
    pub order: Vec<u32>,
    /// Planes.
    pub image: RenderedImage,
}

/// Renders in f64.
pub fn forward(params: &Params, view: &View, mode: FeatureMode, cutoffs: &Cutoffs) -> Forward {
    forward_in_order(params, view, mode, cutoffs, None)
}

/// Renders in f64, in a given depth order instead of the true one: for finite differences, since
/// the image jumps where two splats change places.
pub fn forward_in_order(
    params: &Params,
    view: &View,
    mode: FeatureMode,
    cutoffs: &Cutoffs,
    given: Option<&[u32]>,
) -> Forward {
    let projected: Vec<_> =
        (0..params.len()).map(|i| project::reference(params, i, view, cutoffs.alpha_min)).collect();
    let rendered_features = project::features_reference(&params.features, params.feature_dim, mode);
    let mut order: Vec<u32> = (0..params.len() as u32).filter(|&i| projected[i as usize].is_some()).collect();
    // The sort is stable: equal keys keep the order of the splats.
    order.sort_by_key(|&i| projected[i as usize].as_ref().map(|p| project::depth_key(p.depth as f32)));
    let order = given.map_or(order, <[u32]>::to_vec);
    let scene = raster_forward::ReferenceScene {
        projected: &projected,
        features: &rendered_features,
        feature_dim: params.feature_dim,
        order: &order,
        view,
    };
    let image = raster_forward::reference(&scene, cutoffs);
    Forward { projected, rendered_features, order, image }
}

/// Back-propagates gradients by the planes, `upstream` [(4 + d) + 1, H, W], the last by alpha (see
/// [`raster_backward`]).
pub fn backward(
    params: &Params,
    view: &View,
    mode: FeatureMode,
    cutoffs: &Cutoffs,
    forward: &Forward,
    upstream: &[f64],
) -> Gradients {
    let scene = raster_forward::ReferenceScene {
        projected: &forward.projected,
        features: &forward.rendered_features,
        feature_dim: params.feature_dim,
        order: &forward.order,
        view,
    };
    let splat = raster_backward::reference(&scene, cutoffs, upstream);
    let mut out = Gradients { params: params.zeros_like(), twist: [0.0; 6], intrinsics: [0.0; 4] };
    for i in 0..params.len() {
        if forward.projected[i].is_some() {
            project_backward::reference(params, i, view, &splat.geometry[i], &mut out);
        }
    }
    out.params.features =
        project_backward::features_reference(&params.features, &splat.features, params.feature_dim, mode);
    out
}
