//! Comparison with gsplat: two small scenes with images rendered by gsplat, from the test cases of
//! Brush (<https://github.com/ArthurBrussee/brush>, Apache-2.0, see tests/data/formats/LICENSE).
//!
//! The files contain raw parameters (degree 3, opacity logits) and the image; the camera follows
//! Brush's tests: at (0.123, 0.456, −8) without rotation, 90° across the width, square pixels,
//! black background.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // helpers of tests
mod support;
use glam::{DMat3, DVec3};
use safetensors::SafeTensors;
use splatvk::gpu::test_device;
use splatvk::scene::{Camera, Pose, Splats};
use support::Scene;

fn floats(file: &SafeTensors, name: &str) -> Vec<f32> {
    bytemuck::pod_collect_to_vec(file.tensor(name).unwrap().data())
}

fn rows<const K: usize>(values: &[f32]) -> Vec<[f32; K]> {
    values.chunks_exact(K).map(|c| c.try_into().unwrap()).collect()
}

/// The scene and its image [H, W, 4].
fn load(name: &str) -> (Scene, Vec<f32>) {
    let path = format!("{}/tests/data/formats/brush_{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
    let bytes = std::fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let splats = Splats {
        means: rows(&floats(&file, "means")),
        log_scales: rows(&floats(&file, "scales")),
        quats: rows(&floats(&file, "quats")),
        opacity_logits: floats(&file, "opacities"),
        sh_degree: 3,
        sh: floats(&file, "coeffs"),
        antialiased: false,
    };
    let shape = file.tensor("out_img").unwrap().shape().to_vec();
    let (height, width) = (shape[0] as u32, shape[1] as u32);
    let (w, h) = (f64::from(width), f64::from(height));
    let pose = Pose { rotation: DMat3::IDENTITY, translation: -DVec3::new(0.123, 0.456, -8.0) };
    let camera =
        Camera { name: name.into(), width, height, fx: w / 2.0, fy: w / 2.0, cx: w / 2.0, cy: h / 2.0, pose };
    let mut scene = Scene::new(splats, &camera, 0, 0);
    scene.view.background = [0.0; 3];
    (scene, floats(&file, "out_img"))
}

/// Two f32 renderers of one formula: measured 8e-7, permitted ten times that. Any other convention
/// of camera, pixel centres, SH order, dilation or cut-offs causes 1e-3 or more.
const BOUND: f32 = 1e-5;

#[test]
fn images_match_gsplat() {
    let device = test_device();
    for name in ["tiny_case", "basic_case"] {
        let (scene, image) = load(name);
        let out = scene.render(&device);
        let pixels = scene.pixels();
        assert_eq!(image.len(), 4 * pixels);
        let mut worst = 0f32;
        for (p, reference) in image.chunks_exact(4).enumerate() {
            for k in 0..3 {
                worst = worst.max((out.planes[k * pixels + p] - reference[k]).abs());
            }
            worst = worst.max((1.0 - out.transmittance[p] - reference[3]).abs());
        }
        println!("{name}: worst {worst:.1e}");
        assert!(worst < BOUND, "{name}: {worst}");
        assert!(image.iter().any(|&v| v > 0.5), "the reference is not empty");
    }
}
