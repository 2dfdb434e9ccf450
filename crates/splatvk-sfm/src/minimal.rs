//! Minimal solvers: five points for the essential matrix, three for the absolute pose.
use super::numeric::{nearest_rotation, vec_na};
use crate::scene::Pose;
use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, Matrix3, SMatrix, SVector};

/// Monomials in (x, y, z) up to degree 3: the ten cubics that are eliminated, then the ten that
/// remain.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [2, 1, 0],
    [2, 0, 1],
    [1, 2, 0],
    [1, 1, 1],
    [1, 0, 2],
    [0, 3, 0],
    [0, 2, 1],
    [0, 1, 2],
    [0, 0, 3],
    [2, 0, 0],
    [1, 1, 0],
    [1, 0, 1],
    [0, 2, 0],
    [0, 1, 1],
    [0, 0, 2],
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
    [0, 0, 0],
];

/// A polynomial of degree ≤ 3 in three variables.
type Poly = [f64; 20];

/// Index of the product of two monomials, 20 where the degree exceeds 3.
fn product_table() -> [[u8; 20]; 20] {
    let mut table = [[20u8; 20]; 20];
    for i in 0..20 {
        for j in 0..20 {
            let sum: Vec<u8> = (0..3).map(|k| MONOMIALS[i][k] + MONOMIALS[j][k]).collect();
            if let Some(k) = MONOMIALS.iter().position(|m| m[..] == sum[..]) {
                table[i][j] = k as u8;
            }
        }
    }
    table
}

fn multiply(table: &[[u8; 20]; 20], a: &Poly, b: &Poly) -> Poly {
    let mut out = [0.0; 20];
    for i in 0..20 {
        if a[i] != 0.0 {
            for j in 0..20 {
                let k = table[i][j] as usize;
                if k < 20 {
                    out[k] += a[i] * b[j];
                }
            }
        }
    }
    out
}

fn combine(a: &Poly, b: &Poly, factor: f64) -> Poly {
    std::array::from_fn(|k| a[k] + factor * b[k])
}

/// Essential matrices E (Frobenius norm 1) with `y_kᵀ E x_k = 0` for five pairs of rays (Nistér
/// 2004 constraints, solved through the action matrix of Stewénius et al. 2006).
pub(crate) struct FivePoint {
    table: [[u8; 20]; 20],
}

impl FivePoint {
    pub(crate) fn new() -> Self {
        FivePoint { table: product_table() }
    }

    pub(crate) fn solve(&self, x: &[DVec3; 5], y: &[DVec3; 5]) -> Vec<DMat3> {
        let basis = null_space(x, y);
        let Some(reduced) = self.eliminate(&basis) else { return Vec::new() };
        // Multiplication by x maps the remaining monomials x² xy xz y² yz z² x y z 1 to the first
        // six cubics and four of themselves.
        let mut action = SMatrix::<f64, 10, 10>::zeros();
        for r in 0..6 {
            for c in 0..10 {
                action[(r, c)] = -reduced[(r, c)];
            }
        }
        for (r, c) in [(6, 0), (7, 1), (8, 2), (9, 6)] {
            action[(r, c)] = 1.0;
        }
        let Some(schur) = nalgebra::Schur::try_new(action, 1e-14, 300) else { return Vec::new() };
        let mut out = Vec::new();
        for value in schur.complex_eigenvalues().iter() {
            if value.im.abs() > 1e-6 * (1.0 + value.re.abs()) {
                continue;
            }
            // Inverse iteration; the shift keeps the matrix regular.
            let shift = value.re + 1e-9 * (1.0 + value.re.abs());
            let lu = (action - SMatrix::<f64, 10, 10>::identity() * shift).lu();
            let mut v = SVector::<f64, 10>::from_element(1.0);
            for _ in 0..2 {
                let Some(next) = lu.solve(&v) else { break };
                v = next.normalize();
            }
            if v[9].abs() < 1e-10 {
                continue;
            }
            let (a, b, c) = (v[6] / v[9], v[7] / v[9], v[8] / v[9]);
            let mut e = basis[0] * a + basis[1] * b + basis[2] * c + basis[3];
            let norm = e.to_cols_array().iter().map(|k| k * k).sum::<f64>().sqrt();
            e *= 1.0 / norm;
            if e.is_finite() {
                out.push(e);
            }
        }
        out
    }

