//! `splatvk edit`: operations on selections, which every command applies and which can be undone.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
mod fixture;

use fixture::command::{refuses, splatvk, text};
use fixture::view::{breakfast, masks_of};
use serde_json::Value;
use splatvk::format::edits::{Combine, EditList, Operation, Pick, Term};
use splatvk::format::gaussians;
use splatvk::format::scene_dir::{self, Contents, Scene};
use splatvk::photo;
use splatvk::run::Machine;
use splatvk::run::edit::Editor;
use splatvk::scene::{Camera, Pose, Seen, Splats, World};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// Label of the mug in the masks, and of the lemon.
const MUG: i32 = 9;

/// A copy of the scene with true codes: an edit changes its folder.
fn scene(folder: &Path) -> PathBuf {
    static SCENE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let made = SCENE.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        breakfast(folder.path());
        folder
    });
    let copy = folder.join("breakfast");
    copy_folder(&made.path().join("breakfast"), &copy);
    copy
}

fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let place = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy_folder(&entry.path(), &place),
            false => drop(std::fs::copy(entry.path(), place).unwrap()),
        }
    }
}

fn edit(scene: &Path, arguments: &[&str]) -> Command {
    let mut command = splatvk();
    command.arg("edit").arg(scene).args(arguments);
    command
}

/// Runs a command that must succeed, and returns its standard output.
fn runs(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{command:?}\n{}", text(&output.stderr));
    text(&output.stdout)
}

/// Number of splats of a label: those of every fourth pixel.
fn splats_of(label: i32) -> usize {
    let count = |stem: &str| {
        let mask = masks_of(stem);
        let sampled = |i: &usize| i % mask.width % 4 == 2 && i / mask.width % 4 == 2;
        (0..mask.data.len()).filter(sampled).filter(|i| mask.data[*i] == label).count()
    };
    ["train_00", "train_02"].into_iter().map(count).sum()
}

/// All numbers of a scene, and its edits.
fn state(path: &Path) -> (Scene, Option<usize>) {
    let scene = scene_dir::load(path).unwrap();
    let edits = scene.edits.as_ref().map(|edits| edits.count);
    (scene, edits)
}

#[test]
fn word_thing_and_click_delete_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(folder.path());
    let whole = scene_dir::load(&path).unwrap();
    // The table of text embeddings has too few words to judge presence.
    refuses(&mut edit(&path, &["--delete", "blue mug"]), 2, &["blue mug", "cannot judge", "--force"]);
    assert!(!path.join("edits.json").exists(), "a refusal changes nothing");
    let told = runs(&mut edit(&path, &["--delete", "blue mug", "--force", "--dry-run"]));
    assert!(told.contains(&format!("{} splats", splats_of(MUG))), "{told}");
    assert!(!path.join("edits.json").exists());

    let mut editor = Editor::open(&path, &Machine::default()).unwrap();
    let camera = whole.cameras[0].clone();
    let mask = masks_of("train_00");
    // A pixel in the middle of the mug.
    let pixels: Vec<usize> = (0..mask.data.len()).filter(|i| mask.data[*i] == MUG).collect();
    let middle = pixels[pixels.len() / 2];
    let pixel = [(middle % 640) as f64 + 0.5, (middle / 640) as f64 + 0.5];
    let terms = |pick: Pick| vec![Term { combine: Combine::Add, pick }];
    let word = editor.select(&terms(Pick::Word { text: "blue mug".into(), grow: 0.0 })).unwrap();
    let click = editor.select(&terms(Pick::Click { camera: camera.clone(), pixel, level: None })).unwrap();
    assert_eq!((word.count, &word.rows), (splats_of(MUG), &click.rows));
    assert!(word.doubts.len() == 1 && click.doubts.is_empty());
    let [x, y] = pixel;
    let told = runs(&mut edit(&path, &["--delete", &format!("at:train_00:{x},{y}"), "--dry-run"]));
    assert!(told.contains(&format!("{} splats", splats_of(MUG))), "{told}");

    // An outline around the mug, cut down to the answer, is the visible part of it.
    let (width, height) = (640.0, 480.0);
    let polygon = vec![[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]];
    let outline = Pick::Outline { camera, polygon, through: false };
    let mut both = terms(outline);
    both.push(Term { combine: Combine::Intersect, pick: Pick::Word { text: "blue mug".into(), grow: 0.0 } });
    let visible = editor.select(&both).unwrap();
    assert!(visible.count > word.count / 4 && visible.count < word.count, "{}", visible.count);

    let along = editor.push(vec![(Operation::Delete {}, click)]).unwrap();
    let (after, edits) = state(&path);
    let taken = splats_of(MUG) + along;
    assert_eq!((after.splats.len(), edits), (whole.splats.len() - taken, Some(1)));
    assert_eq!(after.holes.len(), taken);
    assert!(along < splats_of(MUG) / 10, "{along}");
    // Nothing of it is left to select.
    let gone = editor.select(&terms(Pick::Thing { id: "l9".into() })).unwrap_err();
    assert!(gone.exit_code() == 2 && gone.to_string().contains("id:l9"), "{gone}");
}

