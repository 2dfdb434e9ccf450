//! Plans from the arguments that several commands share. No work happens here.
use super::args::PresetArg;
use crate::{Error, Result};
use std::path::PathBuf;

/// The library's preset.
pub fn preset(preset: PresetArg) -> crate::fit::Preset {
    match preset {
        PresetArg::Draft => crate::fit::Preset::Draft,
        PresetArg::Default => crate::fit::Preset::Default,
        PresetArg::Paper => crate::fit::Preset::Paper,
    }
}

pub(super) fn existing(flag: &str, path: &str) -> Result<PathBuf> {
    let path = PathBuf::from(path);
    if path.exists() {
        return Ok(path);
    }
    Err(Error::input(format!("{flag}: {} does not exist; check the path", path.display())))
}
