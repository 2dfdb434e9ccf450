//! `splatlab generate`
use super::args::GenerateArgs;
use crate::generate::regions::InjectedErrors;
use crate::generate::{self as scenes, Effects, SceneSpec, Spoil};
use crate::{Error, Result};
use splatvk::cli::print::{print, print_json};
use splatvk::cli::progress;
use splatvk::format::{Replaced, Workspace};
use std::path::Path;

pub fn generate(args: &GenerateArgs) -> Result<()> {
    let flaws = flaws(args)?;
    let inputs: Vec<&Path> = args.from.as_deref().into_iter().collect();
    let generated = Replaced { name: "generated data", foreign: scenes::foreign };
    let workspace = Workspace::replacing(&args.out, args.force, &inputs, generated)?;
    match &args.from {
        Some(data) => scenes::write_regions(data, workspace.path(), &flaws)?,
        None => scenes::generate(workspace.path(), &spec(args)?, &flaws, progress::reporter().as_ref())?,
    }
    let folder = workspace.commit()?;
    if args.json {
        return print_json(&serde_json::json!({ "folder": folder }));
    }
    print(&format!("data is in {}\n", folder.display()))
}

fn flaws(args: &GenerateArgs) -> Result<InjectedErrors> {
    for (flag, rate) in [("--split", args.split), ("--merge", args.merge), ("--wrong", args.wrong)] {
        if !(0.0..=1.0).contains(&rate) {
            return Err(Error::input(format!("{flag} {rate}: a rate lies between 0 and 1")));
        }
    }
    if !(args.noise >= 0.0 && args.noise.is_finite()) {
        return Err(Error::input(format!("--noise {}: give 0 or more", args.noise)));
    }
    Ok(InjectedErrors {
        seed: args.seed,
        split: args.split,
        merge: args.merge,
        wrong: args.wrong,
        noise: args.noise,
        alike: false,
    })
}

fn spec(args: &GenerateArgs) -> Result<SceneSpec> {
    let size = args.size.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let size = size.ok_or_else(|| Error::input(format!("--size {}: write it as 640x480", args.size)))?;
    let effects = effects(args);
    // Sensor noise replaces the uniform noise by default.
    let default_noise = if effects.sensor_noise { 0.0 } else { SceneSpec::default().photo_noise };
    Ok(SceneSpec {
        seed: args.seed,
        views: args.views,
        held_out: args.held_out,
        beyond: args.beyond,
        size,
        objects: args.objects,
        baseline: args.baseline,
        texture: args.texture,
        gloss: args.gloss,
        thin: args.thin,
        occlusion: args.occlusion,
        similar: args.similar,
        pose_noise: args.pose_noise,
        photo_noise: args.photo_noise.unwrap_or(default_noise),
        steady: args.steady,
        zoom: args.zoom,
        flat: args.flat,
        outdoor: args.outdoor,
        effects,
        walker: args.walker,
        spoil: args.spoil,
    })
}

/// Effects of the options: `--phone` turns all on, the other flags add single ones.
fn effects(args: &GenerateArgs) -> Effects {
    let phone = if args.phone { Effects::PHONE } else { Effects::default() };
    let swapped = args.spoil == Some(Spoil::SwappedExif);
    Effects {
        focal: args.focal || phone.focal || swapped,
        lens: args.lens || phone.lens,
        centre: args.centre || phone.centre,
        light: args.light || phone.light,
        sensor_noise: args.sensor_noise || phone.sensor_noise,
        jpeg: args.jpeg.or(phone.jpeg),
        two_cameras: args.two_cameras || swapped,
    }
}
