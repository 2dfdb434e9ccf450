//! Gradients of the whole render on the GPU against the f64 twin, which is itself checked by central differences.
mod support;
use splatvk::gpu::test_device;
use splatvk::pass::close::Tolerance;
use support::{GpuGradients, Scene, assert_close};

/// Relative 1e-3 by class in the L2 sense (ALGORITHMS 7.8). Single elements are sums of many terms of both signs, so
/// each is also allowed 2e-3 of the class's root mean square; a contribution at the α threshold that one side counts
/// and the other does not may push 2 % of the elements of a small class beyond that.
fn tolerance(reference: &[f64]) -> Tolerance {
    let rms = (reference.iter().map(|x| x * x).sum::<f64>() / reference.len().max(1) as f64).sqrt();
    Tolerance {
        relative_l2: 1e-3,
        absolute: 2e-3 * rms + 1e-9,
        relative: 2e-3,
        outliers: 0.02,
        outlier_factor: 50.0,
    }
}

#[track_caller]
fn assert_class(name: &str, actual: &[f32], reference: &[f64]) {
    assert_close(name, actual, reference, &tolerance(reference));
}

#[track_caller]
fn assert_gradients(scene: &Scene, actual: &GpuGradients, seed: u64) {
    let forward = scene.twin();
    let reference = scene.twin_gradients(&forward, &scene.upstream(seed));
    let p = &reference.params;
    let flat = |v: &[[f32; 3]]| v.as_flattened().to_vec();
    let wide = |v: &[glam::DVec3]| v.iter().flat_map(|x| x.to_array()).collect::<Vec<f64>>();
    assert_class("means", &flat(&actual.splats.means), &wide(&p.means));
    assert_class("log scales", &flat(&actual.splats.log_scales), &wide(&p.log_scales));
    let quats: Vec<f64> = p.quats.iter().flat_map(|q| q.to_array()).collect();
    assert_class("quats", actual.splats.quats.as_flattened(), &quats);
    assert_class("opacity logits", &actual.splats.opacity_logits, &p.opacity_logits);
    assert_class("sh", &actual.splats.sh, &wide(&p.sh));
    assert_class("features", &actual.features, &p.features);
    assert_class("pose twist", &actual.camera[..6], &reference.twist);
    assert_class("intrinsics", &actual.camera[6..], &reference.intrinsics);
}

#[test]
fn random_scenes_match_the_twin() {
    let device = test_device();
    for (n, sh_degree, dim) in [(1, 3, 3), (10, 3, 0), (100, 2, 8), (500, 1, 16), (100, 0, 48)] {
        let scene = Scene::small(n, sh_degree, dim, 60 + n as u64);
        println!("{n} splats, degree {sh_degree}, {dim} features");
        let upstream = scene.upstream(7);
        let gradients = scene.gradients(&device, &upstream);
        assert_gradients(&scene, &gradients, 7);
    }
}