/// A wall of large splats in front of small ones, which stand beside it, too.
#[test]
fn deletion_takes_along_what_no_photo_shows() {
    let folder = tempfile::tempdir().unwrap();
    let grid = |step: f32, half: i32| {
        (-half..=half).flat_map(move |x| (-half..=half).map(move |y| [step * x as f32, step * y as f32]))
    };
    let wall: Vec<[f32; 3]> = grid(0.05, 6).map(|[x, y]| [x, y, 2.0]).collect();
    let floor: Vec<[f32; 3]> = grid(0.05, 20).map(|[x, y]| [x, y, 4.0]).collect();
    let count = wall.len() + floor.len();
    let size = |i: usize| if i < wall.len() { 0.05f32 } else { 0.03 };
    let splats = Splats {
        log_scales: (0..count).map(|i| [size(i).ln(); 3]).collect(),
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![4.0; count],
        sh: vec![0.0; 3 * count],
        means: [wall.clone(), floor.clone()].concat(),
        ..Splats::default()
    };
    let camera = Camera {
        name: "front".into(),
        width: 160,
        height: 160,
        fx: 200.0,
        fy: 200.0,
        cx: 80.0,
        cy: 80.0,
        pose: Pose::IDENTITY,
    };
    let path = folder.path().join("wall");
    std::fs::create_dir(&path).unwrap();
    let contents = Contents {
        splats: &splats,
        seen: &Seen::default(),
        backdrop: &Splats::default(),
        holes: &Splats::default(),
        cameras: &[camera],
        world: &World::default(),
        photos: &[],
        points: None,
        language: None,
        text_embeddings: None,
    };
    scene_dir::write(&path, &contents).unwrap();
    let told = runs(&mut edit(&path, &["--delete", "size>0.04"]));
    assert!(told.contains(&format!("{} splats", wall.len())), "{told}");
    let (left, _) = state(&path);
    // The wall covers ±0.3 at depth 2, hence ±0.6 at depth 4; its outermost splats end softly.
    let reach = |mean: &[f32; 3]| mean[0].abs().max(mean[1].abs());
    assert!(left.splats.means.iter().all(|mean| mean[2] == 4.0 && reach(mean) > 0.5), "{told}");
    let beside = floor.iter().filter(|mean| reach(mean) > 0.8).count();
    assert!(left.splats.len() >= beside && beside > 0, "{} {beside}", left.splats.len());
    runs(&mut edit(&path, &["--undo"]));
    assert_eq!(state(&path).0.splats, splats);
}

