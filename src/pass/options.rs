//! How to render.

/// How stored features become rendered ones (docs/internals/method.md#feature-gauge).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FeatureMode {
    /// f̂ = f / (‖f‖ + ε), the parameterisation of the paper, for each of several blocks of equal
    /// length (one per level).
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

/// How to render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Degree used, at most the stored one.
    pub sh_degree: u32,
    /// From stored to rendered features.
    pub feature_mode: FeatureMode,
    /// Whether the loss on the features reaches means, scales, rotations and opacities.
    pub features_move_geometry: bool,
}

impl Default for RasterOptions {
    /// Degree 0; ε = 1e-3 as in docs/internals/method.md#feature-gauge.
    fn default() -> Self {
        RasterOptions {
            sh_degree: 0,
            feature_mode: FeatureMode::Gauge { epsilon: 1e-3, blocks: 1 },
            features_move_geometry: true,
        }
    }
}
