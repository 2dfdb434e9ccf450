//! Posed photos → scene without language: `splatvk train`.
use crate::fit::{Preset, RgbOptions, ViewDependentOptions};
use crate::format::scene_dir::{self, Contents};
use crate::format::{Workspace, cameras, colmap, ply};
use crate::gpu::{self, Device};
use crate::infer::{Compute, Registry};
use crate::photo::{self, Candidate, Photo};
use crate::pipeline::Graph;
use crate::pose::{self, Geometry};
use crate::progress::{Progress, Recorded};
use crate::report::{self, HtmlReport, RunRecord, ViewShown};
use crate::run::budget::{self, Limits, MemoryDemand};
use crate::run::stages::{self, CameraOrigin};
use crate::run::view::Viewer;
use crate::scene::{Camera, GivenCamera, LanguageField, PointCloud, RgbImage, World};
use crate::{Error, Result, files};
use serde_json::json;
use std::path::{Path, PathBuf};

/// What to do.
#[derive(Clone, Debug, serde::Serialize)]
pub struct TrainPlan {
    /// Folder of photos.
    pub images: PathBuf,
    /// Camera file or COLMAP model folder.
    pub cameras: PathBuf,
    /// How many photos with a camera are used; `None`: all, at most [`photo::MAX_VIEWS`].
    pub views: Option<usize>,
    /// Points to start from (`.ply`, a COLMAP model folder or a data set that holds one) instead of
    /// stereo.
    pub points: Option<PathBuf>,
    /// Scene directory.
    pub out: PathBuf,
    /// Folder of a mask per photo; `None` = one beside the photos, where there is any.
    pub photo_masks: Option<PathBuf>,
    /// Replace an existing scene.
    pub force: bool,
    /// Use the stages that an earlier training with the same photos and settings has finished.
    pub resume: bool,
    /// Seconds between states of training on disk.
    pub checkpoint_seconds: u64,
    /// `None` = draft on a CPU device, default elsewhere.
    pub preset: Option<Preset>,
    /// Steps instead of the preset's.
    pub iterations: Option<usize>,
    /// SH degree of the colours, 0–3; `None` = what the photos support, and 0 in the paper's
    /// preset.
    pub sh_degree: Option<u32>,
    /// Seed of everything random.
    pub seed: u64,
    /// Greatest side of the working images, pixels; `None` = [`photo::default_max_size`] of the
    /// device.
    pub max_size: Option<usize>,
    /// Vulkan device.
    pub device: Option<String>,
    /// The same bits on every run: see [`crate::gpu::Options`].
    pub deterministic: bool,
    /// Folder of the models.
    pub models: Option<PathBuf>,
    /// What computes the networks, one of [`crate::infer::provider::NAMES`]; `None` = see
    /// [`Compute::by`].
    pub provider: Option<String>,
}

/// Figures of a finished training.
#[non_exhaustive]
pub struct TrainOutcome {
    /// Content of run.json.
    pub record: RunRecord,
    /// Closing table for a terminal.
    pub table: String,
}

impl TrainPlan {
    /// The files and folders that the training reads.
    fn read(&self) -> impl Iterator<Item = &Path> {
        let given = [&self.points, &self.models, &self.photo_masks].into_iter().flatten();
        [self.images.as_path(), self.cameras.as_path()].into_iter().chain(given.map(PathBuf::as_path))
    }
}

/// Photos that have a camera, in name order, at most as many as are wanted; what is left out is
/// named in warnings.
fn matched(
    plan: &TrainPlan,
    known: &[GivenCamera],
    max_size: usize,
    work: impl Fn(usize) -> MemoryDemand,
    device: &Device,
    progress: &dyn Progress,
) -> Result<Vec<Photo>> {
    let mut files = with_cameras(plan, known, progress)?;
    let masks = cameras::masks(plan.photo_masks.as_deref(), Some(&plan.cameras))?;
    photo::assign_masks(&mut files, &masks, progress)?;
    let views = plan.views.unwrap_or(files.len().min(photo::MAX_VIEWS));
    let wanted = photo::photo_count(files.len(), Some(views))?;
    let files = match wanted == files.len() {
        true => files,
        false => {
            let (chosen, choice) = pose::choose::choose(&files, wanted, progress)?;
            progress.warn(&choice.message());
            chosen.into_iter().map(|i| files[i].clone()).collect()
        }
    };
    let limits = Limits::now(device.info());
    budget::check(&limits, &photo::sizes_of(&files), max_size, &work(files.len()))?;
    photo::load_each(&files, max_size, progress)
}

