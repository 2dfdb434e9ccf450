//! `splatvk label` and `splatvk objects`: language for splats of any program, and the things of the
//! scene.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
mod fixture;

use fixture::command::{refuses, splatvk, text};
use fixture::{scene, small_views};
use serde_json::Value;
use splatvk::format::{cameras, gaussians, scene_dir};
use splatvk::scene::Splats;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// The splats of the small scene as a file of another program, in the coordinates of its cameras.
fn foreign() -> PathBuf {
    static FOREIGN: OnceLock<PathBuf> = OnceLock::new();
    // Once: the tests run in threads.
    let copied = FOREIGN.get_or_init(|| {
        let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cli/foreign.ply");
        std::fs::copy(scene().join("point_cloud.ply"), &file).unwrap();
        file
    });
    copied.clone()
}

/// Runs a command that must succeed, and returns its standard output.
fn runs(command: &mut Command) -> String {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{command:?}\n{}", text(&output.stderr));
    text(&output.stdout)
}

/// The foreign splats, labelled with their photos.
fn labelled() -> &'static Path {
    static LABELLED: OnceLock<PathBuf> = OnceLock::new();
    LABELLED.get_or_init(|| {
        let (images, cameras, _) = small_views();
        let out = images.with_file_name("labelled");
        let mut label = splatvk();
        label.arg("label").arg(foreign()).arg("--images").arg(images).arg("--cameras").arg(cameras);
        runs(label.arg("--out").arg(&out));
        out
    })
}

/// All numbers of splats as bits.
fn bits(s: &Splats) -> Vec<u32> {
    let all = [s.means.as_flattened(), s.log_scales.as_flattened(), s.quats.as_flattened()];
    let all = all.into_iter().chain([s.opacity_logits.as_slice(), s.sh.as_slice()]);
    all.flatten().map(|v| v.to_bits()).collect()
}

#[test]
fn labelled_splats_keep_every_bit() {
    let given = gaussians::read(&foreign()).unwrap().0;
    let scene = scene_dir::load(labelled()).unwrap();
    assert_eq!((scene.splats.sh_degree, scene.splats.antialiased), (given.sh_degree, given.antialiased));
    assert_eq!(bits(&scene.splats), bits(&given));
    assert!(scene.seen.pixels.is_empty(), "nothing says which splats the training guessed");
    let field = scene.language.unwrap();
    assert!(field.levels.iter().any(|level| !level.codebook.is_empty()));
    assert_eq!(scene.cameras.len(), 2);
}

#[test]
fn labelled_scene_answers_and_lists_things() {
    let mut query = splatvk();
    let answer = runs(query.arg("query").arg(labelled()).args(["lemon", "--json"]));
    let answer: Value = serde_json::from_str(&answer).unwrap();
    assert_eq!(answer["queries"][0]["views"].as_array().unwrap().len(), 2);

    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("things");
    let mut objects = splatvk();
    let printed = runs(objects.arg("objects").arg(labelled()).args(["--min-share", "0", "--out"]).arg(&out));
    let list: Value = serde_json::from_slice(&std::fs::read(out.join("objects.json")).unwrap()).unwrap();
    let list = list["objects"].as_array().unwrap();
    let of_level = |name: &str| list.iter().filter(|o| o["level"] == name).count();
    assert!(of_level("o") > 0 && printed.contains(&format!("{} things", of_level("o"))), "{printed}");
    let rows = std::fs::read_to_string(out.join("objects.csv")).unwrap().lines().count();
    assert_eq!(rows, list.len() + 1);

    // Identifiers are unique, parents are of coarser levels.
    let order = |level: &Value| ["s", "m", "o", "l"].iter().position(|l| level == l).unwrap();
    for (k, object) in list.iter().enumerate() {
        assert!(list[..k].iter().all(|other| other["id"] != object["id"]), "{object}");
        let parent = list.iter().find(|other| other["id"] == object["parent"]);
        assert_eq!(parent.is_some(), !object["parent"].is_null());
        assert!(parent.is_none_or(|p| order(&p["level"]) > order(&object["level"])));
        assert_eq!(object["file"].is_null(), object["level"] != "o");
    }
    // The files have the splats of the list, and so has the column of the scene.
    let total: usize = list
        .iter()
        .filter_map(|object| {
            let file = out.join(object["file"].as_str()?);
            let count = gaussians::read(&file).unwrap().0.len();
            assert_eq!(object["splats"], count);
            Some(count)
        })
        .sum();
    let numbers = object_column(&out.join("scene.ply"));
    assert_eq!(numbers.iter().filter(|n| **n > 0).count(), total);
    let nodes = names(&out.join("scene.glb"));
    let things = list.iter().filter(|o| o["level"] == "o").map(|o| o["name"].as_str().unwrap());
    assert!(
        nodes[0] == "labelled" && things.clone().all(|name| nodes.iter().any(|n| n == name)),
        "{nodes:?}"
    );

    // The mesh has the same things as nodes, as far as photos show enough of them.
    let mesh = folder.path().join("labelled.glb");
    runs(splatvk().arg("mesh").arg(labelled()).arg(&mesh).arg("--by-object"));
    let parts = names(&mesh);
    let named = parts.iter().filter(|part| things.clone().any(|name| *part == name)).count();
    assert!(parts[0] == "labelled" && named > 0, "{parts:?}");
}

