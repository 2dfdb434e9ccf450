//! Answers to texts.
use crate::arrays;
use crate::camera::Camera;
use crate::scene::Scene;
use pyo3::prelude::*;
use splatvk::query::QueryResult;
use splatvk::query::instances::Instance;
use splatvk::query::presence::Presence;
use splatvk::run::Answers;
use splatvk::scene::LEVEL_NAMES;
use splatvk::{Error, scene};
use std::sync::Arc;

/// The answer of a scene to a text.
#[pyclass(module = "splatvk", frozen)]
pub struct Answer {
    scene: Py<Scene>,
    camera: scene::Camera,
    answers: Answers,
    things: Vec<Arc<Instance>>,
    metres_per_unit: Option<f64>,
}

impl Answer {
    pub fn new(scene: Py<Scene>, camera: scene::Camera, mut answers: Answers) -> Answer {
        let things = std::mem::take(&mut answers.instances).into_iter().map(Arc::new).collect();
        let metres_per_unit = scene.get().live().world().scale.as_ref().map(|s| s.metres_per_unit);
        Answer { scene, camera, answers, things, metres_per_unit }
    }

    /// The answer in the view of a camera.
    fn view(&self, py: Python<'_>, camera: Option<&Bound<'_, PyAny>>) -> PyResult<QueryResult> {
        let scene = self.scene.get();
        let camera = camera.map(|c| scene.camera(py, Some(c))).transpose()?;
        let view = match camera.filter(|c| *c != self.camera) {
            None => self.answers.views.first().cloned(),
            Some(other) => {
                scene.on_device(py, |live| live.ask(&self.answers.text, &other))?.views.into_iter().next()
            }
        };
        view.ok_or_else(|| crate::errors::exception(py, &Error::work("an answer without a view")))
    }
}

#[pymethods]
impl Answer {
    /// The text.
    #[getter]
    fn text(&self) -> &str {
        &self.answers.text
    }
    /// "found", "unsure" or "absent"; None where the text model has too few texts to decide.
    #[getter]
    fn presence(&self) -> Option<&'static str> {
        self.answers.presence.map(|p| match p {
            Presence::Found => "found",
            Presence::Unsure => "unsure",
            Presence::Absent => "absent",
        })
    }
    /// Share of other things that fit the scene at least as well, in (0, 1]; None where unknown.
    #[getter]
    fn p_value(&self) -> Option<f32> {
        self.answers.p_value
    }
    /// Agreement of the photos on the answer, 0 to 1; None where unknown.
    #[getter]
    fn reliability(&self) -> Option<f64> {
        self.answers.reliability
    }
    /// The answer in a few words, with what is not understood of the text.
    #[getter]
    fn verdict(&self) -> String {
        self.answers.sentence()
    }
    /// Level that answers: "s", "m" or "l" (subpart, part, whole).
    #[getter]
    fn level(&self) -> &'static str {
        LEVEL_NAMES[self.answers.selection.level]
    }
    /// Things in the scene, largest first.
    #[getter]
    fn things(&self) -> Vec<Thing> {
        let thing = |i: &Arc<Instance>| Thing { instance: i.clone(), metres_per_unit: self.metres_per_unit };
        self.things.iter().map(thing).collect()
    }
    /// (N,) bool, the splats of the answer.
    #[getter]
    fn splats(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let mut mask = vec![false; self.scene.get().live().splats().len()];
        self.answers.selection.splats.iter().for_each(|&i| mask[i] = true);
        let count = mask.len();
        arrays::owned(py, mask, &[count])
    }
    /// (H, W) bool, the pixels of the answer in a view; False everywhere where it is not found.
    #[pyo3(signature = (camera = None))]
    fn mask(&self, py: Python<'_>, camera: Option<&Bound<'_, PyAny>>) -> PyResult<Py<PyAny>> {
        let mask = self.view(py, camera)?.mask();
        arrays::owned(py, mask.data, &[mask.height, mask.width])
    }
    /// (H, W) float32, relevancy in a view; 0.5 is as near as "object", "things", "stuff" or
    /// "texture".
    #[pyo3(signature = (camera = None))]
    fn heat(&self, py: Python<'_>, camera: Option<&Bound<'_, PyAny>>) -> PyResult<Py<PyAny>> {
        let relevancy = self.view(py, camera)?.relevancy();
        arrays::owned(py, relevancy.data, &[relevancy.height, relevancy.width])
    }
    /// Camera of the answer's own view.
    #[getter]
    fn camera(&self) -> Camera {
        Camera(self.camera.clone())
    }
    fn __repr__(&self) -> String {
        format!("<splatvk.Answer to {:?}: {}>", self.answers.text, self.answers.sentence())
    }
}

/// One of the things that a text means.
#[pyclass(module = "splatvk", frozen)]
pub struct Thing {
    instance: Arc<Instance>,
    metres_per_unit: Option<f64>,
}

#[pymethods]
impl Thing {
    /// (3,) float64, centre of its oriented box, scene units.
    #[getter]
    fn center(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        arrays::owned(py, self.instance.centre.to_array().to_vec(), &[3])
    }
    /// (2, 3) float64, lowest and highest corner along the scene's axes.
    #[getter]
    #[pyo3(name = "box")]
    fn bounds(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        arrays::owned(py, self.instance.bounds.map(|b| b.to_array()).concat(), &[2, 3])
    }
    /// (3, 3) float64, the edges of its oriented box as rows, with their lengths; longest variance
    /// first.
    #[getter]
    fn oriented_box(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let o = &self.instance.oriented;
        let edges = [0, 1, 2].map(|k| (o.axes[k] * o.size[k]).to_array());
        arrays::owned(py, edges.concat(), &[3, 3])
    }
    /// (3,) float64, lengths of the edges of its oriented box, scene units.
    #[getter]
    fn size(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        arrays::owned(py, self.instance.oriented.size.to_array().to_vec(), &[3])
    }
    /// (3,) float64, the same lengths in metres; None where the scene has no scale.
    #[getter]
    fn metres(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
        let metres = self.metres_per_unit.map(|unit| (self.instance.oriented.size * unit).to_array());
        metres.map(|m| arrays::owned(py, m.to_vec(), &[3])).transpose()
    }
    /// Its share of the weight of all things of the answer.
    #[getter]
    fn share(&self) -> f64 {
        self.instance.share
    }
    /// Agreement of the photos on it, 0 to 1; None where unknown.
    #[getter]
    fn reliability(&self) -> Option<f64> {
        self.instance.reliability
    }
    /// (n,) int64, indices of its splats, ascending.
    #[getter]
    fn splats(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let rows: Vec<i64> = self.instance.splats.iter().map(|i| *i as i64).collect();
        let count = rows.len();
        arrays::owned(py, rows, &[count])
    }
    fn __repr__(&self) -> String {
        let (c, count) = (self.instance.centre, self.instance.splats.len());
        format!("<splatvk.Thing at ({:.3}, {:.3}, {:.3}), {count} splats>", c.x, c.y, c.z)
    }
}