/// The photos of the folder, and of the folders below it that names of cameras lie in, that have a
/// camera.
fn with_cameras(plan: &TrainPlan, known: &[GivenCamera], progress: &dyn Progress) -> Result<Vec<Candidate>> {
    let names: Vec<&str> = known.iter().map(|c| c.camera.name.as_str()).collect();
    let found = photo::find_named(&plan.images, &names)?;
    found.warnings().iter().for_each(|w| progress.warn(w));
    let paths: Vec<String> = found.photos.iter().map(|p| p.to_string_lossy().into_owned()).collect();
    let place = |e: String| Error::input(format!("{}: {e}", plan.cameras.display()));
    let own = photo::join(&paths, &names).map_err(place)?;
    let (with, without): (Vec<_>, Vec<_>) = found.photos.iter().zip(own).partition(|(_, own)| own.is_some());
    let shown = |list: &[(&PathBuf, Option<usize>)]| {
        let names = list.iter().map(|(p, _)| p.strip_prefix(&plan.images).unwrap_or(p).display().to_string());
        files::listed(&names.collect::<Vec<_>>())
    };
    if with.len() < 2 {
        return Err(Error::input(format!(
            "{}: {} of {} photos have a camera in {}, at least 2 are needed; the photos are {}, the cameras {}",
            plan.images.display(),
            with.len(),
            found.photos.len(),
            plan.cameras.display(),
            shown(&found.photos.iter().map(|p| (p, None)).collect::<Vec<_>>()),
            files::listed(&names)
        )));
    }
    if !without.is_empty() {
        progress.warn(&format!(
            "{} photos have no camera and are left out: {}",
            without.len(),
            shown(&without)
        ));
    }
    let paths: Vec<String> = with.iter().map(|(p, _)| p.to_string_lossy().into_owned()).collect();
    let stems = photo::stems_apart(&paths);
    let files = with.iter().zip(&stems).map(|((path, _), stem)| Candidate::named(path, stem));
    Ok(files.collect())
}

fn points(path: &Path, progress: &dyn Progress) -> Result<PointCloud> {
    if path.is_dir() {
        return colmap::read_points(path);
    }
    let (points, notes) = ply::read_points(path)?;
    notes.iter().for_each(|note| progress.warn(note));
    Ok(points)
}

/// Gives points from a file the footprint that initialisation needs: `z / f` in the camera that
/// sees them nearest.
fn with_footprints(mut cloud: PointCloud, list: &[Camera], progress: &dyn Progress) -> Result<PointCloud> {
    let mut keep = PointCloud::default();
    // What is not finite would spread in training.
    let finite = |i: &usize| cloud.positions[*i].iter().chain(&cloud.colours[*i]).all(|v| v.is_finite());
    let bad = cloud.len() - (0..cloud.len()).filter(finite).count();
    if bad > 0 {
        progress.warn(&format!(
            "--points: {bad} of {} points are left out: they have numbers that are not finite",
            cloud.len()
        ));
    }
    for i in (0..cloud.len()).filter(finite) {
        let p = glam::Vec3::from_array(cloud.positions[i]).as_dvec3();
        let seen = list.iter().enumerate().filter_map(|(v, c)| {
            let (pixel, z) = c.project(p);
            let inside =
                pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < c.width as f64 && pixel.y < c.height as f64;
            (z > 0.0 && inside).then_some((v, (z / c.fx) as f32))
        });
        if let Some((view, radius)) = seen.min_by(|a, b| a.1.total_cmp(&b.1)) {
            keep.positions.push(cloud.positions[i]);
            keep.colours.push(cloud.colours[i]);
            keep.confidence.push(cloud.confidence[i]);
            keep.view.push(view as u8);
            keep.radius.push(radius);
        }
    }
    std::mem::swap(&mut cloud, &mut keep);
    if cloud.is_empty() {
        return Err(Error::input(
            "--points: no point with a colour is seen by any camera; are both in the same coordinates?",
        ));
    }
    Ok(cloud)
}

