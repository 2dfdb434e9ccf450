//! Edits of scene directories.
use crate::device::{self, Process};
use crate::scene::Scene;
use crate::{arrays, errors, work};
use pyo3::prelude::*;
use splatvk::format::edits::{Combine, Operation, Pick, Term};
use splatvk::infer::Registry;
use splatvk::run::Machine;
use splatvk::run::edit::{self, Selected, expression};
use splatvk::run::live::LiveScene;
use splatvk::{Error, Result};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Selected splats of a scene that is being edited.
#[pyclass(module = "splatvk", frozen)]
pub struct Selection {
    selected: Selected,
    splats: usize,
}

#[pymethods]
impl Selection {
    /// Number of splats.
    fn __len__(&self) -> usize {
        self.selected.count
    }
    /// Share of the opacity of the scene, 0 to 1.
    #[getter]
    fn share(&self) -> f64 {
        self.selected.share
    }
    /// Reasons why the selection may be wrong; empty where it is sure.
    #[getter]
    fn doubts(&self) -> Vec<String> {
        self.selected.doubts.clone()
    }
    /// [N] bool: the selected splats of the reconstruction, as `load(path, edits=False)` has them.
    #[getter]
    fn splats(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let rows = (0..self.splats).map(|row| self.selected.rows.has(row)).collect();
        arrays::owned(py, rows, &[self.splats])
    }
    fn __repr__(&self) -> String {
        let text = expression::texts(&self.selected.terms);
        format!("<splatvk.Selection {text}: {} splats>", self.selected.count)
    }
}

/// The edits of a scene directory. Each call writes them into the scene, whole or not at all; the
/// reconstruction stays as it is. A selection is a text of `splatvk edit`, a list of parts as in
/// edits.json, or a `Selection`.
#[pyclass(module = "splatvk", frozen)]
pub struct Editor {
    editor: Mutex<edit::Editor>,
    machine: Machine,
    process: Process,
}

impl Editor {
    fn editor(&self) -> MutexGuard<'_, edit::Editor> {
        self.editor.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn work<T: Send>(
        &self,
        py: Python<'_>,
        body: impl FnOnce(&mut edit::Editor) -> Result<T> + Send,
    ) -> PyResult<T> {
        self.process.check(py)?;
        work::unobserved(py, || body(&mut self.editor()))
    }

    fn selected(&self, py: Python<'_>, selection: &Bound<'_, PyAny>, grow: f32) -> PyResult<Selected> {
        if let Ok(selection) = selection.cast::<Selection>() {
            return Ok(selection.get().selected.clone());
        }
        if let Ok(text) = selection.extract::<String>() {
            return self.work(py, |editor| {
                let terms = expression::terms(&text, editor.scene(), grow)?;
                editor.select(&terms)
            });
        }
        let json: String = py.import("json")?.call_method1("dumps", (selection,))?.extract()?;
        self.work(py, |editor| {
            let terms: Vec<Term> = serde_json::from_str(&json).map_err(|e| {
                Error::input(format!("selection: {e}; give a text or parts as in edits.json"))
            })?;
            editor.select(&terms)
        })
    }

    fn push(
        &self,
        py: Python<'_>,
        operation: Operation,
        selection: &Bound<'_, PyAny>,
        force: bool,
    ) -> PyResult<usize> {
        let selected = self.selected(py, selection, 0.0)?;
        if let Some(doubt) = selected.doubts.first().filter(|_| !force) {
            let message = format!("{doubt}; nothing is changed: force=True edits anyway");
            return Err(errors::exception(py, &Error::input(message)));
        }
        let count = selected.count;
        self.work(py, |editor| editor.push(vec![(operation, selected)]))?;
        Ok(count)
    }
}

#[pymethods]
impl Editor {
    #[new]
    #[pyo3(signature = (path, device = None, models = None))]
    fn new(
        py: Python<'_>,
        path: PathBuf,
        device: Option<String>,
        models: Option<PathBuf>,
    ) -> PyResult<Editor> {
        let machine = Machine { device, models, ..Machine::default() };
        let editor = work::unobserved(py, || edit::Editor::open(&path, &machine))?;
        Ok(Editor { editor: Mutex::new(editor), machine, process: Process::current() })
    }

