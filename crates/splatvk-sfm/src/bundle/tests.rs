use super::*;
use crate::math::Random;
use crate::numeric::rotation_angle;
use crate::scene::{Lens, Pose};
use glam::{DMat2, DVec2, DVec3};
use nalgebra::DMatrix;
use normal::whitening;

/// Four cameras on an arc of 60° around 200 points; pixel noise `noise`.
fn scene(noise: f64) -> (Problem, Problem) {
    let mut rng = Random::new(5);
    let mut p = Problem {
        centres: vec![DVec2::new(320.0, 240.0); 4],
        camera_ids: vec![0; 4],
        zoom: vec![1.0; 4],
        intrinsics: vec![Intrinsics { focal: 600.0, lens: Lens::NONE, principal_point_offset: DVec2::ZERO }],
        priors: vec![IntrinsicsPrior { log_focal: (576f64.ln(), 0.35), ..Default::default() }],
        ..Default::default()
    };
    for k in 0..4 {
        let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.1 * k as f64, 0.35 * k as f64, 0.05));
        // Orbit about (0, 0, 3).
        let c = DVec3::new(0.0, 0.0, 3.0);
        p.poses.push(Pose { rotation: turn.rotation, translation: c - turn.rotation * c });
    }
    p.poses[0] = Pose::IDENTITY;
    for k in 0..200 {
        p.points.push(DVec3::new(rng.normal() * 0.5, rng.normal() * 0.4, 3.0 + rng.normal() * 0.4));
        for view in 0..4 {
            let mut o = Observation { view, point: k, pixel: DVec2::ZERO, sigma: 1.0 };
            o.pixel = p.project(&o).1 + DVec2::new(rng.normal(), rng.normal()) * noise;
            p.observations.push(o);
        }
    }
    let truth = p.clone();
    p.intrinsics[0] = Intrinsics {
        focal: p.intrinsics[0].focal * 1.15,
        lens: Lens::NONE,
        principal_point_offset: DVec2::ZERO,
    };
    for k in 1..4 {
        let v = |rng: &mut Random| DVec3::new(rng.normal(), rng.normal(), rng.normal()) * 0.02;
        p.poses[k] = Pose::exp(v(&mut rng), v(&mut rng)).compose(&p.poses[k]);
    }
    for x in &mut p.points {
        *x += DVec3::new(rng.normal(), rng.normal(), rng.normal()) * 0.03;
    }
    (p, truth)
}

#[test]
fn solve_recovers_truth_despite_outliers() {
    let (mut p, truth) = scene(0.0);
    let mut rng = Random::new(8);
    for o in p.observations.iter_mut().step_by(7) {
        o.pixel += DVec2::new(rng.normal(), rng.normal()) * 40.0;
    }
    p.priors[0].log_focal.1 = 100.0;
    p.solve(4.0, 60).unwrap();
    p.solve(0.02, 60).unwrap();
    assert!((p.intrinsics[0].focal / 600.0 - 1.0).abs() < 1e-4, "{}", p.intrinsics[0].focal);
    for (a, b) in p.poses.iter().zip(&truth.poses) {
        assert!(rotation_angle(&(a.rotation * b.rotation.transpose())) < 1e-4);
    }
}

#[test]
fn solve_takes_few_steps() {
    let (mut p, _) = scene(1.0);
    let plain = p.solve(2.0, 60).unwrap();
    let (mut p, _) = scene(1.0);
    let mut rng = Random::new(8);
    for o in p.observations.iter_mut().step_by(7) {
        o.pixel += DVec2::new(rng.normal(), rng.normal()) * 40.0;
    }
    let spoilt = p.solve(2.0, 60).unwrap();
    println!("{} and {} trials", plain.trials, spoilt.trials);
    // Steps by the weights alone converge linearly and take dozens.
    assert!(plain.trials <= 12 && spoilt.trials <= 14, "{} {}", plain.trials, spoilt.trials);
    let again = p.solve(2.0, 60).unwrap();
    assert!(again.cost > spoilt.cost * (1.0 - 1e-3), "{} {}", again.cost, spoilt.cost);
}

