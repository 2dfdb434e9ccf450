//! Rendering forward and backward, and passes that read a rendered frame.
use crate::support::{
    IMAGE, Scene, assert_class, assert_close, assert_gradients, assert_images, assert_lists, assert_update,
    in_bands, rendered,
};
use splatvk::gpu::Device;
use splatvk::math::Random;
use splatvk::pass::raster_forward::{Cutoffs, ReferenceScene, walk};
use splatvk::pass::{DeviceChoices, FeatureMode, GradientReduction, ShGradientKernel, TileBinning, TileSums};
use splatvk::pass::{bin, pairs as counting};
use splatvk::scene::seeded;
use std::collections::BTreeSet;

/// Splats over 27 × 19 pixels: 4 × 3 tiles, partial on two borders.
fn scene(n: usize, sh_degree: u32, dim: usize, seed: u64) -> Scene {
    let (splats, camera) = seeded::small(n, 27, 19, sh_degree, seed);
    Scene::new(splats, &camera, dim, seed)
}

fn check_both_directions(device: &Device, scene: &Scene, ways: DeviceChoices) {
    let (params, mut raster) = scene.upload_for(device, ways);
    raster.forward(&params, &scene.options).unwrap();
    assert_images(&rendered(&raster), &scene.reference());
    let upstream = scene.upstream(7);
    assert_gradients(scene, &scene.gradients_by(device, ways, &upstream), 7);
}

/// A render in one program, by every kind of lists.
pub fn image(device: &Device) {
    let scene = scene(40, 1, 3, 1048);
    for (grouping, summation) in [
        (TileBinning::Sorting, GradientReduction::Atomics),
        (TileBinning::Sorting, GradientReduction::Entries),
        (TileBinning::Counting, GradientReduction::Atomics),
    ] {
        let (params, mut raster) =
            scene.upload_for(device, DeviceChoices { grouping, summation, ..DeviceChoices::of(device) });
        raster.forward(&params, &scene.options).unwrap();
        assert_images(&rendered(&raster), &scene.reference());
    }
}

/// No splat, one, none in view, fewer pixels than a tile, and lists that have to grow.
pub fn edge_cases(device: &Device) {
    for (n, width, height) in [(0, 9, 5), (1, 3, 2), (1, 17, 8)] {
        let (splats, camera) = seeded::small(n, width, height, 0, 1049);
        check_both_directions(device, &Scene::new(splats, &camera, 0, 1049), DeviceChoices::of(device));
    }
    let mut behind = scene(3, 0, 3, 1050);
    behind.splats.means.fill((-3.0 * behind.view.position().as_vec3()).to_array());
    behind.view.translation = glam::DVec3::new(0.0, 0.0, -50.0);
    check_both_directions(device, &behind, DeviceChoices::of(device));
    let mut large = scene(12, 0, 0, 1051);
    large.splats.log_scales.fill([3.0, 2.5, 2.0]);
    large.splats.opacity_logits.fill(-3.0);
    check_both_directions(device, &large, DeviceChoices::of(device));
    // Some lie beyond the clamp of the Jacobian, on every side, and still reach into the image.
    let mut beyond = scene(20, 0, 0, 1053);
    beyond.view.focal = beyond.view.focal.map(|f| 1.6 * f);
    check_both_directions(device, &beyond, DeviceChoices::of(device));
}

/// Compares bands with the reference of the whole: 8 planes of 6000 pixels exceed 128 KiB.
pub fn bands(device: &Device) {
    let (splats, camera) = seeded::small(12, 40, 150, 0, 1052);
    let scene = Scene::new(splats, &camera, 3, 1052);
    let upstream = scene.upstream(7);
    for summation in [GradientReduction::Atomics, GradientReduction::Entries] {
        let (planes, gradients, count) = in_bands(&scene, device, summation, &upstream);
        assert!(count > 1, "one band");
        assert_close("planes", &planes, &scene.reference().image.planes, &IMAGE);
        assert_gradients(&scene, &gradients, 7);
    }
}

