//! `splatlab object-accuracy`: the things of a scene against the objects of views that it has not
//! seen.
use super::args::ObjectAccuracyArgs;
use super::mesh_accuracy::similarity;
use crate::panoptic::Panoptic;
use crate::{Error, Result};
use serde_json::{Value, json};
use splatvk::cli::args::EditUse;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::scene;
use splatvk::eval::{GroundTruth, Split};
use splatvk::format::scene_dir::Scene;
use splatvk::gpu::{self, Device};
use splatvk::query::instances::Places;
use splatvk::query::things::{LEVELS, numbers};
use splatvk::run::objects::LEAST_SHARE;
use splatvk::run::view::BlendedValues;
use splatvk::scene::{Camera, Image};
use std::collections::BTreeSet;
use std::path::Path;

/// Share of the picture below which a segment is small: the largest are ground and walls.
const SMALL: f64 = 0.1;
/// Blending weight from which a pixel shows a thing.
const SHOWN: f32 = 0.5;

pub fn object_accuracy(args: &ObjectAccuracyArgs) -> Result<()> {
    if args.scenes.len() != args.ground_truth.len() {
        return Err(Error::input(format!(
            "{} scenes and {} of --ground-truth: give one for each",
            args.scenes.len(),
            args.ground_truth.len()
        )));
    }
    let device = gpu::open(args.device.device.as_deref())?;
    // Per partition all segments and small ones.
    let mut scores = vec![[Panoptic::default(); 2]; LEVELS.len()];
    for (scene, truth) in args.scenes.iter().zip(&args.ground_truth) {
        add(scene, truth, &device, &mut scores)?;
    }
    let levels = LEVELS.iter().zip(&scores);
    if args.device.json {
        let figures = |score: &Panoptic| {
            json!({
                "pq": score.quality(), "sq": score.segmentation(), "rq": score.recognition(),
                "matched": score.matched, "extra": score.extra, "missed": score.missed,
            })
        };
        let level = |(name, [all, small]): (&&str, &[Panoptic; 2])| json!({ "level": name, "all": figures(all), "small": figures(small) });
        return print_json(&Value::Array(levels.map(level).collect()));
    }
    let mut text = "level  segments           PQ     SQ     RQ     matched  extra  missed\n".to_owned();
    for (name, score) in levels {
        for (which, score) in ["all", "below a tenth"].iter().zip(score) {
            text += &format!(
                "{name:<6} {which:<15} {:6.3} {:6.3} {:6.3} {:10} {:6} {:7}\n",
                score.quality(),
                score.segmentation(),
                score.recognition(),
                score.matched,
                score.extra,
                score.missed
            );
        }
    }
    print(&text)
}

/// Adds the views of a scene.
fn add(path: &Path, folder: &Path, device: &Device, scores: &mut [[Panoptic; 2]]) -> Result<()> {
    let truth = GroundTruth::read(folder)?;
    let scene = scene::load(path, EditUse::default())?;
    let from_truth = similarity(&truth, &scene)?.inverse();
    let mut views = Vec::new();
    for frame in truth.frames.iter().filter(|frame| frame.split != Split::Train) {
        let objects = truth.objects(frame)?;
        views.extend(objects.map(|objects| (from_truth.camera(&frame.camera), objects)));
    }
    if views.is_empty() {
        return Err(Error::input(format!(
            "{}: no masks of views that are held out from the photos",
            folder.display()
        )));
    }
    let cameras: Vec<&Camera> = views.iter().map(|(camera, _)| camera).collect();
    for (owners, score) in partitions(&scene)?.iter().zip(scores) {
        for (found, (_, objects)) in shown(&scene, owners, &cameras, device)?.iter().zip(&views) {
            score[0].add(found, objects, |_| true);
            score[1].add(found, objects, |share| share < SMALL);
        }
    }
    Ok(())
}

/// Per level of things the thing of every splat, 0 = none.
fn partitions(scene: &Scene) -> Result<Vec<Vec<u32>>> {
    let field = scene.language.as_ref().ok_or_else(|| Error::input("the scene has no language"))?;
    let count = scene.splats.len();
    let places = Places::of(&scene.splats, field);
    let all = places.things(LEAST_SHARE);
    Ok((0..LEVELS.len()).map(|level| numbers(all.iter(), level, count)).collect())
}

/// Per view the owner of most of every pixel, 0 = none.
fn shown(scene: &Scene, owners: &[u32], cameras: &[&Camera], device: &Device) -> Result<Vec<Image<u32>>> {
    let empty = |camera: &&Camera| Image::filled(camera.width as usize, camera.height as usize, 0u32);
    let mut numbers: Vec<Image<u32>> = cameras.iter().map(empty).collect();
    let own: BTreeSet<u32> = owners.iter().copied().filter(|owner| *owner > 0).collect();
    for owner in own {
        let values: Vec<f32> = owners.iter().map(|o| f32::from(u8::from(*o == owner))).collect();
        let mut shares = BlendedValues::new(device, &scene.splats, &values)?;
        for (numbers, camera) in numbers.iter_mut().zip(cameras) {
            let share = shares.view(camera)?;
            let most = numbers.data.iter_mut().zip(&share.data).filter(|(_, share)| **share > SHOWN);
            // Shares of different things add up to at most 1.
            most.for_each(|(number, _)| *number = owner);
        }
    }
    Ok(numbers)
}
