//! Scenes as files of other programs: exports, meshes, things.
use crate::device;
use crate::scene::Scene;
use crate::work;
use pyo3::prelude::*;
use serde_json::{Value, json};
use splatvk::format::scene_dir;
use splatvk::infer::Registry;
use splatvk::progress::Progress;
use splatvk::run::export::{self as exports, Asked, ExportPlan};
use splatvk::run::mesh::{Collider, MeshPlan};
use splatvk::run::metric::Distance;
use splatvk::run::objects::{self as things, LEAST_SHARE, Listed, ObjectFiles, ObjectOptions};
use splatvk::run::{Machine, stored};
use splatvk::{Error, Result};
use std::path::{Path, PathBuf};

/// A scene in memory, or the place of one.
enum Source {
    Copied(Box<scene_dir::Scene>),
    Stored(PathBuf),
}

impl Source {
    /// The scene of an argument, a `Scene` or a path, and its device and models.
    fn of(
        py: Python<'_>,
        given: &Bound<'_, PyAny>,
        device: Option<&str>,
        models: Option<PathBuf>,
    ) -> PyResult<(Source, Machine)> {
        if let Ok(given) = given.cast::<Scene>() {
            return given
                .get()
                .on_device(py, |live| Ok((Source::Copied(Box::new(live.copied())), live.machine())));
        }
        let path: PathBuf = given.extract()?;
        let device = device::device(py, device)?;
        let registry = work::unobserved(py, || Registry::open(models.as_deref()))?;
        Ok((Source::Stored(path), Machine::of(device, registry)))
    }

    fn path(&self) -> PathBuf {
        match self {
            Source::Copied(scene) => scene.path.clone(),
            Source::Stored(path) => path.clone(),
        }
    }

    fn scene(self, progress: &dyn Progress) -> Result<scene_dir::Scene> {
        match self {
            Source::Copied(scene) => Ok(*scene),
            Source::Stored(path) => {
                let scene = scene_dir::load(&path)?;
                scene.warnings.iter().for_each(|note| progress.warn(note));
                Ok(scene)
            }
        }
    }
}

/// Options of [`export`]: a dict with all of them.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct ExportOptions {
    format: Option<String>,
    ply_degree: u32,
    spz_version: Option<u32>,
    with_features: bool,
    title: Option<String>,
    views: Option<PathBuf>,
    guessed: bool,
    up: Option<String>,
    metres: bool,
    raw: bool,
    force: bool,
}

impl ExportOptions {
    fn plan(self) -> Result<ExportPlan> {
        let up = self.up.as_deref().map(exports::up_axis).transpose();
        let up = up.map_err(|reason| Error::input(format!("up: {reason}")))?;
        if self.ply_degree > 3 {
            return Err(Error::input(format!("ply_degree {}: give 0 to 3", self.ply_degree)));
        }
        if let Some(version) = self.spz_version.filter(|version| !(2..=4).contains(version)) {
            return Err(Error::input(format!("spz_version {version}: give 2 to 4")));
        }
        Ok(ExportPlan {
            format: self.format,
            ply_degree: self.ply_degree,
            spz_version: self.spz_version,
            with_features: self.with_features,
            title: self.title,
            views: self.views,
            guessed: self.guessed,
            asked: Asked { up, metres: self.metres, raw: self.raw },
        })
    }
}

/// Writes a scene for another program, and returns the JSON of `splatvk export --json`.
#[pyfunction]
pub fn export(
    py: Python<'_>,
    scene: &Bound<'_, PyAny>,
    path: PathBuf,
    options: ExportOptions,
    observer: Py<PyAny>,
) -> PyResult<String> {
    let (source, _) = Source::of(py, scene, None, None)?;
    work::observed(py, &observer, |progress| {
        let force = options.force;
        let plan = options.plan()?;
        let out = plan.reserve(&source.path(), &path, force)?;
        let mut done = out.write(source.scene(progress)?, progress)?;
        progress.inform(&done.text);
        done.json["files"] = json!([path]);
        Ok(done.json.to_string())
    })
}

/// Options of [`mesh`]: a dict with all of them.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct MeshOptions {
    triangles: usize,
    error: Option<String>,
    voxel: Option<String>,
    fill_guessed: bool,
    collider: Option<String>,
    by_object: bool,
    vocabulary: Option<Vec<String>>,
    cameras: Option<PathBuf>,
    raw: bool,
    force: bool,
}

