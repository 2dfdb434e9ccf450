//! Running a plan: photos → cameras, depth and points → splats → language → scene directory.
use super::base::BaseScene;
use super::list;
use super::networks::Networks;
use super::outcome::RunOutcome;
use super::plan::RunPlan;
use super::record;
use super::sources::{self, GraphBuilder};
use super::stages::PlacedPhotos;
use crate::format::scene_dir::{self, Contents};
use crate::format::{Workspace, cameras};
use crate::gpu::{self, Device};
use crate::infer::{Registry, home};
use crate::photo::{self, Candidate, MaskChoice, Photo};
use crate::pipeline::{Graph, Store};
use crate::pose;
use crate::progress::{Progress, Recorded};
use crate::scene::World;
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Runs the plan and writes the scene directory, whole or not at all.
pub fn run(plan: &RunPlan, progress: &dyn Progress) -> Result<RunOutcome> {
    let progress = &Recorded::new(progress);
    let base = plan.add.as_deref().map(BaseScene::open).transpose()?.map(Arc::new);
    let registry = plan.registry()?;
    sources::check_texts(&plan.features, &plan.queries, &registry)?;
    let inputs: Vec<&Path> = plan.read().collect();
    let workspace = Workspace::create(&plan.out, plan.force, &inputs)?;
    // The device comes first: it says how large the photos may be.
    let device = Device::open(&gpu::Options {
        deterministic: plan.deterministic,
        ..gpu::options(plan.device.as_deref())
    })?;
    let max_size = plan.max_size.unwrap_or(photo::default_max_size(device.info().is_cpu));
    let (photos, choice) = match &base {
        Some(base) => (joining(plan, base, &device, max_size, progress)?, None),
        None => {
            let (mut chosen, choice) = pose::choose::photos(&plan.inputs, plan.views, progress)?;
            photo::assign_masks(&mut chosen, &masks(plan)?, progress)?;
            plan.check_budget(&device, &photo::sizes_of(&chosen), max_size)?;
            (photo::load_each(&chosen, max_size, progress)?, choice)
        }
    };
    let store = store(plan.resume, plan.checkpoint_seconds)?;
    let made = work(plan, &device, &registry, base.as_ref(), photos, &store, progress)?;
    let outcome = RunOutcome { choice, ..made };
    write(workspace, &outcome, progress)?;
    Ok(outcome)
}

/// The run without its files, for programs that hold photos, device and models themselves. Of the
/// plan, everything about inputs, output, device and models goes unread.
pub fn reconstruct(
    plan: &RunPlan,
    device: &Device,
    registry: &Registry,
    mut photos: Vec<Photo>,
    progress: &dyn Progress,
) -> Result<RunOutcome> {
    photo::check_set(&photos)?;
    let progress = &Recorded::new(progress);
    photo::cut_bars(&mut photos, progress);
    let sizes: Vec<_> = photos.iter().map(|p| (p.image.width, p.image.height)).collect();
    plan.check_budget(device, &sizes, usize::MAX)?;
    work(plan, device, registry, None, photos, &Store::none(), progress)
}

/// Writes what [`reconstruct`] made as a scene directory, whole or not at all; `force` replaces a
/// scene.
pub fn save(outcome: &mut RunOutcome, out: &Path, force: bool, progress: &dyn Progress) -> Result<()> {
    let workspace = Workspace::create(out, force, &[])?;
    outcome.plan.out = out.to_path_buf();
    write(workspace, outcome, progress)
}

/// Where the masks of the photos come from.
fn masks(plan: &RunPlan) -> Result<MaskChoice> {
    let cameras = plan.init.argument.as_deref().filter(|_| plan.init.name == "cameras");
    cameras::masks(plan.photo_masks.as_deref(), cameras.map(Path::new))
}

/// The photos that join a scene, all that were named.
fn joining(
    plan: &RunPlan,
    base: &BaseScene,
    device: &Device,
    max_size: usize,
    progress: &dyn Progress,
) -> Result<Vec<Photo>> {
    let found = photo::find(&plan.inputs)?;
    if let Some(video) = found.videos.first() {
        return Err(Error::input(format!(
            "{}: a video; --add takes photos, for a video make a scene of its own",
            video.display()
        )));
    }
    found.warnings().iter().for_each(|w| progress.warn(w));
    found.photos.iter().try_for_each(|p| photo::check_name(p))?;
    let mut files: Vec<Candidate> = found.photos.iter().map(|p| Candidate::file(p)).collect();
    photo::assign_masks(&mut files, &masks(plan)?, progress)?;
    // As large as those of the scene, where nothing else is asked for: finer ones would be shown no
    // better.
    let sides = base.known.photos.iter().map(|p| p.image.width.max(p.image.height));
    let max_size = plan.max_size.or(sides.max()).unwrap_or(max_size);
    let sizes = base.known.photos.iter().map(|p| (p.image.width, p.image.height));
    let sizes: Vec<_> = sizes.chain(photo::sizes_of(&files)).collect();
    plan.check_budget(device, &sizes, max_size)?;
    progress.begin("photos", files.len() as u64);
    let mut photos = Vec::with_capacity(files.len());
    for file in &files {
        progress.check()?;
        photos.push(file.load(max_size, progress)?);
        progress.step(photos.len() as u64, "");
    }
    progress.end();
    photo::cut_bars(&mut photos, progress);
    let mut photos = base.without_its_own(photos, progress)?;
    photo::settle(&mut photos, &base.known.photos, progress);
    base.check(&photos)?;
    Ok(photos)
}