fn by_atomics(device: &Device) -> DeviceChoices {
    DeviceChoices { summation: GradientReduction::Atomics, ..DeviceChoices::of(device) }
}

pub fn colours(device: &Device) {
    for tile_sums in [TileSums::Shuffles, TileSums::Shared] {
        let ways = DeviceChoices { tile_sums, ..by_atomics(device) };
        check_both_directions(device, &scene(40, 3, 0, 1040), ways);
    }
}

/// A splat far beside the image, splats on every border of tiles, and more splats per tile than a
/// subgroup has lanes.
pub fn shared_tile_sums(device: &Device) {
    let ways = DeviceChoices { tile_sums: TileSums::Shared, ..by_atomics(device) };
    let mut large = scene(70, 0, 0, 1051);
    large.splats.log_scales.fill([3.0, 2.5, 2.0]);
    large.splats.opacity_logits.fill(-3.0);
    check_both_directions(device, &large, ways);
    let mut beyond = scene(20, 0, 0, 1053);
    beyond.view.focal = beyond.view.focal.map(|f| 1.6 * f);
    check_both_directions(device, &beyond, ways);
}

pub fn few_features(device: &Device) {
    check_both_directions(device, &scene(30, 1, 3, 1041), by_atomics(device));
}

/// Without coupling between features and geometry in the backward pass.
pub fn eight_features(device: &Device) {
    let mut scene = scene(20, 2, 8, 1047);
    scene.options.features_move_geometry = false;
    let ways = by_atomics(device);
    let (params, mut raster) = scene.upload_for(device, ways);
    raster.forward(&params, &scene.options).unwrap();
    assert_images(&rendered(&raster), &scene.reference());
    let upstream = scene.upstream(7);
    let gradients = scene.gradients_by(device, ways, &upstream);
    // Gradients of the features equal those with coupling; gradients of the geometry come from the
    // other planes alone.
    scene.options.features_move_geometry = true;
    let reference = scene.reference_gradients(&scene.reference(), &upstream);
    assert_class("features", &gradients.features, &reference.params.features);
    let mut without = upstream;
    let pixels = scene.pixels();
    without[4 * pixels..12 * pixels].fill(0.0);
    let reference = scene.reference_gradients(&scene.reference(), &without);
    let means: Vec<f64> = reference.params.means.iter().flat_map(|m| m.to_array()).collect();
    assert_class("means", gradients.splats.means.as_flattened(), &means);
}

/// More than one launch per tile; features in the gauge of three levels.
pub fn many_features(device: &Device) {
    let mut scene = scene(25, 0, 33, 1042);
    scene.options.feature_mode = FeatureMode::Gauge { epsilon: 1e-3, blocks: 3 };
    check_both_directions(device, &scene, by_atomics(device));
}

/// All widths of a launch that [`many_features`] leaves out, and all degrees, summed by entry.
pub fn gradients_by_entry(device: &Device) {
    let ways = DeviceChoices { summation: GradientReduction::Entries, ..DeviceChoices::of(device) };
    for (n, sh_degree, dim) in [(40, 2, 0), (20, 1, 3), (20, 3, 8), (15, 0, 16), (12, 0, 37)] {
        let scene = scene(n, sh_degree, dim, 1043 + dim as u64);
        check_both_directions(device, &scene, ways);
    }
}

/// Workgroups that take two turns; all degrees, and a degree below that of the coefficients.
fn gradients_in_turns(device: &Device, sh_gradients: ShGradientKernel) {
    let ways = DeviceChoices { sh_gradients, projection_groups: 1, ..DeviceChoices::of(device) };
    for sh_degree in [0, 1, 2, 3] {
        let mut scene = scene(70, sh_degree, 0, 1046);
        let upstream = scene.upstream(7);
        assert_gradients(&scene, &scene.gradients_by(device, ways, &upstream), 7);
        if sh_degree == 3 {
            scene.options.sh_degree = 1;
            let gradients = scene.gradients_by(device, ways, &upstream);
            let unused = |row: &[f32]| row[12..].iter().all(|v| *v == 0.0);
            assert!(gradients.splats.sh.chunks_exact(48).all(unused), "unused coefficients");
        }
    }
}

