//! Language for splats of any program (`splatvk label`): their views go through the stages of a run
//! that follow the training of colours, and closed-form lifting carries the codes onto the splats.
//! No number of a splat changes.
mod coverage;
mod space;
mod synthesize;
mod views;

use super::config::{GeometryConfig, LanguageConfig, ReconstructionConfig, TrainingConfig};
use super::execute::{Reconstruction, Start, store, write};
use super::outcome::RunOutcome;
use super::plan::RunPlan;
use super::remaining::WithRemaining;
use super::sources::{self, SourceChoice};
use super::stages::GivenViews;
use crate::format::scene_dir::{self, Scene};
use crate::format::{Workspace, edits};
use crate::pass::renderer::{RenderedFrame, Renderer};
use crate::photo::{self, Photo};
use crate::pipeline::Store;
use crate::pose::Geometry;
use crate::progress::{Progress, Recorded};
use crate::scene::{Camera, DepthMap, PointCloud, World};
use crate::{Error, Result, files};
use glam::DVec2;
use std::path::{Path, PathBuf};
use views::{ViewSource, Views};

/// Configuration of a run that gives splats language; `cameras` is a file of cameras in their
/// coordinates.
pub fn config(
    cameras: Option<PathBuf>,
    max_size: Option<usize>,
    language: LanguageConfig,
) -> ReconstructionConfig {
    let init = cameras.map(|file| SourceChoice::with("cameras", file));
    ReconstructionConfig {
        geometry: GeometryConfig {
            init: init.unwrap_or_else(|| SourceChoice::named("sfm")),
            depth_prior: SourceChoice::named("none"),
        },
        training: TrainingConfig { max_size, ..TrainingConfig::default() },
        language: Some(language),
    }
}

/// Gives the splats of `plan.inputs.splats` language and writes a scene directory, whole or not at
/// all; a plan without a place for it keeps the scene in memory.
pub(super) fn run(plan: &RunPlan, path: &Path, progress: &dyn Progress) -> Result<RunOutcome> {
    let remaining = WithRemaining::new(progress);
    let progress = &Recorded::new(&remaining);
    plan.inputs.check()?;
    let registry = plan.machine.registry()?;
    if let Some(language) = &plan.config.language {
        sources::check_texts(&language.features, &plan.inputs.queries, &registry)?;
    }
    let scene = scene_dir::load(path)?;
    scene.warnings.iter().for_each(|note| progress.warn(note));
    if scene.splats.is_empty() {
        return Err(Error::input(format!("{}: no splats; there is nothing to label", path.display())));
    }
    let source = ViewSource::of(plan, &scene)?;
    let read: Vec<&Path> = plan.read().collect();
    let output = &plan.output;
    let workspace = match output.out.as_os_str().is_empty() {
        true => None,
        false => Some(Workspace::create(&output.out, output.force, &read)?),
    };
    let device = plan.machine.open(plan.config.training.deterministic, progress)?;
    let max_size = plan.config.training.max_size.unwrap_or(photo::default_max_size(device.info().is_cpu));
    let mut renderer = Renderer::new(&device, &scene.splats, &[], 0)?;
    let Views { photos, cameras, frames } =
        Views::new(&source, plan, &scene, &mut renderer, max_size, progress)?;
    drop(renderer);

    let geometry = geometry(&cameras, &frames, &photos, source.method());
    let views = GivenViews {
        identity: identity(path)?,
        up: scene.world.up.clone(),
        shows_photos: source.shows_photos(),
        // Colours take most of the memory, and only renders need them.
        splats: scene.splats.bare(),
        frames,
        photos,
        geometry,
    };
    let reconstruction = Reconstruction {
        config: &plan.config,
        queries: &plan.inputs.queries,
        start: Start::Splats(Box::new(views)),
        remaining: &remaining,
        preview: None,
    };
    let store = match workspace {
        Some(_) => store(output.resume, output.checkpoint_seconds)?,
        None => Store::none(),
    };
    let made = reconstruction.run(&device, &registry, Vec::new(), &store, progress)?;
    let outcome = finished(made, scene, plan);
    if let Some(workspace) = workspace {
        write(workspace, &outcome, progress)?;
    }
    Ok(outcome)
}

/// The outcome with the given splats in their full colours.
fn finished(mut made: RunOutcome, scene: Scene, plan: &RunPlan) -> RunOutcome {
    let Scene { splats, seen, backdrop, world, .. } = scene;
    let count = splats.len();
    let up = world.up.or(made.world.up.take());
    RunOutcome {
        plan: plan.clone(),
        world: World { up, scale: world.scale },
        rgb: crate::fit::FitStats { splats: [count; 2], ..Default::default() },
        splats,
        seen,
        backdrop,
        ..made
    }
}

/// Pixels between points that are taken from a depth map.
const POINT_STEP: usize = 6;

/// Cameras, rendered depth and points of the views.
fn geometry(cameras: &[Camera], frames: &[RenderedFrame], photos: &[Photo], method: &str) -> Geometry {
    let mut points = PointCloud::default();
    let mut depths = Vec::with_capacity(frames.len());
    for (view, ((camera, frame), photo)) in cameras.iter().zip(frames).zip(photos).enumerate() {
        let mut depth = DepthMap::rendered(frame.depth.clone());
        depth.keep(|i| photo.uses(i));
        add_points(&mut points, view, camera, &depth, photo);
        depths.push(depth);
    }
    Geometry { cameras: cameras.to_vec(), depths, points, method: method.to_owned(), ..Geometry::default() }
}

/// Appends the points of every [`POINT_STEP`]th pixel with depth.
fn add_points(points: &mut PointCloud, view: usize, camera: &Camera, depth: &DepthMap, photo: &Photo) {
    let (width, height) = (depth.depth.width, depth.depth.height);
    let inverse = camera.pose.inverse();
    for y in (0..height).step_by(POINT_STEP) {
        for x in (0..width).step_by(POINT_STEP) {
            let z = depth.depth.data[y * width + x];
            if z <= 0.0 {
                continue;
            }
            let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let point = inverse.transform(camera.ray(pixel) * f64::from(z));
            points.positions.push(point.as_vec3().to_array());
            points.colours.push(photo.image.at(x, y));
            points.confidence.push(depth.confidence.data[y * width + x]);
            points.view.push(view as u32);
            points.radius.push(z / camera.fx as f32);
        }
    }
}

/// Checksum of the splats.
fn identity(path: &Path) -> Result<String> {
    let sum = |file: &Path| files::content_hash(file).map_err(Error::io(file));
    if !path.is_dir() {
        return sum(path);
    }
    let edits = path.join(edits::FILE);
    let edits = if edits.exists() { sum(&edits)? } else { String::new() };
    Ok(sum(&path.join("point_cloud.ply"))? + " " + &edits)
}
