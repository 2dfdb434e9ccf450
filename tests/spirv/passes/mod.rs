//! Small scenes for every pass, each compared with its reference: the cases of `splatvk doctor
//! --check`, and edge cases of rendering beside them. A scene panics if a pass fails or differs.
mod bench;
mod frames;

pub use frames::{bands, image};
use splatvk::check::{self, Case};
use splatvk::gpu::Device;

#[derive(Clone, Copy)]
pub enum Scene {
    Check(Case),
    Own(&'static str, fn(&Device)),
}

impl Scene {
    /// The pass and its variant, or the name of the scene.
    pub fn name(&self) -> String {
        match self {
            Scene::Own(name, _) => (*name).to_owned(),
            Scene::Check(Case { pass, variant: None, .. }) => (*pass).to_owned(),
            Scene::Check(Case { pass, variant: Some(variant), .. }) => format!("{pass}, {}", variant.name()),
        }
    }

    pub fn run(&self, device: &Device) {
        match self {
            Scene::Own(_, run) => run(device),
            Scene::Check(case) => drop(case.row(device).outcome.unwrap()),
        }
    }
}

/// Scenes without float atomics.
const PLAIN: &[(&str, fn(&Device))] = &[
    ("bench", bench::bench),
    ("gradients by entry", frames::gradients_by_entry),
    ("SH gradients per thread", frames::sh_per_thread),
    ("SH gradients in shared memory", frames::sh_shared),
    ("fused update", frames::fused_update),
    ("lists by counting", frames::lists_by_counting),
    ("lists by sorting", frames::lists_by_sorting),
    ("edge cases", frames::edge_cases),
    ("pairs", frames::pairs),
];

/// Scenes with float atomics.
const ADDING: &[(&str, fn(&Device))] = &[
    ("colours", frames::colours),
    ("tile sums in shared memory", frames::shared_tile_sums),
    ("3 features", frames::few_features),
    ("8 features", frames::eight_features),
    ("21 features", frames::many_features),
];

/// The edge cases of rendering, those with float atomics last.
pub fn own() -> impl Iterator<Item = Scene> {
    PLAIN.iter().chain(ADDING).map(|(name, run)| Scene::Own(name, *run))
}

/// Scenes for a device with native float atomics, or those that differ on a device without them.
pub fn all(float_atomics: bool) -> Vec<Scene> {
    let adds = |scene: &Scene| ADDING.iter().any(|(name, _)| *name == scene.name());
    let checks = check::cases(float_atomics).map(Scene::Check);
    match float_atomics {
        true => checks.chain(own()).collect(),
        false => checks.last().into_iter().chain(own().filter(adds)).collect(),
    }
}

/// Scene with a name.
pub fn named(name: &str) -> Scene {
    all(true).into_iter().find(|s| s.name() == name).expect("a scene")
}
