//! Data of the library as NumPy arrays.
use numpy::ndarray::ArrayView;
use numpy::{Element, IxDyn, PyArray, PyArray1, PyArrayMethods};
use pyo3::prelude::*;

/// An array that owns its data.
pub fn owned<T: Element>(py: Python<'_>, data: Vec<T>, shape: &[usize]) -> PyResult<Py<PyAny>> {
    Ok(PyArray1::from_vec(py, data).reshape(IxDyn(shape))?.into_any().unbind())
}

/// A read-only array over memory of `owner`.
///
/// # Safety
/// `data` stays where it is, unchanged, for as long as `owner` lives.
pub unsafe fn borrowed<'py, T: Element>(
    data: &[T],
    shape: &[usize],
    owner: Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    let view = ArrayView::from_shape(IxDyn(shape), data)
        .map_err(|e| pyo3::exceptions::PyValueError::new_err(e.to_string()))?;
    // SAFETY: passed on; Python cannot write to it.
    let array = unsafe { PyArray::borrow_from_array(&view, owner) };
    array.readwrite().make_nonwriteable();
    Ok(array.into_any())
}
