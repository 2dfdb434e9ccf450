//! Training on scenes with exactly known geometry.
#![allow(clippy::unwrap_used)] // helpers of tests
use glam::{DMat3, DVec2, DVec3};
use splatvk::fit::{self, Preset, RgbOptions};
use splatvk::format::{npy, ply};
use splatvk::gpu;
use splatvk::pass::Renderer;
use splatvk::pass::metrics::{psnr, psnr_masked, ssim};
use splatvk::progress::Progress;
use splatvk::scene::{Camera, DepthMap, Image, PointCloud, Pose, RgbImage, to_linear, to_srgb};
use std::path::{Path, PathBuf};

/// A posed photo with exact depth.
struct View {
    image: RgbImage,
    camera: Camera,
    depth: Image<f32>,
}

/// One split of a test set, every side divided by `shrink`.
fn load(split: &str, shrink: usize) -> Vec<View> {
    let folder: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast");
    let text = std::fs::read_to_string(folder.join("ground_truth.json")).unwrap();
    let truth: serde_json::Value = serde_json::from_str(&text).unwrap();
    let frames = truth["frames"].as_array().unwrap().iter().filter(|f| f["split"] == split);
    frames.map(|f| view(&folder, f, shrink)).collect()
}

fn view(folder: &Path, frame: &serde_json::Value, shrink: usize) -> View {
    let file = frame["file"].as_str().unwrap();
    let photo = splatvk::photo::load(&folder.join(file)).unwrap();
    let m = |r: usize, c: usize| frame["world_to_camera"][r][c].as_f64().unwrap();
    let column = |c: usize| DVec3::new(m(0, c), m(1, c), m(2, c));
    let k = |name: &str| frame[name].as_f64().unwrap();
    let (width, height) = (photo.image.width, photo.image.height);
    let camera = Camera {
        name: photo.stem.clone(),
        width: width as u32,
        height: height as u32,
        fx: k("fx"),
        fy: k("fy"),
        cx: k("cx"),
        cy: k("cy"),
        pose: Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) },
    };
    let path = folder.join(format!("depth/{}.npz", photo.stem));
    let depth = npy::read_npz(path).unwrap()["depth"].to_f32();
    let (w, h) = (width / shrink, height / shrink);
    let corner = |i: usize| ((i % w) * shrink, (i / w) * shrink);
    let mean = |i: usize| {
        let (x, y) = corner(i);
        let block = |c: usize| {
            (0..shrink * shrink).map(|b| photo.image.at(x + b % shrink, y + b / shrink)[c]).sum::<f32>()
        };
        [0, 1, 2].map(|c| block(c) / (shrink * shrink) as f32)
    };
    let centre = |i: usize| depth[(corner(i).1 + shrink / 2) * width + corner(i).0 + shrink / 2];
    View {
        image: RgbImage { width: w, height: h, data: (0..w * h).map(mean).collect() },
        camera: camera.resized(w as u32, h as u32),
        depth: Image { width: w, height: h, data: (0..w * h).map(centre).collect() },
    }
}

/// Surface points of the views: every pixel, unless an earlier view has that surface already.
fn points(views: &[View]) -> PointCloud {
    let mut cloud = PointCloud::default();
    for (v, view) in views.iter().enumerate() {
        for i in 0..view.depth.data.len() {
            let z = f64::from(view.depth.data[i]);
            let (x, y) = (i % view.depth.width, i / view.depth.width);
            let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let world = view.camera.unproject(pixel, z);
            if z <= 0.0 || views[..v].iter().any(|earlier| covers(earlier, world)) {
                continue;
            }
            cloud.positions.push(world.as_vec3().into());
            cloud.colours.push(view.image.data[i]);
            cloud.confidence.push(1.0);
            cloud.view.push(v as u32);
            cloud.radius.push((z / view.camera.fx) as f32);
        }
    }
    cloud
}

fn covers(view: &View, world: DVec3) -> bool {
    let (pixel, z) = view.camera.project(world);
    let inside = pixel.x >= 0.0
        && pixel.y >= 0.0
        && pixel.x < f64::from(view.camera.width)
        && pixel.y < f64::from(view.camera.height);
    z > 0.0
        && inside
        && (f64::from(view.depth.at(pixel.x as usize, pixel.y as usize)) / z - 1.0).abs() < 0.005
}

struct Print;
impl Progress for Print {
    fn begin(&self, _: &'static str, _: u64) {}
    fn step(&self, done: u64, note: &str) {
        if done.is_multiple_of(50) {
            println!("{done}: {note}");
        }
    }
    fn end(&self) {}
    fn warn(&self, message: &str) {
        println!("{message}");
    }
}

/// Environment variable `NAME` as a number: tuning parameters of the ignored measurement below.
fn knob(name: &str, default: f64) -> f64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default)
}

