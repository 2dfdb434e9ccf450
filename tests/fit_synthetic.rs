//! Training on small scenes made of splats, with exactly known truth.
#![allow(clippy::unwrap_used)] // helpers of tests
use glam::DVec3;
use splatvk::fit::schedule::Exponential;
use splatvk::fit::{self, LanguageOptions, Preset, RgbOptions, Start, Trained, ViewDependentOptions};
use splatvk::format::scene_dir::{self, Contents};
use splatvk::gpu::{self, Device, Options, TestDevice, test_device};
use splatvk::math::Random;
use splatvk::pass::metrics::psnr;
use splatvk::pass::{FeatureMode, RasterOptions, Renderer};
use splatvk::progress::Silent;
use splatvk::run::view::Viewer;
use splatvk::scene::{
    Camera, Codebook, Image, LanguageField, LevelField, Pose, RgbImage, Seen, Splats, World,
};

const WIDTH: u32 = 96;
const HEIGHT: u32 = 72;

/// A random textured wall 4 ± 0.7 units in front of camera 0, of `n` splats.
fn wall(n: usize, seed: u64) -> Splats {
    let mut random = Random::new(seed);
    let mut splats = Splats::default();
    for _ in 0..n {
        let (x, y) = (random.uniform() * 5.0 - 2.5, random.uniform() * 4.0 - 2.0);
        let z = 4.0 + 0.7 * (x * 1.7).sin() * (y * 1.3).cos();
        splats.means.push([x as f32, y as f32, z as f32]);
        splats.log_scales.push([0; 3].map(|_| (0.05 + 0.06 * random.uniform()).ln() as f32));
        splats.quats.push([0; 4].map(|_| random.normal() as f32));
        splats.opacity_logits.push(2.0 + random.normal() as f32 * 0.5);
        splats.sh.extend([0; 3].map(|_| (random.uniform() * 3.0 - 1.5) as f32));
    }
    splats
}

fn cameras(n: usize) -> Vec<Camera> {
    (0..n).map(|i| camera(i, n)).collect()
}

/// Camera `i` of `n`; each turns towards the centre of the wall as it moves sideways.
fn camera(i: usize, n: usize) -> Camera {
    let a = i as f64 - (n - 1) as f64 * 0.5;
    // Each turns towards the wall's centre as it moves sideways.
    let pose = Pose::exp(DVec3::ZERO, DVec3::new(0.03 * a, 0.17 * a, 0.02 * a))
        .compose(&Pose { translation: DVec3::new(-0.7 * a, 0.1 * a, 0.05 * a * a), ..Pose::IDENTITY });
    Camera {
        name: format!("view {i}"),
        width: WIDTH,
        height: HEIGHT,
        fx: 90.0,
        fy: 90.0,
        cx: 48.0,
        cy: 36.0,
        pose,
    }
}

fn photos(device: &Device, splats: &Splats, cameras: &[Camera]) -> Vec<RgbImage> {
    let mut renderer = Renderer::new(device, splats, &[], 0).unwrap();
    cameras.iter().map(|c| renderer.render(c).unwrap().rgb).collect()
}

/// Rotation angle between two poses, degrees.
fn angle(a: &Pose, b: &Pose) -> f64 {
    let r = a.rotation * b.rotation.transpose();
    ((r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0) * 0.5).clamp(-1.0, 1.0).acos().to_degrees()
}

