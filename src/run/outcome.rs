//! The result of a run.
use super::answer::Answers;
use super::plan::RunPlan;
use super::view::DecodedFrame;
use crate::fit;
use crate::language;
use crate::photo::Photo;
use crate::pose::{self, Geometry};
use crate::preset::Preset;
use crate::progress::StageRecord;
use crate::report::ModelUsed;
use crate::report::viewer::CodeNames;
use crate::scene::{Camera, LanguageField, Seen, Splats, World};

/// Everything that a run made; [`crate::report`] turns it into run.json, report.html and the
/// summary.
#[non_exhaustive]
pub struct RunOutcome {
    /// The plan that was run.
    pub plan: RunPlan,
    /// The preset that was used.
    pub preset: Preset,
    /// The device that was used.
    pub device: crate::gpu::DeviceInfo,
    /// Which photos were used and why, where there were more than wanted.
    pub choice: Option<pose::choose::Choice>,
    /// Photos at working resolution.
    pub photos: Vec<Photo>,
    /// Photos whose place could not be found surely.
    pub left_out: Vec<pose::choose::LeftOut>,
    /// The first so many photos were in the scene already that the others were added to; 0 = no
    /// scene.
    pub known: usize,
    /// Geometry before training.
    pub geometry: Geometry,
    /// Refined cameras.
    pub cameras: Vec<Camera>,
    /// Which way is up, as far as that was found.
    pub world: World,
    /// The scene.
    pub splats: Splats,
    /// What the photos show of it.
    pub seen: Seen,
    /// Figures of the colour stage.
    pub rgb: fit::FitStats,
    /// PSNR of the finished scene against every photo, dB.
    pub psnr: Vec<f64>,
    /// The trained scene seen from every photo's camera.
    pub frames: Vec<DecodedFrame>,
    /// The scene's language; `None` for a scene of colours alone.
    pub language: Option<LanguageOutcome>,
    /// What computed the networks.
    pub provider: Option<&'static str>,
    /// Built-in models.
    pub models: Vec<crate::infer::ModelStatus>,
    /// Files of the networks that were used.
    pub networks: Vec<ModelUsed>,
    /// Times and memory per stage, up to the writing of the scene.
    pub stages: Vec<StageRecord>,
    /// Wall seconds up to there; less than the stages together, since some overlap.
    pub seconds: f64,
    /// What the user was warned of.
    pub warnings: Vec<String>,
}

/// The language of a finished run.
#[non_exhaustive]
pub struct LanguageOutcome {
    /// Codes and features.
    pub field: LanguageField,
    /// Masks, edges and components behind it.
    pub alignment: language::align::Alignment,
    /// Decode accuracy over the language stage.
    pub curve: Vec<fit::LanguagePoint>,
    /// One per query of the plan.
    pub answers: Vec<Answers>,
    /// The text model's own phrases per level and code.
    pub names: CodeNames,
}
