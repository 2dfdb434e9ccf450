//! Scenes: made from photos, loaded, read, rendered, asked, saved.
use crate::answer::Answer;
use crate::camera::Camera;
use crate::device::{self, Process};
use crate::{arrays, errors, work};
use numpy::{Element, PyReadonlyArray1, PyReadonlyArray3};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Map, Value};
use splatvk::format::scene_dir;
use splatvk::infer::Registry;
use splatvk::photo;
use splatvk::query::instances::{Places, splat_codes};
use splatvk::run::live::LiveScene;
use splatvk::run::{self, Extras, RunPlan};
use splatvk::scene::{LEVEL_NAMES, RgbImage};
use splatvk::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

/// A Gaussian-splat scene: N Gaussians in scene units and OpenCV axes, the cameras of its photos,
/// and the index that answers texts. Calls of one scene from several threads wait for each other.
#[pyclass(module = "splatvk", frozen, weakref)]
pub struct Scene {
    live: Mutex<LiveScene>,
    process: Process,
    /// Where the scene is stored, if it is.
    path: Mutex<Option<PathBuf>>,
    scales: OnceLock<Vec<f32>>,
    quats: OnceLock<Vec<f32>>,
    opacities: OnceLock<Vec<f32>>,
    seen: OnceLock<Vec<bool>>,
    codes: OnceLock<Vec<i32>>,
    things: OnceLock<Vec<i32>>,
}

impl Scene {
    pub fn of(live: LiveScene, path: Option<PathBuf>) -> Scene {
        Scene {
            live: Mutex::new(live),
            process: Process::current(),
            path: Mutex::new(path),
            scales: OnceLock::new(),
            quats: OnceLock::new(),
            opacities: OnceLock::new(),
            seen: OnceLock::new(),
            codes: OnceLock::new(),
            things: OnceLock::new(),
        }
    }

    pub fn live(&self) -> MutexGuard<'_, LiveScene> {
        self.live.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A call that uses the device, without the GIL.
    pub fn on_device<T: Send>(
        &self,
        py: Python<'_>,
        body: impl FnOnce(&mut LiveScene) -> Result<T> + Send,
    ) -> PyResult<T> {
        self.process.check(py)?;
        work::unobserved(py, || body(&mut self.live()))
    }

    /// The camera of an argument: a [`Camera`], the index or the name of one of the scene's own, or
    /// its first.
    pub fn camera(
        &self,
        py: Python<'_>,
        given: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<splatvk::scene::Camera> {
        let refused = |text: String| Err(errors::named(py, "InputError", text));
        let live = self.live();
        let own = live.cameras();
        let Some(given) = given else {
            return match own.first() {
                Some(first) => Ok(first.clone()),
                None => refused("the scene has no cameras; give one".to_owned()),
            };
        };
        if let Ok(camera) = given.cast::<Camera>() {
            return Ok(camera.get().0.clone());
        }
        if let Ok(index) = given.extract::<usize>() {
            return match own.get(index) {
                Some(camera) => Ok(camera.clone()),
                None => refused(format!("there is no camera {index}; the scene has {}", own.len())),
            };
        }
        if let Ok(name) = given.extract::<String>() {
            return match own
                .iter()
                .find(|c| c.name == name || Path::new(&c.name).file_stem() == Some(name.as_ref()))
            {
                Some(camera) => Ok(camera.clone()),
                None => refused(format!("there is no camera called {name:?}")),
            };
        }
        refused("a camera is a splatvk.Camera, the index or the name of one of the scene's own".to_owned())
    }

    /// Activated values, computed once: what `activate` makes of the splats.
    fn kept<'py, T: Element>(
        this: &Bound<'py, Self>,
        slot: impl FnOnce(&Scene) -> &OnceLock<Vec<T>>,
        row: &[usize],
        activate: impl FnOnce(&LiveScene) -> Vec<T>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let scene = this.get();
        let values = slot(scene).get_or_init(|| activate(&scene.live()));
        let count = values.len() / row.iter().product::<usize>().max(1);
        let shape: Vec<usize> = std::iter::once(count).chain(row.iter().copied()).collect();
        // SAFETY: a set OnceLock never changes, and `this` keeps it.
        unsafe { arrays::borrowed(values, &shape, this.clone().into_any()) }
    }
}

