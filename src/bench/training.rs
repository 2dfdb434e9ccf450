//! Benchmark of the training step: passes by timestamps on the device, the whole step by wall
//! clock.
use super::measure::{Budget, Quartiles};
use super::model::{PassWork, Roofline};
use super::report::{COLOUR, Clock, STEP, SUM, Section};
use super::workload::Workload;
use crate::Result;
use crate::fit::options::Rates;
use crate::fit::scale::SceneScale;
use crate::fit::{LanguageOptions, LanguageRun, Photos, Preset, RgbOptions, RgbRun, Start, Training};
use crate::gpu::{Device, Recorder};
use crate::pass::pairs;
use crate::pass::renderer::Renderer;
use crate::scene::seeded;
use crate::scene::{Codebook, Image, LevelField, RgbImage};

/// Codes per level of the synthetic feature targets; a scene of four photos has about as many.
const CODES: usize = 32;
/// A step far beyond the end of the schedules.
const ITERATION: usize = 1_000_000;

/// Measures the step of the colour stage: forward, L1 + SSIM, regularisers, backward, Adam.
pub fn colour(device: &Device, workload: &Workload, limits: (&Budget, &Roofline)) -> Result<Section> {
    device.reset_peak_memory();
    let target = [workload.target(device)?];
    let cameras = [workload.camera.clone()];
    let options = RgbOptions {
        rates: Rates::STILL,
        poses: None,
        virtual_views: 0,
        ..RgbOptions::preset(Preset::Default)
    };
    let scale = SceneScale::measure(&cameras, &workload.splats.means);
    let photos = Photos { images: &target, cameras: &cameras, depths: None, coverage: &[] };
    let mut run = RgbRun::new(device, photos, &workload.splats, scale, &options)?;
    let mut section = Section::new(COLOUR, workload.describe(0));
    measure(device, &mut run, limits, &mut section)?;
    let mut renderer = Renderer::new(device, &workload.splats, &[], 0)?;
    let render = limits.0.wall(|| renderer.render(&workload.camera).map(drop))?;
    section.time("render to the host", Clock::Wall, render);
    Ok(section)
}

/// Measures the step of the language stage with `features` channels: the same image loss, and L1 to
/// the codes of labelled pixels.
pub fn with_features(
    device: &Device,
    workload: &Workload,
    features: usize,
    limits: (&Budget, &Roofline),
) -> Result<Section> {
    device.reset_peak_memory();
    let target = [workload.target(device)?];
    let cameras = [workload.camera.clone()];
    let levels = features.div_ceil(16);
    let fields: Vec<LevelField> =
        (0..levels).map(|l| level(&target[0], features / levels, l as u64)).collect();
    let fields: Vec<(usize, &LevelField)> = fields.iter().enumerate().collect();
    let options = LanguageOptions {
        rates: Rates::STILL,
        feature_rate: 0.0,
        start: Start::Zero,
        check_every: 0,
        ..LanguageOptions::preset(Preset::Default)
    };
    let mut run = LanguageRun::new(
        device,
        Photos { images: &target, cameras: &cameras, depths: None, coverage: &[] },
        &workload.splats,
        &fields,
        &options,
        &crate::progress::Silent,
    )?;
    run.set_features(&seeded::features(workload.splats.len(), features, 0))?;
    let mut section = Section::new(format!("{COLOUR}, {features} features"), workload.describe(features));
    measure(device, &mut run, limits, &mut section)?;
    Ok(section)
}

/// Random codes, with labels in blocks of pixels.
fn level(image: &RgbImage, width: usize, seed: u64) -> LevelField {
    let mut codes = seeded::features(CODES, width, seed);
    for code in codes.chunks_exact_mut(width) {
        let norm = code.iter().map(|v| v * v).sum::<f32>().sqrt();
        code.iter_mut().for_each(|v| *v /= norm);
    }
    let block = |i: usize| ((i % image.width / 32 + 7 * (i / image.width / 32)) % CODES) as i32;
    let data = (0..image.data.len()).map(block).collect();
    LevelField {
        codebook: Codebook {
            embedding_dim: 1,
            code_dim: width,
            embeddings: vec![1.0; CODES],
            codes,
            ..Codebook::default()
        },
        targets: vec![Image { width: image.width, height: image.height, data }],
        ..LevelField::default()
    }
}

