//! The commands that make scenes, as lists of stages, and what is done with a finished one.
pub mod answer;
pub mod ask;
pub mod base;
mod border;
pub mod budget;
pub mod compat;
pub mod encoder;
mod execute;
mod fidelity;
mod light;
mod list;
pub mod live;
pub mod method;
pub mod metric;
mod networks;
mod outcome;
mod plan;
mod recent;
mod record;
pub mod refine;
pub mod score;
pub mod sources;
pub mod stages;
pub mod train;
pub mod view;

pub use answer::Answers;
pub use compat::Compat;
pub use execute::{reconstruct, run, save, stage_folder};
pub use method::{FEATURE_DIM, Method, Recipe};
pub use outcome::RunOutcome;
pub use plan::{CHECKPOINT_SECONDS, RunPlan};
pub use record::{closing_table, run_record};

#[cfg(test)]
mod defaults_tests;