    /// The ten cubic constraints with the cubic monomials eliminated: the right half of the reduced
    /// matrix.
    fn eliminate(&self, basis: &[DMat3; 4]) -> Option<SMatrix<f64, 10, 10>> {
        let t = &self.table;
        let mut e = [[[0.0; 20]; 3]; 3];
        for r in 0..3 {
            for c in 0..3 {
                for (k, slot) in [16, 17, 18, 19].into_iter().enumerate() {
                    e[r][c][slot] = basis[k].col(c)[r];
                }
            }
        }
        let mut eet = [[[0.0; 20]; 3]; 3];
        for r in 0..3 {
            for c in 0..3 {
                for k in 0..3 {
                    eet[r][c] = combine(&eet[r][c], &multiply(t, &e[r][k], &e[c][k]), 1.0);
                }
            }
        }
        let trace = combine(&combine(&eet[0][0], &eet[1][1], 1.0), &eet[2][2], 1.0);
        let mut rows = Vec::with_capacity(10);
        for r in 0..3 {
            for c in 0..3 {
                let mut sum = [0.0; 20];
                for k in 0..3 {
                    sum = combine(&sum, &multiply(t, &eet[r][k], &e[k][c]), 2.0);
                }
                rows.push(combine(&sum, &multiply(t, &trace, &e[r][c]), -1.0));
            }
        }
        let minor = |a: usize, b: usize| {
            combine(&multiply(t, &e[1][a], &e[2][b]), &multiply(t, &e[1][b], &e[2][a]), -1.0)
        };
        let mut det = multiply(t, &e[0][0], &minor(1, 2));
        det = combine(&det, &multiply(t, &e[0][1], &minor(0, 2)), -1.0);
        rows.push(combine(&det, &multiply(t, &e[0][2], &minor(0, 1)), 1.0));
        let left = SMatrix::<f64, 10, 10>::from_fn(|r, c| rows[r][c]);
        let right = SMatrix::<f64, 10, 10>::from_fn(|r, c| rows[r][c + 10]);
        left.full_piv_lu().solve(&right).filter(|m| m.iter().all(|v| v.is_finite()))
    }
}

/// Four matrices spanning the solutions of the five linear equations.
fn null_space(x: &[DVec3; 5], y: &[DVec3; 5]) -> [DMat3; 4] {
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (x, y) in x.iter().zip(y) {
        let (x, y) = (x.normalize(), y.normalize());
        // Column-major vec(E): entry (r, c) at 3c + r multiplies y_r x_c.
        let row = SVector::<f64, 9>::from_fn(|k, _| y[k % 3] * x[k / 3]);
        normal += row * row.transpose();
    }
    let eigen = normal.symmetric_eigen();
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    std::array::from_fn(|k| DMat3::from_cols_slice(eigen.eigenvectors.column(order[k]).as_slice()))
}

/// The four (R, t) of an essential matrix, |t| = 1, second camera = R·first + t.
pub(crate) fn decompose_essential(e: &DMat3) -> [Pose; 4] {
    let svd = Matrix3::from_column_slice(&e.to_cols_array()).svd(true, true);
    let (Some(mut u), Some(mut vt)) = (svd.u, svd.v_t) else { return [Pose::IDENTITY; 4] };
    if u.determinant() < 0.0 {
        u = -u;
    }
    if vt.determinant() < 0.0 {
        vt = -vt;
    }
    // nalgebra sorts singular values in decreasing order, so the null direction is the last column.
    let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let t = DVec3::new(u[(0, 2)], u[(1, 2)], u[(2, 2)]);
    let (a, b) = (u * w * vt, u * w.transpose() * vt);
    let rotation = |m: &Matrix3<f64>| nearest_rotation(&DMat3::from_cols_slice(m.as_slice()));
    let (a, b) = (rotation(&a), rotation(&b));
    [
        Pose { rotation: a, translation: t },
        Pose { rotation: a, translation: -t },
        Pose { rotation: b, translation: t },
        Pose { rotation: b, translation: -t },
    ]
}

