//! Training: losses, schedules, pruning, pose refinement.
mod added;
mod bounds;
mod coarse;
pub mod index_head;
pub mod init;
mod language;
mod lift;
mod model;
pub mod options;
pub mod pose;
mod rgb;
pub mod scale;
pub mod schedule;
mod training;
mod unseen;
mod views;

pub use crate::preset::Preset;
pub use added::{new_surface, train_on};
pub(crate) use coarse::Photos;
pub(crate) use language::Run as LanguageRun;
pub use language::{LanguagePoint, TrainedLanguage, train_language};
pub use options::{InitOptions, LanguageOptions, Rates, RgbOptions};
pub(crate) use rgb::Run as RgbRun;
pub use rgb::{CurvePoint, FitStats, Trained, fit_rgb, train_rgb};
pub(crate) use training::Training;
