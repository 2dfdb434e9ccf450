//! The compiled part of the Python package `splatvk`: types of the library as Python classes, and
//! their data as NumPy arrays. It decides nothing; defaults, sources and errors are the library's.
mod answer;
mod arrays;
mod camera;
mod device;
mod edit;
mod errors;
mod files;
mod scene;
mod work;

use pyo3::prelude::*;

#[pymodule]
mod _splatvk {
    #[pymodule_export]
    use crate::answer::{Answer, Thing};
    #[pymodule_export]
    use crate::camera::Camera;
    #[pymodule_export]
    use crate::device::{close_device, device_name};
    #[pymodule_export]
    use crate::edit::{Editor, Selection};
    #[pymodule_export]
    use crate::files::{export, mesh, objects};
    #[pymodule_export]
    use crate::scene::{Scene, load, options, reconstruct, reconstruct_pixels};
    #[pymodule_export]
    use crate::work::Event;
    use pyo3::prelude::*;

    /// The command line: returns its exit code.
    #[pyfunction]
    fn main(py: Python<'_>, arguments: Vec<std::ffi::OsString>) -> u8 {
        py.detach(|| splatvk::cli::run_with(arguments))
    }

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