/// Camera poses that see three world points along three rays (Grunert 1841 in the form of Haralick
/// et al. 1994).
pub(crate) fn three_point(world: &[DVec3; 3], rays: &[DVec3; 3]) -> Vec<Pose> {
    let j = rays.map(|r| r.normalize());
    let (a2, b2, c2) = (
        (world[1] - world[2]).length_squared(),
        (world[0] - world[2]).length_squared(),
        (world[0] - world[1]).length_squared(),
    );
    if a2.min(b2).min(c2) < 1e-20 {
        return Vec::new();
    }
    let (ca, cb, cg) = (j[1].dot(j[2]), j[0].dot(j[2]), j[0].dot(j[1]));
    let (m, p) = ((a2 - c2) / b2, (a2 + c2) / b2);
    let polynomial = [
        (1.0 + m).powi(2) - 4.0 * a2 / b2 * cg * cg,
        4.0 * (-m * (1.0 + m) * cb + 2.0 * a2 / b2 * cg * cg * cb - (1.0 - p) * ca * cg),
        2.0 * (m * m - 1.0 + 2.0 * m * m * cb * cb + 2.0 * (b2 - c2) / b2 * ca * ca - 4.0 * p * ca * cb * cg
            + 2.0 * (b2 - a2) / b2 * cg * cg),
        4.0 * (m * (1.0 - m) * cb - (1.0 - p) * ca * cg + 2.0 * c2 / b2 * ca * ca * cb),
        (m - 1.0).powi(2) - 4.0 * c2 / b2 * ca * ca,
    ];
    let mut out = Vec::new();
    for v in real_roots(&polynomial) {
        let denominator = 2.0 * (cg - v * ca);
        let s1 = b2 / (1.0 + v * v - 2.0 * v * cb);
        if v <= 0.0 || denominator.abs() < 1e-12 || s1 <= 0.0 {
            continue;
        }
        let u = ((m - 1.0) * v * v - 2.0 * m * cb * v + 1.0 + m) / denominator;
        if u <= 0.0 {
            continue;
        }
        let s1 = s1.sqrt();
        out.push(rigid_from_three(world, &[j[0] * s1, j[1] * (u * s1), j[2] * (v * s1)]));
    }
    out
}

/// The rigid motion that best maps three points onto three others.
fn rigid_from_three(from: &[DVec3; 3], to: &[DVec3; 3]) -> Pose {
    let a = (from[0] + from[1] + from[2]) / 3.0;
    let b = (to[0] + to[1] + to[2]) / 3.0;
    let mut h = DMat3::ZERO;
    for k in 0..3 {
        let (x, y) = (from[k] - a, to[k] - b);
        h += DMat3::from_cols(y * x.x, y * x.y, y * x.z);
    }
    let rotation = nearest_rotation(&h);
    Pose { rotation, translation: b - rotation * a }
}

/// Real roots of `Σ c_k x^k` with five coefficients.
fn real_roots(c: &[f64; 5]) -> Vec<f64> {
    if c[4].abs() < 1e-14 * c.iter().fold(0.0, |m: f64, v| m.max(v.abs())) {
        return Vec::new();
    }
    let mut companion = DMatrix::<f64>::zeros(4, 4);
    for k in 0..4 {
        companion[(k, 3)] = -c[k] / c[4];
        if k > 0 {
            companion[(k, k - 1)] = 1.0;
        }
    }
    let Some(schur) = nalgebra::Schur::try_new(companion, 1e-14, 200) else { return Vec::new() };
    let mut roots = Vec::new();
    for value in schur.complex_eigenvalues().iter() {
        // Double roots come out as a pair with imaginary parts of the order of the square root of
        // rounding.
        if value.im.abs() > 1e-5 * (1.0 + value.re.abs()) {
            continue;
        }
        let mut x = value.re;
        for _ in 0..3 {
            let f = c.iter().rev().fold(0.0, |s, k| s * x + k);
            let d = (1..5).rev().fold(0.0, |s, k| s * x + k as f64 * c[k]);
            if d.abs() < 1e-300 {
                break;
            }
            x -= f / d;
        }
        roots.push(x);
    }
    roots
}

