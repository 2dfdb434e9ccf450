//! Similarity transforms and mirroring of Gaussians.
use crate::math::sphere_directions;
use crate::scene::sh;
use crate::scene::{Similarity, Splats};
use glam::{DMat3, DQuat, DVec3, Vec3};
use nalgebra::DMatrix;

/// Directions at which two SH expansions are compared: more than the 7 functions of degree 3 need.
const DIRECTIONS: usize = 24;

/// Transforms the Gaussians; `by.rotation` is a proper rotation, `by.scale` > 0. SH rotate with
/// them: the colour of direction d moves to direction R·d.
pub fn transform_splats(splats: &mut Splats, by: &Similarity) {
    let turn = DQuat::from_mat3(&by.rotation);
    let growth = by.scale.ln() as f32;
    for mean in &mut splats.means {
        let p = Vec3::from_array(*mean).as_dvec3();
        *mean = by.transform(p).as_vec3().to_array();
    }
    splats.log_scales.as_flattened_mut().iter_mut().for_each(|s| *s += growth);
    for quat in &mut splats.quats {
        let [w, x, y, z] = quat.map(f64::from);
        let q = turn * DQuat::from_xyzw(x, y, z, w);
        *quat = [q.w, q.x, q.y, q.z].map(|v| v as f32);
    }
    let width = 3 * splats.sh_len();
    for degree in 1..=splats.sh_degree {
        let matrix = turned_basis(&by.rotation, degree);
        let first = 3 * (degree * degree) as usize;
        for row in splats.sh.chunks_exact_mut(width) {
            let own = &mut row[first..first + 3 * matrix.nrows()];
            let old: Vec<f64> = own.iter().map(|v| f64::from(*v)).collect();
            for (k, value) in own.iter_mut().enumerate() {
                let sum = |i: usize| matrix[(k / 3, i)] * old[3 * i + k % 3];
                *value = (0..matrix.ncols()).map(sum).sum::<f64>() as f32;
            }
        }
    }
}

/// Mirrors the Gaussians at the plane z = 0: the colour of a direction moves to the mirrored
/// direction.
pub fn mirror_z(splats: &mut Splats) {
    splats.means.iter_mut().for_each(|m| m[2] = -m[2]);
    // A rotation about an axis becomes the opposite one about the mirrored axis.
    splats.quats.iter_mut().for_each(|q| (q[1], q[2]) = (-q[1], -q[2]));
    let width = 3 * splats.sh_len();
    for row in splats.sh.chunks_exact_mut(width) {
        for (k, coefficient) in row.chunks_exact_mut(3).enumerate() {
            let degree = k.isqrt();
            // Y_lm has the parity l + |m| in z.
            let order = (k - degree * degree).abs_diff(degree);
            if (degree + order) % 2 == 1 {
                coefficient.iter_mut().for_each(|v| *v = -*v);
            }
        }
    }
}

/// Rotation matrix of the 2l + 1 coefficients of degree l: rotations leave the span of the
/// functions of one degree, so that least squares over some directions are exact.
fn turned_basis(rotation: &DMat3, degree: u32) -> DMatrix<f64> {
    let functions = 2 * degree as usize + 1;
    let directions: Vec<DVec3> = sphere_directions(DIRECTIONS).collect();
    let first = (degree * degree) as usize;
    let basis_values = |turn: DMat3| {
        DMatrix::from_fn(DIRECTIONS, functions, |row, column| {
            sh::basis(turn * directions[row], degree)[first + column]
        })
    };
    let (new, old) = (basis_values(DMat3::IDENTITY), basis_values(rotation.transpose()));
    let squares = new.transpose() * &new;
    // The directions are spread over the sphere, so the functions are well conditioned there.
    let inverse = squares.try_inverse().unwrap_or_else(|| DMatrix::identity(functions, functions));
    inverse * new.transpose() * old
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transform_rotates_sh_and_covariance() {
        let sh: Vec<f32> = (0..48).map(|i| (i as f32 * 1.7).sin()).collect();
        let mut s = Splats {
            means: vec![[1.0, -2.0, 3.0]],
            log_scales: vec![[0.1, -0.2, 0.3]],
            quats: vec![[0.5, 0.5, -0.5, 0.5]],
            opacity_logits: vec![0.3],
            sh_degree: 3,
            sh: sh.clone(),
            antialiased: false,
        };
        let rotation = DMat3::from_quat(DQuat::from_xyzw(0.3, -0.5, 0.2, 0.7).normalize());
        let by = Similarity { scale: 2.5, rotation, translation: DVec3::new(0.5, 1.0, -4.0) };
        transform_splats(&mut s, &by);
        let colour = |sh: &[f32], d: DVec3, channel: usize| {
            let b = sh::basis(d, 3);
            (0..16).map(|k| b[k] * f64::from(sh[3 * k + channel])).sum::<f64>()
        };
        for direction in sphere_directions(DIRECTIONS) {
            let d = DMat3::from_rotation_y(0.4) * direction;
            for channel in 0..3 {
                let (before, after) = (colour(&sh, d, channel), colour(&s.sh, rotation * d, channel));
                assert!((before - after).abs() < 1e-5, "direction {direction}: {before} {after}");
            }
        }
        // Covariance: R S Sᵀ Rᵀ rotates and scales with the scene.
        let covariance = |q: [f32; 4], s: [f32; 3]| {
            let [w, x, y, z] = q.map(f64::from);
            let m = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
                * DMat3::from_diagonal(Vec3::from_array(s.map(f32::exp)).as_dvec3());
            m * m.transpose()
        };
        let before = covariance([0.5, 0.5, -0.5, 0.5], [0.1, -0.2, 0.3]);
        let expected = rotation * before * rotation.transpose() * 2.5 * 2.5;
        assert!(covariance(s.quats[0], s.log_scales[0]).abs_diff_eq(expected, 1e-5));
        let mean = 2.5 * (rotation * DVec3::new(1.0, -2.0, 3.0)) + by.translation;
        assert!((Vec3::from_array(s.means[0]).as_dvec3() - mean).length() < 1e-5);
    }

    #[test]
    fn mirror_z_mirrors_sh_and_covariance() {
        let sh: Vec<f32> = (0..48).map(|i| (i as f32 * 1.7).sin()).collect();
        let quat = [0.5, 0.1, -0.7, 0.3];
        let mut s = Splats {
            means: vec![[1.0, -2.0, 3.0]],
            quats: vec![quat],
            sh_degree: 3,
            sh: sh.clone(),
            ..Splats::default()
        };
        mirror_z(&mut s);
        assert_eq!(s.means[0], [1.0, -2.0, -3.0]);
        let mirror = DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        for direction in sphere_directions(DIRECTIONS) {
            let d = DMat3::from_rotation_y(0.4) * direction;
            let colour =
                |sh: &[f32], d| (0..16).map(|k| sh::basis(d, 3)[k] * f64::from(sh[3 * k])).sum::<f64>();
            assert!((colour(&sh, d) - colour(&s.sh, mirror * d)).abs() < 1e-6, "direction {direction}");
        }
        let covariance = |q: [f32; 4]| {
            let [w, x, y, z] = q.map(f64::from);
            let m = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
                * DMat3::from_diagonal(DVec3::new(1.0, 2.0, 3.0));
            m * m.transpose()
        };
        assert!(covariance(s.quats[0]).abs_diff_eq(mirror * covariance(quat) * mirror, 1e-6));
    }
}
