//! Running a plan: photos → cameras, depth and points → splats → language → scene directory.
use super::base::BaseScene;
use super::config::ReconstructionConfig;
use super::graph::{self, ScenePlan};
use super::networks::Networks;
use super::outcome::{LanguageOutcome, RunOutcome};
use super::plan::{Extras, Inputs, RunPlan};
use super::preview::Preview;
use super::remaining::{WithRemaining, Work};
use super::sources::{self, GraphBuilder};
use super::stages::{CameraOrigin, GivenViews, PlacedPhotos};
use super::view::Viewer;
use super::{ignored, label, photos, points, summary};
use crate::format::scene_dir::{self, Contents};
use crate::format::{Workspace, cameras, edits};
use crate::gpu::Device;
use crate::infer::{Registry, home};
use crate::photo::{self, Photo};
use crate::pipeline::{self, Store};
use crate::progress::{Progress, Recorded};
use crate::scene::{LanguageField, Seen, World};
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Runs the plan and writes the scene directory, whole or not at all.
pub fn run(plan: &RunPlan, progress: &dyn Progress) -> Result<RunOutcome> {
    if let Some(splats) = &plan.inputs.splats {
        return label::run(plan, splats, progress);
    }
    let remaining = WithRemaining::new(progress);
    let progress = &Recorded::new(&remaining);
    plan.inputs.check()?;
    let base = plan.inputs.add.as_deref().map(BaseScene::open).transpose()?.map(Arc::new);
    if let Some(scene) = plan.inputs.add.as_ref().filter(|scene| scene.join(edits::FILE).exists()) {
        progress.warn(&format!("{}: its edits stay there, the new scene has none", scene.display()));
    }
    let registry = plan.machine.registry()?;
    if let Some(language) = &plan.config.language {
        sources::check_texts(&language.features, &plan.inputs.queries, &registry)?;
    }
    let read: Vec<&Path> = plan.read().collect();
    let workspace = Workspace::create(&plan.output.out, plan.output.force, &read)?;
    let known = photos::camera_file(plan).map(cameras::read_file).transpose()?;
    if known.is_none() && plan.inputs.points.is_some() {
        return Err(Error::input("points are in the frame of given cameras; give --init cameras:FILE"));
    }
    let cloud = plan.inputs.points.as_deref().map(|file| points::read(file, progress)).transpose()?;
    // The device comes before the photos: it limits their size. While it opens, ONNX Runtime is
    // loaded and the program is read for the keys of the stages, which the graph needs.
    let device = std::thread::scope(|scope| {
        scope.spawn(|| {
            pipeline::program();
            // The graph reports an error where it needs networks.
            registry.compute().name().ok()
        });
        plan.machine.open(plan.config.training.deterministic, progress)
    })?;
    let max_size = plan.config.training.max_size.unwrap_or(photo::default_max_size(device.info().is_cpu));
    let (mut photos, choice) = match &base {
        Some(base) => (photos::joining(plan, base, &device, max_size, progress)?, None),
        None => photos::load(plan, known.as_ref(), &device, max_size, progress)?,
    };
    let origin = match (known, cloud) {
        (Some(known), Some(cloud)) => {
            Some(CameraOrigin::GivenGeometry(points::geometry(&mut photos, &known, cloud, progress)?))
        }
        (known, _) => known.map(CameraOrigin::Known),
    };
    let store = store(plan.output.resume, plan.output.checkpoint_seconds)?;
    let queries = &plan.inputs.queries;
    let reconstruction = Reconstruction {
        config: &plan.config,
        queries,
        start: base.map_or(Start::Photos(origin.map(Box::new)), Start::Scene),
        remaining: &remaining,
        preview: Some(Preview::of(&workspace, &plan.output.out)),
    };
    let made = reconstruction.run(&device, &registry, photos, &store, progress)?;
    let outcome = RunOutcome { choice, plan: plan.clone(), ..made };
    write(workspace, &outcome, progress)?;
    Ok(outcome)
}

