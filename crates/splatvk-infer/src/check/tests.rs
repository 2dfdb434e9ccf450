//! Stand-in networks that recognise the built-in pictures and answer with the true scene or with
//! one fault. They compare their input with every picture and look the answer up.
use std::path::Path;

use splatvk_test_support::onnx::{Attribute, FLOAT, Onnx};

use super::super::Registry;
use super::super::adapter::ImageSpec;
use super::super::graph::GraphFile;
use super::super::prepare::prepare;
use super::pictures::{Surface, pictures, place, surface};
use super::{Measured, check};
use crate::Result;
use crate::installed::Installed;

/// Size of the networks' input.
const SIZE: [usize; 2] = [64, 48];
const PIXELS: usize = SIZE[0] * SIZE[1];
/// The most pictures of a check.
const ALL: usize = 6;
/// Focal length at that size, and the distance of the box; the wall is three times as far.
const FOCAL: f32 = 60.0;
const NEAR: f32 = 1.0;
/// One step of the camera: 6 pixels of the box at that size.
const STEP: f32 = 6.0 * NEAR / FOCAL;

/// Preprocessing of the stand-ins.
fn spec() -> ImageSpec {
    toml::from_str("mean = [0.5, 0.5, 0.5]\nstd = [0.5, 0.5, 0.5]\nsize = 64\nfit = \"resize\"").unwrap()
}

const IMAGE: &str = "image = { mean = [0.5, 0.5, 0.5], std = [0.5, 0.5, 0.5], size = 64, fit = \"resize\" }";

/// The pictures as inputs, one row each.
fn inputs() -> Vec<Vec<f32>> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("size.onnx");
    Onnx::new()
        .input("images", FLOAT, "1 n 3 48 64")
        .output("depth", "1 n 48 64")
        .output("depth_conf", "1 n 48 64")
        .output("pose_enc", "1 n 9")
        .write(&path);
    let graph = GraphFile::recognise(&path).unwrap();
    pictures(ALL).iter().map(|p| prepare(&p.image, &graph, &spec(), "images").data).collect()
}

/// True depth of every picture, [ALL, H, W]; from another camera the box covers other pixels.
fn depths() -> Vec<f32> {
    let one = |k: usize| {
        let [right, down] = place(k);
        (0..PIXELS).map(move |p| {
            let (x, y) = (10.0 * (p % SIZE[0]) as f64 + 5.0, 10.0 * (p / SIZE[0]) as f64 + 5.0);
            let by = Surface::Box.disparity();
            let (u, v) = (x + right * by, y + down * by);
            let inside = (260.0..420.0).contains(&u) && (160.0..330.0).contains(&v);
            if inside { NEAR } else { 3.0 * NEAR }
        })
    };
    (0..ALL).flat_map(one).collect()
}

/// World → camera of every picture, [ALL, 3, 4], in the frame of picture 0.
fn poses() -> Vec<f32> {
    let one = |k: usize| {
        let [right, down] = place(k).map(|v| -STEP * v as f32);
        [1.0, 0.0, 0.0, right, 0.0, 1.0, 0.0, down, 0.0, 0.0, 1.0, 0.0]
    };
    (0..ALL).flat_map(one).collect()
}

/// Adds `name` [n]: the picture that each of the photos in `images`, [n, 3, H, W] or
/// [1, n, 3, H, W], shows. Of |x − t|² only −2 x·t + |t|² depends on the picture t.
fn recognised(graph: Onnx, images: &str, name: &str) -> Onnx {
    let rows = inputs();
    let length = rows[0].len();
    let columns: Vec<f32> = (0..length).flat_map(|k| rows.iter().map(move |r| 2.0 * r[k])).collect();
    let squares: Vec<f32> = rows.iter().map(|r| r.iter().map(|v| v * v).sum()).collect();
    let own = |what: &str| format!("{name}_{what}");
    graph
        .integers(&own("flat"), &[-1, length as i64])
        .weight(&own("pictures"), &[length as u64, ALL as u64], &columns)
        .weight(&own("squares"), &[ALL as u64], &squares)
        .node("Reshape", &format!("{images} {}", own("flat")), &own("rows"), &[])
        .node("MatMul", &format!("{} {}", own("rows"), own("pictures")), &own("products"), &[])
        .node("Sub", &format!("{} {}", own("products"), own("squares")), &own("likeness"), &[])
        .node(
            "ArgMax",
            &own("likeness"),
            name,
            &[("axis", Attribute::Int(1)), ("keepdims", Attribute::Int(0))],
        )
}

/// Contents of a stand-in for a multi-view network.
struct Views {
    photos: &'static str,
    depth: Vec<f32>,
    poses: Vec<f32>,
    /// The tensor that selects the poses: "picture" or "place".
    by: &'static str,
    /// Whether the graph takes two photos only, whatever its header says.
    traced: bool,
}

