//! Tests of the analytic gradients of the reference against central differences.
use super::options::FeatureMode;
use super::params::Params;
use super::raster_forward::Cutoffs;
use super::reference::{backward, forward, forward_in_order};
use super::view::View;
use crate::math::Random;
use crate::scene::Pose;
use crate::scene::seeded;
use glam::DVec3;

/// Σ over all planes of plane · upstream, with alpha = 1 − T last.
fn loss(params: &Params, view: &View, mode: FeatureMode, order: &[u32], upstream: &[f64]) -> f64 {
    let image = forward_in_order(params, view, mode, &Cutoffs::SMOOTH, Some(order)).image;
    let alpha = image.transmittance.iter().map(|t| 1.0 - t);
    image.planes.iter().copied().chain(alpha).zip(upstream).map(|(v, g)| v * g).sum()
}

struct Scene {
    params: Params,
    view: View,
    upstream: Vec<f64>,
}

fn scene(n: usize, sh_degree: u32, dim: usize, seed: u64) -> Scene {
    let (splats, camera) = seeded::small(n, 20, 14, sh_degree, seed);
    let params = Params::new(&splats, &seeded::features(n, dim, seed), dim);
    let view = View::new(&camera, 0.05).with_background([0.2, 0.4, 0.1]);
    let mut random = Random::new(seed + 1);
    let upstream = (0..(5 + dim) * 20 * 14).map(|_| random.scaled_normal(1.0)).collect();
    Scene { params, view, upstream }
}

fn twisted(view: &View, xi: [f64; 6]) -> View {
    let pose = Pose { rotation: view.rotation, translation: view.translation };
    let moved = Pose::exp(DVec3::new(xi[0], xi[1], xi[2]), DVec3::new(xi[3], xi[4], xi[5])).compose(&pose);
    View { rotation: moved.rotation, translation: moved.translation, ..view.clone() }
}

/// Asserts |numeric − analytic| ≤ 1e-5 of the largest gradient of the class: central differences
/// with step 1e-5 in f64 have an error of about 1e-10 from truncation and 1e-8 from rounding of a
/// loss of size 1e2.
fn assert_class(name: &str, pairs: &[(f64, f64)]) {
    let scale = pairs.iter().fold(1e-3, |m: f64, p| m.max(p.0.abs()));
    for (k, (numeric, analytic)) in pairs.iter().enumerate() {
        assert!(
            (numeric - analytic).abs() <= 1e-5 * scale,
            "{name} sample {k}: numeric {numeric}, analytic {analytic}"
        );
    }
    assert!(pairs.iter().any(|p| p.0.abs() > 0.0), "{name}: nothing was tested");
}

/// World coordinates of a point in camera coordinates.
fn world_point(view: &View, p: DVec3) -> DVec3 {
    view.rotation.transpose() * (p - view.translation)
}

fn check(mut s: Scene, mode: FeatureMode, samples: usize) {
    let out = forward(&s.params, &s.view, mode, &Cutoffs::SMOOTH);
    let g = backward(&s.params, &s.view, mode, &Cutoffs::SMOOTH, &out, &s.upstream);
    let n = s.params.len();
    let mut random = Random::new(99);
    let step = 1e-5;
    macro_rules! class {
        ($name:expr, $index:expr, $at:expr) => {{
            let mut pairs = Vec::new();
            for _ in 0..samples {
                let index = $index(&mut random);
                let at: fn(&mut Params, usize) -> &mut f64 = $at;
                let kept = *at(&mut s.params, index);
                let mut side = |sign: f64| {
                    *at(&mut s.params, index) = kept + sign * step;
                    loss(&s.params, &s.view, mode, &out.order, &s.upstream)
                };
                let numeric = (side(1.0) - side(-1.0)) / (2.0 * step);
                *at(&mut s.params, index) = kept;
                pairs.push((numeric, *at(&mut g.params.clone(), index)));
            }
            assert_class($name, &pairs);
        }};
    }
    let pick = |count: usize| move |r: &mut Random| (r.bits() % count as u64) as usize;
    class!("means", pick(3 * n), |p, i| &mut p.means[i / 3][i % 3]);
    class!("log scales", pick(3 * n), |p, i| &mut p.log_scales[i / 3][i % 3]);
    class!("quats", pick(4 * n), |p, i| &mut p.quats[i / 4][i % 4]);
    class!("opacity", pick(n), |p, i| &mut p.opacity_logits[i]);
    class!("sh", pick(3 * s.params.sh.len()), |p, i| &mut p.sh[i / 3][i % 3]);
    if s.params.feature_dim > 0 {
        class!("features", pick(s.params.features.len()), |p, i| &mut p.features[i]);
    }
    let mut pairs = Vec::new();
    for k in 0..6 {
        let mut xi = [0.0; 6];
        xi[k] = step;
        let plus = loss(&s.params, &twisted(&s.view, xi), mode, &out.order, &s.upstream);
        xi[k] = -step;
        let minus = loss(&s.params, &twisted(&s.view, xi), mode, &out.order, &s.upstream);
        pairs.push(((plus - minus) / (2.0 * step), g.twist[k]));
    }
    assert_class("pose", &pairs);
    let mut pairs = Vec::new();
    for k in 0..4 {
        let side = |sign: f64| {
            let mut view = s.view.clone();
            let target = if k < 2 { &mut view.focal[k] } else { &mut view.centre[k - 2] };
            *target += sign * step;
            loss(&s.params, &view, mode, &out.order, &s.upstream)
        };
        pairs.push(((side(1.0) - side(-1.0)) / (2.0 * step), g.intrinsics[k]));
    }
    assert_class("intrinsics", &pairs);
}

