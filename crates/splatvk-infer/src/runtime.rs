//! Sessions of ONNX Runtime with plain tensors as inputs and outputs.
use std::path::{Path, PathBuf};

use ort::session::SessionInputValue;
use ort::value::{Tensor as OrtTensor, TensorElementType};

use super::compute::Compute;
use super::contract::reorder;
use super::library::{line, loaded};
use super::provider::settings;
use crate::{Error, Result};

/// A dense tensor of 32-bit floats.
#[derive(Clone, Debug, Default)]
pub struct Tensor {
    /// Axes, outermost first.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub data: Vec<f32>,
}

/// Input of a session. Floats and integers are converted to the element type of the graph; of truth
/// values 0 is false.
#[derive(Clone)]
#[non_exhaustive]
pub enum Input {
    /// Row-major floats.
    F32(Vec<usize>, Vec<f32>),
    /// Row-major integers.
    I64(Vec<usize>, Vec<i64>),
}

impl Input {
    /// Axes, outermost first.
    pub fn shape(&self) -> &[usize] {
        match self {
            Input::F32(shape, _) | Input::I64(shape, _) => shape,
        }
    }

    /// The same values in another layout ([`super::contract`]); `None` when the shape does not fit.
    pub(super) fn relaid(self, from: &str, to: &str) -> Option<Input> {
        Some(match self {
            Input::F32(shape, data) => {
                let (shape, data) = reorder(shape, data, from, to)?;
                Input::F32(shape, data)
            }
            Input::I64(shape, data) => {
                let (shape, data) = reorder(shape, data, from, to)?;
                Input::I64(shape, data)
            }
        })
    }

    fn value(self, wanted: Option<TensorElementType>) -> ort::Result<SessionInputValue<'static>> {
        use TensorElementType as T;
        match (self, wanted) {
            (Input::F32(shape, data), _) => float_value(shape, data, wanted),
            (Input::I64(shape, data), Some(T::Int32)) => {
                let narrow: Vec<i32> = data.into_iter().map(|v| v as i32).collect();
                Ok(OrtTensor::from_array((shape, narrow))?.into())
            }
            (Input::I64(shape, data), Some(T::Float16 | T::Float32 | T::Float64)) => {
                float_value(shape, data.into_iter().map(|v| v as f32).collect(), wanted)
            }
            (Input::I64(shape, data), Some(T::Bool)) => {
                let truth: Vec<bool> = data.into_iter().map(|v| v != 0).collect();
                Ok(OrtTensor::from_array((shape, truth))?.into())
            }
            (Input::I64(shape, data), _) => Ok(OrtTensor::from_array((shape, data))?.into()),
        }
    }
}

/// Floats in the element type of the graph.
fn float_value(
    shape: Vec<usize>,
    data: Vec<f32>,
    wanted: Option<TensorElementType>,
) -> ort::Result<SessionInputValue<'static>> {
    Ok(match wanted {
        Some(TensorElementType::Float16) => {
            let half: Vec<half::f16> = data.into_iter().map(half::f16::from_f32).collect();
            OrtTensor::from_array((shape, half))?.into()
        }
        Some(TensorElementType::Float64) => {
            let wide: Vec<f64> = data.into_iter().map(f64::from).collect();
            OrtTensor::from_array((shape, wide))?.into()
        }
        _ => OrtTensor::from_array((shape, data))?.into(),
    })
}

/// One loaded network. Dropping it frees its memory.
pub struct Session {
    inner: ort::session::Session,
    file: PathBuf,
    /// Declared after `inner`, whose memory it returns: fields are dropped in order.
    _memory: Option<TrimHeapOnDrop>,
}

/// Makes glibc return freed memory to the system when dropped. Otherwise a loaded network occupies
/// twice its weights, and a dropped one once.
struct TrimHeapOnDrop;

impl Drop for TrimHeapOnDrop {
    fn drop(&mut self) {
        #[cfg(all(target_os = "linux", target_env = "gnu"))]
        // SAFETY: the function has no preconditions and locks the arenas it changes.
        unsafe {
            libc::malloc_trim(0);
        }
    }
}