#[test]
fn fit_recovers_perturbed_camera() {
    let device = test_device();
    let splats = wall(700, 5);
    let truth = cameras(3);
    let images = photos(&device, &splats, &truth);
    let mut start = truth.clone();
    // 0.5° and 1 % of the depth (docs/internals/method.md#tolerances).
    let turn = DVec3::new(0.5, -0.7, 0.4).normalize() * 0.5f64.to_radians();
    let shift = DVec3::new(0.6, 0.5, -0.6).normalize() * 0.04;
    start[2].pose = Pose::exp(shift, turn).compose(&truth[2].pose);
    assert!(angle(&start[2].pose, &truth[2].pose) > 0.49);

    let mut options = RgbOptions::preset(Preset::Draft);
    // 300 updates of the camera: rotation and translation have similar effects, so the last tenths
    // of a degree converge slowly.
    options.iterations = 900;
    options.rates = fit::Rates::STILL;
    let rate = Exponential { start: 1e-3, end: 3e-5, steps: 900 };
    options.poses = Some(fit::pose::PoseOptions { start: 0, rate });
    let scale = fit::scale::SceneScale::measure(&truth, &splats.means);
    let trained =
        fit::fit_rgb(&device, &images, &start, splats.clone(), scale, None, &options, &Silent).unwrap();
    let left = angle(&trained.cameras[2].pose, &truth[2].pose);
    let offset = (trained.cameras[2].pose.centre() - truth[2].pose.centre()).length();
    assert!(left < 0.05, "{left:.4}° left");
    assert!(offset < 0.005, "{offset:.4} units left of 0.04");
    assert_eq!(trained.cameras[0].pose, truth[0].pose, "camera 0 fixes the frame");
    assert!(trained.stats.poses_refined && trained.stats.mean_psnr() > 35.0);
    assert_eq!(trained.splats, splats, "rates of zero leave the splats alone");
}

#[test]
fn fit_recovers_scene_and_repeats_seed() {
    let device = TestDevice::open(&Options { deterministic: true, ..gpu::options(None) }).unwrap();
    let truth = wall(500, 8);
    let cameras = cameras(3);
    let images = photos(&device, &truth, &cameras);
    let mut start = truth.clone();
    let mut random = Random::new(1);
    start.sh.iter_mut().for_each(|v| *v += random.normal() as f32 * 0.4);
    start.means.iter_mut().flatten().for_each(|v| *v += random.normal() as f32 * 0.02);
    let mut options = RgbOptions::preset(Preset::Draft);
    options.iterations = 160;
    options.poses = None;
    // Black shines through the wall.
    options.losses.opacity = None;
    let scale = fit::scale::SceneScale::measure(&cameras, &truth.means);
    let run =
        || fit::fit_rgb(&device, &images, &cameras, start.clone(), scale, None, &options, &Silent).unwrap();
    let trained = run();
    let (first, last) = (trained.stats.curve[0].loss, trained.stats.curve.last().unwrap().loss);
    assert!(last < 0.4 * first, "loss {first:.4} → {last:.4}");
    let again = run();
    assert!(again.splats == trained.splats && again.cameras == trained.cameras, "other bits");
    assert_eq!(again.stats.curve, trained.stats.curve);
}

#[test]
fn fit_prunes_faint_splats() {
    let device = test_device();
    let truth = wall(300, 8);
    let cameras = cameras(2);
    let images = photos(&device, &truth, &cameras);
    let mut start = truth.clone();
    (0..40).for_each(|i| start.opacity_logits[i * 3] = -9.0);
    let mut options = RgbOptions::preset(Preset::Draft);
    (options.iterations, options.prune_every, options.prune_from) = (12, 5, 5);
    let scale = fit::scale::SceneScale::measure(&cameras, &truth.means);
    let fit = |start: Splats| fit::fit_rgb(&device, &images, &cameras, start, scale, None, &options, &Silent);
    assert_eq!(fit(start.clone()).unwrap().splats.len(), 260);
    start.opacity_logits.fill(-9.0);
    assert!(fit(start).unwrap_err().to_string().contains("faded"));
    let wrong = fit::fit_rgb(&device, &images[..1], &cameras, truth, scale, None, &options, &Silent);
    assert!(wrong.unwrap_err().to_string().contains("one camera per photo"));
}