impl MeshOptions {
    fn plan(&self, progress: &dyn Progress) -> Result<MeshPlan> {
        let length = |name: &str, text: &Option<String>| -> Result<Option<Distance>> {
            let parsed = text.as_deref().map(str::parse).transpose();
            parsed.map_err(|reason: String| Error::input(format!("{name}: {reason}")))
        };
        let collider = match self.collider.as_deref() {
            None | Some("none") => None,
            Some("hull") => Some(Collider::Hull),
            Some("decomposition") => Some(Collider::Decomposition),
            Some(other) => {
                return Err(Error::input(format!("collider {other:?}: give \"hull\" or \"decomposition\"")));
            }
        };
        Ok(MeshPlan {
            triangles: self.triangles,
            error: length("error", &self.error)?,
            voxel: length("voxel", &self.voxel)?,
            fill_guessed: self.fill_guessed,
            collider,
            by_object: self.by_object,
            vocabulary: self.vocabulary.clone(),
            cameras: self.cameras.as_deref().map(|file| stored::cameras(file, progress)).transpose()?,
            raw: self.raw,
            ..MeshPlan::default()
        })
    }
}

/// Writes a mesh of a scene, and returns its figures as JSON.
#[pyfunction]
#[pyo3(signature = (scene, path, options, observer, device = None, models = None))]
pub fn mesh(
    py: Python<'_>,
    scene: &Bound<'_, PyAny>,
    path: PathBuf,
    options: MeshOptions,
    observer: Py<PyAny>,
    device: Option<&str>,
    models: Option<PathBuf>,
) -> PyResult<String> {
    let (source, machine) = Source::of(py, scene, device, models)?;
    work::observed(py, &observer, |progress| {
        let (plan, from) = (options.plan(progress)?, source.path());
        let inputs: Vec<&Path> =
            [Some(from.as_path()), options.cameras.as_deref()].into_iter().flatten().collect();
        let out = plan.reserve(&path, options.force, &inputs)?;
        let mut figures = out.write(source.scene(progress)?, &machine, progress)?;
        figures["file"] = json!(path);
        Ok(figures.to_string())
    })
}

/// Options of [`objects`]: a dict with all of them.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct ObjectsOptions {
    vocabulary: Option<Vec<String>>,
    min_share: Option<f64>,
    out: Option<PathBuf>,
    level: String,
    format: String,
    raw: bool,
    force: bool,
}

/// The things of a scene, with its edits, as JSON: the list `objects` of objects.json. With `out`
/// they are written, too.
#[pyfunction]
#[pyo3(signature = (scene, options, observer, device = None, models = None))]
pub fn objects(
    py: Python<'_>,
    scene: &Bound<'_, PyAny>,
    options: ObjectsOptions,
    observer: Py<PyAny>,
    device: Option<&str>,
    models: Option<PathBuf>,
) -> PyResult<String> {
    let (source, machine) = Source::of(py, scene, device, models)?;
    work::observed(py, &observer, |progress| Ok(listed(source, &machine, options, progress)?.to_string()))
}

fn listed(
    source: Source,
    machine: &Machine,
    options: ObjectsOptions,
    progress: &dyn Progress,
) -> Result<Value> {
    let levels = ["subpart", "part", "whole", "object"];
    let level = levels.iter().position(|name| *name == options.level).ok_or_else(|| {
        Error::input(format!(
            "level {:?}: give \"object\", \"whole\", \"part\" or \"subpart\"",
            options.level
        ))
    })?;
    let files = ObjectFiles { level, format: options.format, raw: options.raw };
    let from = source.path();
    let out = options.out.as_deref();
    let reserved = out.map(|folder| files.reserve(folder, options.force, &[&from])).transpose()?;
    let mut scene = source.scene(progress)?;
    let least_share = options.min_share.unwrap_or(LEAST_SHARE);
    let asked = ObjectOptions { vocabulary: options.vocabulary, least_share };
    let (ready, list) = things::of_scene(&mut scene, machine, &asked, progress)?;
    let mut record = match (reserved, out) {
        (Some(reserved), Some(folder)) => {
            let listed = Listed { scene: &mut scene, ready: &ready, list: &list };
            reserved.write(listed, folder, progress)?
        }
        _ => things::record(&scene, &list, level)?,
    };
    Ok(record["objects"].take())
}