impl Session {
    /// Loads a graph for the chosen provider; on the CPU it has one thread per core.
    pub fn load(file: &Path, compute: &Compute) -> Result<Self> {
        let bytes = file.metadata().map_or(0, |m| m.len());
        Session::load_sized(file, bytes, compute)
    }

    /// [`Session::load`] of a graph whose weights may lie in other files: `bytes` counts them all.
    pub(super) fn load_sized(file: &Path, bytes: u64, compute: &Compute) -> Result<Self> {
        let environment = &loaded()?.1;
        let large = bytes >= LARGE;
        let build = |provider| settings(environment, provider, large)?.commit_from_file(file);
        let provider = compute.selected()?;
        let built = match build(provider) {
            Err(e) if provider.is_some() && compute.replaceable() => {
                let name = compute.name().unwrap_or_default();
                compute.note(format!(
                    "{}: not on {name} ({}); the CPU computes it",
                    file.display(),
                    line(&e)
                ));
                build(None)
            }
            built => built,
        };
        let inner = built.map_err(|e| {
            Error::missing_model(
                file.display(),
                format!("{}: ONNX Runtime cannot load it: {}", file.display(), line(&e)),
            )
        })?;
        if large {
            drop(TrimHeapOnDrop);
        }
        Ok(Session { inner, file: file.to_path_buf(), _memory: large.then(|| TrimHeapOnDrop) })
    }

    /// Runs the graph once and returns the named outputs as 32-bit floats.
    pub fn run(&mut self, inputs: Vec<(impl Into<String>, Input)>, outputs: &[&str]) -> Result<Vec<Tensor>> {
        let file = self.file.display().to_string();
        let failed = |e: ort::Error| Error::work(format!("{file}: {}", line(&e)));
        let mut fed: Vec<(String, SessionInputValue<'_>)> = Vec::with_capacity(inputs.len());
        for (name, input) in inputs {
            let name = name.into();
            let port = self.inner.inputs().iter().find(|i| i.name() == name);
            let wanted = port.and_then(|i| i.dtype().tensor_type());
            fed.push((name, input.value(wanted).map_err(failed)?));
        }
        let produced = self.inner.run(fed).map_err(failed)?;
        let mut tensors = Vec::with_capacity(outputs.len());
        for name in outputs {
            let value = produced
                .get(*name)
                .ok_or_else(|| Error::work(format!("{file}: the graph has no output {name}")))?;
            tensors.push(to_floats(value).map_err(failed)?);
        }
        Ok(tensors)
    }
}

fn to_floats(value: &ort::value::DynValue) -> ort::Result<Tensor> {
    use TensorElementType as T;
    let lengths = |shape: &ort::value::Shape| shape.iter().map(|n| *n as usize).collect();
    Ok(match value.dtype().tensor_type() {
        Some(T::Float16) => {
            let (shape, data) = value.try_extract_tensor::<half::f16>()?;
            Tensor { shape: lengths(shape), data: data.iter().map(|v| v.to_f32()).collect() }
        }
        Some(T::Float64) => {
            let (shape, data) = value.try_extract_tensor::<f64>()?;
            Tensor { shape: lengths(shape), data: data.iter().map(|v| *v as f32).collect() }
        }
        Some(T::Int64) => {
            let (shape, data) = value.try_extract_tensor::<i64>()?;
            Tensor { shape: lengths(shape), data: data.iter().map(|v| *v as f32).collect() }
        }
        Some(T::Bool) => {
            let (shape, data) = value.try_extract_tensor::<bool>()?;
            Tensor { shape: lengths(shape), data: data.iter().map(|v| f32::from(u8::from(*v))).collect() }
        }
        _ => {
            let (shape, data) = value.try_extract_tensor::<f32>()?;
            Tensor { shape: lengths(shape), data: data.to_vec() }
        }
    })
}

/// Smallest size of a large network, bytes: its memory matters more than the time of allocation.
const LARGE: u64 = 200 << 20;
