use super::complete::completed;
use super::floaters;
use super::select::{clicked, grown, is_inside, nearest};
use crate::format::scene_dir::Scene;
use crate::query::instances::Places;
use crate::query::things::OBJECTS;
use crate::scene::{Camera, Codebook, Image, LanguageField, LevelField, Pose, SH_C0, Splats};
use glam::DVec2;

/// Splats at places, of a grey each.
fn splats(places: &[[f32; 3]], greys: &[f32]) -> Splats {
    Splats {
        means: places.to_vec(),
        log_scales: vec![[-4.0; 3]; places.len()],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; places.len()],
        opacity_logits: vec![3.0; places.len()],
        sh: greys.iter().flat_map(|grey| [(grey - 0.5) / SH_C0; 3]).collect(),
        ..Splats::default()
    }
}

/// Places of splats with features of one level, whose two codes are (1, 0) and (0, 1).
fn places_of(splats: &Splats, features: Vec<f32>) -> Places {
    let rows = vec![1.0, 0.0, 0.0, 1.0];
    let codebook = Codebook {
        embedding_dim: 2,
        code_dim: 2,
        embeddings: rows.clone(),
        codes: rows,
        ..Codebook::default()
    };
    let level = LevelField { codebook, features, ..LevelField::default() };
    Places::of(splats, &LanguageField { levels: vec![level], space: String::new() })
}

#[test]
fn polygons_contain_their_inside() {
    // A U, open at its top.
    let outline =
        [[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [2.0, 2.0], [2.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]];
    let inside = |x, y| is_inside(&outline, DVec2::new(x, y));
    assert!(inside(0.5, 0.5) && inside(2.5, 0.5) && inside(1.5, 2.5));
    assert!(!inside(1.5, 0.5) && !inside(1.5, -1.0) && !inside(4.0, 2.5) && !inside(-0.1, 2.5));
}

#[test]
fn growth_moves_the_bar_between_every_code_and_the_best() {
    let bars = [(-1.0, 1.0), (-0.5, 0.9), (0.0, 0.8), (0.5, 0.4), (1.0, 0.0)];
    for (grow, share) in bars {
        assert!((grown(0.8, grow) - share).abs() < 1e-6, "{grow}");
    }
}

/// A dark shell of code 0 around x = 0, a bright floor of code 1 below it, and splats without a
/// code: inside the shell, on the floor, and far away.
#[test]
fn hidden_splats_join_the_thing_of_their_place_and_colour() {
    let shell = (0..40).map(|i| [(0.157 * i as f32).cos(), 0.05 * i as f32, (0.157 * i as f32).sin()]);
    let floor = (0..80).map(|i| [0.25 * (i % 9) as f32 - 1.0, 2.05, 0.25 * (i / 9) as f32 - 1.0]);
    let mut places: Vec<[f32; 3]> = shell.chain(floor).collect();
    let mut greys = [vec![0.1; 40], vec![0.9; 80]].concat();
    places.extend([[0.1, 1.0, 0.0], [0.0, 2.0, 0.1], [0.1, 2.0, 0.3], [30.0, 1.0, 0.0]]);
    greys.extend([0.12, 0.88, 0.15, 0.1]);
    let splats = splats(&places, &greys);
    let features = (0..124).flat_map(|i| match i {
        0..40 => [1.0f32, 0.0],
        40..120 => [0.0, 1.0],
        _ => [0.0, 0.0],
    });
    let places = places_of(&splats, features.collect());
    let all = completed((0..40).collect(), &splats, &places.lists()[0]);
    // The bright splat at the floor stays with the floor, and so does the dark one on it.
    let hidden: Vec<usize> = all.iter().copied().filter(|i| *i >= 40).collect();
    assert_eq!(hidden, [120], "{hidden:?}");
    assert!(all.is_sorted() && all.len() == 41);
}

#[test]
fn click_selects_a_thing_before_the_coarsest_mask() {
    let all = [Some(5), Some(6), Some(7)];
    assert_eq!((clicked(None, &all, 1), clicked(Some(2), &all, 1)), (Some((OBJECTS, 6)), Some((2, 7))));
    let no_part = [Some(5), None, Some(7)];
    assert_eq!((clicked(None, &no_part, 1), clicked(Some(1), &no_part, 1)), (Some((2, 7)), None));
    assert_eq!(clicked(None, &[None; 3], 1), None);
}

/// A thing of the codes 0 and 1, a speck of code 1 of no thing, and another thing of code 1.
#[test]
fn click_on_a_part_selects_its_thing_with_specks() {
    let splats = splats(
        &[[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.2, 0.0, 1.0], [9.0, 0.0, 1.0], [5.0, 0.0, 1.0]],
        &[0.5; 5],
    );
    let places = places_of(&splats, vec![1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0]);
    let things = [vec![0, 1, 2], vec![4]];
    let at = |x: f64| nearest(&places, &things, &[2, 3, 4], glam::DVec3::new(x, 0.0, 1.0), 0);
    assert_eq!((at(0.3), at(4.0)), (vec![0, 1, 2, 3], vec![3, 4]));
}

#[test]
fn floaters_are_in_front_of_surfaces() {
    let camera = |name: &str, x: f64| Camera {
        name: name.into(),
        width: 10,
        height: 10,
        fx: 10.0,
        fy: 10.0,
        cx: 5.0,
        cy: 5.0,
        pose: Pose { translation: glam::DVec3::new(-x, 0.0, 0.0), ..Pose::IDENTITY },
    };
    let mut scene = Scene::default();
    scene.cameras = vec![camera("a", 0.0), camera("b", 0.5), camera("c", 1.0)];
    // On the surface at depth 2; in front of it in all views; on a nearer thing in view b, and in
    // front of the surface in the others; behind; outside of every view.
    scene.splats = splats(
        &[[0.5, 0.0, 2.0], [0.5, 0.0, 1.5], [0.5, 0.3, 1.5], [0.5, 0.0, 3.0], [50.0, 0.0, 1.0]],
        &[0.5; 5],
    );
    let mut depths = vec![Image::filled(10, 10, 2.0f32); 3];
    // The thing covers the pixel of view b that shows the third splat.
    depths[1].data[7 * 10 + 5] = 1.5;
    assert_eq!(floaters::find(&scene, &depths, false).unwrap(), [1]);
    assert_eq!(floaters::find(&scene, &depths, true).unwrap(), [1, 2]);
    scene.cameras.clear();
    assert_eq!(floaters::find(&scene, &[], false).unwrap_err().exit_code(), 2);
}