/// Measures train and held-out PSNR with exact cameras and points: the limit of training alone.
/// `cargo test --test fit -- --ignored --nocapture breakfast`
#[test]
#[ignore = "a measurement of about two minutes on a CPU device"]
fn fit_breakfast_with_exact_geometry() {
    let shrink = knob("SHRINK", 1.0) as usize;
    let (train, test) = (load("train", shrink), load("test", shrink));
    let device = gpu::open(None).unwrap();
    let images: Vec<RgbImage> = train.iter().map(|v| v.image.clone()).collect();
    let cameras: Vec<Camera> = train.iter().map(|v| v.camera.clone()).collect();
    let depths: Vec<DepthMap> = train
        .iter()
        .map(|v| DepthMap {
            depth: v.depth.clone(),
            confidence: Image::filled(v.depth.width, v.depth.height, 1.0),
        })
        .collect();
    let cloud = points(&train);
    let mut options = RgbOptions::preset(Preset::Draft);
    options.iterations = knob("ITERATIONS", options.iterations as f64) as usize;
    options.losses.depth = options.losses.depth.map(|weight| knob("DEPTH", weight));
    options.losses.needles = options.losses.needles.map(|weight| knob("RATIO", weight));
    options.margin = knob("MARGIN", options.margin);
    options.init.opacity = knob("OPACITY", options.init.opacity.into()) as f32;
    options.init.footprint = knob("FOOTPRINT", options.init.footprint.into()) as f32;
    options.init.neighbours = knob("NEIGHBOURS", options.init.neighbours.into()) as f32;
    options.init.max_points = knob("POINTS", options.init.max_points as f64) as usize;
    let speed = knob("SPEED", 1.0);
    options.rates.means.start *= knob("MEANS", 1.0) * speed;
    options.rates.means.end *= knob("MEANS", 1.0) * speed;
    options.rates.means.steps = options.iterations.max(1);
    options.rates.log_scales *= knob("SCALES", 1.0) * speed;
    options.rates.opacity *= knob("OPACITIES", 1.0) * speed;
    options.rates.sh_dc *= knob("COLOURS", 1.0) * speed;
    options.rates.quats *= knob("QUATS", 1.0) * speed;
    if knob("POSES", 0.0) == 0.0 {
        options.poses = None;
    }
    println!("{} points", cloud.len());
    let trained =
        fit::train_rgb(&device, &images, &cameras, &cloud, Some(&depths), &options, &Print).unwrap();
    let mut renderer = Renderer::new(&device, &trained.splats, &[], 0).unwrap();
    let (mut sum, mut structure) = (0.0, 0.0);
    for view in &test {
        let frame = renderer.render(&view.camera).unwrap();
        let value = psnr(&frame.rgb, &view.image);
        let covered = |i: usize| frame.alpha.data[i] > 0.9;
        let share =
            (0..view.image.data.len()).filter(|&i| covered(i)).count() as f64 / view.image.data.len() as f64;
        println!(
            "{}: {value:.2} dB, {:.2} dB on the {:.1} % that is opaque",
            view.camera.name,
            psnr_masked(&frame.rgb, &view.image, covered),
            100.0 * share
        );
        if let Some(folder) = std::env::var_os("RENDERS") {
            let pixels: Vec<u8> =
                frame.rgb.data.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0) as u8).collect();
            let path = Path::new(&folder).join(format!("{}.png", view.camera.name));
            image::save_buffer(path, &pixels, view.camera.width, view.camera.height, image::ColorType::Rgb8)
                .unwrap();
        }
        sum += value;
        structure += ssim(&frame.rgb, &view.image);
    }
    println!(
        "RESULT train {:.2} dB, held out {:.2} dB, SSIM {:.4}, splats {:?}, {:.0} s",
        trained.stats.mean_psnr(),
        sum / test.len() as f64,
        structure / test.len() as f64,
        trained.stats.splats,
        trained.stats.seconds
    );
}

/// Six times the light of the 8-bit photos: nearly white areas are far above 1 here. The trained
/// scene must reproduce it, also from a file.
#[test]
fn fit_learns_light_above_one() {
    let mut train = load("train", 8);
    for view in &mut train {
        view.image.data.iter_mut().flatten().for_each(|v| *v = to_srgb(6.0 * to_linear(*v)));
    }
    let device = gpu::open(None).unwrap();
    let images: Vec<RgbImage> = train.iter().map(|v| v.image.clone()).collect();
    let cameras: Vec<Camera> = train.iter().map(|v| v.camera.clone()).collect();
    let options = RgbOptions { poses: None, ..RgbOptions::preset(Preset::Draft).with_iterations(120) };
    let trained =
        fit::train_rgb(&device, &images, &cameras, &points(&train), None, &options, &Print).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bright.ply");
    ply::write_splats(&file, &trained.splats, ply::PlyOptions::default()).unwrap();
    let splats = ply::read_splats(&file).unwrap();
    let frame = Renderer::new(&device, &splats, &[], 0).unwrap().render(&cameras[0]).unwrap();
    let bright: Vec<(f32, f32)> = (0..images[0].data.len())
        .map(|i| (to_linear(frame.rgb.data[i][1]), to_linear(images[0].data[i][1])))
        .filter(|(_, target)| *target > 2.5)
        .collect();
    let mut ratio: Vec<f32> = bright.iter().map(|(shown, target)| shown / target).collect();
    ratio.sort_by(f32::total_cmp);
    println!("{} bright pixels, median ratio {:?}", ratio.len(), ratio.get(ratio.len() / 2));
    assert!(ratio.len() > 100, "{} bright pixels", ratio.len());
    // Edges between bright and dark are blurred in 120 steps; most of the bright area is not.
    assert!((ratio[ratio.len() / 2] - 1.0).abs() < 0.1, "{}", ratio[ratio.len() / 2]);
    assert!(bright.iter().any(|(shown, _)| *shown > 2.5));
}
