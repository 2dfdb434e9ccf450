//! Tests of [`super`].
use super::*;
use crate::fit::losses::Losses;
use crate::gpu::test_device;
use crate::pass::Renderer;
use crate::preset::Preset;
use crate::scene::seeded;
use crate::scene::{Image, Pose};
use glam::DVec3;

fn turned(camera: &Camera, by: DVec3) -> Camera {
    Camera { pose: Pose::exp(DVec3::ZERO, by).compose(&camera.pose), ..camera.clone() }
}

/// Splats, two cameras, and their photos of the splats.
fn scene(device: &Device) -> (Splats, Vec<Camera>, Vec<RgbImage>) {
    let (splats, camera) = seeded::small(300, 75, 53, 0, 1003);
    let cameras = vec![camera.clone(), turned(&camera, DVec3::X * 0.01)];
    let mut renderer = Renderer::new(device, &splats, &[], 0).unwrap();
    let images = cameras.iter().map(|c| renderer.render(c).unwrap().rgb).collect();
    (splats, cameras, images)
}

#[test]
fn worse_refined_cameras_are_discarded() {
    let device = test_device();
    let (splats, cameras, images) = scene(&device);
    let options = RgbOptions { bounded: false, ..RgbOptions::preset(Preset::Draft) };
    let scale = SceneScale::measure(&cameras, &splats.means);
    let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &[] };
    let mut run = Run::new(&device, photos, &splats, scale, &options).unwrap();
    // A bad refinement of the second camera.
    run.trainer.cameras[1] = turned(&cameras[1], DVec3::Y * 0.2);
    let (_, kept, _, refined) = run.finish().unwrap();
    assert!(!refined && kept == cameras);
}

/// Trained alone, each term approaches its own target; without a term nothing moves.
#[test]
fn each_loss_trains_its_own_target() {
    let device = test_device();
    let (mut start, cameras, images) = scene(&device);
    // The largest ratio of the seeded splats is 6; from 8 on a splat is a needle.
    start.log_scales[0][0] = start.log_scales[0][1] + 3.0;
    let mut renderer = Renderer::new(&device, &start, &[], 0).unwrap();
    let frames: Vec<_> = cameras.iter().map(|c| renderer.render(c).unwrap()).collect();
    let farther =
        |map: &Image<f32>| Image { data: map.data.iter().map(|z| 1.1 * z).collect(), ..map.clone() };
    let confidence = Image::filled(75, 53, 1.0);
    let depths: Vec<_> = frames
        .iter()
        .map(|f| DepthMap { depth: farther(&f.depth), confidence: confidence.clone() })
        .collect();
    let scale = SceneScale::measure(&cameras, &start.means);
    let photos = Photos { images: &images, cameras: &cameras, depths: Some(&depths), coverage: &[] };
    let off = Losses { l1: 0.0, dssim: 0.0, ..Losses::PHOTOS };
    let trained = |losses| {
        let preset = RgbOptions::preset(Preset::Draft);
        let options = RgbOptions { losses, iterations: 10, poses: None, bounded: false, ..preset };
        let options = RgbOptions { prune_every: 0, virtual_views: 0, ..options };
        fit_photos(&device, photos, start.clone(), scale, &options, &crate::progress::Silent).unwrap().splats
    };
    let largest_ratio = |splats: &Splats| {
        let range = |s: &[f32; 3]| s[0].max(s[1]).max(s[2]) - s[0].min(s[1]).min(s[2]);
        splats.log_scales.iter().map(range).fold(0.0, f32::max)
    };
    let rendered =
        |splats: &Splats| Renderer::new(&device, splats, &[], 0).unwrap().render(&cameras[0]).unwrap();
    let depth_error = |splats: &Splats| {
        let pairs = rendered(splats)
            .depth
            .data
            .into_iter()
            .zip(&depths[0].depth.data)
            .filter(|(z, d)| *z > 0.0 && **d > 0.0);
        pairs.map(|(z, d)| f64::from((z - d).abs() / d)).sum::<f64>()
    };
    let opacity = |splats: &Splats| rendered(splats).alpha.data.iter().sum::<f32>();
    assert_eq!(trained(off), start);
    let round = trained(Losses { needles: Some(1.0), ..off });
    let moved = trained(Losses { depth: Some(1.0), ..off });
    let opaque = trained(Losses { opacity: Some(1.0), ..off });
    let ratios = [&round, &moved, &start].map(largest_ratio);
    assert!(ratios[0] < ratios[2], "{ratios:?}");
    let errors = [&moved, &round, &start].map(depth_error);
    assert!(errors[0] < 0.9 * errors[2], "{errors:?}");
    let alphas = [&opaque, &start].map(opacity);
    assert!(alphas[0] > 1.05 * alphas[1], "{alphas:?}");
}

