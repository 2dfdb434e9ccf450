//! Raw splat parameters and gradients in f64, for the references.
use crate::scene::{Splats, sh_coefficients};
use glam::{DVec3, DVec4};

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
    /// As [`Splats::antialiased`].
    pub antialiased: bool,
}

impl Params {
    /// Converts host splats and their features [N, d] (empty for d = 0) to f64.
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
            antialiased: splats.antialiased,
        }
    }

    /// Zeros of the same shape, to accumulate gradients.
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
            antialiased: self.antialiased,
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