/// Reconstructs without files, for programs that hold photos, device and models themselves.
pub fn reconstruct(
    config: &ReconstructionConfig,
    extras: &Extras,
    device: &Device,
    registry: &Registry,
    mut photos: Vec<Photo>,
    progress: &dyn Progress,
) -> Result<RunOutcome> {
    photo::check_set(&photos)?;
    let remaining = WithRemaining::new(progress);
    let progress = &Recorded::new(&remaining);
    photo::cut_bars(&mut photos, progress);
    let sizes: Vec<_> = photos.iter().map(|p| (p.image.width, p.image.height)).collect();
    config.check_budget(device, &sizes, usize::MAX)?;
    let paths = photos.iter().map(|p| p.path.clone()).collect();
    let given = (!extras.cameras.is_empty()).then(|| CameraOrigin::Known(extras.cameras.clone().into()));
    let reconstruction = Reconstruction {
        config,
        queries: &extras.queries,
        start: Start::Photos(given.map(Box::new)),
        remaining: &remaining,
        preview: None,
    };
    let made = reconstruction.run(device, registry, photos, &Store::none(), progress)?;
    let inputs = Inputs { photos: paths, queries: extras.queries.clone(), ..Inputs::default() };
    Ok(RunOutcome { plan: RunPlan { inputs, config: config.clone(), ..RunPlan::default() }, ..made })
}

/// Writes the outcome of [`reconstruct`] as a scene directory, whole or not at all; `force`
/// replaces a scene.
pub fn save(outcome: &mut RunOutcome, out: &Path, force: bool, progress: &dyn Progress) -> Result<()> {
    let workspace = Workspace::create(out, force, &[])?;
    outcome.plan.output.out = out.to_path_buf();
    write(workspace, outcome, progress)
}

/// Begin of a reconstruction.
pub(super) enum Start {
    /// Photos, with given cameras or geometry instead of the source of the configuration.
    Photos(Option<Box<CameraOrigin>>),
    /// A scene that photos join.
    Scene(Arc<BaseScene>),
    /// Splats that get language.
    Splats(Box<GivenViews>),
}

/// A reconstruction whose photos are read.
pub(super) struct Reconstruction<'a> {
    pub(super) config: &'a ReconstructionConfig,
    pub(super) queries: &'a [String],
    pub(super) start: Start,
    pub(super) remaining: &'a WithRemaining<'a>,
    pub(super) preview: Option<Preview>,
}

