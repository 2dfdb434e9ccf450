//! Small scenes for every pass, each compared with its reference. A scene panics if a pass fails or
//! differs.
mod arrays;
mod frames;
mod losses;
mod queries;
mod stereo;

pub use frames::{bands, image};
use splatvk::gpu::Device;

pub type Scene = fn(&Device);

/// Scenes without float atomics.
pub const PLAIN: &[(&str, Scene)] = &[
    ("scan", arrays::scan),
    ("gather", arrays::gather),
    ("sum", arrays::sum),
    ("sort in chunks", arrays::sort_chunks),
    ("sort in one sweep", arrays::sort_sweep),
    ("bench", arrays::bench),
    ("gradients by entry", frames::gradients_by_entry),
    ("SH gradients per thread", frames::sh_per_thread),
    ("SH gradients in shared memory", frames::sh_shared),
    ("fused update", frames::fused_update),
    ("lists by counting", frames::lists_by_counting),
    ("lists by sorting", frames::lists_by_sorting),
    ("edge cases", frames::edge_cases),
    ("pairs", frames::pairs),
    ("label weights", frames::label_weights),
    ("decode", frames::decode),
    ("pack", frames::pack),
    ("depth loss", losses::depth),
    ("ratio penalty", losses::ratio),
    ("adam", losses::adam),
    ("code loss", losses::codes),
    ("ssim and l1", losses::ssim_l1),
    ("plane sweep", stereo::plane_sweep),
    ("text query", queries::search),
];

/// Scenes with float atomics.
pub const ADDING: &[(&str, Scene)] = &[
    ("colours", frames::colours),
    ("tile sums in shared memory", frames::shared_tile_sums),
    ("3 features", frames::few_features),
    ("8 features", frames::eight_features),
    ("21 features", frames::many_features),
];

/// Scene with a name.
pub fn named(name: &str) -> Scene {
    PLAIN.iter().chain(ADDING).find(|s| s.0 == name).expect("a scene").1
}
