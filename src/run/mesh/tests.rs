use super::*;
use crate::gpu::test_device;
use crate::progress::Silent;
use crate::scene::{Pose, SH_C0, Seen, Splats};
use glam::{DMat3, DVec3};

/// Number of splats along each side of the wall.
const SIDE: usize = 48;

/// A wall at z = 3 of flat splats: the left third red, the middle third unseen.
fn wall() -> Scene {
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for (y, x) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (y, x))) {
        let at = |i: usize| (i as f32 + 0.5) / SIDE as f32 * 2.0 - 1.0;
        splats.means.push([at(x), at(y), 3.0]);
        let wide = (1.2 / SIDE as f32).ln();
        splats.log_scales.push([wide, wide, 0.001f32.ln()]);
        splats.quats.push([1.0, 0.0, 0.0, 0.0]);
        splats.opacity_logits.push(4.0);
        let colour = if third(x) == 0 { [1.0, 0.0, 0.0] } else { [0.5; 3] };
        splats.sh.extend(colour.map(|v: f32| (v - 0.5) / SH_C0));
    }
    let mut scene = Scene::default();
    scene.seen = Seen { pixels: (0..SIDE * SIDE).map(|i| f32::from(third(i % SIDE) != 1)).collect() };
    scene.splats = splats;
    scene
}

fn third(x: usize) -> usize {
    3 * x / SIDE
}

fn cameras() -> Vec<Camera> {
    let at = |x: f64| Pose { rotation: DMat3::IDENTITY, translation: DVec3::new(-x, 0.0, 0.0) };
    let camera = |pose| Camera {
        name: "a".into(),
        width: 160,
        height: 120,
        fx: 140.0,
        fy: 140.0,
        cx: 80.0,
        cy: 60.0,
        pose,
    };
    [-0.4, 0.4].map(|x| camera(at(x))).to_vec()
}

fn made(fill_guessed: bool, things: Option<&Things>) -> SceneMesh {
    let device = test_device();
    let options = MeshOptions { voxel: None, simplify: Simplify::None, fill_guessed };
    on_device(&device, &wall(), &cameras(), things, "wall", options, &Silent).unwrap()
}

#[test]
fn unseen_surfaces_are_holes_unless_asked_for() {
    let [open, filled] = [false, true].map(|fill| made(fill, None));
    let middle = |m: &SceneMesh| m.mesh.positions.iter().filter(|p| p[0].abs() < 0.25).count();
    assert_eq!(middle(&open), 0);
    assert!(middle(&filled) > 300);
    assert!(open.area < 0.75 * filled.area, "{} {}", open.area, filled.area);
    for mesh in [&open.mesh, &filled.mesh] {
        assert_eq!(mesh.parts[0].name, "wall");
        let worst = mesh.positions.iter().map(|p| (p[2] - 3.0).abs()).fold(0.0, f32::max);
        assert!(worst < 0.5 * open.voxel as f32, "{worst}");
        let red = mesh.positions.iter().zip(&mesh.colours).filter(|(p, _)| p[0] < -0.45);
        assert!(red.clone().count() > 300 && red.clone().all(|(_, c)| c[0] > 0.5 && c[1] < 0.2));
    }
}

#[test]
fn things_are_parts_with_their_names() {
    // Four things, so that they take more than one rendering; two of them are nowhere.
    let names = ["lamp", "red half", "cup", "grey third"].map(str::to_owned).to_vec();
    let object = (0..SIDE * SIDE).map(|i| [2, 0, 4][third(i % SIDE)]).collect();
    let things = Things { object, names };
    let mesh = made(true, Some(&things)).mesh;
    let found: Vec<&str> = mesh.parts.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(found, ["rest", "red half", "grey third"]);
    for (part, range) in mesh.parts.iter().zip([-0.39..0.39, -1.1..-0.27, 0.27..1.1]) {
        let own = mesh.part(part);
        assert!(own.triangles.len() > 500);
        let off = own.positions.iter().filter(|p| !range.contains(&p[0])).count();
        assert!(off < own.positions.len() / 20, "{}: {off} of {}", part.name, own.positions.len());
    }
}

#[test]
fn things_of_another_scene_and_no_cameras_are_refused() {
    let device = test_device();
    let options = MeshOptions { voxel: None, simplify: Simplify::None, fill_guessed: false };
    let refused = |cameras: &[Camera], things: Option<&Things>| {
        let error = on_device(&device, &wall(), cameras, things, "wall", options, &Silent).unwrap_err();
        assert_eq!(error.exit_code(), 2);
        error.to_string()
    };
    let other = Things { object: vec![1], names: vec!["cup".into()] };
    assert!(refused(&cameras(), Some(&other)).contains("do not fit"));
    assert!(refused(&[], None).contains("--cameras"));
    let behind = [Camera {
        pose: Pose { rotation: DMat3::from_diagonal(DVec3::new(-1.0, 1.0, -1.0)), ..Pose::IDENTITY },
        ..cameras()[0].clone()
    }];
    assert!(refused(&behind, None).contains("no surface"));
}
