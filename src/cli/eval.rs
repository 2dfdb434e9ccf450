//! `splatvk eval`
use super::args::{DeviceArgs, EvalArgs};
use super::print::{print, print_json};
use super::{moved, progress, scene};
use crate::eval::{EvalReport, Evaluation, GroundTruth};
use crate::format::scene_dir::Scene;
use crate::format::write_json;
use crate::gpu;
use crate::query::TextQuery;
use crate::run::Compat;
use crate::run::ask;
use crate::run::encoder;
use crate::run::outputs::WrittenFiles;
use crate::run::score::{Questions, ScoredScene, score_field};
use crate::scene::LanguageField;
use crate::{Error, Result};
use serde::Serialize;
use std::path::Path;

pub(super) fn eval(args: &EvalArgs) -> Result<()> {
    if let Some(protocol) = args.protocol.as_deref().filter(|name| *name != "field") {
        return Err(moved(&format!("eval --protocol {protocol}")));
    }
    if args.cameras.is_some() {
        return Err(Error::input("--cameras: ground_truth.json has the cameras; leave it out"));
    }
    let inputs = [Some(args.scene.as_path()), Some(&args.ground_truth), args.cameras_of.as_deref()];
    let inputs: Vec<&Path> = inputs.into_iter().flatten().collect();
    let open = |out| WrittenFiles::open(out, args.force, &inputs);
    let out = args.out.as_deref().map(open).transpose()?;
    let mut scene = scene::load(&args.scene, args.edits)?;
    if let Some(other) = &args.cameras_of {
        scene.cameras = scene::load(other, args.edits)?.cameras;
    }
    let scores = score_scene(&scene, args, out.as_ref())?;
    report(&scores, out, args.text.then(|| scores.text()), args.device.json)
}

/// Queries of the texts in the scene's space; none for a scene without language.
pub fn embed(scene: &Scene, texts: &[String], device: &DeviceArgs) -> Result<Vec<TextQuery>> {
    if scene.language.is_none() || texts.is_empty() {
        return Ok(Vec::new());
    }
    let mut encoder = encoder::of_scene(scene, device.registry()?)?;
    let queries = ask::embedded(texts, encoder.as_mut())?;
    encoder.embedding_warning().iter().for_each(|warning| progress::reporter().warn(warning));
    Ok(queries)
}

fn score_scene(scene: &Scene, args: &EvalArgs, out: Option<&WrittenFiles>) -> Result<EvalReport> {
    let truth = GroundTruth::read(&args.ground_truth)?;
    if let Some(doubt) = truth.check(scene.language.is_some())? {
        progress::print_warning(&doubt);
    }
    let mut evaluation = Evaluation::new(truth, &scene.cameras, out.map(WrittenFiles::folder))?;
    evaluation.add_world(&scene.world);
    let phrases: Vec<String> = evaluation.phrases().into_iter().map(|p| p.1).collect();
    let queries = embed(scene, &phrases, &args.device)?;
    let device = gpu::open(args.device.device.as_deref())?;
    let no_language = LanguageField::default();
    let field = scene.language.as_ref().unwrap_or(&no_language);
    score_field(
        &device,
        ScoredScene { splats: &scene.splats, backdrop: &scene.backdrop, field },
        Questions { queries: &queries, options: Compat::answers(args.compat.as_deref(), &args.scene)? },
        evaluation,
        args.refine_views,
        progress::reporter().as_ref(),
        &mut |_, _| Ok(()),
    )
}

/// Writes and prints a report: the table, if there is one, or JSON, on one line with `as_json`.
pub fn report(
    report: &impl Serialize,
    out: Option<WrittenFiles>,
    table: Option<String>,
    as_json: bool,
) -> Result<()> {
    let value = serde_json::to_value(report).map_err(|e| Error::work(format!("eval report: {e}")))?;
    if let Some(mut out) = out {
        write_json(&out.file("eval.json")?, &value)?;
        out.keep()?;
    }
    if let Some(table) = table {
        return print(&table);
    }
    if as_json {
        return print_json(&value);
    }
    let text = serde_json::to_string_pretty(&value).map_err(|e| Error::work(format!("eval report: {e}")))?;
    print(
        &(text
            + "
"),
    )
}
