//! Contents of `run.json` and of the report.
use super::bare::bare;
use super::viewer;
use crate::photo::Light;
use crate::progress::StageRecord;
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// Model file of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelUsed {
    /// Model name.
    pub name: String,
    /// SHA-256 of the file.
    pub sha256: String,
    /// SPDX expression.
    pub licence: String,
}

/// Content of `run.json`, with typed configuration and statistics or with plain JSON.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct RunRecord<Config = Value, Statistics = Value> {
    /// "splatvk 0.1.0".
    pub program: String,
    /// Options after defaults were resolved.
    pub config: Config,
    /// Seed of everything random.
    pub seed: u64,
    /// Name of the Vulkan device.
    pub device: String,
    /// Whether the device computes on the CPU.
    pub device_is_cpu: bool,
    /// Model files of the run.
    pub models: Vec<ModelUsed>,
    /// Stages in order.
    pub stages: Vec<StageRecord>,
    /// Wall seconds of the run.
    pub seconds: f64,
    /// Splats, PSNR, match counts, codes per level.
    pub statistics: Statistics,
    /// Warnings of the run.
    pub warnings: Vec<String>,
}

impl<Config: Serialize, Statistics: Serialize> RunRecord<Config, Statistics> {
    /// Record as JSON without the folders of the paths that the user typed, since scenes and
    /// reports are shared.
    ///
    /// # Errors
    /// Values that JSON does not hold.
    pub fn without_folders<'a>(self, typed: impl IntoIterator<Item = &'a Path>) -> Result<RunRecord> {
        let typed: Vec<&Path> = typed.into_iter().collect();
        let json =
            |value: serde_json::Result<Value>| value.map_err(|e| Error::work(format!("run.json: {e}")));
        let mut warnings = Value::from(self.warnings);
        let mut config = json(serde_json::to_value(self.config))?;
        let mut statistics = json(serde_json::to_value(self.statistics))?;
        for value in [&mut config, &mut statistics, &mut warnings] {
            bare(value, typed.iter().copied());
        }
        let texts = warnings.as_array().into_iter().flatten();
        let warnings = texts.filter_map(|w| w.as_str().map(str::to_owned)).collect();
        let RunRecord { program, seed, device, device_is_cpu, models, stages, seconds, .. } = self;
        Ok(RunRecord {
            program,
            config,
            seed,
            device,
            device_is_cpu,
            models,
            stages,
            seconds,
            statistics,
            warnings,
        })
    }
}

impl RunRecord {
    /// Writes `run.json` into a scene folder.
    pub fn write(&self, folder: &Path) -> Result<()> {
        crate::format::write_json(&folder.join("run.json"), self)
    }
}

/// Training view in the report; maps have the size of the photo or are absent.
#[derive(Clone, Copy, Debug)]
pub struct ViewShown<'a> {
    /// Name under the pictures, also the stem of preview files.
    pub name: &'a str,
    /// Working-resolution photo.
    pub photo: &'a RgbImage,
    /// Render from the final scene.
    pub render: Option<&'a RgbImage>,
    /// Expected depth of the render.
    pub depth: Option<&'a Image<f32>>,
    /// Decoded codes per level (name, map), −1 = none.
    pub levels: &'a [(&'a str, Image<i32>)],
    /// PSNR of the render, dB.
    pub psnr: Option<f64>,
    /// Light that was corrected in the photo.
    pub light: Light,
}

/// Answer to one query in one view.
#[derive(Clone, Debug)]
pub struct AnswerShown {
    /// Index into the views.
    pub view: usize,
    /// [H, W] relevancy, size of the photo.
    pub relevancy: Image<f32>,
    /// [H, W] mask.
    pub mask: Option<Image<bool>>,
    /// Whether the view shows it.
    pub found: bool,
}

/// How sure an answer is, for its colour on the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Certainty {
    /// The thing is there.
    Found,
    /// The masks may show something else.
    Unsure,
    /// No view shows it.
    Nothing,
}

/// Query with its answers.
#[derive(Clone, Debug)]
pub struct QueryShown<'a> {
    /// Text of the query.
    pub text: &'a str,
    /// Answer in a few words.
    pub verdict: String,
    /// How sure it is.
    pub certainty: Certainty,
    /// One per view.
    pub answers: Vec<AnswerShown>,
}

/// Figure of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Figure {
    /// Short name.
    pub label: &'static str,
    /// Value with its unit.
    pub value: String,
    /// A sentence that explains it.
    pub meaning: &'static str,
    /// Whether a reader needs it to judge the scene; the others are folded in the report.
    pub matters: bool,
}

impl Figure {
    /// A figure that is folded in the report.
    pub fn new(label: &'static str, value: String, meaning: &'static str) -> Figure {
        Figure { label, value, meaning, matters: false }
    }

    /// A figure that the report shows at once.
    pub fn that_matters(label: &'static str, value: String, meaning: &'static str) -> Figure {
        Figure { label, value, meaning, matters: true }
    }
}

/// Figure over the optimisation steps of a stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Curve {
    /// Measured quantity.
    pub name: &'static str,
    /// dB, % or empty.
    pub unit: &'static str,
    /// (step, value).
    pub points: Vec<(f64, f64)>,
}

/// Contents of `report.html` and `previews/`.
#[derive(Clone, Debug)]
pub struct HtmlReport<'a> {
    /// Headline, usually the name of the photo folder.
    pub title: &'a str,
    /// Training views.
    pub views: Vec<ViewShown<'a>>,
    /// Queries of the run.
    pub queries: Vec<QueryShown<'a>>,
    /// Training curves.
    pub curves: Vec<Curve>,
    /// Embedding space of the language field; for `words/…` the page explains its limits.
    pub space: Option<&'a str>,
    /// Scene for the interactive view.
    pub scene: Option<viewer::Scene3d<'a>>,
    /// Figures with their meaning.
    pub figures: Vec<Figure>,
    /// Run record.
    pub run: &'a RunRecord,
}
