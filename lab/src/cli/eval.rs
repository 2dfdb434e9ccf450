//! `splatlab eval`
use super::args::EvalArgs;
use crate::protocol::{self, CodeScores, DecodedView, Masks, ProtocolKind};
use crate::{Error, Result};
use splatvk::cli::args::EditUse;
use splatvk::cli::eval::{embed, report};
use splatvk::cli::{progress, scene, views};
use splatvk::format::picture;
use splatvk::format::scene_dir::Scene;
use splatvk::gpu;
use splatvk::report::file_name;
use splatvk::run::outputs::WrittenFiles;
use splatvk::run::view::Viewer;
use splatvk::scene::RgbImage;
use std::path::{Path, PathBuf};

pub fn eval(args: &EvalArgs) -> Result<()> {
    let inputs = [Some(&args.scene), Some(&args.ground_truth), args.cameras.as_ref()];
    let inputs: Vec<&Path> = inputs.into_iter().flatten().map(PathBuf::as_path).collect();
    let open = |out| WrittenFiles::open(out, args.force, &inputs);
    let mut out = args.out.as_deref().map(open).transpose()?;
    let scene = scene::load(&args.scene, EditUse::default())?;
    let scores = published(args.protocol.kind(), &scene, args, out.as_mut())?;
    report(&scores, out, None, args.device.json)
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
    let queries = embed(scene, &protocol.prompts(), &args.device)?;
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

fn write(out: &mut WrittenFiles, stem: &str, rgb: &RgbImage, masks: Masks) -> Result<()> {
    let name = format!("{stem}.png");
    picture::write_png(&out.file(&format!("renders/{name}"))?, rgb)?;
    for (phrase, mask) in masks {
        picture::write_mask_png(&out.file(&format!("masks/{}/{name}", file_name(&phrase)))?, &mask)?;
    }
    Ok(())
}