pub fn sh_per_thread(device: &Device) {
    gradients_in_turns(device, ShGradientKernel::PerThread);
}

pub fn sh_shared(device: &Device) {
    gradients_in_turns(device, ShGradientKernel::Shared);
}

/// Gradients and Adam in one pass: workgroups that take two turns, all degrees, and last vectors
/// with one, two and four numbers.
pub fn fused_update(device: &Device) {
    let ways = DeviceChoices { projection_groups: 1, ..DeviceChoices::of(device) };
    for (n, sh_degree) in [(70, 0), (69, 1), (67, 2), (68, 3)] {
        assert_update(device, &scene(n, sh_degree, 0, 1054), ways);
    }
}

/// Tile lists of both algorithms, compared with the reference.
pub fn lists_by_counting(device: &Device) {
    let (total, extra) = assert_lists(device, &scene(60, 0, 0, 1044));
    assert!(total > 50 && extra * 20 < total, "{extra} of {total}");
}

/// [`lists_by_counting`] with several chunks of splats, and with splats of every size: those of
/// a thread, of a subgroup and of the whole device.
pub fn lists_by_sorting(device: &Device) {
    assert_lists(device, &scene(600, 0, 0, 1054));
    let (mut splats, camera) = seeded::small(40, 150, 140, 0, 1055);
    let mut random = Random::new(1055);
    for (scales, logit) in splats.log_scales.iter_mut().zip(&mut splats.opacity_logits) {
        *scales = [0; 3].map(|_| random.between(-3.0, 1.0) as f32);
        *logit = 0.0;
    }
    let scene = Scene::new(splats, &camera, 0, 1055);
    let forward = scene.reference();
    let lists = bin::reference(&forward.projected, &forward.order, scene.view.size);
    let tiles_of = |i: usize| lists.iter().flatten().filter(|&&splat| splat as usize == i).count();
    let sizes: Vec<usize> = (0..40).map(tiles_of).collect();
    let number =
        |sizes: &[usize], range: std::ops::Range<usize>| sizes.iter().filter(|n| range.contains(n)).count();
    let numbers = [1..33, 33..257, 257..1000].map(|range| number(&sizes, range));
    assert!(numbers.iter().all(|&n| n > 3), "{numbers:?}");
    assert_lists(device, &scene);
}

pub fn pairs(device: &Device) {
    let scene = scene(60, 0, 0, 1045);
    let (params, mut raster) = scene.upload(device);
    raster.forward(&params, &scene.options).unwrap();
    let counting::Pairs { evaluated, blended, in_rows } = counting::count(device, &raster).unwrap();
    let forward = scene.reference();
    let reference = ReferenceScene {
        projected: &forward.projected,
        features: &[],
        feature_dim: 0,
        order: &forward.order,
        view: &scene.view,
    };
    let (mut expected, mut rows) = (0, BTreeSet::new());
    for (x, y) in (0..19).flat_map(|y| (0..27).map(move |x| (x, y))) {
        let (list, _) = walk(&reference, &Cutoffs::STANDARD, x, y);
        expected += list.len();
        rows.extend(list.iter().map(|pair| (pair.splat, x / 8, y)));
    }
    // f32 and f64 may disagree at the two thresholds for one pair.
    assert!((blended - expected as f64).abs() <= 1.0, "{blended} of {expected}");
    assert!((in_rows - 8.0 * rows.len() as f64).abs() <= 8.0, "{in_rows} in {} rows", rows.len());
    let listed: usize = raster.tile_lists().unwrap().iter().map(Vec::len).sum();
    assert!(evaluated >= blended && evaluated <= 64.0 * listed as f64, "{evaluated} {listed}");
}
