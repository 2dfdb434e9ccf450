//! Options of a render.

/// Map from stored to rendered features (docs/internals/method.md#feature-gauge).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FeatureMode {
    /// f̂ = f / (‖f‖ + ε), the parameterisation of the paper, per block; blocks have equal length,
    /// one per level.
    Gauge {
        /// ε.
        epsilon: f32,
        /// Number of blocks.
        blocks: usize,
    },
    /// f̂ = f.
    Linear,
}

impl FeatureMode {
    /// ε as the shaders take it, negative for [`FeatureMode::Linear`].
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

/// Options of a render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// SH degree to render, at most the stored one.
    pub sh_degree: u32,
    /// Map from stored to rendered features.
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
