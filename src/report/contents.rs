//! Contents of run.json and the report.
use super::bare::bare;
use super::viewer;
use crate::Result;
use crate::photo::Light;
use crate::progress::StageRecord;
use crate::scene::{Image, RgbImage};
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// A model file that a run used.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ModelUsed {
    /// Model name.
    pub name: String,
    /// Of the file.
    pub sha256: String,
    /// SPDX expression.
    pub licence: String,
}

/// The content of `run.json`.
#[derive(Clone, Debug, Serialize)]
pub struct RunRecord {
    /// "splatvk 0.1.0".
    pub program: String,
    /// Options after defaults were resolved.
    pub config: Value,
    /// Seed of everything random.
    pub seed: u64,
    /// Name of the Vulkan device.
    pub device: String,
    /// The device computes on the CPU.
    pub device_is_cpu: bool,
    /// Model files that were used.
    pub models: Vec<ModelUsed>,
    /// Stages in order.
    pub stages: Vec<StageRecord>,
    /// Wall seconds of the run.
    pub seconds: f64,
    /// Splats, PSNR, match counts, codes per level: free-form.
    pub statistics: Value,
    /// What the user was warned about.
    pub warnings: Vec<String>,
}

impl RunRecord {
    /// The same without the folders of the paths that the user typed: a scene and its report are
    /// passed on, and nobody there needs to know where the photos lay.
    pub fn without_folders<'a>(mut self, typed: impl IntoIterator<Item = &'a Path>) -> RunRecord {
        let mut warnings = Value::from(std::mem::take(&mut self.warnings));
        let typed: Vec<&Path> = typed.into_iter().collect();
        for value in [&mut self.config, &mut self.statistics, &mut warnings] {
            bare(value, typed.iter().copied());
        }
        let texts = warnings.as_array().into_iter().flatten();
        self.warnings = texts.filter_map(|w| w.as_str().map(str::to_owned)).collect();
        self
    }

    /// Writes `run.json` into a scene folder.
    pub fn write(&self, folder: &Path) -> Result<()> {
        crate::format::write_json(&folder.join("run.json"), self)
    }
}

/// One training view in the report; maps have the size of the photo or are left out.
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
    /// What was taken out of the photo.
    pub light: Light,
}

/// The answer to one text in one view.
#[derive(Clone, Copy, Debug)]
pub struct AnswerShown<'a> {
    /// Index into the views.
    pub view: usize,
    /// [H, W] relevancy, size of the photo.
    pub relevancy: &'a Image<f32>,
    /// [H, W] mask.
    pub mask: Option<&'a Image<bool>>,
    /// Best relevancy.
    pub score: f32,
    /// Reached the threshold.
    pub found: bool,
    /// Name of the level that answered.
    pub level: &'a str,
}

/// A query and its answers.
#[derive(Clone, Debug)]
pub struct QueryShown<'a> {
    /// The text of the query.
    pub text: &'a str,
    /// The answer in a few words.
    pub verdict: String,
    /// One per view.
    pub answers: Vec<AnswerShown<'a>>,
}

/// A figure over the optimisation steps of a stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Curve {
    /// What is measured.
    pub name: &'static str,
    /// dB, %, or nothing.
    pub unit: &'static str,
    /// (step, value).
    pub points: Vec<(f64, f64)>,
}

/// Everything that `report.html` and `previews/` show.
#[derive(Clone, Debug)]
pub struct HtmlReport<'a> {
    /// Headline, usually the name of the photo folder.
    pub title: &'a str,
    /// Training views.
    pub views: Vec<ViewShown<'a>>,
    /// Queries of the run.
    pub queries: Vec<QueryShown<'a>>,
    /// How training went.
    pub curves: Vec<Curve>,
    /// Embedding space of the language field; `words/…` gets a plain statement of what it covers.
    pub space: Option<&'a str>,
    /// The scene for the interactive view.
    pub scene: Option<viewer::Scene3d<'a>>,
    /// Figures for the head of the page: (label, value).
    pub figures: Vec<(String, String)>,
    /// Run record.
    pub run: &'a RunRecord,
}
