//! The result of a run.
use super::answer::Answers;
use super::ignored::Ignored;
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

/// Everything that a run produced; [`crate::report`] turns it into run.json, report.html and the
/// summary.
#[non_exhaustive]
pub struct RunOutcome {
    /// The plan that was run.
    pub plan: RunPlan,
    /// The preset that was used.
    pub preset: Preset,
    /// The device that was used.
    pub device: crate::gpu::DeviceInfo,
    /// Choice of photos with its reasons, if there were more than requested.
    pub choice: Option<pose::choose::Choice>,
    /// Photos at working resolution.
    pub photos: Vec<Photo>,
    /// Things that were ignored in the photos.
    pub ignored: Vec<Ignored>,
    /// Photos that could not be registered reliably.
    pub left_out: Vec<pose::choose::LeftOut>,
    /// Number of leading photos that an extended scene already had; 0 for a new scene.
    pub known: usize,
    /// Geometry before training.
    pub geometry: Geometry,
    /// Refined cameras.
    pub cameras: Vec<Camera>,
    /// Direction up and scale, as far as known.
    pub world: World,
    /// The scene.
    pub splats: Splats,
    /// Blending weight of the splats in the photos.
    pub seen: Seen,
    /// Splats behind the scene, which no photo shows.
    pub backdrop: Splats,
    /// Statistics of the colour stage.
    pub rgb: fit::FitStats,
    /// PSNR of the finished scene against every photo, dB.
    pub psnr: Vec<f64>,
    /// The finished scene rendered from every photo's camera.
    pub frames: Vec<DecodedFrame>,
    /// The scene's language; `None` for a scene of colours alone.
    pub language: Option<LanguageOutcome>,
    /// Execution provider of the networks.
    pub provider: Option<&'static str>,
    /// Built-in models.
    pub models: Vec<crate::infer::ModelStatus>,
    /// Files of the networks that were used.
    pub networks: Vec<ModelUsed>,
    /// Times and memory per stage, up to the writing of the scene.
    pub stages: Vec<StageRecord>,
    /// Wall-clock seconds up to there; less than the sum of the stages, since some overlap.
    pub seconds: f64,
    /// Warnings to the user.
    pub warnings: Vec<String>,
}

/// The language of a finished run.
#[non_exhaustive]
pub struct LanguageOutcome {
    /// Codes and features.
    pub field: LanguageField,
    /// Masks, edges and components.
    pub alignment: language::align::Alignment,
    /// Decode accuracy over the language stage.
    pub curve: Vec<fit::LanguagePoint>,
    /// Answers, one per query of the plan.
    pub answers: Vec<Answers>,
    /// Phrases of the text model per level and code.
    pub names: CodeNames,
}