/// Coverage of the left half of a photo.
fn left_half(width: usize, height: usize, outside: Outside) -> Coverage {
    let share = (0..width * height).map(|i| if i % width < width / 2 { 1.0 } else { 0.0 }).collect();
    Coverage { share: Image { width, height, data: share }, outside }
}

#[test]
fn unused_pixels_do_not_train_splats() {
    let device = test_device();
    let (truth, cameras, images) = scene(&device);
    let mut start = truth.clone();
    start.sh.iter_mut().for_each(|v| *v *= 0.5);
    let coverage: Vec<_> = cameras.iter().map(|_| Some(left_half(75, 53, Outside::Unknown))).collect();
    let options = RgbOptions {
        iterations: 12,
        poses: None,
        bounded: false,
        prune_every: 0,
        ..RgbOptions::preset(Preset::Draft)
    };
    let scale = SceneScale::measure(&cameras, &truth.means);
    let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage: &coverage };
    let trained =
        fit_photos(&device, photos, start.clone(), scale, &options, &crate::progress::Silent).unwrap();
    // Splats cover a few pixels, so those far from the middle are on one side only.
    let moved = |columns: std::ops::Range<f64>| {
        let inside = |i: &usize| {
            let (pixel, z) = cameras[0].project(DVec3::from(truth.means[*i].map(f64::from)));
            z > 0.0 && columns.contains(&pixel.x) && (0.0..53.0).contains(&pixel.y)
        };
        let all: Vec<usize> = (0..start.len()).filter(inside).collect();
        let changed = |i: &&usize| trained.splats.sh[3 * **i..3 * **i + 3] != start.sh[3 * **i..3 * **i + 3];
        (all.iter().filter(changed).count(), all.len())
    };
    let (left, right) = (moved(0.0..25.0), moved(68.0..75.0));
    assert!(
        2 * left.0 > left.1 && right.0 == 0 && right.1 > 5,
        "moved: {left:?} on the left, {right:?} on the right"
    );
    // PSNR is over the used pixels and does not depend on the others.
    let half = |c: usize| RgbImage {
        data: (0..75 * 53).map(|i| if i % 75 < 37 { images[0].data[i] } else { [c as f32; 3] }).collect(),
        ..images[0].clone()
    };
    assert_eq!([photos.psnr(0, &half(0)), photos.psnr(0, &half(1))], [MOST_PSNR; 2]);
}

#[test]
fn empty_background_becomes_transparent() {
    let device = test_device();
    let (truth, cameras, images) = scene(&device);
    // Black splats in empty space, which colour cannot distinguish from a black background.
    let mut start = truth.clone();
    let right = |mean: &[f32; 3], camera: &Camera| {
        let (pixel, _) = camera.project(DVec3::from(mean.map(f64::from)));
        pixel.x > 0.5 * f64::from(camera.width)
    };
    for i in (0..start.len()).filter(|i| right(&truth.means[*i], &cameras[0])) {
        start.sh[3 * i..3 * i + 3].fill(-0.5 / crate::scene::SH_C0);
        start.opacity_logits[i] = 2.0;
    }
    let coverage: Vec<_> = cameras.iter().map(|_| Some(left_half(75, 53, Outside::Empty))).collect();
    let images: Vec<RgbImage> =
        images.iter().zip(&coverage).map(|(i, c)| c.as_ref().unwrap().target(i)).collect();
    let options = RgbOptions { iterations: 150, poses: None, ..RgbOptions::preset(Preset::Draft) };
    let scale = SceneScale::measure(&cameras, &truth.means);
    let alpha_right = |coverage: &[Option<Coverage>]| {
        let photos = Photos { images: &images, cameras: &cameras, depths: None, coverage };
        let trained =
            fit_photos(&device, photos, start.clone(), scale, &options, &crate::progress::Silent).unwrap();
        let alpha =
            Renderer::new(&device, &trained.splats, &[], 0).unwrap().render(&cameras[0]).unwrap().alpha;
        // Away from the middle, which splats of the left half reach across.
        let far: Vec<f32> = (0..75 * 53).filter(|i| i % 75 > 48).map(|i| alpha.data[i]).collect();
        far.iter().sum::<f32>() / far.len() as f32
    };
    let (with, without) = (alpha_right(&coverage), alpha_right(&[]));
    assert!(with < 0.15 && without > 0.4, "{with} with an empty background, {without} on plain black");
}
