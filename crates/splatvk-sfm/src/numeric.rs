//! Small numeric helpers shared by the geometry code.
use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

/// Weight of the Cauchy loss `ρ = c² ln(1 + r²/c²)` with respect to squared error, from r².
pub(crate) fn cauchy_weight(r2: f64, c: f64) -> f64 {
    1.0 / (1.0 + r2 / (c * c))
}

/// Second derivative of the Cauchy loss along the residual, over its weight, from r²; negative
/// beyond c.
pub(crate) fn cauchy_curvature(r2: f64, c: f64) -> f64 {
    let s = r2 / (c * c);
    (1.0 - s) / (1.0 + s)
}

/// Cauchy loss, from r².
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
pub fn rotation_angle(r: &DMat3) -> f64 {
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
/// `residuals(x, out)` fills `out` with weighted residuals of fixed length; the loss is their
/// squared sum. Returns parameters and loss.
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