#[test]
fn every_command_sees_the_edits_until_they_are_undone() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(folder.path());
    let (whole, _) = state(&path);
    let told = runs(&mut edit(
        &path,
        &["--delete", "blue mug", "--recolour", "lemon=#36f", "--move", "plate=0,0,0.1", "--force"],
    ));
    assert!(told.lines().count() == 4 && told.contains("no photo shows them"), "{told}");
    let (edited, edits) = state(&path);
    assert_eq!(edits, Some(3));
    assert_eq!(scene_dir::load_unedited(&path).unwrap().splats, whole.splats);

    // Export writes the edited scene; without edits, the reconstruction.
    let count = |arguments: &[&str]| {
        let file = folder.path().join("out.ply");
        let mut export = splatvk();
        runs(export.arg("export").arg(&path).arg(&file).args(["--guessed", "--force"]).args(arguments));
        gaussians::read(&file).unwrap().0.len()
    };
    assert_eq!(count(&[]), edited.splats.len());
    assert_eq!(count(&["--ignore-edits"]), whole.splats.len());

    // Pictures differ where the mug was, and only stripes of grey are behind it.
    let render = |arguments: &[&str]| {
        let out = folder.path().join("views");
        let mut render = splatvk();
        render.arg("render").arg(&path).arg("--cameras").arg(path.join("cameras/transforms.json"));
        runs(render.args(["--force", "--out"]).arg(&out).args(arguments));
        photo::load(&out.join("train_00.png")).unwrap().image
    };
    let (with, without) = (render(&[]), render(&["--ignore-edits"]));
    let mask = masks_of("train_00");
    let change = |label: i32| {
        let pixels = (0..mask.data.len()).filter(|i| mask.data[*i] == label);
        let difference = |i: usize| (0..3).map(|k| (with.data[i][k] - without.data[i][k]).abs()).sum::<f32>();
        let all: Vec<f32> = pixels.map(difference).collect();
        all.iter().sum::<f32>() / all.len() as f32
    };
    assert!(change(MUG) > 0.2 && change(5) < 0.03, "{} {}", change(MUG), change(5));

    // Undo and redo step through the list; its end is the reconstruction, bit by bit.
    let listed = runs(&mut edit(&path, &["--list"]));
    assert!(listed.contains("1. delete \"blue mug\"") && listed.contains("3. move by"), "{listed}");
    runs(&mut edit(&path, &["--undo", "2"]));
    assert_eq!(state(&path).1, Some(1));
    runs(&mut edit(&path, &["--undo"]));
    assert_eq!(state(&path).0.splats, whole.splats);
    refuses(&mut edit(&path, &["--undo"]), 2, &["nothing to undo"]);
    runs(&mut edit(&path, &["--redo", "3"]));
    assert_eq!(state(&path).0.splats, edited.splats);

    // The baked scene is the edited one, and has no list.
    let baked = folder.path().join("baked");
    runs(&mut edit(&path, &["--bake", baked.to_str().unwrap()]));
    let (scene, edits) = state(&baked);
    assert_eq!((scene.splats, scene.holes, edits), (edited.splats, edited.holes, None));
    assert_eq!(scene.language, edited.language);
}

#[test]
fn edits_are_refused_with_their_reason() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(folder.path());
    let refused: [(&[&str], &[&str]); 8] = [
        (&[], &["--delete", "--list"]),
        (&["--delete", "id:l99"], &["id:l99", "splatvk objects"]),
        (&["--delete", "age<3"], &["age", "opacity"]),
        (&["--delete", "opacity<0 & seen>0"], &["seen"]),
        (&["--delete", "opacity>0"], &["leaves no splat"]),
        (&["--recolour", "lemon"], &["no value"]),
        (&["--recolour", "lemon=red"], &["#rrggbb"]),
        (&["--move", "lemon=5cm,0,0"], &["scale is not known", "splatvk measure"]),
    ];
    for (arguments, words) in refused {
        refuses(&mut edit(&path, arguments), 2, words);
    }
    assert!(!path.join("edits.json").exists());
    refuses(&mut edit(&path.join("point_cloud.ply"), &["--list"]), 2, &["splatvk label"]);

    // A list of another scene is named, and can be left out.
    runs(&mut edit(&path, &["--isolate", "id:l4", "--json"]));
    let file = path.join("edits.json");
    let mut list: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    list["positions"] = "0".into();
    std::fs::write(&file, list.to_string()).unwrap();
    let mut export = splatvk();
    export.arg("export").arg(&path).arg(folder.path().join("a.ply"));
    refuses(&mut export, 2, &["edits.json", "another reconstruction", "--ignore-edits"]);
    runs(export.arg("--ignore-edits"));

    // A run does not replace a scene with edits.
    let mut run = splatvk();
    run.arg("run").arg(fixture::data("breakfast/images")).arg("--out").arg(&path).arg("--force");
    refuses(&mut run, 2, &["edits.json", "move"]);
}

#[test]
fn two_editors_do_not_lose_edits() {
    let folder = tempfile::tempdir().unwrap();
    let path = scene(folder.path());
    let open = || Editor::open(&path, &Machine::default()).unwrap();
    let (mut first, mut second) = (open(), open());
    let term = |id: &str| vec![Term { combine: Combine::Add, pick: Pick::Thing { id: id.into() } }];
    let [a, b] =
        [(&mut first, "l4"), (&mut second, "l5")].map(|(editor, id)| editor.select(&term(id)).unwrap());
    first.push(vec![(Operation::Delete {}, a)]).unwrap();
    let error = second.push(vec![(Operation::Delete {}, b)]).unwrap_err();
    assert!(error.exit_code() == 2 && error.to_string().contains("another program"), "{error}");
    let whole = scene_dir::load_unedited(&path).unwrap();
    assert_eq!(EditList::read(&path, &whole.splats).unwrap(), *first.list());
}
