//! Plans from the arguments that several commands share. No work happens here.
use super::args::PresetArg;

/// The library's preset.
pub fn preset(preset: PresetArg) -> crate::fit::Preset {
    match preset {
        PresetArg::Draft => crate::fit::Preset::Draft,
        PresetArg::Default => crate::fit::Preset::Default,
        PresetArg::Paper => crate::fit::Preset::Paper,
    }
}