fn work(
    plan: &RunPlan,
    device: &Device,
    registry: &Registry,
    base: Option<&Arc<BaseScene>>,
    photos: Vec<Photo>,
    store: &Store,
    progress: &Recorded,
) -> Result<RunOutcome> {
    // Whatever can be refused is read before the long work, not after it.
    registry.compute().report(progress)?;
    let networks = Networks::of(plan, registry)?;
    networks.warn_untrained(progress);
    list::check(plan, &photos, registry)?;
    let preset = plan.preset_on(device);
    let mut build = GraphBuilder {
        graph: Graph::default(),
        registry: registry.clone(),
        sam: plan.sam,
        given_features: plan.features.argument.is_some(),
        depth_prior: plan.depth_prior.clone(),
        preset,
        seed: plan.seed,
    };
    let scene = match base {
        Some(base) => list::added(&mut build, plan, device, base, photos)?,
        None => list::scene(&mut build, plan, device, photos)?,
    };
    let mut made = build.graph.run(&scene.targets(), device, registry, store, progress)?;
    registry.compute().report(progress)?;
    let (trained, language) = (made.take(scene.trained)?, made.take(scene.language)?);
    let PlacedPhotos { photos, left_out, .. } = made.take(scene.placed)?;
    let frames = made.take(scene.frames)?;
    let psnr = super::fidelity::psnr(&frames, &photos);
    super::fidelity::warn(&photos, &psnr, progress);
    let mut geometry = made.take(scene.geometry)?;
    if let Some(base) = base {
        let new = std::mem::replace(&mut geometry.points, base.points.clone());
        geometry.points.append(new);
    }
    let seen = super::view::seen(device, &language.splats, &trained.cameras, progress)?;
    Ok(RunOutcome {
        plan: plan.clone(),
        preset,
        device: device.info().clone(),
        choice: None,
        photos,
        left_out,
        geometry,
        known: base.map_or(0, |b| b.known.photos.len()),
        cameras: trained.cameras,
        world: World { up: made.take(scene.up)?, scale: base.and_then(|b| b.world.scale.clone()) },
        splats: language.splats,
        seen,
        rgb: trained.stats,
        psnr,
        field: language.field,
        alignment: made.take(scene.aligned)?.alignment,
        language_curve: language.curve,
        frames,
        answers: made.take(scene.answers)?,
        names: made.take(scene.names)?,
        provider: registry.compute().name().ok(),
        models: registry.status(),
        networks: networks.used()?,
        stages: progress.stages(),
        seconds: progress.seconds(),
        warnings: progress.warnings(),
    })
}

/// What stages made, on disk.
pub(super) fn store(resume: bool, checkpoint_seconds: u64) -> Result<Store> {
    match stage_folder() {
        Ok(folder) => Ok(Store::at(folder, resume, Duration::from_secs(checkpoint_seconds))),
        Err(e) if resume => Err(e),
        Err(_) => Ok(Store::none()),
    }
}

/// Where runs keep what their stages made.
pub fn stage_folder() -> Result<PathBuf> {
    Ok(home()?.join("stages"))
}

fn write(workspace: Workspace, outcome: &RunOutcome, progress: &dyn Progress) -> Result<()> {
    progress.begin("write", 2);
    progress.check()?;
    let table = sources::text_table(&outcome.plan.features);
    let contents = Contents {
        splats: &outcome.splats,
        seen: &outcome.seen,
        cameras: &outcome.cameras,
        world: &outcome.world,
        photos: &outcome.photos,
        points: Some(&outcome.geometry.points),
        language: Some(&outcome.field),
        text_embeddings: table.as_deref(),
    };
    scene_dir::write(workspace.path(), &contents)?;
    progress.step(1, "");
    record::write(workspace.path(), outcome)?;
    progress.check()?;
    workspace.commit()?;
    progress.end();
    Ok(())
}