/// Essential matrix `[t]× R`.
pub(crate) fn essential(pose: &Pose) -> DMat3 {
    super::numeric::skew(pose.translation) * pose.rotation
}

/// Midpoint of the shortest segment between two rays, in the frame of the first camera; `pose` maps
/// the first camera to the second. `None` behind either camera.
pub(crate) fn triangulate_two(pose: &Pose, x: DVec3, y: DVec3) -> Option<DVec3> {
    // λ·R x + t = μ·y in the second frame.
    let r = pose.rotation * x;
    let a = nalgebra::Matrix3x2::from_columns(&[vec_na(r), -vec_na(y)]);
    let s = (a.transpose() * a).try_inverse()? * (a.transpose() * -vec_na(pose.translation));
    if s[0] <= 0.0 || s[1] <= 0.0 {
        return None;
    }
    let first = x * s[0];
    let second = pose.inverse().transform(y * s[1]);
    Some((first + second) * 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;
    use crate::numeric::rotation_angle;

    fn random_pose(rng: &mut Random) -> Pose {
        let mut v = || DVec3::new(rng.normal(), rng.normal(), rng.normal());
        Pose::exp(v() * 0.5, v() * 0.3)
    }

    #[test]
    fn five_point_recovers_essential_matrix() {
        let solver = FivePoint::new();
        let mut rng = Random::new(7);
        let mut worst: Vec<f64> = Vec::new();
        for _ in 0..200 {
            let pose = random_pose(&mut rng);
            let points: [DVec3; 5] =
                std::array::from_fn(|_| DVec3::new(rng.normal(), rng.normal(), 5.0 + rng.normal()));
            let x = points.map(|p| p / p.z);
            let y = points.map(|p| pose.transform(p));
            let truth = essential(&pose);
            let norm = truth.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
            let best = solver
                .solve(&x, &y)
                .iter()
                .map(|e| {
                    let dot: f64 =
                        e.to_cols_array().iter().zip(truth.to_cols_array()).map(|(a, b)| a * b / norm).sum();
                    1.0 - dot.abs()
                })
                .fold(f64::INFINITY, f64::min);
            worst.push(best);
        }
        worst.sort_by(f64::total_cmp);
        // A few random configurations are close to degenerate.
        assert!(worst[190] < 1e-8, "{:?}", &worst[180..]);
    }

    #[test]
    fn three_point_recovers_pose() {
        let mut rng = Random::new(3);
        let mut good = 0;
        for _ in 0..200 {
            let pose = random_pose(&mut rng);
            let world: [DVec3; 3] =
                std::array::from_fn(|_| DVec3::new(rng.normal(), rng.normal(), 5.0 + rng.normal()));
            let rays = world.map(|p| pose.transform(p));
            good += three_point(&world, &rays).iter().any(|p| {
                rotation_angle(&(p.rotation * pose.rotation.transpose())) < 1e-5
                    && (p.translation - pose.translation).length() < 1e-4
            }) as usize;
        }
        assert!(good >= 196, "{good} of 200");
    }

    #[test]
    fn decompose_essential_contains_true_motion() {
        let pose = Pose::exp(DVec3::new(0.6, -0.3, 0.2), DVec3::new(0.2, 0.5, -0.1));
        let t = pose.translation.normalize();
        assert!(decompose_essential(&essential(&pose)).iter().any(|p| {
            rotation_angle(&(p.rotation * pose.rotation.transpose())) < 1e-9
                && (p.translation - t).length() < 1e-9
        }));
    }
}