/// Result of view-dependent fitting for splats of SH degree 0, with photos of `truth`.
fn with_view_dependence(device: &Device, truth: &Splats, cameras: &[Camera], degree: Option<u32>) -> Trained {
    let images = photos(device, truth, cameras);
    let mut start = Splats { sh_degree: 0, ..truth.clone() };
    start.sh = truth.sh.chunks_exact(3 * truth.sh_len()).flat_map(|row| row[..3].to_vec()).collect();
    let options = RgbOptions {
        iterations: 1,
        rates: fit::Rates::STILL,
        poses: None,
        ..RgbOptions::preset(Preset::Draft)
    };
    let scale = fit::scale::SceneScale::measure(cameras, &start.means);
    let trained = fit::fit_rgb(device, &images, cameras, start, scale, None, &options, &Silent).unwrap();
    let before = (trained.splats.clone(), trained.cameras.clone());
    let options = ViewDependentOptions::preset(Preset::Draft, degree, 0);
    let found = fit::fit_view_dependent(device, &images, &[], trained, &options, &Silent).unwrap();
    assert_eq!(found.cameras, before.1);
    let geometry = |s: &Splats| Splats { sh: Vec::new(), sh_degree: 0, ..s.clone() };
    assert!(geometry(&found.splats) == geometry(&before.0), "only colours are fitted");
    found
}

#[test]
fn view_dependence_needs_heldout_gain() {
    let device = test_device();
    let cameras = cameras(9);
    let (held_out, seen) = cameras.split_at(1);
    let matte = wall(500, 8);
    // Brighter from the right: one slope for all, as from a distant lamp.
    let mut glossy = Splats { sh_degree: 1, ..matte.clone() };
    glossy.sh = matte.sh.chunks_exact(3).flat_map(|c| [c, &[0.0; 6], &[-0.5; 3]].concat()).collect();

    let found = with_view_dependence(&device, &matte, seen, None);
    assert_eq!((found.splats.sh_degree, found.stats.view_dependence.degree), (0, 0));
    let trials = &found.stats.view_dependence.trials;
    assert!(trials.len() == 3 && trials.iter().all(|t| !t.supported()), "{trials:?}");

    let found = with_view_dependence(&device, &glossy, seen, None);
    let trials = &found.stats.view_dependence.trials;
    assert!(found.splats.sh_degree >= 1 && trials.last().unwrap().supported(), "{trials:?}");
    let truth = &photos(&device, &glossy, held_out)[0];
    let shown = |splats: &Splats| psnr(&photos(&device, splats, held_out)[0], truth);
    let (before, after) = (shown(&matte), shown(&found.splats));
    println!("{before:.1} dB without, {after:.1} dB with degree {}: {trials:.2?}", found.splats.sh_degree);
    assert!(after > before + 1.0, "{before:.1} dB without, {after:.1} dB with");

    let found = with_view_dependence(&device, &glossy, &seen[..3], None);
    assert!(found.splats.sh_degree == 0 && found.stats.view_dependence.trials.is_empty(), "too few photos");
    let found = with_view_dependence(&device, &glossy, &seen[..3], Some(2));
    assert!(found.splats.sh_degree == 2 && found.stats.view_dependence.trials.is_empty(), "as asked");
}

/// Two objects, left and right of x = 0: labels where the pixel is opaque, from the true features.
fn two_objects(device: &Device, splats: &Splats, cameras: &[Camera]) -> LanguageField {
    let object = |p: &[f32; 3]| usize::from(p[0] > 0.0);
    let features: Vec<f32> =
        splats.means.iter().flat_map(|p| [0, 1, 2].map(|k| f32::from(k == object(p)))).collect();
    let options = RasterOptions { feature_mode: FeatureMode::Linear, ..RasterOptions::default() };
    let mut renderer = Renderer::new(device, splats, &features, 3).unwrap().with_options(options);
    let targets = cameras.iter().map(|c| {
        let frame = renderer.render(c).unwrap();
        let label =
            |i: usize| match (frame.alpha.data[i] > 0.6, frame.features[3 * i] > frame.features[3 * i + 1]) {
                (false, _) => -1,
                (true, left) => i32::from(!left),
            };
        let data = (0..frame.alpha.data.len()).map(label).collect();
        Image { width: WIDTH as usize, height: HEIGHT as usize, data }
    });
    let level = LevelField {
        codebook: Codebook {
            embedding_dim: 2,
            code_dim: 3,
            embeddings: vec![1.0, 0.0, 0.0, 1.0],
            codes: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            weights: vec![1.0; 2],
            members: vec![Vec::new(); 2],
            min_chord: 2f32.sqrt(),
        },
        targets: targets.collect(),
        ..LevelField::default()
    };
    // Three levels with the same content; the middle one has no masks.
    LanguageField { levels: vec![level.clone(), LevelField::default(), level], space: "test".into() }
}