impl Reconstruction<'_> {
    pub(super) fn run(
        self,
        device: &Device,
        registry: &Registry,
        mut photos: Vec<Photo>,
        store: &Store,
        progress: &Recorded,
    ) -> Result<RunOutcome> {
        let Reconstruction { config, queries, start, remaining, preview } = self;
        // Everything that can be refused is read before the long stages.
        config.check()?;
        // Given cameras and points need no network.
        let given = matches!(&start, Start::Photos(Some(origin)) if matches!(**origin, CameraOrigin::GivenGeometry(_)));
        let needs_networks = config.language.is_some() || !given || !config.training.ignore.is_empty();
        if needs_networks {
            registry.compute().report(progress)?;
        }
        let networks = Networks::find(config, registry)?;
        networks.warn_untrained(progress);
        if needs_networks {
            graph::check(config, &photos, registry)?;
        }
        let ignored = ignored::apply(config, &mut photos, device, registry, store, progress)?;
        let preset = config.preset_on(device);
        let training = config.rgb_options(preset, device, photos.len());
        remaining.plan(&Work {
            on_cpu: device.info().is_cpu,
            photos: photos.len(),
            fine: photos.iter().filter(|p| p.fine.is_some()).count(),
            pixels: photos.iter().map(|p| p.image.width * p.image.height).sum(),
            steps: training.iterations,
            language: config.language.is_some(),
            built_in: networks.is_empty(),
        });
        let build = GraphBuilder::new(config, preset, registry);
        let mut plan = ScenePlan { build, config, queries, device, preview };
        let (mut base, mut full_colour) = (None, None);
        let scene = match start {
            Start::Photos(origin) => plan.scene(photos, origin.map(|origin| *origin))?,
            Start::Scene(scene) => plan.added(base.insert(scene), photos)?,
            Start::Splats(mut views) => {
                full_colour = Some((std::mem::take(&mut views.frames), views.shows_photos));
                plan.labelled(*views)?
            }
        };
        let mut made = plan.build.graph.run(&scene.targets(), device, registry, store, progress)?;
        if needs_networks {
            registry.compute().report(progress)?;
        }
        let trained = made.take(scene.trained)?;
        let PlacedPhotos { photos, left_out, .. } = made.take(scene.placed)?;
        let (splats, mut frames, language) = match scene.language {
            Some(outputs) => {
                let language = made.take(outputs.language)?;
                let outcome = LanguageOutcome {
                    field: language.field,
                    alignment: made.take(outputs.aligned)?.alignment,
                    curve: language.curve,
                    answers: made.take(outputs.answers)?,
                    names: made.take(outputs.names)?,
                };
                (language.splats, made.take(outputs.frames)?, Some(outcome))
            }
            None => {
                let mut viewer = Viewer::new(device, &trained.splats, &LanguageField::default())?;
                let frames = trained.cameras.iter().map(|c| viewer.view(c)).collect::<Result<_>>()?;
                (trained.splats, frames, None)
            }
        };
        let (mut shows_photos, is_trained) = (true, full_colour.is_none());
        if let Some((full, are_photos)) = full_colour {
            frames.iter_mut().zip(full).for_each(|(frame, full)| frame.rendered = full);
            shows_photos = are_photos;
        }
        let psnr = if shows_photos { super::fidelity::psnr(&frames, &photos) } else { Vec::new() };
        super::fidelity::warn(&photos, &psnr, progress);
        let mut geometry = made.take(scene.geometry)?;
        if let Some(base) = &base {
            let new = std::mem::replace(&mut geometry.points, base.points.clone());
            geometry.points.append(new);
        }
        let seen = match is_trained {
            true => super::view::seen(device, &splats, &trained.cameras, progress)?,
            // Those that the views do not show may be anything but guesses of this program.
            false => Seen::default(),
        };
        Ok(RunOutcome {
            plan: RunPlan::default(),
            preset,
            device: device.info().clone(),
            choice: None,
            photos,
            ignored,
            left_out,
            geometry,
            known: base.as_ref().map_or(0, |b| b.known.photos.len()),
            cameras: trained.cameras,
            world: World {
                up: made.take(scene.up)?,
                scale: base.as_ref().and_then(|b| b.world.scale.clone()),
            },
            splats,
            seen,
            backdrop: trained.backdrop,
            rgb: trained.stats,
            psnr,
            frames,
            language,
            provider: registry.compute().name().ok(),
            models: if config.language.is_some() { registry.status() } else { Vec::new() },
            networks: networks.used()?,
            stages: progress.stages(),
            seconds: progress.seconds(),
            warnings: progress.warnings(),
        })
    }
}

/// Stage outputs on disk.
pub(super) fn store(resume: bool, checkpoint_seconds: u64) -> Result<Store> {
    match stage_folder() {
        Ok(folder) => Ok(Store::at(folder, resume, Duration::from_secs(checkpoint_seconds))),
        Err(e) if resume => Err(e),
        Err(_) => Ok(Store::none()),
    }
}

/// Folder where runs keep outputs of their stages.
pub fn stage_folder() -> Result<PathBuf> {
    Ok(home()?.join("stages"))
}

pub(super) fn write(workspace: Workspace, outcome: &RunOutcome, progress: &dyn Progress) -> Result<()> {
    progress.begin("write", 2);
    progress.check()?;
    let language = outcome.plan.config.language.as_ref();
    let table = language.and_then(|l| sources::text_table(&l.features));
    let contents = Contents {
        splats: &outcome.splats,
        seen: &outcome.seen,
        backdrop: &outcome.backdrop,
        holes: &Default::default(),
        cameras: &outcome.cameras,
        world: &outcome.world,
        photos: &outcome.photos,
        points: Some(&outcome.geometry.points),
        language: outcome.language.as_ref().map(|l| &l.field),
        text_embeddings: table.as_deref(),
    };
    let (scene, report) = rayon::join(
        || {
            let written = scene_dir::write(workspace.path(), &contents);
            progress.step(1, "report");
            written
        },
        || summary::write(workspace.path(), outcome),
    );
    scene.and(report)?;
    progress.check()?;
    workspace.commit()?;
    progress.end();
    Ok(())
}