#[pymethods]
impl Scene {
    /// (N, 3) float32, centres.
    #[getter]
    fn means<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let live = this.get().live();
        let means = &live.splats().means;
        // SAFETY: a LiveScene never changes its splats, and `this` keeps it.
        unsafe { arrays::borrowed(means.as_flattened(), &[means.len(), 3], this.clone().into_any()) }
    }
    /// (N, (d+1)², 3) float32, spherical harmonics of degree d, as in gsplat.
    #[getter]
    fn sh<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let live = this.get().live();
        let splats = live.splats();
        // SAFETY: as in `means`.
        unsafe { arrays::borrowed(&splats.sh, &[splats.len(), splats.sh_len(), 3], this.clone().into_any()) }
    }
    /// (N, 3) float32, standard deviations along the own axes.
    #[getter]
    fn scales<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::kept(
            this,
            |s| &s.scales,
            &[3],
            |live| live.splats().log_scales.as_flattened().iter().map(|v| v.exp()).collect(),
        )
    }
    /// (N, 4) float32, unit quaternions (w, x, y, z).
    #[getter]
    fn quats<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::kept(
            this,
            |s| &s.quats,
            &[4],
            |live| {
                let unit = |q: &[f32; 4]| {
                    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
                    q.map(|v| v / length)
                };
                live.splats().quats.iter().flat_map(unit).collect()
            },
        )
    }
    /// (N,) float32 in (0, 1).
    #[getter]
    fn opacities<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::kept(
            this,
            |s| &s.opacities,
            &[],
            |live| live.splats().opacity_logits.iter().map(|v| 1.0 / (1.0 + (-v).exp())).collect(),
        )
    }
    /// (N,) bool; False where no photo shows the splat and it is a guess. All True for a file of
    /// Gaussians, of which nothing is known.
    #[getter]
    fn seen<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::kept(
            this,
            |s| &s.seen,
            &[],
            |live| (0..live.splats().len()).map(|i| !live.seen().is_unseen(i)).collect(),
        )
    }
    /// (N, 3) int32, the code of each splat as a subpart, a part and a whole (levels "s", "m", "l");
    /// -1 without one.
    #[getter]
    fn codes<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::kept(
            this,
            |s| &s.codes,
            &[LEVEL_NAMES.len()],
            |live| {
                let mut codes = vec![-1; live.splats().len() * LEVEL_NAMES.len()];
                let levels = live.language().map_or(&[][..], |field| &field.levels);
                for (at, level) in levels.iter().enumerate() {
                    for (splat, code) in splat_codes(level).into_iter().enumerate() {
                        let place = codes.get_mut(splat * LEVEL_NAMES.len() + at);
                        if let (Some(place), Some(Ok(code))) = (place, code.map(i32::try_from)) {
                            *place = code;
                        }
                    }
                }
                codes
            },
        )
    }
    /// (N,) int32, code of the largest part of the thing of each splat; -1 without one.
    #[getter]
    fn things<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::kept(
            this,
            |s| &s.things,
            &[],
            |live| {
                let mut codes = vec![-1; live.splats().len()];
                let field = live.language();
                let objects = field.map(|field| Places::of(live.splats(), field).objects());
                for object in objects.unwrap_or_default() {
                    let code = i32::try_from(object.code).unwrap_or(-1);
                    object.instance.splats.iter().for_each(|i| codes[*i] = code);
                }
                codes
            },
        )
    }
    /// Degree of the spherical harmonics, 0 to 3.
    #[getter]
    fn sh_degree(&self) -> u32 {
        self.live().splats().sh_degree
    }
    /// Whether the splats are meant with the 2-D Mip filter (gsplat: `rasterize_mode="antialiased"`).
    #[getter]
    fn antialiased(&self) -> bool {
        self.live().splats().antialiased
    }
    /// Cameras of the photos, at working size; empty for a file of Gaussians.
    #[getter]
    fn cameras(&self) -> Vec<Camera> {
        self.live().cameras().iter().cloned().map(Camera).collect()
    }
    /// (3,) float64, unit vector against gravity; None where it is not known.
    #[getter]
    fn up(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
        let up = self.live().world().up.as_ref().map(|up| up.direction.to_array().to_vec());
        up.map(|up| arrays::owned(py, up, &[3])).transpose()
    }
    /// Metres per unit of the scene; None where no length was stated.
    #[getter]
    fn metres_per_unit(&self) -> Option<f64> {
        self.live().world().scale.as_ref().map(|s| s.metres_per_unit)
    }
    /// Warnings of the run that made the scene, or of reading its file.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.live().warnings().to_vec()
    }
    /// Whether texts can be asked.
    #[getter]
    fn has_language(&self) -> bool {
        self.live().language().is_some_and(|field| field.levels.iter().any(|l| !l.codebook.is_empty()))
    }
    /// Where the scene is stored; None if it is not.
    #[getter]
    pub fn path(&self) -> Option<PathBuf> {
        self.path.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
    fn __len__(&self) -> usize {
        self.live().splats().len()
    }
    fn __repr__(&self) -> String {
        let live = self.live();
        let place = self.path().map(|p| format!(" of {}", p.display())).unwrap_or_default();
        format!("<splatvk.Scene{place}: {} splats, {} cameras>", live.splats().len(), live.cameras().len())
    }
    /// Answers a text. `camera` is the view of the answer's mask and heat; the first of the scene
    /// without it.
    #[pyo3(signature = (text, camera = None))]
    fn query(this: &Bound<'_, Self>, text: &str, camera: Option<&Bound<'_, PyAny>>) -> PyResult<Answer> {
        let py = this.py();
        let camera = this.get().camera(py, camera)?;
        let answers = this.get().on_device(py, |live| live.ask(text, &camera))?;
        Ok(Answer::new(this.clone().unbind(), camera, answers))
    }
    /// Renders a view: a dict of "rgb" (H, W, 3), "alpha" (H, W) and "depth" (H, W; scene units, 0
    /// where alpha is below ½), float32, on black; "codes" (3, H, W) int32, the codes of the levels
    /// "s", "m" and "l", -1 without one.
    #[pyo3(signature = (camera = None, channels = None))]
    fn render<'py>(
        &self,
        py: Python<'py>,
        camera: Option<&Bound<'py, PyAny>>,
        channels: Option<Vec<String>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let camera = self.camera(py, camera)?;
        let view = self.on_device(py, |live| live.view(&camera))?;
        let frame = view.rendered;
        let (h, w) = (camera.height as usize, camera.width as usize);
        let views = PyDict::new(py);
        for channel in channels.unwrap_or_else(|| vec!["rgb".to_owned()]) {
            let array = match channel.as_str() {
                "rgb" => arrays::owned(py, frame.rgb.data.as_flattened().to_vec(), &[h, w, 3])?,
                "alpha" => arrays::owned(py, frame.alpha.data.clone(), &[h, w])?,
                "depth" => arrays::owned(py, frame.depth.data.clone(), &[h, w])?,
                "codes" => {
                    let planes = view.codes.iter().flat_map(|level| level.data.iter().copied()).collect();
                    arrays::owned(py, planes, &[view.codes.len(), h, w])?
                }
                other => {
                    let text =
                        format!("there is no channel {other:?}; there are rgb, alpha, depth and codes");
                    return Err(errors::named(py, "InputError", text));
                }
            };
            views.set_item(channel, array)?;
        }
        Ok(views)
    }
    /// The splats of a mask (N,) bool or of indices as a scene of their own, with the cameras and the
    /// language of this one.
    fn __getitem__(&self, py: Python<'_>, rows: &Bound<'_, PyAny>) -> PyResult<Scene> {
        let count = self.live().splats().len();
        let rows: Vec<usize> = if let Ok(mask) = rows.extract::<PyReadonlyArray1<'_, bool>>() {
            if mask.len()? != count {
                return Err(PyIndexError::new_err(format!(
                    "the mask has {} rows, the scene {count}",
                    mask.len()?
                )));
            }
            mask.as_array().iter().enumerate().filter(|(_, keep)| **keep).map(|(i, _)| i).collect()
        } else {
            rows.extract::<Vec<usize>>()?
        };
        if let Some(row) = rows.iter().find(|row| **row >= count) {
            return Err(PyIndexError::new_err(format!("there is no splat {row}; the scene has {count}")));
        }
        Ok(Scene::of(self.on_device(py, |live| live.picked(&rows))?, None))
    }
    /// Writes a file of Gaussians in the format of its ending (.ply, .spz, .sog, .glb, ...), or a
    /// scene directory where there is no ending. Files keep the axes and the unit of the scene, as
    /// with `splatvk export --raw`; those of USD (.usd, .usda, .usdc) are of `to_usd`. Existing ones
    /// are replaced only with `force`.
    #[pyo3(signature = (path, force = false))]
    fn save(this: &Bound<'_, Self>, path: PathBuf, force: bool) -> PyResult<()> {
        if is_usd(&path) {
            return Scene::to_usd(this, path, "y", force);
        }
        let scene = this.get();
        scene.on_device(this.py(), |live| live.save(&path, force))?;
        if path.is_dir() {
            *scene.path.lock().unwrap_or_else(PoisonError::into_inner) = Some(path);
        }
        Ok(())
    }
    /// Writes a USD file with a ParticleField3DGaussianSplat, upright where the direction up is known
    /// (`up` is "y" or "z"), and metersPerUnit where metres are. Needs `pip install splatvk[usd]`.
    #[pyo3(signature = (path, up = "y", force = false))]
    fn to_usd(this: &Bound<'_, Self>, path: PathBuf, up: &str, force: bool) -> PyResult<()> {
        this.py().import("splatvk._usd")?.call_method1("write", (this, path, up, force)).map(drop)
    }
    /// The arguments of gsplat's `rasterization`: a dict of means, quats, scales, opacities, colors
    /// (spherical harmonics), sh_degree, rasterize_mode, and viewmats, Ks, width, height of the
    /// scene's cameras; NumPy arrays, for `torch.from_numpy`.
    fn to_gsplat<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        converted(this, "to_gsplat")
    }
    /// A `trimesh.PointCloud` of the centres with their colours.
    fn to_trimesh<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        converted(this, "to_trimesh")
    }
    /// Logs splats, cameras and boxes of things to a Rerun recording: `rerun.init(...)` first.
    #[pyo3(signature = (path = "scene"))]
    fn to_rerun<'py>(this: &Bound<'py, Self>, path: &str) -> PyResult<Bound<'py, PyAny>> {
        this.py().import("splatvk._convert")?.call_method1("to_rerun", (this, path))
    }
    /// The interactive view in a notebook, with questions and a selection that comes back:
    /// `widget.mask` selects splats of the scene. Needs `pip install splatvk[notebook]`.
    #[pyo3(signature = (height = 480))]
    fn widget<'py>(this: &Bound<'py, Self>, height: usize) -> PyResult<Bound<'py, PyAny>> {
        this.py().import("splatvk._widget")?.call_method1("make", (this, height))
    }
    /// The page of the interactive view with at most `most` splats; with `asks` it sends questions
    /// to the page around it.
    fn _page(&self, py: Python<'_>, most: usize, asks: bool) -> PyResult<String> {
        let title = self.path().and_then(|p| Some(p.file_stem()?.to_string_lossy().into_owned()));
        work::unobserved(py, || self.live().page(title.as_deref().unwrap_or("scene"), most, asks))
    }
    /// The answer to a text as JSON for that page.
    fn _ask(this: &Bound<'_, Self>, text: &str) -> PyResult<String> {
        let py = this.py();
        let camera = this.get().camera(py, None)?;
        this.get().on_device(py, |live| Ok(live.ask(text, &camera)?.shown().json().to_string()))
    }
    /// The interactive view as a frame, for notebooks.
    fn _repr_html_<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        this.py().import("splatvk._widget")?.call_method1("html", (this,))
    }
    /// A `pycolmap.Reconstruction` of cameras and points; the scene has to be stored.
    fn to_pycolmap<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        converted(this, "to_pycolmap")
    }
    fn __reduce__(&self, py: Python<'_>) -> PyResult<(Py<PyAny>, (PathBuf,))> {
        match self.path() {
            Some(path) => Ok((py.import("splatvk")?.getattr("load")?.unbind(), (path,))),
            None => Err(errors::named(
                py,
                "InputError",
                "the scene is not stored anywhere, so it cannot be pickled; save it first".to_owned(),
            )),
        }
    }
}