fn language_options() -> LanguageOptions {
    LanguageOptions { iterations: 40, check_every: 20, ..LanguageOptions::preset(Preset::Draft) }
}

#[test]
fn language_separates_objects_in_all_modes() {
    let device = test_device();
    let splats = wall(700, 5);
    let cameras = cameras(3);
    let images = photos(&device, &splats, &cameras);
    let field = two_objects(&device, &splats, &cameras);
    let base = language_options();
    let zero = LanguageOptions { start: Start::Zero, feature_rate: 7e-3, iterations: 120, ..base.clone() };
    let cases = [
        ("lifted", base.clone()),
        ("lifted and left", LanguageOptions { iterations: 0, ..base.clone() }),
        ("from zero", zero),
        ("per level", LanguageOptions { per_level: true, ..base.clone() }),
        ("detached", LanguageOptions { detach_geometry: true, ..base }),
    ];
    for (name, options) in cases {
        let trained =
            fit::train_language(&device, &images, &cameras, &splats, field.clone(), &options, &Silent)
                .unwrap();
        // Features that are not trained are not measured.
        let measured = [0, 1, 2].map(|level| fit::decode_accuracy(&trained.curve, level).is_some());
        assert_eq!(measured, [options.iterations > 0, false, options.iterations > 0], "{name}");
        let accuracy = [0, 2].map(|level| {
            let truth = &field.levels[level];
            decoded_right(&device, (&trained.splats, &trained.field), &cameras, truth, level)
        });
        assert!(accuracy.iter().all(|a| *a > 0.99), "{name}: {accuracy:?}");
        assert_eq!(trained.field.levels[0].features.len(), 3 * splats.len());
        assert!(trained.field.levels[1].features.is_empty(), "a level without codes stays empty");
        let own = [0, 1, 2].map(|level: usize| trained.field.levels[level].splats.is_some());
        assert_eq!(own, [options.per_level, false, options.per_level], "{name}");
        if options.detach_geometry {
            assert_eq!(trained.splats, splats);
        }
    }
}

/// Share of a level's labelled pixels that a scene decodes to their label.
fn decoded_right(
    device: &Device,
    (splats, field): (&Splats, &LanguageField),
    cameras: &[Camera],
    truth: &LevelField,
    level: usize,
) -> f64 {
    let mut viewer = Viewer::new(device, splats, field).unwrap();
    let (mut right, mut labelled) = (0, 0);
    for (camera, labels) in cameras.iter().zip(&truth.targets) {
        let codes = viewer.codes(camera).unwrap();
        for (&code, &label) in codes[level].data.iter().zip(&labels.data).filter(|(_, label)| **label >= 0) {
            right += usize::from(code == label);
            labelled += 1;
        }
    }
    right as f64 / f64::from(labelled)
}