impl Views {
    fn right() -> Views {
        Views { photos: "n", depth: depths(), poses: poses(), by: "picture", traced: false }
    }

    /// A graph that looks depth and poses up, and gives poses relative to the first photo.
    fn graph(&self) -> Onnx {
        let n = self.photos;
        let turn = [1.0, 1.0, 1.0, 0.0].repeat(3);
        let moved = [0.0, 0.0, 0.0, 1.0].repeat(3);
        let lens = [FOCAL, 0.0, 32.0, 0.0, FOCAL, 24.0, 0.0, 0.0, 1.0].repeat(ALL);
        let graph = Onnx::new()
            .input("image", FLOAT, &format!("1 {n} 3 48 64"))
            .output("depth", &format!("1 {n} 48 64"))
            .output("depth_conf", &format!("1 {n} 48 64"))
            .output("extrinsics", &format!("1 {n} 3 4"))
            .output("intrinsics", &format!("1 {n} 3 3"))
            .weight("depths", &[ALL as u64, 48, 64], &self.depth)
            .weight("sure", &[ALL as u64, 48, 64], &[5.0; ALL * PIXELS])
            .weight("poses", &[ALL as u64, 3, 4], &self.poses)
            .weight("lenses", &[ALL as u64, 3, 3], &lens)
            .weight("turn", &[3, 4], &turn)
            .weight("moved", &[3, 4], &moved)
            .integers("front", &[0]);
        let length = if self.traced { 2 } else { -1 };
        let graph =
            graph.integers("listed", &[length, 3, 48, 64]).node("Reshape", "image listed", "list", &[]);
        recognised(graph, "list", "picture")
            // Places in the list: 0, 1, 2…
            .integers("none", &[0])
            .integers("one", &[1])
            .node("Mul", "picture none", "nothing", &[])
            .node("Add", "nothing one", "ones", &[])
            .node("CumSum", "ones front", "counted", &[])
            .node("Sub", "counted one", "place", &[])
            .node("Gather", "depths picture", "depth_rows", &[])
            .node("Unsqueeze", "depth_rows front", "depth", &[])
            .node("Gather", "sure picture", "sure_rows", &[])
            .node("Unsqueeze", "sure_rows front", "depth_conf", &[])
            .node("Gather", "lenses picture", "lens_rows", &[])
            .node("Unsqueeze", "lens_rows front", "intrinsics", &[])
            .node("Gather", &format!("poses {}", self.by), "world", &[])
            .node("Gather", "world front", "first", &[])
            .node("Mul", "first moved", "start", &[])
            .node("Sub", "world start", "pose_rows", &[])
            .node("Unsqueeze", "pose_rows front", "extrinsics", &[])
    }

    fn check(&self, adapter: &str) -> Result<Vec<Measured>> {
        check_graph(
            "da3",
            &self.graph(),
            &format!("family = \"da3\"\n{adapter}\n[[graph]]\npart = \"multi-view\"\n{IMAGE}"),
        )
    }
}

/// Checks one graph that lies with its adapter in the folder `name`.
fn check_graph(name: &str, graph: &Onnx, adapter: &str) -> Result<Vec<Measured>> {
    let dir = tempfile::tempdir().unwrap();
    check(&install(dir.path(), name, graph, adapter))
}

fn install(folder: &Path, name: &str, graph: &Onnx, adapter: &str) -> Installed {
    graph.write(&folder.join(name).join("model.onnx"));
    std::fs::write(folder.join(name).join("adapter.toml"), adapter).unwrap();
    let found = super::super::installed::inventory(&Registry::of(&[folder]).uncached());
    assert!(found.broken.is_empty(), "{:?}", found.broken);
    found.models.into_iter().next().unwrap()
}

fn figure(step: &Measured, name: &str) -> f64 {
    step.figures.iter().find(|f| f.name == name).unwrap().value
}

/// The fault that a check names, one line.
fn fault(checked: Result<Vec<Measured>>) -> String {
    let error = checked.expect_err("must be refused");
    assert_eq!(error.exit_code(), 3);
    let text = error.to_string();
    assert!(!text.contains('\n') && text.contains("export it again with"), "{text}");
    text
}

#[test]
fn surfaces_match_the_pictures() {
    let both = pictures(2);
    let (mut seen, mut changed) = ([0, 0], 0.0f32);
    for (x, y) in (0..480).flat_map(|y| (0..640).map(move |x| (x, y))) {
        let Some(found) = surface(0, x as f64, y as f64) else { continue };
        seen[found as usize] += 1;
        let moved = x - found.disparity() as usize;
        let (a, b) = (both[0].image.at(x, y), both[1].image.at(moved, y));
        changed = (0..3).fold(changed, |m, c| m.max((a[c] - b[c]).abs()));
        assert_eq!(surface(1, moved as f64, y as f64), Some(found));
    }
    assert!(changed < 1e-6, "{changed}");
    assert!(seen[0] > 100_000 && seen[1] == 128 * 138, "{seen:?}");
}

