//! Plans from the arguments that several commands share. No work happens here.
use super::args::PresetArg;
use crate::photo::SMALLEST_SIDE;
use crate::{Error, Result};
use std::path::PathBuf;

/// `--max-size`, if it leaves enough to work with.
pub fn max_size(given: Option<usize>) -> Result<Option<usize>> {
    match given {
        Some(n) if n < SMALLEST_SIDE => Err(Error::input(format!(
            "--max-size {n}: give at least {SMALLEST_SIDE} pixels, or leave it out"
        ))),
        _ => Ok(given),
    }
}

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
