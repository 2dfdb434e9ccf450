//! Training: losses, schedules, pruning, pose refinement.
pub mod densify;
pub mod init;
pub mod options;
pub mod pose;
pub mod schedule;

pub use options::{FeatureGauge, InitOptions, LanguageOptions, Preset, Rates, RgbOptions};