#[test]
fn whitening_squares_to_hessian_of_loss() {
    let (c, h) = (2.0, 1e-5);
    for r in [DVec2::new(0.3, -0.4), DVec2::new(1.0, 0.8), DVec2::new(-3.0, 5.0)] {
        let half = |x: f64, y: f64| 0.5 * crate::numeric::cauchy((r + DVec2::new(x, y)).length_squared(), c);
        let gradient = DVec2::new(half(h, 0.0) - half(-h, 0.0), half(0.0, h) - half(0.0, -h)) / (2.0 * h);
        let square = |along: DVec2| half(along.x, along.y) - 2.0 * half(0.0, 0.0) + half(-along.x, -along.y);
        let across = square(r.perp().normalize() * h * 10.0) / (100.0 * h * h);
        let along = square(r.normalize() * h * 10.0) / (100.0 * h * h);
        let weight = 1.0 / (1.0 + r.length_squared() / (c * c));
        for (curvature, along) in
            [(Curvature::Weighted, weight), (Curvature::Robust, along.max(0.1 * weight))]
        {
            let white = whitening(r, c, curvature);
            let (u, v) = white.rows(DVec2::X, DVec2::Y);
            // RᵀR, whose columns are products of the rows.
            let hessian = DMat2::from_cols(u * u.x + v * v.x, u * u.y + v * v.y);
            let bend = |d: DVec2| d.dot(hessian * d) / d.length_squared();
            assert!((bend(r) - along).abs() < 1e-5, "{r} {curvature:?} {} {along}", bend(r));
            assert!((bend(r.perp()) - across).abs() < 1e-5, "{r} {curvature:?}");
            let product = u * white.residual(r).x + v * white.residual(r).y;
            assert!((product - gradient).length() < 1e-8, "{r} {curvature:?} {product} {gradient}");
        }
    }
}

#[test]
fn relaxed_points_are_at_their_optimum() {
    let (_, truth) = scene(0.5);
    let mut p = truth.clone();
    let mut rng = Random::new(9);
    p.points.iter_mut().for_each(|x| *x += DVec3::new(rng.normal(), rng.normal(), rng.normal()) * 0.02);
    let (given, c) = (p.points.clone(), 2.0);
    let mut cost = p.cost(c);
    let first = p.relax_points(&given, c, Curvature::Weighted);
    assert!(first < cost && (first - p.cost(c)).abs() < 1e-9 * cost, "{first} {cost}");
    for _ in 0..20 {
        let before = p.points.clone();
        let next = p.relax_points(&before, c, Curvature::Robust);
        assert!(next <= cost, "never up");
        cost = next;
    }
    let largest = p.linearise(c, Curvature::Weighted).points.iter().map(|b| b.g.length()).fold(0.0, f64::max);
    assert!(largest < 1e-3, "{largest}");
}

#[test]
fn focal_sigma_matches_error() {
    // σ of one run is compared with the actual error of that run: within a factor that a normal
    // deviate exceeds once in 10,000.
    let (mut p, _) = scene(1.0);
    let out = p.solve(1e3, 60).unwrap();
    let sigma = out.sigmas[0][0];
    assert!(sigma > 1e-4 && sigma < 0.02, "{sigma}");
    assert!((p.intrinsics[0].focal / 600.0).ln().abs() < 3.9 * sigma, "{} {sigma}", p.intrinsics[0].focal);
}

#[test]
fn variance_equals_noise() {
    let (mut p, _) = scene(0.2);
    p.solve(1e3, 60).unwrap();
    assert!((p.variance(1e3) / 0.04 - 1.0).abs() < 0.1, "{}", p.variance(1e3));
}