/// Runs the plan and writes the scene directory, whole or not at all.
pub fn train(plan: &TrainPlan, progress: &dyn Progress) -> Result<TrainOutcome> {
    let progress = &Recorded::new(progress);
    let inputs = [Some(&plan.cameras), plan.points.as_ref(), plan.models.as_ref()];
    let inputs: Vec<&Path> =
        inputs.into_iter().flatten().chain([&plan.images]).map(PathBuf::as_path).collect();
    let workspace = Workspace::create(&plan.out, plan.force, &inputs)?;
    let known = cameras::read_file(&plan.cameras)?;
    let given = plan.points.as_deref().map(|path| points(path, progress)).transpose()?;
    let device = Device::open(&gpu::Options {
        deterministic: plan.deterministic,
        ..gpu::options(plan.device.as_deref())
    })?;
    let max_size = plan.max_size.unwrap_or(photo::default_max_size(device.info().is_cpu));
    let preset = plan.preset.unwrap_or(if device.info().is_cpu { Preset::Draft } else { Preset::Default });
    let work = |photos| MemoryDemand::colour(preset, photos);
    let mut photos = matched(plan, &known.cameras, max_size, work, &device, progress)?;
    let registry = Registry::with(plan.models.as_deref(), Compute::by(plan.provider.as_deref()))?;
    let source = match given {
        Some(cloud) => {
            known.warnings.iter().for_each(|w| progress.warn(w));
            let geometry = from_points(&mut photos, &known.cameras, cloud, progress)?;
            CameraOrigin::GivenGeometry(geometry)
        }
        None => CameraOrigin::Known(known),
    };
    let mut options = RgbOptions::preset(preset);
    options.limit_splats(budget::most_splats(device.info(), 0), work(photos.len()).splats);
    options.seed = plan.seed;
    if let Some(n) = plan.iterations {
        options = options.with_iterations(n);
    }
    let mut graph = Graph::default();
    let placed = graph.add(stages::Cameras::new(photos, source, plan.seed)?, ());
    let priors = graph.add(stages::DepthPriors::new(stages::PriorOrigin::None)?, (placed,));
    let geometry = graph.add(stages::DenseDepth { preset, seed: plan.seed }, (placed, priors));
    let trained = graph.add(stages::TrainColour { options }, (placed, geometry));
    let options = ViewDependentOptions::preset(preset, plan.sh_degree, plan.seed);
    let trained = graph.add(stages::ViewDependence { options }, (placed, trained));
    let up = graph.add(stages::Upright, (placed, geometry, trained));
    let targets = [placed.target(), geometry.target(), trained.target(), up.target()];
    let store = super::execute::store(plan.resume, plan.checkpoint_seconds)?;
    let mut made = graph.run(&targets, &device, &registry, &store, progress)?;
    let (photos, geometry) = (made.take(placed)?.photos, made.take(geometry)?);
    let trained = made.take(trained)?;
    let world = World { up: made.take(up)?, scale: None };
    super::fidelity::warn(&photos, &trained.stats.psnr, progress);

    let seen = super::view::seen(&device, &trained.splats, &trained.cameras, progress)?;
    progress.begin("write", 1);
    let nothing = LanguageField::default();
    let mut viewer = Viewer::new(&device, &trained.splats, &nothing)?;
    let frames = trained.cameras.iter().map(|c| viewer.view(c)).collect::<Result<Vec<_>>>()?;
    let contents = Contents {
        splats: &trained.splats,
        seen: &seen,
        cameras: &trained.cameras,
        world: &world,
        photos: &photos,
        points: Some(&geometry.points),
        language: None,
        text_embeddings: None,
    };
    scene_dir::write(workspace.path(), &contents)?;
    progress.end();
    let stages = progress.stages();
    let curves = super::record::curves(&trained.stats, &[]);
    let record = RunRecord {
        program: format!("splatvk {}", env!("CARGO_PKG_VERSION")),
        config: json!({ "plan": plan, "preset": preset, "provider": registry.compute().name().ok() }),
        seed: plan.seed,
        device: device.info().name.clone(),
        device_is_cpu: device.info().is_cpu,
        models: Vec::new(),
        seconds: progress.seconds(),
        stages,
        statistics: json!({
            "working_sizes": super::record::working_sizes(&photos),
            "geometry": { "method": geometry.method, "points": geometry.points.len() },
            "world": world,
            "light": super::light::record(&photos),
            "splats": { "start": trained.stats.splats[0], "end": trained.splats.len(), "unseen": seen.unseen() },
            "view_dependence": trained.stats.view_dependence,
            "psnr_train": trained.stats.psnr, "poses_refined": trained.stats.poses_refined,
            "curves": curves,
        }),
        warnings: progress.warnings(),
    };
    let mut figures = vec![
        ("device".to_owned(), device.info().name.clone()),
        ("photos".to_owned(), super::record::sizes(&photos)),
        super::record::splats_figure(&trained.splats, &seen),
        super::fidelity::figure(&trained.stats.psnr),
    ];
    figures.extend(super::record::view_dependence_figure(&trained.stats.view_dependence));
    figures.push(super::record::up_figure(&world));
    figures.extend(super::light::figure(&photos));
    // What renders are compared with.
    let targets: Vec<RgbImage> = photos.iter().map(Photo::target).collect();
    let views = photos.iter().zip(&targets).zip(&frames).zip(&trained.stats.psnr);
    let views = views.map(|(((p, target), f), psnr)| ViewShown {
        name: &p.stem,
        photo: target,
        render: Some(&f.rendered.rgb),
        depth: Some(&f.rendered.depth),
        levels: &[],
        psnr: Some(*psnr),
        light: p.light,
    });
    let title = plan.out.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let bare = record.clone().without_folders(plan.read().chain([plan.out.as_path()]));
    let shown = HtmlReport {
        title: &title,
        views: views.collect(),
        queries: Vec::new(),
        curves: curves.clone(),
        space: None,
        scene: Some(report::viewer::Scene3d {
            title: &title,
            splats: &trained.splats,
            seen: &seen,
            cameras: &trained.cameras,
            world: &world,
            photos: targets.iter().collect(),
            language: None,
            names: &Vec::new(),
            answers: Vec::new(),
        }),
        figures: figures.clone(),
        run: &bare,
    };
    bare.write(workspace.path())?;
    report::write_html(workspace.path(), &shown)?;
    report::write_previews(workspace.path(), &shown)?;
    progress.check()?;
    workspace.commit()?;
    let table = super::fidelity::heading(&trained.stats.psnr)
        + &report::table(&record.stages, record.seconds, &figures);
    Ok(TrainOutcome { record, table })
}

/// Geometry of given cameras and points; the lenses are taken out of the photos.
fn from_points(
    photos: &mut [Photo],
    known: &[GivenCamera],
    cloud: PointCloud,
    progress: &dyn Progress,
) -> Result<Geometry> {
    let cameras = pose::assign(photos, known, progress)?;
    photos.iter_mut().for_each(|p| p.fine = None);
    let points = with_footprints(cloud, &cameras, progress)?;
    Ok(Geometry {
        points,
        cameras,
        depths: Vec::new(),
        focal_log_sigma: None,
        fitted: Vec::new(),
        method: "cameras+points".into(),
    })
}