fn measure(
    device: &Device,
    run: &mut impl Training,
    limits: (&Budget, &Roofline),
    section: &mut Section,
) -> Result<()> {
    let (budget, roofline) = limits;
    // Grows the tile lists to the size of the scene before the first recording.
    run.step(ITERATION)?;
    run.finish_step()?;
    let sums = section.passes(device, &|| run.record(0), budget)?;
    let processor = section.rows.iter().map(|r| r.ms.processor).sum();
    section.time(SUM, Clock::Device, Quartiles { processor, ..Quartiles::of(&sums) });
    let before = device.memory().allocations;
    let mut steps = 0usize;
    let step = budget.wall(|| {
        steps += 1;
        run.step(ITERATION)
    })?;
    run.finish_step()?;
    // Without the gradients that the separate passes below write.
    let peak = device.memory().peak as f64 / f64::from(1 << 20);
    let allocations = (device.memory().allocations - before) as f64 / steps as f64;
    measure_forward_backward(device, run, budget, section)?;
    section.time(STEP, Clock::Wall, step);
    add_figures(device, run, roofline, section)?;
    section.figure("peak device memory", peak, "MiB");
    section.figure("allocations per step", allocations, "");
    Ok(())
}

/// Measures forward, and forward with backward, as separate programs.
fn measure_forward_backward(
    device: &Device,
    run: &impl Training,
    budget: &Budget,
    section: &mut Section,
) -> Result<()> {
    let p = run.trainer().step_resources();
    let gradients = p.params.zeros_like(device)?;
    for (name, backward) in [("forward", false), ("forward + backward", true)] {
        let mut rec = Recorder::new(device, name);
        p.raster.record_forward(&mut rec, p.params, p.options);
        if backward {
            p.raster.record_backward(&mut rec, p.params, p.options, &gradients);
        }
        let program = rec.compile()?;
        section.time(name, Clock::Wall, budget.wall(|| Ok(program.run()?))?);
    }
    Ok(())
}

/// Adds counts of the work of a step, and its least time.
fn add_figures(
    device: &Device,
    run: &impl Training,
    roofline: &Roofline,
    section: &mut Section,
) -> Result<()> {
    let p = run.trainer().step_resources();
    let frame = p.raster.frame();
    let intersections = f64::from(frame.status.read()?[0]);
    let pairs = pairs::count(device, p.raster)?;
    let seconds = section.row(STEP).map_or(f64::NAN, |r| r.ms.median / 1e3);
    let pixels = f64::from(frame.width) * f64::from(frame.height);
    let work = PassWork {
        splats: p.params.count as f64,
        sh: p.params.sh_len() as f64,
        features: p.params.feature_dim as f64,
        pixels,
        intersections,
        blended: pairs.blended,
        in_rows: pairs.in_rows,
        ..PassWork::default()
    };
    section.bound(&work, roofline);
    section.figure("intersections", intersections, "tile–splat pairs");
    section.figure("visible splats", pairs::visible(p.raster)? as f64, "");
    section.figure("pairs evaluated", pairs.evaluated, "pixel–splat pairs");
    section.figure("pairs blended", pairs.blended, "pixel–splat pairs");
    section.figure("evaluated / blended", pairs.evaluated / pairs.blended, "");
    section.figure("pairs in rows with a blended one", pairs.in_rows, "pixel–splat pairs");
    section.figure("blended per pixel", pairs.blended / pixels, "");
    section.figure("splats per second", work.splats / seconds / 1e6, "M/s");
    section.figure("intersections per second", intersections / seconds / 1e6, "M/s");
    Ok(())
}