#[test]
fn solve_recovers_free_intrinsics() {
    let (mut p, _) = scene(0.0);
    let truth = Intrinsics {
        focal: 600.0,
        lens: Lens::radial(-0.12, 0.03),
        principal_point_offset: DVec2::new(4.0, -3.0),
    };
    let (mut wide, _) = scene(0.0);
    wide.intrinsics[0] = truth;
    // The rig of `scene` before it was disturbed, with that distortion.
    let (_, rig) = scene(0.0);
    wide.poses.clone_from(&rig.poses);
    wide.points.clone_from(&rig.points);
    for (k, o) in wide.observations.iter().enumerate() {
        // Exact, so that the priors have no influence.
        p.observations[k] = Observation { pixel: wide.project(o).1, sigma: 1e-3, ..*o };
    }
    let free =
        IntrinsicsPrior { log_focal: (576f64.ln(), 0.35), lens: [0.5; 2], principal_point_offset: 20.0 };
    let mut held = p.clone();
    p.priors[0] = free;
    p.solve(1e9, 200).unwrap();
    let found = p.intrinsics[0];
    assert!((found.focal / 600.0 - 1.0).abs() < 1e-3, "{found:?}");
    assert!((found.lens.k1 + 0.12).abs() < 2e-3 && (found.lens.k2 - 0.03).abs() < 1e-2, "{found:?}");
    assert!((found.principal_point_offset - truth.principal_point_offset).length() < 0.5, "{found:?}");
    let out = held.solve(1e9, 100).unwrap();
    assert_eq!(
        (held.intrinsics[0].lens, held.intrinsics[0].principal_point_offset),
        (Lens::NONE, DVec2::ZERO)
    );
    assert_eq!(out.sigmas[0][1..], [0.0; 4], "what is held has no uncertainty");
}

/// The problem after a step in one parameter, numbered as in the normal equations, points last.
fn moved(p: &Problem, at: usize, h: f64) -> Problem {
    let (poses, cameras) = p.sizes();
    let mut q = p.clone();
    if at < poses {
        let mut step = [DVec3::ZERO; 2];
        step[at % 6 / 3][at % 3] = h;
        let pose = &mut q.poses[1 + at / 6];
        *pose = Pose::exp(step[0], step[1]).compose(pose);
    } else if at < cameras {
        let o = &mut q.intrinsics[(at - poses) / INTRINSICS];
        match (at - poses) % INTRINSICS {
            0 => o.focal *= h.exp(),
            1 => o.lens.k1 += h,
            2 => o.lens.k2 += h,
            3 => o.principal_point_offset.x += h,
            _ => o.principal_point_offset.y += h,
        }
    } else {
        q.points[(at - cameras) / 3][(at - cameras) % 3] += h;
    }
    q
}

/// Two cameras with different intrinsics, all parameters free, away from the optimum.
fn two_cameras() -> Problem {
    let (mut p, _) = scene(1.0);
    let free =
        IntrinsicsPrior { log_focal: (576f64.ln(), 0.35), lens: [0.1; 2], principal_point_offset: 5.0 };
    p.priors = vec![free, IntrinsicsPrior { lens: [0.2; 2], ..free }];
    let intrinsics = |focal, k1| Intrinsics {
        focal,
        lens: Lens::radial(k1, -0.04),
        principal_point_offset: DVec2::new(2.0, 1.0),
    };
    p.intrinsics = vec![intrinsics(620.0, 0.05), intrinsics(590.0, -0.1)];
    p.camera_ids = vec![0, 1, 0, 1];
    p
}

#[test]
fn gradient_equals_derivative_of_cost() {
    let (p, c, h) = (two_cameras(), 1e3, 1e-6);
    let normal = p.linearise(c, Curvature::Weighted);
    let cameras = p.sizes().1;
    for k in 0..cameras + 3 * p.points.len() {
        let numeric = (moved(&p, k, h).cost(c) - moved(&p, k, -h).cost(c)) / (2.0 * h);
        let half =
            if k < cameras { normal.g[k] } else { normal.points[(k - cameras) / 3].g[(k - cameras) % 3] };
        // The normal equations hold half the derivative; 1e-4 of it is the error of the difference.
        assert!((numeric - 2.0 * half).abs() < 1e-4 * (2.0 * half).abs().max(1.0), "{k}: {numeric} {half}");
    }
}

