//! `splatvk eval`
use super::args::{EvalArgs, ProtocolArg};
use super::encoder;
use super::progress;
use super::{print, print_json};
use crate::format::{create_folder, scene_dir, write_json};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::query::eval::{Evaluation, GroundTruth, Rendered, Report};
use crate::query::{MaskRule, QueryOptions, QueryResult, TextQuery};
use crate::run::sources;
use crate::run::view::Viewer;
use crate::scene::LanguageField;
use crate::{Error, Result};

/// Share of the re-normalised relevancy from which a pixel belongs to the answer (LERF evaluations, ALGORITHMS 0.6).
const LERF_THRESHOLD: f32 = 0.6;

pub fn eval(args: &EvalArgs) -> Result<()> {
    let scene = scene_dir::load(&args.scene)?;
    let truth = GroundTruth::read(&args.ground_truth)?;
    if let Some(out) = &args.out {
        create_folder(out).map_err(|e| Error::input(format!("{e}; choose another --out")))?;
    }
    let mut evaluation = Evaluation::new(truth, &scene.cameras, args.out.as_deref())?;
    let phrases = evaluation.phrases();
    let queries = match &scene.language {
        Some(_) if !phrases.is_empty() => {
            let registry = Registry::open(args.device.models.as_deref())?;
            let mut encoder = encoder::of_scene(&scene, registry)?;
            let texts: Vec<String> = phrases.iter().map(|p| p.1.clone()).collect();
            sources::queries(&texts, encoder.as_mut())?
        }
        _ => Vec::new(),
    };
    let device = Device::open(args.device.device.as_deref())?;
    let nothing = LanguageField::default();
    let field = scene.language.as_ref().unwrap_or(&nothing);
    let mut viewer = Viewer::new(&device, &scene.splats, field)?;
    let progress = progress::here();
    let frames = evaluation.cameras();
    progress.begin("eval", frames.len() as u64);
    for (i, (frame, camera)) in frames.iter().enumerate() {
        progress.check()?;
        let view = viewer.view(camera)?;
        let answers = phrases
            .iter()
            .zip(&queries)
            .map(|((label, _), q)| Ok((*label, answer(&view.codes, field, q, args.protocol)?)))
            .collect::<Result<Vec<(u32, QueryResult)>>>()?;
        let rendered = Rendered { rgb: view.frame.rgb, alpha: view.frame.alpha, depth: view.frame.depth };
        evaluation.add_frame(frame, &rendered, &answers)?;
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    report(&evaluation.finish(), args)
}

fn answer(
    codes: &[crate::scene::Plane<i32>],
    field: &LanguageField,
    query: &TextQuery,
    protocol: ProtocolArg,
) -> Result<QueryResult> {
    let mask = match protocol {
        ProtocolArg::Field => QueryOptions::default().mask,
        ProtocolArg::Lerf => MaskRule::Lerf(LERF_THRESHOLD),
    };
    crate::query::answer(codes, field, query, &QueryOptions { mask, ..QueryOptions::default() })
}

/// The report is JSON in any case; `--json` keeps it on one line.
fn report(report: &Report, args: &EvalArgs) -> Result<()> {
    let value = serde_json::to_value(report).map_err(|e| Error::work(format!("eval report: {e}")))?;
    if let Some(out) = &args.out {
        write_json(&out.join("eval.json"), &value)?;
    }
    if args.device.json {
        return print_json(&value);
    }
    let text = serde_json::to_string_pretty(&value).map_err(|e| Error::work(format!("eval report: {e}")))?;
    print(&(text + "\n"))
}