/// Whether a file is of USD by its ending.
fn is_usd(path: &Path) -> bool {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    ["usd", "usda", "usdc"].iter().any(|usd| ending.eq_ignore_ascii_case(usd))
}

/// The scene in the types of another package, by a function of `splatvk._convert`.
fn converted<'py>(scene: &Bound<'py, Scene>, function: &str) -> PyResult<Bound<'py, PyAny>> {
    scene.py().import("splatvk._convert")?.call_method1(function, (scene,))
}

/// Loads a scene directory or a file of Gaussians, with the edits of the scene unless `edits` is
/// False.
#[pyfunction]
#[pyo3(signature = (path, device = None, models = None, edits = true))]
pub fn load(
    py: Python<'_>,
    path: PathBuf,
    device: Option<&str>,
    models: Option<PathBuf>,
    edits: bool,
) -> PyResult<Scene> {
    let device = device::device(py, device)?;
    let live = work::unobserved(py, || {
        let scene = if edits { scene_dir::load(&path) } else { scene_dir::load_unedited(&path) };
        LiveScene::loaded(&device, scene?, &Registry::open(models.as_deref())?)
    })?;
    Ok(Scene::of(live, Some(std::path::absolute(&path)?)))
}

/// Options of [`reconstruct`] with their defaults, as JSON.
#[pyfunction]
pub fn options(py: Python<'_>) -> PyResult<String> {
    let plan = serde_json::to_string(&RunPlan::default()).map_err(|e| Error::work(e.to_string()));
    plan.map_err(|e| errors::exception(py, &e))
}

