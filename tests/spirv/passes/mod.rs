//! Small scenes for every pass, each compared with its twin.
mod arrays;

use splatvk::gpu::Device;

/// Runs one pass or a chain of them; `Err` says what is wrong.
pub type Scene = fn(&Device) -> Result<(), String>;

pub const ALL: &[(&str, Scene)] = &[
    ("scan", arrays::scan),
    ("gather", arrays::gather),
    ("sum", arrays::sum),
    ("sort in chunks", arrays::sort_chunks),
    ("sort in one sweep", arrays::sort_sweep),
];

/// An error that names what does not hold.
fn require(what: &str, holds: bool) -> Result<(), String> {
    if holds { Ok(()) } else { Err(format!("{what}: not what the twin computes")) }
}
