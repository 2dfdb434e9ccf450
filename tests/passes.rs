//! Every rasterisation pass on the GPU against its f64 twin, with validation on.
mod support;
use splatvk::gpu::test_device;
use support::{Scene, assert_images};

#[test]
fn random_scenes_match_the_twin() {
    let device = test_device();
    for (n, sh_degree, dim) in [(1, 0, 0), (10, 3, 3), (100, 2, 8), (500, 1, 16)] {
        let scene = Scene::small(n, sh_degree, dim, 40 + n as u64);
        println!("{n} splats, degree {sh_degree}, {dim} features");
        assert_images(&scene.render(&device), &scene.twin());
    }
}
