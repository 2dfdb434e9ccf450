//! The Gaussians of a scene, as raw (pre-activation) parameters.
use serde::{Deserialize, Serialize};

/// Constant of the first spherical harmonic, `1 / (2 √π)`: colour = 0.5 + SH_C0 · f_dc.
pub const SH_C0: f32 = 0.282_094_8;

/// Number of spherical-harmonics coefficients per channel at a degree 0–3.
pub const fn sh_coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// Structure of arrays of N Gaussians (Kerbl et al. 2023), raw parameters as 3DGS files store them.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct Splats {
    /// [N, 3] world units, OpenCV axes.
    pub means: Vec<[f32; 3]>,
    /// [N, 3] natural log of the standard deviation along each local axis.
    pub log_scales: Vec<[f32; 3]>,
    /// [N, 4] (w, x, y, z), not necessarily normalised.
    pub quats: Vec<[f32; 4]>,
    /// [N] opacity before the sigmoid.
    pub opacity_logits: Vec<f32>,
    /// Spherical-harmonics degree, 0–3.
    pub sh_degree: u32,
    /// [N, (degree+1)², 3] coefficients, DC first, RGB interleaved.
    pub sh: Vec<f32>,
    /// Whether opacities are meant with the 2-D Mip filter (Yu et al. 2024, Mip-Splatting): where
    /// the projection dilates a splat, its opacity falls by the square root of the ratio of the
    /// determinants, so that thin splats keep their total weight.
    pub antialiased: bool,
}

impl Splats {
    /// No Gaussians, with capacity for `n` of an SH degree.
    pub fn with_capacity(n: usize, sh_degree: u32) -> Splats {
        Splats {
            means: Vec::with_capacity(n),
            log_scales: Vec::with_capacity(n),
            quats: Vec::with_capacity(n),
            opacity_logits: Vec::with_capacity(n),
            sh_degree,
            sh: Vec::with_capacity(3 * sh_coefficients(sh_degree) * n),
            antialiased: false,
        }
    }
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }
    /// True without Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }
    /// Appends the rows of `other`, which must have the same SH degree and the same filter.
    pub fn append(&mut self, mut other: Splats) {
        debug_assert_eq!((self.sh_degree, self.antialiased), (other.sh_degree, other.antialiased));
        self.means.append(&mut other.means);
        self.log_scales.append(&mut other.log_scales);
        self.quats.append(&mut other.quats);
        self.opacity_logits.append(&mut other.opacity_logits);
        self.sh.append(&mut other.sh);
    }
    /// Appends splats of a lower or equal SH degree.
    pub fn append_raised(&mut self, mut other: Splats) {
        other.raise_sh_degree(self.sh_degree);
        other.antialiased = self.antialiased;
        self.append(other);
    }
    /// Adds zero coefficients up to `degree` (0–3).
    pub fn raise_sh_degree(&mut self, degree: u32) {
        let (old, new) = (3 * self.sh_len(), 3 * sh_coefficients(degree.min(3)));
        if new > old {
            let mut sh = Vec::with_capacity(self.len() * new);
            for row in self.sh.chunks_exact(old) {
                sh.extend_from_slice(row);
                sh.resize(sh.len() + new - old, 0.0);
            }
            self.sh = sh;
            self.sh_degree = degree.min(3);
        }
    }
    /// The given rows, in their order.
    pub fn picked(&self, rows: &[usize]) -> Splats {
        let width = 3 * self.sh_len();
        Splats {
            means: rows.iter().map(|&i| self.means[i]).collect(),
            log_scales: rows.iter().map(|&i| self.log_scales[i]).collect(),
            quats: rows.iter().map(|&i| self.quats[i]).collect(),
            opacity_logits: rows.iter().map(|&i| self.opacity_logits[i]).collect(),
            sh_degree: self.sh_degree,
            sh: rows.iter().flat_map(|&i| &self.sh[i * width..(i + 1) * width]).copied().collect(),
            antialiased: self.antialiased,
        }
    }
    /// The splats with colours of SH degree 0, which do not depend on the direction.
    pub fn bare(&self) -> Splats {
        Splats {
            means: self.means.clone(),
            log_scales: self.log_scales.clone(),
            quats: self.quats.clone(),
            opacity_logits: self.opacity_logits.clone(),
            sh_degree: 0,
            sh: self.sh.chunks_exact(3 * self.sh_len()).flat_map(|row| &row[..3]).copied().collect(),
            antialiased: self.antialiased,
        }
    }
    /// Coefficients per channel.
    pub fn sh_len(&self) -> usize {
        sh_coefficients(self.sh_degree)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raise_sh_degree_keeps_colours() {
        let mut splats =
            Splats { means: vec![[0.0; 3]; 2], sh: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], ..Splats::default() };
        splats.raise_sh_degree(1);
        assert_eq!((splats.sh.len(), splats.sh_degree), (24, 1));
        assert_eq!(
            (&splats.sh[..4], &splats.sh[12..16]),
            (&[1.0, 2.0, 3.0, 0.0][..], &[4.0, 5.0, 6.0, 0.0][..])
        );
    }
}