/// Makes a scene from photos: `plan` is a `RunPlan` as JSON.
#[pyfunction]
pub fn reconstruct(py: Python<'_>, plan: &str, observer: Py<PyAny>) -> PyResult<Scene> {
    let plan = read_plan(plan).map_err(|e| errors::exception(py, &e))?;
    let device = device::device(py, plan.machine.device.as_deref())?;
    let live = work::observed(py, &observer, |progress| {
        let outcome = run::run(&plan, progress)?;
        LiveScene::trained(&device, outcome, &plan.machine.registry()?)
    })?;
    Ok(Scene::of(live, Some(std::path::absolute(&plan.output.out)?)))
}

/// Makes a scene from pixels: `photos` are names and arrays (H, W, 3), float32 in [0, 1], sRGB. The
/// scene is stored where the plan has a place.
#[pyfunction]
pub fn reconstruct_pixels(
    py: Python<'_>,
    plan: &str,
    photos: Vec<(String, PyReadonlyArray3<'_, f32>)>,
    observer: Py<PyAny>,
) -> PyResult<Scene> {
    let plan = read_plan(plan).map_err(|e| errors::exception(py, &e))?;
    let device = device::device(py, plan.machine.device.as_deref())?;
    let default = photo::default_max_size(device.info().is_cpu);
    let max_size = plan.config.training.max_size.unwrap_or(default);
    let mut read = Vec::with_capacity(photos.len());
    for (name, array) in &photos {
        let array = array.as_array();
        let (height, width, channels) = array.dim();
        if channels != 3 {
            return Err(errors::named(
                py,
                "InputError",
                format!("{name}: (H, W, 3) is needed, not {:?}", array.shape()),
            ));
        }
        let values: Vec<f32> = array.iter().copied().collect();
        let image = RgbImage { width, height, data: values.as_chunks::<3>().0.to_vec() };
        let photo = photo::from_pixels(Path::new(name), &image, None, max_size);
        read.push(photo.map_err(|e| errors::exception(py, &e))?);
    }
    let out = &plan.output.out;
    let live = work::observed(py, &observer, |progress| {
        let registry = plan.machine.registry()?;
        let extras = Extras { queries: plan.inputs.queries.clone(), ..Extras::default() };
        let mut outcome = run::reconstruct(&plan.config, &extras, &device, &registry, read, progress)?;
        if !out.as_os_str().is_empty() {
            run::save(&mut outcome, out, plan.output.force, progress)?;
        }
        LiveScene::trained(&device, outcome, &registry)
    })?;
    let path = (!out.as_os_str().is_empty()).then(|| std::path::absolute(out)).transpose()?;
    Ok(Scene::of(live, path))
}

/// Reads a plan and names its sources; keys that no plan has are refused.
fn read_plan(text: &str) -> Result<RunPlan> {
    let wrong = |e: serde_json::Error| Error::input(format!("options: {e}"));
    let given: Map<String, Value> = serde_json::from_str(text).map_err(wrong)?;
    let known = serde_json::to_value(RunPlan::default()).map_err(wrong)?;
    let others: Vec<&str> = known.as_object().into_iter().flatten().map(|(key, _)| key.as_str()).collect();
    RunPlan::with_options(&given, &others)
}