    /// Selects splats of the edited scene. `grow` is −1 to 1: words select less or more.
    #[pyo3(signature = (selection, grow = 0.0))]
    fn select(&self, py: Python<'_>, selection: &Bound<'_, PyAny>, grow: f32) -> PyResult<Selection> {
        let selected = self.selected(py, selection, grow)?;
        Ok(Selection { selected, splats: self.editor().list().splats() })
    }
    /// Removes splats; returns the number of selected ones.
    #[pyo3(signature = (selection, force = false))]
    fn delete(&self, py: Python<'_>, selection: &Bound<'_, PyAny>, force: bool) -> PyResult<usize> {
        self.push(py, Operation::Delete {}, selection, force)
    }
    /// Removes all other splats.
    #[pyo3(signature = (selection, force = false))]
    fn isolate(&self, py: Python<'_>, selection: &Bound<'_, PyAny>, force: bool) -> PyResult<usize> {
        self.push(py, Operation::Isolate {}, selection, force)
    }
    /// Gives splats a colour, "#rrggbb", and keeps their shading.
    #[pyo3(signature = (selection, colour, force = false))]
    fn recolour(
        &self,
        py: Python<'_>,
        selection: &Bound<'_, PyAny>,
        colour: &str,
        force: bool,
    ) -> PyResult<usize> {
        let colour = expression::colour(colour).map_err(|e| errors::exception(py, &e))?;
        self.push(py, Operation::Recolour { colour }, selection, force)
    }
    /// Moves splats: (x, y, z) in scene units, or a text of `splatvk edit` such as "up 5cm".
    #[pyo3(name = "move", signature = (selection, by, force = false))]
    fn shift(
        &self,
        py: Python<'_>,
        selection: &Bound<'_, PyAny>,
        by: &Bound<'_, PyAny>,
        force: bool,
    ) -> PyResult<usize> {
        let by = match by.extract::<String>() {
            Ok(text) => self.work(py, |editor| expression::displacement(&text, editor.scene()))?,
            Err(_) => by.extract::<[f64; 3]>()?,
        };
        self.push(py, Operation::Move { by }, selection, force)
    }
    /// Removes splats that float in front of the surfaces; returns their number.
    #[pyo3(signature = (thorough = false))]
    fn floaters(&self, py: Python<'_>, thorough: bool) -> PyResult<usize> {
        let terms = [Term { combine: Combine::Add, pick: Pick::Floaters { thorough } }];
        self.work(py, |editor| {
            let selected = editor.select(&terms)?;
            let count = selected.count;
            editor.push(vec![(Operation::Delete {}, selected)]).map(|_| count)
        })
    }
    /// Undoes the last edit; False without one.
    fn undo(&self, py: Python<'_>) -> PyResult<bool> {
        self.work(py, edit::Editor::undo)
    }
    /// Applies the edit that was undone last; False without one.
    fn redo(&self, py: Python<'_>) -> PyResult<bool> {
        self.work(py, edit::Editor::redo)
    }
    /// The edits as in edits.json, oldest first.
    #[getter]
    fn edits<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let text = serde_json::to_string(&self.editor().list().edits);
        let text = text.map_err(|e| errors::exception(py, &Error::work(e.to_string())))?;
        py.import("json")?.call_method1("loads", (text,))
    }
    /// The edited scene.
    fn scene(&self, py: Python<'_>) -> PyResult<Scene> {
        let device = device::device(py, self.machine.device.as_deref())?;
        let path = self.editor().scene().path.clone();
        let live = self.work(py, |editor| {
            let registry = Registry::open(self.machine.models.as_deref())?;
            LiveScene::loaded(&device, editor.scene().clone(), &registry)
        })?;
        Ok(Scene::of(live, Some(std::path::absolute(path)?)))
    }
    fn __repr__(&self) -> String {
        let editor = self.editor();
        format!("<splatvk.Editor of {}: {} edits>", editor.scene().path.display(), editor.list().edits.len())
    }
}