#[test]
fn right_views_pass() {
    let steps = Views::right().check("").unwrap();
    assert!(steps.iter().all(|s| s.warning.is_none()), "{steps:?}");
    let lists = steps.iter().filter(|s| s.step.starts_with("geometry of"));
    let lengths: Vec<&str> = lists.map(|s| s.step.split(' ').nth(2).unwrap()).collect();
    assert_eq!(lengths, ["2", "2", "3", "3", "3", "4", "4", "6", "6"]);
    assert!(steps.iter().filter_map(|s| s.error).all(|e| e < 1e-5));
    let two = steps.iter().find(|s| s.step == "geometry of 2 photos").unwrap();
    assert!(figure(two, "direction") < 0.1 && figure(two, "rotation") < 0.1, "{two:?}");
    assert!((figure(two, "depth ratio") - 3.0).abs() < 1e-3);
    assert!((figure(two, "baseline") - f64::from(STEP / NEAR)).abs() < 1e-3);
    // With a fixed number only lists of that length are run.
    let steps = Views { photos: "4", ..Views::right() }.check("").unwrap();
    assert!(steps.iter().skip(1).all(|s| s.step.starts_with("geometry of 4 photos")) && steps.len() == 5);
    assert!(figure(&steps[1], "direction") < 0.1);
}

#[test]
fn poses_of_places_are_refused() {
    let baked = |photos| Views { photos, by: "place", ..Views::right() };
    let text = fault(baked("n").check(""));
    assert!(
        text.contains("reversing the list moves cameras") && text.contains("tools/export/export_da3.py"),
        "{text}"
    );
    let text = fault(baked("4").check(""));
    assert!(text.contains("all of 4 photos but the first reversed"), "{text}");
    // Reversed, each of two cameras moves by twice their distance; copies of one photo lie as far
    // apart as two photos.
    let steps = baked("2").check("untrained = true").unwrap();
    assert!((figure(&steps[2], "centres") - 2.0).abs() < 1e-3 && steps[2].step.ends_with("reversed"));
    assert!((figure(&steps[3], "centres") - 1.0).abs() < 1e-3 && steps[3].step.ends_with("doubled"));
    // The order of the photos behind the first counts for random weights too.
    assert!(fault(baked("n").check("untrained = true")).contains("all of 3 photos but the first reversed"));
}

#[test]
fn wrong_parallax_is_refused() {
    let negate = |column: usize| {
        let all = poses();
        all.iter().enumerate().map(|(k, v)| if k % 4 == 3 && k / 4 % 3 == column { -v } else { *v }).collect()
    };
    let mirrored = Views { poses: negate(0), ..Views::right() };
    let text = fault(mirrored.check(""));
    assert!(text.contains("180° from its true direction") && text.contains("\"invert\""), "{text}");
    // Random weights may give any scene, as long as the order of photos does not count.
    let steps = mirrored.check("untrained = true").unwrap();
    assert!(figure(&steps[1], "direction") > 179.0 && steps.iter().all(|s| s.warning.is_none()));

    let inverse = Views { depth: depths().iter().map(|z| 1.0 / z).collect(), ..Views::right() };
    assert!(fault(inverse.check("")).contains("as if the graph gave inverse depth"));
    let behind = Views { depth: depths().iter().map(|z| -z).collect(), ..Views::right() };
    assert!(fault(behind.check("")).contains("the depth of most pixels is not positive"));
    let one_place = Views { poses: poses()[..12].repeat(ALL), ..Views::right() };
    assert!(fault(one_place.check("")).contains("does not compare its photos"));

    let flat = Views { depth: depths().iter().map(|z| z.powf(0.3)).collect(), ..Views::right() };
    let steps = flat.check("").unwrap();
    assert!(steps[1].warning.as_ref().unwrap().contains("depth ratio 3 (1.5 to 6)"), "{steps:?}");
}

/// A graph whose axis of photos is named, but which was traced with two.
#[test]
fn traced_number_of_photos_is_refused() {
    let text = fault(Views { traced: true, ..Views::right() }.check(""));
    assert!(text.contains("its number of photos is free, but 3 photos fail"), "{text}");
}

