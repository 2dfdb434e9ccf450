//! Cameras.
use crate::{arrays, errors};
use glam::{DMat3, DVec3};
use numpy::{PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use splatvk::scene::{self, Pose};

/// A pinhole camera without distortion. Pixel units; the centre of the first pixel is (0.5, 0.5).
///
/// `K` is the 3 × 3 matrix of intrinsics, `w2c` the 4 × 4 transform from the scene to the camera
/// in OpenCV axes (x right, y down, z forward), as gsplat's `viewmats` and pycolmap's
/// `cam_from_world`.
#[pyclass(module = "splatvk", frozen, eq)]
#[derive(Clone, PartialEq)]
pub struct Camera(pub scene::Camera);

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (K, w2c, width, height, name = "camera"))]
    #[allow(non_snake_case)]
    fn new(
        py: Python<'_>,
        K: PyReadonlyArray2<'_, f64>,
        w2c: PyReadonlyArray2<'_, f64>,
        width: u32,
        height: u32,
        name: &str,
    ) -> PyResult<Camera> {
        let refused = |text: &str| Err(errors::named(py, "InputError", text.to_owned()));
        if K.shape() != [3, 3] || w2c.shape() != [4, 4] {
            return refused("Camera: K has the shape (3, 3) and w2c (4, 4)");
        }
        let (k, w) = (K.as_array(), w2c.as_array());
        if k[[0, 1]] != 0.0 {
            return refused("Camera: K has a skew, which cannot be rendered");
        }
        if k[[1, 0]] != 0.0 || [k[[2, 0]], k[[2, 1]], k[[2, 2]]] != [0.0, 0.0, 1.0] {
            return refused("Camera: K is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]");
        }
        if [w[[3, 0]], w[[3, 1]], w[[3, 2]], w[[3, 3]]] != [0.0, 0.0, 0.0, 1.0] {
            return refused("Camera: the last row of w2c is not 0, 0, 0, 1");
        }
        let column = |c: usize| DVec3::new(w[[0, c]], w[[1, c]], w[[2, c]]);
        let rotation = DMat3::from_cols(column(0), column(1), column(2));
        let camera = scene::Camera {
            name: name.to_owned(),
            width,
            height,
            fx: k[[0, 0]],
            fy: k[[1, 1]],
            cx: k[[0, 2]],
            cy: k[[1, 2]],
            pose: Pose { rotation, translation: column(3) },
        };
        camera.checked().map(Camera).map_err(|e| errors::named(py, "InputError", e))
    }

    /// File name of the photo, or a label.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }
    /// Pixels.
    #[getter]
    fn width(&self) -> u32 {
        self.0.width
    }
    /// Pixels.
    #[getter]
    fn height(&self) -> u32 {
        self.0.height
    }
    /// (3, 3) float64, pixels.
    #[getter]
    #[pyo3(name = "K")]
    fn intrinsics(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let c = &self.0;
        arrays::owned(py, vec![c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0], &[3, 3])
    }
    /// (4, 4) float64, scene to camera, OpenCV axes.
    #[getter]
    fn w2c(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let Pose { rotation: r, translation: t } = self.0.pose;
        let row = |k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]];
        arrays::owned(py, [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]].concat(), &[4, 4])
    }
    /// (3,) float64, centre in the scene.
    #[getter]
    fn center(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        arrays::owned(py, self.0.pose.centre().to_array().to_vec(), &[3])
    }
    fn __repr__(&self) -> String {
        let c = &self.0;
        format!("Camera({:?}, {} × {}, focal length {:.1} px)", c.name, c.width, c.height, c.fx)
    }
}