#[test]
fn model_per_level_decodes_as_trained() {
    let device = test_device();
    let splats = wall(700, 5);
    let cameras = cameras(3);
    let images = photos(&device, &splats, &cameras);
    let field = two_objects(&device, &splats, &cameras);
    let seen = Seen::default();
    // A rate at which the splats of the levels clearly diverge, also in their depth order.
    let rate = Exponential { start: 0.03, end: 0.03, steps: 40 };
    let rates = fit::Rates { means: rate, ..language_options().rates };
    let options = LanguageOptions { per_level: true, rates, image_weight: 0.0, ..language_options() };
    let trained = fit::train_language(&device, &images, &cameras, &splats, field, &options, &Silent).unwrap();
    assert_eq!(trained.splats, splats, "colours stay as they were");
    let folder = tempfile::tempdir().unwrap();
    let contents = Contents {
        splats: &trained.splats,
        seen: &seen,
        backdrop: &Default::default(),
        holes: &Splats::default(),
        cameras: &cameras,
        world: &World::default(),
        photos: &[],
        points: None,
        language: Some(&trained.field),
        text_embeddings: None,
    };
    scene_dir::write(folder.path(), &contents).unwrap();
    let loaded = scene_dir::load(folder.path()).unwrap();
    let field = loaded.language.clone().unwrap();
    for level in [0, 2] {
        let (own, truth) = (&field.levels[level], &trained.field.levels[level]);
        assert_eq!(own.splats, truth.splats);
        let measured = fit::decode_accuracy(&trained.curve, level).unwrap();
        let decoded = decoded_right(&device, (&loaded.splats, &field), &loaded.cameras, truth, level);
        println!("level {level}: {measured:.4} in training, {decoded:.4} of the saved scene");
        // The device also leaves pixels of faint splats without a code.
        assert!((measured - decoded).abs() < 2e-3, "level {level}: {measured} trained, {decoded} loaded");
    }
    // Features are on the channels of their levels, with any of the models.
    let mut viewer = Viewer::new(&device, &loaded.splats, loaded.language.as_ref().unwrap()).unwrap();
    let frame = viewer.view_with_features(&cameras[0]).unwrap();
    for (level, first) in [(0, 0), (2, 3)] {
        let pixels = frame.rendered.features.chunks_exact(6).zip(&frame.codes[level].data);
        let codes = &field.levels[level].codebook;
        let alike = pixels
            .filter(|(f, code)| **code < 0 || codes.decode(&f[first..first + 3]) == Some(**code as usize));
        assert_eq!(alike.count(), frame.rendered.alpha.data.len(), "level {level}");
    }
    // Mirrored splats of one level exchange its objects; the other level and the colours stay.
    let mut mirrored = trained.field.clone();
    mirrored.levels[0].splats.as_mut().unwrap().means.iter_mut().for_each(|p| p[0] = -p[0]);
    let folder = tempfile::tempdir().unwrap();
    scene_dir::write(folder.path(), &Contents { language: Some(&mirrored), ..contents }).unwrap();
    let loaded = scene_dir::load(folder.path()).unwrap();
    let mirrored = (&loaded.splats, loaded.language.as_ref().unwrap());
    let right =
        |level: usize| decoded_right(&device, mirrored, &loaded.cameras, &trained.field.levels[level], level);
    assert!(right(0) < 0.3 && right(2) > 0.99, "{} {}", right(0), right(2));
}

#[test]
fn ratio_of_rate_and_epsilon_matters() {
    let device = test_device();
    let splats = wall(400, 6);
    let cameras = cameras(2);
    let images = photos(&device, &splats, &cameras);
    let field = two_objects(&device, &splats, &cameras);
    let run = |epsilon: f32, feature_rate: f64| {
        let options = LanguageOptions {
            epsilon,
            feature_rate,
            start: Start::Zero,
            detach_geometry: true,
            iterations: 60,
            ..language_options()
        };
        fit::train_language(&device, &images, &cameras, &splats, field.clone(), &options, &Silent).unwrap()
    };
    let (a, b) = (run(1e-3, 7e-3), run(1e-5, 7e-5));
    let decode = |f: &[f32]| f[0] > f[1];
    let pairs = a.field.levels[0].features.chunks_exact(3).zip(b.field.levels[0].features.chunks_exact(3));
    let differing = pairs.filter(|(x, y)| decode(x) != decode(y)).count();
    // Splats without labelled pixels stay at rounding noise; of the others only near ties may
    // differ.
    assert!(differing <= splats.len() / 100, "{differing} of {} decode differently", splats.len());
}

#[test]
fn zero_language_weight_changes_nothing() {
    let device = test_device();
    let splats = wall(300, 6);
    let cameras = cameras(2);
    let images = photos(&device, &splats, &cameras);
    let field = two_objects(&device, &splats, &cameras);
    let run = |iterations: usize| {
        let options = LanguageOptions { image_weight: 1.0, iterations, check_every: 0, ..language_options() };
        fit::train_language(&device, &images, &cameras, &splats, field.clone(), &options, &Silent).unwrap()
    };
    // Two runs lift with atomic sums in another order, hence the last digits; an Adam step would
    // move a feature by about its rate, more than 1e-3.
    let (lifted, trained) = (run(0), run(9));
    let pairs = lifted.field.levels[0].features.iter().zip(&trained.field.levels[0].features);
    let moved = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(moved < 1e-5, "{moved}");
}
