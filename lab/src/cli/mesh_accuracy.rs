//! `splatlab mesh-accuracy`: the mesh of a scene against true depth.
use super::args::MeshAccuracyArgs;
use crate::{Error, Result};
use serde_json::{Value, json};
use splatvk::cli::args::EditUse;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::{progress, scene};
use splatvk::eval::{GroundTruth, Split};
use splatvk::format::scene_dir::Scene;
use splatvk::photo::stem;
use splatvk::pose::align::pose_errors;
use splatvk::run::mesh::{self, MeshOptions};
use splatvk::scene::{Camera, Similarity};
use splatvk_mesh::{Accuracy, Simplify, TrueView, WITHIN, accuracy};

pub fn mesh_accuracy(args: &MeshAccuracyArgs) -> Result<()> {
    let truth = GroundTruth::read(&args.ground_truth)?;
    let photos = views(&truth, |split| split == Split::Train)?;
    let others = views(&truth, |split| split != Split::Train)?;
    let scene = scene::load(&args.scene, EditUse::default())?;
    let to_truth = similarity(&truth, &scene)?;
    let options = MeshOptions {
        voxel: args.voxel,
        simplify: Simplify::Triangles(args.triangles),
        fill_guessed: args.fill_guessed,
    };
    let device = args.device.device.as_deref();
    let progress = progress::reporter();
    let made = mesh::mesh(&scene, &scene.cameras, None, "scene", options, device, progress.as_ref())?;
    let placed = mesh::placed(&made.mesh, &to_truth);
    let found = accuracy(&placed, &photos, &others).ok_or_else(|| {
        Error::input(format!("{}: no depth, or none that makes a surface", args.ground_truth.display()))
    })?;
    let figures = figures(&found, placed.triangles.len(), made.voxel * to_truth.scale);
    match args.device.json {
        true => print_json(&figures),
        false => print(&text(&found, &figures)),
    }
}

/// Frames of the truth with their depth.
fn views(truth: &GroundTruth, wanted: impl Fn(Split) -> bool) -> Result<Vec<TrueView>> {
    let mut views = Vec::new();
    for frame in truth.frames.iter().filter(|f| wanted(f.split)) {
        let depth = truth.depth(frame)?;
        views.extend(depth.map(|depth| TrueView { camera: frame.camera.clone(), depth }));
    }
    Ok(views)
}

/// Scene → truth, from the cameras of the photos.
pub(super) fn similarity(truth: &GroundTruth, scene: &Scene) -> Result<Similarity> {
    let (mut found, mut known): (Vec<Camera>, Vec<Camera>) = (Vec::new(), Vec::new());
    for frame in truth.frames.iter().filter(|f| f.split == Split::Train) {
        if let Some(camera) = scene.cameras.iter().find(|c| stem(&c.name) == frame.stem) {
            found.push(camera.clone());
            known.push(frame.camera.clone());
        }
    }
    match found.len() {
        0 | 1 => Err(Error::input(format!(
            "{}: {} of its train frames are views of the scene, at least 2 are needed; is it another scene's ground truth?",
            truth.folder.display(),
            found.len()
        ))),
        _ => Ok(pose_errors(&found, &known, 1.0).similarity),
    }
}

fn figures(found: &Accuracy, triangles: usize, voxel: f64) -> Value {
    let within = found.within.iter().zip(WITHIN).map(|(w, share)| {
        json!({
            "share_of_depth": share, "precision": w.precision, "precision_all": w.precision_all,
            "recall": w.recall, "f1": w.f1,
        })
    });
    json!({
        "median": found.median,
        "mean": found.mean,
        "size": found.size,
        "median_share": found.median / found.size,
        "mean_share": found.mean / found.size,
        "within": within.collect::<Vec<_>>(),
        "seen_by_two": found.seen_by_two,
        "triangles": triangles,
        "voxel": voxel,
    })
}

fn text(found: &Accuracy, figures: &Value) -> String {
    let percent = |v: f64| format!("{:.1} %", 100.0 * v);
    let mut out = format!(
        "accuracy where two photos see it: median {:.4}, mean {:.4} of a scene of {:.3}: {:.3} %, {:.3} %\n",
        found.median,
        found.mean,
        found.size,
        100.0 * found.median / found.size,
        100.0 * found.mean / found.size
    );
    for (within, share) in found.within.iter().zip(WITHIN) {
        out += &format!(
            "within {} of depth: F1 {}, precision {} (whole mesh {}), recall {}\n",
            percent(share),
            percent(within.f1),
            percent(within.precision),
            percent(within.precision_all),
            percent(within.recall)
        );
    }
    out + &format!(
        "two photos see {} of the mesh; {} triangles\n",
        percent(found.seen_by_two),
        figures["triangles"]
    )
}
