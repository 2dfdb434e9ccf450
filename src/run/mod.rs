//! Commands that make scenes, as graphs of stages, and uses of a finished scene.
pub mod answer;
pub mod ask;
pub mod base;
mod border;
pub mod budget;
pub mod compat;
pub mod concepts;
pub mod config;
pub mod edit;
pub mod encoder;
mod execute;
mod fidelity;
mod graph;
mod ignored;
mod label;
mod light;
pub mod live;
pub mod mesh;
pub mod method;
pub mod metric;
mod networks;
pub mod objects;
pub mod orbit;
mod outcome;
pub mod paper;
pub mod path;
mod photos;
mod plan;
pub mod points;
pub mod preview;
mod recent;
pub mod record;
pub mod refine;
mod remaining;
pub mod score;
pub mod sources;
pub mod stages;
mod summary;
pub mod view;
#[cfg(feature = "cli")]
pub(crate) mod whole;

pub use answer::Answers;
pub use compat::Compat;
pub use config::{GeometryConfig, LanguageConfig, ReconstructionConfig, TrainingConfig};
pub use execute::{reconstruct, run, save, stage_folder};
pub use ignored::{Ignored, IgnoredPart};
pub use method::{FEATURE_DIM, Method, Recipe};
pub use networks::models_used;
pub use outcome::RunOutcome;
pub use plan::{CHECKPOINT_SECONDS, Destination, Extras, Inputs, Machine, RunPlan};
pub use record::{RunRecord, run_record};
pub use summary::closing_table;

#[cfg(test)]
mod defaults_tests;
