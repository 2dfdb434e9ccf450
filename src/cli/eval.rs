//! `splatvk eval`
use super::args::{EvalArgs, ProtocolArg};
use super::outputs::WrittenFiles;
use super::print::{print, print_json};
use super::progress;
use super::scene;
use super::views;
use crate::eval::protocol::{self, CodeScores, DecodedView, Masks, ProtocolKind};
use crate::eval::{EvalReport, Evaluation, GroundTruth};
use crate::format::scene_dir::Scene;
use crate::format::{picture, write_json};
use crate::gpu;
use crate::query::TextQuery;
use crate::report::file_name;
use crate::run::Compat;
use crate::run::ask;
use crate::run::encoder;
use crate::run::score::{Questions, score_field};
use crate::run::view::Viewer;
use crate::scene::LanguageField;
use crate::{Error, Result};
use serde::Serialize;
use std::path::{Path, PathBuf};

pub fn eval(args: &EvalArgs) -> Result<()> {
    let inputs: Vec<&Path> = [Some(&args.scene), Some(&args.ground_truth), args.cameras.as_ref()]
        .into_iter()
        .flatten()
        .map(PathBuf::as_path)
        .collect();
    let open = |out| WrittenFiles::open(out, args.force, &inputs);
    let mut out = args.out.as_deref().map(open).transpose()?;
    let scene = scene::load(&args.scene)?;
    match args.protocol {
        ProtocolArg::Field if args.cameras.is_some() => Err(Error::input(
            "--cameras: with --protocol field the cameras stand in ground_truth.json; leave it out",
        )),
        ProtocolArg::Field => {
            let scores = score_scene(&scene, args, out.as_ref())?;
            report(&scores, args, out, Some(scores.text()))
        }
        _ if args.refine_views || args.text || args.compat.is_some() => Err(Error::input(
            "--refine-views, --text and --compat belong to --protocol field; leave them out",
        )),
        ProtocolArg::Lerf => {
            report(&published(ProtocolKind::Lerf, &scene, args, out.as_mut())?, args, out, None)
        }
        ProtocolArg::Ovs => {
            report(&published(ProtocolKind::Ovs, &scene, args, out.as_mut())?, args, out, None)
        }
        ProtocolArg::Scannet => {
            report(&published(ProtocolKind::ScanNet, &scene, args, out.as_mut())?, args, out, None)
        }
    }
}

/// Queries of the texts in the scene's space; none for a scene without language.
fn embed(scene: &Scene, texts: &[String], args: &EvalArgs) -> Result<Vec<TextQuery>> {
    if scene.language.is_none() || texts.is_empty() {
        return Ok(Vec::new());
    }
    let registry = args.device.registry()?;
    let mut encoder = encoder::of_scene(scene, registry)?;
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
    let queries = embed(scene, &phrases, args)?;
    let device = gpu::open(args.device.device.as_deref())?;
    let no_language = LanguageField::default();
    let field = scene.language.as_ref().unwrap_or(&no_language);
    score_field(
        &device,
        &scene.splats,
        field,
        Questions { queries: &queries, options: Compat::answers(args.compat.as_deref(), &args.scene)? },
        evaluation,
        args.refine_views,
        progress::reporter().as_ref(),
        &mut |_, _| Ok(()),
    )
}

fn published(
    kind: ProtocolKind,
    scene: &Scene,
    args: &EvalArgs,
    mut out: Option<&mut WrittenFiles>,
) -> Result<protocol::ProtocolReport> {
    let Some(field) = &scene.language else {
        return Err(Error::input(format!(
            "{}: the scene has no language; make one with splatvk run",
            args.scene.display()
        )));
    };
    let known = args.cameras.as_deref().map(views::read).transpose()?.unwrap_or_default();
    let mut protocol = protocol::open(kind, &args.ground_truth, &scene.cameras, &known)?;
    let queries = embed(scene, &protocol.prompts(), args)?;
    let scores = CodeScores::new(field, &queries)?;
    let device = gpu::open(args.device.device.as_deref())?;
    let mut viewer = Viewer::new(&device, &scene.splats, field)?;
    let progress = progress::reporter();
    let views = protocol.views().to_vec();
    progress.begin("eval", views.len() as u64);
    for (i, view) in views.iter().enumerate() {
        progress.check()?;
        let decoded = viewer.view(&view.camera)?;
        let masks = protocol.add(i, &DecodedView { codes: &decoded.codes, scores: &scores })?;
        if let Some(out) = out.as_deref_mut() {
            write(out, &view.stem, &decoded.rendered.rgb, masks)?;
        }
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    Ok(protocol.finish())
}

fn write(out: &mut WrittenFiles, stem: &str, rgb: &crate::scene::RgbImage, masks: Masks) -> Result<()> {
    let name = format!("{stem}.png");
    picture::write_png(&out.file(&format!("renders/{name}"))?, rgb)?;
    for (phrase, mask) in masks {
        picture::write_mask_png(&out.file(&format!("masks/{}/{name}", file_name(&phrase)))?, &mask)?;
    }
    Ok(())
}

/// Writes and prints the report: JSON unless `--text` is given, on one line with `--json`.
fn report(
    report: &impl Serialize,
    args: &EvalArgs,
    out: Option<WrittenFiles>,
    table: Option<String>,
) -> Result<()> {
    let value = serde_json::to_value(report).map_err(|e| Error::work(format!("eval report: {e}")))?;
    if let Some(mut out) = out {
        write_json(&out.file("eval.json")?, &value)?;
        out.keep()?;
    }
    if let Some(table) = table.filter(|_| args.text) {
        return print(&table);
    }
    if args.device.json {
        return print_json(&value);
    }
    let text = serde_json::to_string_pretty(&value).map_err(|e| Error::work(format!("eval report: {e}")))?;
    print(&(text + "\n"))
}
