//! Small numeric helpers shared by the geometry code.
use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

/// SplitMix64: a fixed-seed generator, so that every run draws the same samples.
pub(crate) struct Rng(u64);

impl Rng {
    pub(crate) fn new(seed: u64) -> Self {
        Rng(seed)
    }
    pub(crate) fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    /// Uniform in [0, n); n > 0.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        ((self.next_u64() as u128 * n as u128) >> 64) as usize
    }
    /// `N` different indices below n; n ≥ N.
    pub(crate) fn sample<const N: usize>(&mut self, n: usize) -> [usize; N] {
        let mut out = [usize::MAX; N];
        let mut k = 0;
        while k < N {
            let i = self.below(n);
            if !out[..k].contains(&i) {
                out[k] = i;
                k += 1;
            }
        }
        out
    }
    /// Uniform in [0, 1).
    #[cfg(test)]
    pub(crate) fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }
    /// Standard normal (Box–Muller).
    #[cfg(test)]
    pub(crate) fn normal(&mut self) -> f64 {
        let u = 1.0 - self.uniform();
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Middle value (upper of the two for an even count); `None` when empty. Reorders the slice.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The value below which a fraction `q` lies; `None` when empty. Reorders the slice.
pub(crate) fn quantile(values: &mut [f64], q: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let k = ((values.len() as f64 * q) as usize).min(values.len() - 1);
    Some(*values.select_nth_unstable_by(k, |a, b| a.total_cmp(b)).1)
}

/// Weight of the Cauchy loss `ρ = c² ln(1 + r²/c²)` with respect to squared error, from r².
pub(crate) fn cauchy_weight(r2: f64, c: f64) -> f64 {
    1.0 / (1.0 + r2 / (c * c))
}

/// The Cauchy loss itself.
pub(crate) fn cauchy(r2: f64, c: f64) -> f64 {
    c * c * (r2 / (c * c)).ln_1p()
}

pub(crate) fn to_na(m: &DMat3) -> Matrix3<f64> {
    Matrix3::from_column_slice(&m.to_cols_array())
}

pub(crate) fn from_na(m: &Matrix3<f64>) -> DMat3 {
    DMat3::from_cols_slice(m.as_slice())
}

pub(crate) fn vec_na(v: DVec3) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z)
}

/// The cross-product matrix `[v]×`.
pub(crate) fn skew(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// The rotation nearest to a matrix in the Frobenius norm.
pub(crate) fn nearest_rotation(m: &DMat3) -> DMat3 {
    let svd = to_na(m).svd(true, true);
    let (Some(u), Some(vt)) = (svd.u, svd.v_t) else { return DMat3::IDENTITY };
    let sign = (u * vt).determinant().signum();
    from_na(&(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * vt))
}

/// Angle of a rotation matrix, radians, exact near 0 and near π.
pub(crate) fn rotation_angle(r: &DMat3) -> f64 {
    let axis = DVec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
    let trace = r.x_axis.x + r.y_axis.y + r.z_axis.z;
    axis.length().atan2(trace - 1.0)
}

/// Rotation vector of a rotation matrix.
pub(crate) fn rotation_log(r: &DMat3) -> DVec3 {
    let q = glam::DQuat::from_mat3(r).normalize();
    let (v, w) = (DVec3::new(q.x, q.y, q.z), q.w);
    let n = v.length();
    if n < 1e-12 { v * 2.0 } else { v * (2.0 * n.atan2(w.abs()) * w.signum() / n) }
}

/// Least squares by Levenberg–Marquardt over few parameters with a forward-difference Jacobian.
/// `residuals(x)` returns weighted residuals of fixed length; the loss is their squared sum.
pub(crate) fn minimise_small<const N: usize>(
    x0: [f64; N],
    step: [f64; N],
    max_steps: usize,
    mut residuals: impl FnMut(&[f64; N], &mut Vec<f64>),
) -> ([f64; N], f64) {
    let (mut x, mut r, mut trial) = (x0, Vec::new(), Vec::new());
    residuals(&x, &mut r);
    let mut cost: f64 = r.iter().map(|v| v * v).sum();
    let mut lambda = 1e-3;
    for _ in 0..max_steps {
        let mut jacobian = Vec::with_capacity(N);
        for k in 0..N {
            let mut y = x;
            y[k] += step[k];
            residuals(&y, &mut trial);
            jacobian.push(trial.iter().zip(&r).map(|(a, b)| (a - b) / step[k]).collect::<Vec<_>>());
        }
        let h = DMatrix::from_fn(N, N, |i, j| {
            jacobian[i].iter().zip(&jacobian[j]).map(|(a, b)| a * b).sum::<f64>()
        });
        let g = DVector::from_fn(N, |i, _| jacobian[i].iter().zip(&r).map(|(a, b)| a * b).sum::<f64>());
        let before = cost;
        for _ in 0..8 {
            let mut damped = h.clone();
            for i in 0..N {
                damped[(i, i)] += lambda * h[(i, i)] + 1e-15;
            }
            let Some(factor) = damped.cholesky() else {
                lambda *= 10.0;
                continue;
            };
            let d = factor.solve(&g);
            let mut y = x;
            for i in 0..N {
                y[i] -= d[i];
            }
            residuals(&y, &mut trial);
            let c: f64 = trial.iter().map(|v| v * v).sum();
            if c < cost {
                (x, cost) = (y, c);
                std::mem::swap(&mut r, &mut trial);
                lambda = (lambda * 0.2).max(1e-12);
                break;
            }
            lambda *= 6.0;
        }
        if before - cost <= 1e-7 * before {
            break;
        }
    }
    (x, cost)
}
