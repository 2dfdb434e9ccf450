//! Real spherical harmonics up to degree 3, in the order and with the signs that all 3DGS files use
//! (docs/internals/method.md#splat-parameters; reference of `glsl/shared/sh.glsl`).
use glam::DVec3;

/// Constant of degree 0.
pub const C0: f64 = 0.28209479177387814;
/// Constant of degree 1.
pub const C1: f64 = 0.4886025119029199;
/// Constants of degree 2.
pub const C2: [f64; 5] =
    [1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396];
/// Constants of degree 3.
pub const C3: [f64; 7] = [
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
];

/// The 16 basis functions at a unit direction; those above `degree` are 0.
pub fn basis(d: DVec3, degree: u32) -> [f64; 16] {
    let (x, y, z) = (d.x, d.y, d.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let mut b = [0.0; 16];
    b[0] = C0;
    if degree >= 1 {
        b[1..4].copy_from_slice(&[-C1 * y, C1 * z, -C1 * x]);
    }
    if degree >= 2 {
        b[4] = C2[0] * x * y;
        b[5] = C2[1] * y * z;
        b[6] = C2[2] * (2.0 * zz - xx - yy);
        b[7] = C2[3] * x * z;
        b[8] = C2[4] * (xx - yy);
    }
    if degree >= 3 {
        b[9] = C3[0] * y * (3.0 * xx - yy);
        b[10] = C3[1] * x * y * z;
        b[11] = C3[2] * y * (4.0 * zz - xx - yy);
        b[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        b[13] = C3[4] * x * (4.0 * zz - xx - yy);
        b[14] = C3[5] * z * (xx - yy);
        b[15] = C3[6] * x * (xx - 3.0 * yy);
    }
    b
}

/// Derivatives of [`basis`] by the three components of the direction, taken as free variables.
pub fn basis_gradient(d: DVec3, degree: u32) -> [DVec3; 16] {
    let (x, y, z) = (d.x, d.y, d.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let mut g = [DVec3::ZERO; 16];
    if degree >= 1 {
        g[1] = DVec3::new(0.0, -C1, 0.0);
        g[2] = DVec3::new(0.0, 0.0, C1);
        g[3] = DVec3::new(-C1, 0.0, 0.0);
    }
    if degree >= 2 {
        g[4] = C2[0] * DVec3::new(y, x, 0.0);
        g[5] = C2[1] * DVec3::new(0.0, z, y);
        g[6] = C2[2] * DVec3::new(-2.0 * x, -2.0 * y, 4.0 * z);
        g[7] = C2[3] * DVec3::new(z, 0.0, x);
        g[8] = C2[4] * DVec3::new(2.0 * x, -2.0 * y, 0.0);
    }
    if degree >= 3 {
        g[9] = C3[0] * DVec3::new(6.0 * x * y, 3.0 * (xx - yy), 0.0);
        g[10] = C3[1] * DVec3::new(y * z, x * z, x * y);
        g[11] = C3[2] * DVec3::new(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z);
        g[12] = C3[3] * DVec3::new(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy);
        g[13] = C3[4] * DVec3::new(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z);
        g[14] = C3[5] * DVec3::new(2.0 * x * z, -2.0 * y * z, xx - yy);
        g[15] = C3[6] * DVec3::new(3.0 * (xx - yy), -6.0 * x * y, 0.0);
    }
    g
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradient_matches_central_differences() {
        let d = DVec3::new(0.36, -0.48, 0.8);
        let step = 1e-6;
        let analytic = basis_gradient(d, 3);
        for axis in 0..3 {
            let offset = DVec3::AXES[axis] * step;
            let (plus, minus) = (basis(d + offset, 3), basis(d - offset, 3));
            for k in 0..16 {
                let numeric = (plus[k] - minus[k]) / (2.0 * step);
                assert!((numeric - analytic[k][axis]).abs() < 1e-8, "basis {k}, axis {axis}");
            }
        }
    }

    #[test]
    fn basis_is_orthonormal_over_the_sphere() {
        // Fibonacci points integrate polynomials of degree 6 on the sphere to about 1e-4 at 20 000
        // points.
        let n = 20_000;
        let mut gram = [[0.0; 16]; 16];
        for i in 0..n {
            let z: f64 = 1.0 - (2.0 * i as f64 + 1.0) / n as f64;
            let phi = i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt());
            let r = (1.0 - z * z).sqrt();
            let b = basis(DVec3::new(r * phi.cos(), r * phi.sin(), z), 3);
            for j in 0..16 {
                for k in 0..16 {
                    gram[j][k] += b[j] * b[k] * 4.0 * std::f64::consts::PI / n as f64;
                }
            }
        }
        for j in 0..16 {
            for k in 0..16 {
                let expected = if j == k { 1.0 } else { 0.0 };
                assert!((gram[j][k] - expected).abs() < 1e-3, "{j} {k}: {}", gram[j][k]);
            }
        }
    }
}