#[test]
fn gradients_of_one_splat_match_differences() {
    check(scene(1, 3, 3, 5), FeatureMode::Linear, 12);
}

#[test]
fn gradients_of_gauge_features_match_differences() {
    check(scene(10, 3, 8, 6), FeatureMode::Gauge { epsilon: 1e-3, blocks: 2 }, 40);
}

#[test]
fn gradients_of_hundred_splats_match_differences() {
    check(scene(100, 2, 3, 7), FeatureMode::Gauge { epsilon: 1e-3, blocks: 1 }, 20);
}

#[test]
fn gradients_of_many_splats_match_differences() {
    check(scene(500, 1, 0, 8), FeatureMode::Linear, 10);
}

#[test]
fn gradients_of_antialiased_splats_match_differences() {
    let mut s = scene(60, 1, 0, 12);
    s.params.antialiased = true;
    // Thin enough that the dilation takes most of their opacity.
    s.params.log_scales.iter_mut().take(20).for_each(|v| v.x -= 2.0);
    check(s, FeatureMode::Linear, 30);
}

#[test]
fn gradients_in_clamped_branches_match_differences() {
    let mut s = scene(10, 1, 0, 9);
    // Far off-axis in x and in y, but large enough to reach the image.
    s.params.means[0] = world_point(&s.view, DVec3::new(-2.6, 0.2, 2.0));
    s.params.log_scales[0] = DVec3::new(0.5, 0.1, 0.2);
    s.params.means[1] = world_point(&s.view, DVec3::new(0.1, 2.4, 2.0));
    s.params.log_scales[1] = DVec3::new(0.3, 0.5, 0.1);
    // Opacity 0.9991: clamped near its centre, not in its outskirts.
    s.params.opacity_logits[2] = 7.0;
    s.params.means[2] = world_point(&s.view, DVec3::new(0.05, 0.02, 1.9));
    let out = forward(&s.params, &s.view, FeatureMode::Linear, &Cutoffs::SMOOTH);
    let (negative, positive) = s.view.jacobian_limits();
    for (i, axis) in [(0, 0), (1, 1)] {
        let t = s.view.rotation * s.params.means[i] + s.view.translation;
        let slope = t[axis] / t.z;
        assert!(slope < -negative[axis] || slope > positive[axis], "splat {i} is not in the clamped branch");
    }
    let nearest = out.projected[2].as_ref().unwrap();
    assert!(nearest.opacity > Cutoffs::SMOOTH.alpha_max);
    check(s, FeatureMode::Linear, 30);
}

#[test]
fn zero_features_have_inverse_epsilon_gradient() {
    let mode = FeatureMode::Gauge { epsilon: 1e-3, blocks: 1 };
    let raw = super::project_backward::features_reference(&[0.0; 3], &[1.0, -2.0, 0.5], 3, mode);
    for (a, b) in raw.iter().zip([1.0, -2.0, 0.5]) {
        assert!((a - b / f64::from(1e-3f32)).abs() < 1e-9);
    }
}

/// A common motion of world and camera does not change the image, so the pose gradient equals the
/// negative gradient by the same motion of the splats.
#[test]
fn pose_gradient_balances_the_mean_gradients() {
    let s = scene(50, 3, 0, 11);
    let out = forward(&s.params, &s.view, FeatureMode::Linear, &Cutoffs::STANDARD);
    let g = backward(&s.params, &s.view, FeatureMode::Linear, &Cutoffs::STANDARD, &out, &s.upstream);
    let sum: DVec3 = g.params.means.iter().copied().sum();
    let rho = DVec3::new(g.twist[0], g.twist[1], g.twist[2]);
    assert!((s.view.rotation * sum - rho).length() < 1e-9 * rho.length().max(1.0));
}
