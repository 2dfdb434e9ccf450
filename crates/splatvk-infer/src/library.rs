//! ONNX Runtime, loaded at run time from a shared library: once per process, since a second library
//! cannot be loaded beside it.
use crate::files::{home, installed};
use crate::{Error, Result};
use ort::environment::Environment;
use ort::logging::LogLevel;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

#[cfg(target_os = "macos")]
const LIBRARY: &str = "libonnxruntime.dylib";
#[cfg(windows)]
const LIBRARY: &str = "onnxruntime.dll";
#[cfg(not(any(target_os = "macos", windows)))]
const LIBRARY: &str = "libonnxruntime.so";

/// The library's path and its environment, or the error of loading it.
static LOADED: OnceLock<Result<(PathBuf, Environment), String>> = OnceLock::new();

/// The library in use, loaded on the first call: `ORT_DYLIB_PATH`, else `lib/splatvk` of the
/// package that the program came in, else `lib` under [`home`], else the system's.
pub fn runtime() -> Result<PathBuf> {
    // ort panics when used without a library, so every session goes through this check first.
    Ok(loaded()?.0.clone())
}

pub(super) fn loaded() -> Result<&'static (PathBuf, Environment)> {
    LOADED.get_or_init(load).as_ref().map_err(|e| Error::missing(e.as_str()))
}

fn load() -> Result<(PathBuf, Environment), String> {
    let fix = "run tools/setup (or tools/models/build) to get it, or set ORT_DYLIB_PATH";
    if let Some(path) = std::env::var_os("ORT_DYLIB_PATH").filter(|v| !v.is_empty()).map(PathBuf::from) {
        let failed =
            |e| format!("ONNX Runtime: ORT_DYLIB_PATH={} cannot be loaded ({e}); {fix}", path.display());
        return try_load(&path).map(|e| (path.clone(), e)).map_err(failed);
    }
    // A package brings the version that it was tested with; the user's folder may have an older one.
    let own = match installed("lib/splatvk").map(|folder| folder.join(LIBRARY)).filter(|l| l.exists()) {
        Some(packaged) => Ok(packaged),
        None => home().map(|home| home.join("lib").join(LIBRARY)),
    };
    if let Ok(own) = &own
        && own.exists()
    {
        let failed = |e| format!("ONNX Runtime: {} cannot be loaded ({e}); {fix}", own.display());
        return try_load(own).map(|e| (own.clone(), e)).map_err(failed);
    }
    let system = PathBuf::from(LIBRARY);
    let failed = |_| match &own {
        Ok(own) => format!("ONNX Runtime: neither {} nor a system {LIBRARY} is there; {fix}", own.display()),
        Err(e) => format!("ONNX Runtime: no system {LIBRARY} is there, and {e}"),
    };
    try_load(&system).map(|e| (system.clone(), e)).map_err(failed)
}

fn try_load(path: &Path) -> Result<Environment, String> {
    let one_line = |e: String| e.split_whitespace().collect::<Vec<_>>().join(" ");
    let builder = ort::environment::init_from(path).map_err(|e| one_line(e.to_string()))?;
    let environment = builder.with_name("splatvk").with_telemetry(false).build().map_err(|e| line(&e))?;
    environment.set_log_level(LogLevel::Error);
    Ok(environment)
}

pub(super) fn line(error: &ort::Error) -> String {
    error.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}