#[test]
fn reduced_step_equals_full_step() {
    let mut p = two_cameras();
    p.points.truncate(30);
    p.observations.retain(|o| o.point < 30);
    let (c, h, lambda) = (1e9, 1e-6, 1e-2);
    let cameras = p.sizes().1;
    let n = cameras + 3 * p.points.len();
    let residuals = |q: &Problem| -> Vec<f64> {
        q.observations.iter().flat_map(|o| (q.residual(o) / o.sigma).to_array()).collect()
    };
    // Gauss–Newton on all parameters at once, the Jacobian by differences.
    let columns: Vec<DVector<f64>> = (0..n)
        .map(|k| {
            let (a, b) = (residuals(&moved(&p, k, h)), residuals(&moved(&p, k, -h)));
            DVector::from_iterator(a.len(), a.iter().zip(&b).map(|(a, b)| (a - b) / (2.0 * h)))
        })
        .collect();
    let jacobian = DMatrix::from_columns(&columns);
    let (mut whole, mut g) =
        (jacobian.transpose() * &jacobian, jacobian.transpose() * DVector::from_vec(residuals(&p)));
    let priors = p.intrinsics.iter().zip(&p.priors).flat_map(|(o, prior)| prior.deviations(o));
    for (k, (distance, sigma)) in priors.enumerate() {
        let i = p.sizes().0 + k;
        whole[(i, i)] += 1.0 / (sigma * sigma);
        g[i] += distance / (sigma * sigma);
    }
    for i in 0..n {
        whole[(i, i)] *= 1.0 + lambda;
    }
    let step = whole.cholesky().unwrap().solve(&g);
    let mut next = p.clone();
    assert!(next.step(&p.linearise(c, Curvature::Weighted), lambda));
    for (k, (a, b)) in p.points.iter().zip(&next.points).enumerate() {
        let want = DVec3::from_slice(&step.as_slice()[cameras + 3 * k..]);
        // Differences of second order and rounding; a missing block shows in the first digit.
        assert!((*a - *b - want).length() < 1e-5 * (1.0 + want.length()), "{k}: {} {want}", *a - *b);
    }
    let focal = |q: &Problem, k: usize| q.intrinsics[k].focal / p.intrinsics[k].focal - 1.0;
    for k in 0..2 {
        let want = -step[p.sizes().0 + INTRINSICS * k];
        assert!((focal(&next, k) - want).abs() < 1e-6, "{} {want}", focal(&next, k));
    }
}

#[test]
fn displacement_sigmas_match_displaced_photos() {
    let (_, mut truth) = scene(0.0);
    truth.priors[0].log_focal = (600f64.ln(), 0.35);
    let (by, half) = (vec![0.5; 4], vec![320.0; 4]);
    let stated = truth.displacement_sigmas(1e9, &half, &by).unwrap();
    let (mut focal, mut rotation) = (0.0, 0.0);
    for column in 0..4 * displacement::PATTERNS {
        let (view, pattern) = (column / displacement::PATTERNS, column % displacement::PATTERNS);
        let mut p = truth.clone();
        for o in p.observations.iter_mut().filter(|o| o.view == view) {
            let at = (o.pixel - DVec2::new(320.0, 240.0)) / 320.0;
            o.pixel += displacement::patterns(at)[pattern] * by[view];
        }
        p.solve(1e9, 30).unwrap();
        focal += (p.intrinsics[0].focal / 600.0).ln().powi(2);
        rotation += rotation_angle(&(p.poses[3].rotation * truth.poses[3].rotation.transpose())).powi(2);
    }
    println!("{} {focal} {} {rotation}", stated.intrinsics[0][0], stated.rotations[3]);
    assert!((stated.intrinsics[0][0] / focal.sqrt() - 1.0).abs() < 0.05);
    assert!((stated.rotations[3] / rotation.sqrt() - 1.0).abs() < 0.05);
    assert_eq!((stated.intrinsics[0][1], stated.rotations[0]), (0.0, 0.0), "held");
}