/// A pair network with the true points of the first two pictures; the second camera is `step` to
/// the right of the first.
fn pair_network(step: f32) -> Result<Vec<Measured>> {
    let depth = depths();
    // Points of a picture in its own camera, or `by` to the right of it.
    let points = |picture: usize, by: f32| {
        (0..PIXELS).flat_map(move |p| {
            let z = depth[picture * PIXELS + p];
            let ray = [(p % SIZE[0]) as f32 + 0.5 - 32.0, (p / SIZE[0]) as f32 + 0.5 - 24.0];
            [z * ray[0] / FOCAL + by, z * ray[1] / FOCAL, z]
        })
    };
    let own: Vec<f32> = (0..2).flat_map(|k| points.clone()(k, 0.0)).collect();
    // The other view's points in the camera of the first input: by the first input, 0 or 1.
    let other: Vec<f32> = points.clone()(1, step).chain(points(0, -step)).collect();
    let mut graph = Onnx::new().input("img1", FLOAT, "1 3 48 64").input("img2", FLOAT, "1 3 48 64");
    for (k, table) in [("1", &own), ("2", &other)] {
        graph = graph
            .output(&format!("pts3d_{k}"), "1 48 64 3")
            .output(&format!("conf_{k}"), "1 48 64")
            .weight(&format!("points_{k}"), &[2, 48, 64, 3], table)
            .weight(&format!("sure_{k}"), &[1, 48, 64], &[5.0; PIXELS])
            .node("Gather", &format!("points_{k} picture"), &format!("pts3d_{k}"), &[])
            .node("Identity", &format!("sure_{k}"), &format!("conf_{k}"), &[]);
    }
    let graph = recognised(graph, "img1", "picture");
    check_graph("dust3r", &graph, &format!("family = \"dust3r\"\n[[graph]]\npart = \"pair\"\n{IMAGE}"))
}

#[test]
fn pair_network_finds_the_parallax() {
    let steps = pair_network(STEP).unwrap();
    assert!(steps[0].warning.is_none() && steps[0].step == "geometry of 2 photos");
    assert!(figure(&steps[0], "direction") < 0.1 && figure(&steps[0], "rotation") < 0.1, "{steps:?}");
    assert!((figure(&steps[0], "depth ratio") - 3.0).abs() < 1e-3);
    let text = fault(pair_network(-STEP));
    assert!(text.contains("180° from its true direction") && text.contains("export_dust3r.py"), "{text}");
}

/// A matcher with the true matches, scaled by `by` about each pixel.
fn matcher(by: f32, adapter: &str) -> Result<Vec<Measured>> {
    let field = |picture: usize| -> Vec<f32> {
        let near = depths();
        let target = move |p: usize| {
            let on_box = near[picture * PIXELS + p] == NEAR;
            let disparity = if on_box { Surface::Box } else { Surface::Wall }.disparity() as f32 / 10.0;
            let moved = [-by, by][picture] * disparity;
            let x = ((p % SIZE[0]) as f32 + 0.5 + moved) / SIZE[0] as f32;
            let y = ((p / SIZE[0]) as f32 + 0.5) / SIZE[1] as f32;
            [2.0 * x - 1.0, 2.0 * y - 1.0]
        };
        (0..PIXELS).flat_map(target).collect()
    };
    let mut graph = Onnx::new().input("img_A", FLOAT, "1 3 48 64").input("img_B", FLOAT, "1 3 48 64");
    for (k, name) in ["AB", "BA"].into_iter().enumerate() {
        graph = graph
            .output(&format!("warp_{name}"), "1 48 64 2")
            .output(&format!("overlap_{name}"), "1 48 64 1")
            .weight(&format!("field_{k}"), &[1, 48, 64, 2], &field(k))
            .weight(&format!("sure_{k}"), &[1, 48, 64, 1], &[0.9; PIXELS])
            .node("Identity", &format!("field_{k}"), &format!("warp_{name}"), &[])
            .node("Identity", &format!("sure_{k}"), &format!("overlap_{name}"), &[]);
    }
    check_graph("romav2", &graph, &format!("family = \"roma\"\n{adapter}"))
}

#[test]
fn matcher_finds_the_parallax() {
    let steps = matcher(1.0, "").unwrap();
    assert!(steps[0].warning.is_none(), "{steps:?}");
    assert!(figure(&steps[0], "wall error") < 0.1 && figure(&steps[0], "box error") < 0.1, "{steps:?}");
    let text = fault(matcher(-1.0, ""));
    assert!(text.contains("move the wall by -20.0 px and the box by -60.0 px"), "{text}");
    let steps = matcher(0.8, "").unwrap();
    assert!(steps[0].warning.as_ref().unwrap().contains("rough"), "{steps:?}");
    assert!((figure(&steps[0], "box error") - 12.0).abs() < 0.1);
    let steps = matcher(-1.0, "untrained = true").unwrap();
    assert!((figure(&steps[0], "wall error") - 40.0).abs() < 0.1 && steps[0].warning.is_none());
}
