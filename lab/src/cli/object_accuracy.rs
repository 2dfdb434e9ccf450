//! `splatlab object-accuracy`: the things of a scene against the objects of views that it has not
//! seen.
use super::args::ObjectAccuracyArgs;
use super::mesh_accuracy::similarity;
use crate::panoptic::Panoptic;
use crate::sizes::{Size, TruePhoto, extents, matches};
use crate::{Error, Result};
use glam::DVec3;
use serde_json::{Value, json};
use splatvk::cli::args::EditUse;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::{progress, scene};
use splatvk::eval::{GroundTruth, Split};
use splatvk::format::scene_dir::Scene;
use splatvk::gpu::{self, Device};
use splatvk::query::instances::Places;
use splatvk::query::things::{LEVELS, OBJECTS, Thing, numbers};
use splatvk::run::mesh::{self, MeshOptions, Simplify, TRIANGLES, Things};
use splatvk::run::objects::LEAST_SHARE;
use splatvk::run::view::BlendedValues;
use splatvk::scene::{Camera, Image};
use std::collections::BTreeSet;

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
    let mut sizes = Vec::new();
    for (scene, truth) in args.scenes.iter().zip(&args.ground_truth) {
        let truth = GroundTruth::read(truth)?;
        let scene = scene::load(scene, EditUse::default())?;
        let things = things(&scene)?;
        match args.sizes {
            true => sizes.extend(measured(&scene, &things, &truth, &device)?),
            false => add(&scene, &things, &truth, &device, &mut scores)?,
        }
    }
    match (args.device.json, args.sizes) {
        (true, true) => print_json(&sizes.iter().map(Size::json).collect()),
        (true, false) => print_json(&figures(&scores)),
        (false, true) => print(&table(&sizes)),
        (false, false) => print(&text(&scores)),
    }
}

fn figures(scores: &[[Panoptic; 2]]) -> Value {
    let figures = |score: &Panoptic| {
        json!({
            "pq": score.quality(), "sq": score.segmentation(), "rq": score.recognition(),
            "matched": score.matched, "extra": score.extra, "missed": score.missed,
        })
    };
    let level = |(name, [all, small]): (&&str, &[Panoptic; 2])| json!({ "level": name, "all": figures(all), "small": figures(small) });
    LEVELS.iter().zip(scores).map(level).collect()
}

fn text(scores: &[[Panoptic; 2]]) -> String {
    let mut text = "level  segments           PQ     SQ     RQ     matched  extra  missed\n".to_owned();
    for (name, score) in LEVELS.iter().zip(scores) {
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
    text
}

fn table(sizes: &[Size]) -> String {
    let mut text =
        "object                    size (x y z)           truth                  error (x y z)\n".to_owned();
    for size in sizes {
        let row = |v: DVec3| v.to_array().map(|v| format!("{v:.3}")).join(" ");
        let errors = size.errors().to_array().map(|e| format!("{:+.1}", 100.0 * e));
        text += &format!(
            "{:<25} {:<22} {:<22} {} %\n",
            size.name,
            row(size.found),
            row(size.known),
            errors.join(" ")
        );
    }
    let mut errors: Vec<f64> = sizes.iter().flat_map(|s| s.errors().abs().to_array()).collect();
    errors.sort_by(f64::total_cmp);
    let Some(median) = errors.get(errors.len() / 2) else {
        return text + "no thing is an object of the truth\n";
    };
    let within = |share: f64| errors.iter().filter(|e| **e <= share).count() as f64 / errors.len() as f64;
    text + &format!(
        "{} objects: median error {:.1} % of a side; {:.0} % of the sides within 3 %, {:.0} % within 10 %\n",
        sizes.len(),
        100.0 * median,
        100.0 * within(0.03),
        100.0 * within(0.1)
    )
}

/// The things of all levels.
fn things(scene: &Scene) -> Result<Vec<Thing>> {
    let field = scene.language.as_ref().ok_or_else(|| Error::input("the scene has no language"))?;
    Ok(Places::of(&scene.splats, field).things(LEAST_SHARE))
}

/// Adds the views of a scene.
fn add(
    scene: &Scene,
    things: &[Thing],
    truth: &GroundTruth,
    device: &Device,
    scores: &mut [[Panoptic; 2]],
) -> Result<()> {
    let from_truth = similarity(truth, scene)?.inverse();
    let mut views = Vec::new();
    for frame in truth.frames.iter().filter(|frame| frame.split != Split::Train) {
        let objects = truth.objects(frame)?;
        views.extend(objects.map(|objects| (from_truth.camera(&frame.camera), objects)));
    }
    if views.is_empty() {
        return Err(Error::input(format!(
            "{}: no masks of views that are held out from the photos",
            truth.folder.display()
        )));
    }
    let cameras: Vec<&Camera> = views.iter().map(|(camera, _)| camera).collect();
    for (level, score) in scores.iter_mut().enumerate() {
        let owners = numbers(things.iter(), level, scene.splats.len());
        for (found, (_, objects)) in shown(scene, &owners, &cameras, device)?.iter().zip(&views) {
            score[0].add(found, objects, |_| true);
            score[1].add(found, objects, |share| share < SMALL);
        }
    }
    Ok(())
}

/// Sizes of the parts of the mesh of a scene that are objects of the truth. Surfaces are left out:
/// their size is that of the pictures.
fn measured(scene: &Scene, things: &[Thing], truth: &GroundTruth, device: &Device) -> Result<Vec<Size>> {
    let to_truth = similarity(truth, scene)?;
    let mut photos = Vec::new();
    for frame in truth.frames.iter().filter(|frame| frame.split == Split::Train) {
        let known = truth.objects(frame)?.zip(truth.depth(frame)?);
        photos.extend(known.map(|(objects, depth)| TruePhoto {
            camera: frame.camera.clone(),
            objects,
            depth,
        }));
    }
    let cameras: Vec<Camera> = photos.iter().map(|photo| to_truth.inverse().camera(&photo.camera)).collect();
    let objects = things.iter().filter(|thing| thing.level == OBJECTS && !thing.is_surface);
    let owners = numbers(objects, OBJECTS, scene.splats.len());
    let found = shown(scene, &owners, &cameras.iter().collect::<Vec<_>>(), device)?;
    let matched = matches(found.iter().zip(photos.iter().map(|photo| &photo.objects)));
    let number = |owner: &u32| matched.keys().position(|thing| thing == owner).map_or(0, |k| k as u32 + 1);
    // Names of objects may be the same, their numbers are not.
    let names = matched.values().map(u32::to_string).collect();
    let parts = Things { object: owners.iter().map(number).collect(), names };
    let options = MeshOptions { voxel: None, simplify: Simplify::Triangles(TRIANGLES), fill_guessed: false };
    let progress = progress::reporter();
    let made = mesh::on_device(device, scene, &scene.cameras, Some(&parts), "", options, progress.as_ref())?;
    let placed = mesh::placed(&made.mesh, &to_truth);
    let known = extents(&photos);
    let size = |object: &u32| {
        let part = placed.parts.iter().find(|part| part.name == object.to_string())?;
        let (low, high) = placed.part(part).extent()?;
        let found = DVec3::from_array([0, 1, 2].map(|k| f64::from(high[k] - low[k])));
        let name = truth.labels.get(object).cloned().unwrap_or_default();
        Some(Size { name, found, known: *known.get(object)? })
    };
    Ok(matched.values().filter_map(size).collect())
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