/// Names of the nodes of a binary glTF, the root first.
fn names(file: &Path) -> Vec<String> {
    let bytes = std::fs::read(file).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let root: Value = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    let named = |node: &Value| node["name"].as_str().unwrap_or_default().to_owned();
    root["nodes"].as_array().unwrap().iter().map(named).collect()
}

/// The last property of every vertex of a binary PLY, which is `int object`.
fn object_column(file: &Path) -> Vec<i32> {
    let bytes = std::fs::read(file).unwrap();
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let header = String::from_utf8(bytes[..at].to_vec()).unwrap();
    assert!(header.contains("property int object\nend_header"), "{header}");
    let row = 4 * header.matches("property").count();
    bytes[at..].chunks_exact(row).map(|r| i32::from_le_bytes(r[row - 4..].try_into().unwrap())).collect()
}

#[test]
fn splats_without_photos_get_rendered_views() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("words");
    let mut label = splatvk();
    runs(label.arg("label").arg(foreign()).args(["--synthesize", "3", "--out"]).arg(&out));
    let scene = scene_dir::load(&out).unwrap();
    assert!((1..=3).contains(&scene.cameras.len()), "{}", scene.cameras.len());
    assert_eq!(bits(&scene.splats), bits(&gaussians::read(&foreign()).unwrap().0));
    assert!(scene.world.up.is_none(), "the cameras follow an assumption");
    let record: Value = serde_json::from_slice(&std::fs::read(out.join("run.json")).unwrap()).unwrap();
    let method = record["statistics"]["geometry"]["method"].as_str().unwrap();
    assert_eq!(method, "given splats, renders from cameras in free space");
}

#[test]
fn label_refuses_views_that_do_not_fit() {
    let (images, camera_file, _) = small_views();
    let folder = tempfile::tempdir().unwrap();
    let label = |file: &Path| {
        let mut c = splatvk();
        c.arg("label").arg(file).arg("--out").arg(folder.path().join("out"));
        c
    };
    refuses(label(&foreign()).arg("--images").arg(&images), 2, &["--cameras"]);
    // The cameras of other photos.
    let mut swapped = cameras::read(&camera_file).unwrap();
    let name = swapped[0].name.clone();
    swapped[0].name = std::mem::replace(&mut swapped[1].name, name);
    let file = folder.path().join("swapped.json");
    cameras::write_json(&file, &swapped).unwrap();
    let mut c = label(&foreign());
    refuses(
        c.arg("--images").arg(&images).arg("--cameras").arg(&file),
        2,
        &["do not show these photos", "leave --images out"],
    );
    // One splat shows nothing.
    let one = folder.path().join("one.ply");
    gaussians::write(&one, &gaussians::read(&foreign()).unwrap().0.picked(&[0]), None).unwrap();
    refuses(&mut label(&one), 2, &["too few or too transparent"]);
    assert!(!folder.path().join("out").exists());
    refuses(splatvk().arg("objects").arg(foreign()), 2, &["splatvk label makes a scene"]);
    let photo = images.join(format!("{}.png", swapped[0].name));
    let mut add = splatvk();
    add.arg("run").arg("--add").arg(labelled()).arg(photo);
    refuses(&mut add, 2, &["made by splatvk label", "label the file again"]);
    refuses(splatvk().arg("objects").arg(scene()), 2, &["no language", "splatvk label"]);
}
