//! Data with a known answer: scenes with exact cameras, depth, masks and phrases, and regions with
//! injected errors.
mod flat;
mod folder;
mod outdoor;
mod overlay;
mod phone;
mod photos;
pub mod regions;
mod render;
mod scene;
mod shapes;
mod spoil;
mod walker;

pub use flat::Flat;
pub use folder::{CLEAN, USED, foreign, generate, write_regions};
pub use outdoor::Sky;
pub use phone::{Effects, PhotoEffects, TrueLight, to_linear, to_srgb};
pub use render::{RayCast, geometry, photo, render};
pub use scene::{SceneSpec, SyntheticScene, build_scene};
pub use shapes::{Hit, Paint, SceneObject, Shape};
pub use spoil::Spoil;
pub use walker::Walker;

#[cfg(test)]
mod overlay_tests;
#[cfg(test)]
mod query_tests;
