//! Other outputs of a network: its own cameras and its own scale of confidence; and wrong pairs.
use super::*;
use crate::progress::Recorded;
use crate::scene::Pose;

/// One unit for all maps, as from a network that sees all photos at once.
const AT_ONCE: Faults = Faults { scale: 0.0, ..FAULTS };

fn solved(case: &Case, pairs: &[PairPointmaps], matches: &[PairMatches], cameras: &[Camera]) -> Geometry {
    let maps = Pointmaps { cameras: cameras.to_vec(), ..network_output(&case.views, pairs) };
    align(maps, matches.to_vec(), 0, &Silent).unwrap().geometry
}

/// Cameras rotated about the vertical axis and translated.
fn moved(cameras: &[Camera], degrees: f64, shift: f64) -> Vec<Camera> {
    let mut out = cameras.to_vec();
    for (k, c) in out.iter_mut().enumerate().skip(1) {
        let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
        let twist = Pose::exp(DVec3::X * shift, DVec3::Y * (sign * degrees).to_radians());
        c.pose = twist.compose(&c.pose);
    }
    out
}

fn assert_right(g: &Geometry, truth: &Truth) {
    let e = errors(g, truth);
    assert!(e.rotation_degrees.iter().all(|v| *v < 0.1), "{:?}", e.rotation_degrees);
    assert!(e.centre.iter().all(|v| *v < 0.005), "{:?}", e.centre);
}

#[test]
fn align_starts_from_network_cameras() {
    let (case, truth) = case();
    let (pairs, matches) = case.input(AT_ONCE);
    let g = solved(&case, &pairs, &matches, &moved(&case.cameras, 0.2, 0.01 * truth.mean_depth));
    assert_eq!(g.method, "pointmaps, started from the network's own cameras");
    assert_right(&g, &truth);
    // The solution does not depend on the start.
    let from_pairs = solved(&case, &pairs, &matches, &[]);
    assert_eq!(from_pairs.method, "pointmaps");
    let d = difference(&g.cameras, &from_pairs.cameras);
    assert!(d < 1e-4, "{d}");
}

#[test]
fn align_rejects_wrong_network_cameras() {
    let (case, truth) = case();
    let (pairs, matches) = case.input(AT_ONCE);
    let g = solved(&case, &pairs, &matches, &moved(&case.cameras, 60.0, truth.mean_depth));
    assert!(g.method.contains("explain fewer matches"), "{}", g.method);
    assert_right(&g, &truth);
}

#[test]
fn align_prefers_network_to_wrong_pairs() {
    let (case, truth) = case();
    let (mut pairs, matches) = case.input(AT_ONCE);
    let right = case.cameras.clone();
    // Points in the frames of other cameras: rigid, and wrong.
    let elsewhere = moved(&right, 60.0, truth.mean_depth);
    let mut rng = Random::new(9);
    for p in &mut pairs {
        for (map, of, by) in [(&mut p.x21, p.second, p.first), (&mut p.x12, p.first, p.second)] {
            let world = case.map(of, of, 1.0, 0.01, &mut rng);
            let to = elsewhere[by].pose.compose(&right[of].pose.inverse());
            map.points = world
                .points
                .iter()
                .map(|x| to.transform(glam::Vec3::from(*x).as_dvec3()).as_vec3().to_array())
                .collect();
        }
    }
    let canonical = canonical::canonical_maps(&case.views, &pairs);
    let focals = canonical::focals(&case.views, &canonical);
    let edges = pairs
        .iter()
        .zip(&matches)
        .filter_map(|(p, m)| pairs::edge(&case.views, p, &m.matches, &canonical, &focals, 0));
    assert!(tree::register(4, &edges.collect::<Vec<_>>()).is_ok(), "the pairs do give a start");
    let g = solved(&case, &pairs, &matches, &right);
    assert_eq!(g.method, "pointmaps, started from the network's own cameras");
    assert_right(&g, &truth);
}

#[test]
fn align_without_edges_uses_network_cameras() {
    let (case, truth) = case();
    let (mut pairs, matches) = case.input(AT_ONCE);
    // Each view's points are right in its own camera, and nonsense in any other.
    let mut rng = Random::new(8);
    for p in pairs.iter_mut().flat_map(|p| [&mut p.x21, &mut p.x12]).flat_map(|m| &mut m.points) {
        *p = [rng.normal() as f32, rng.normal() as f32, 3.0 + rng.uniform() as f32];
    }
    let g = solved(&case, &pairs, &matches, &case.cameras);
    assert_eq!(g.method, "pointmaps, started from the network's own cameras");
    assert_right(&g, &truth);
    let error = align(network_output(&case.views, &pairs), matches, 0, &Silent).unwrap_err();
    assert!(error.to_string().contains("do not overlap enough"), "{error}");
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn view_with_wrong_pairs_left_out() {
    let (case, truth) = case();
    let (pairs, mut matches) = case.input(FAULTS);
    let mut rng = Random::new(21);
    let size = (case.views[3].width as f64, case.views[3].height as f64);
    for (pair, m) in pairs.iter().zip(&mut matches).filter(|(p, _)| p.second == 3) {
        assert!(pair.first < 3);
        m.matches.iter_mut().for_each(|m| m.b = DVec2::new(rng.uniform() * size.0, rng.uniform() * size.1));
    }
    let recorded = Recorded::new(&Silent);
    let found = align(network_output(&case.views, &pairs), matches, 0, &recorded).unwrap();
    assert_eq!(found.left_out, [3]);
    assert!(recorded.warnings()[0].starts_with("train_03 is left out"), "{:?}", recorded.warnings());
    assert_eq!(found.geometry.cameras.len(), 3);
    let e = pose_errors(&found.geometry.cameras, &truth.cameras[..3], truth.mean_depth);
    assert!(e.rotation_degrees.iter().all(|v| *v < 0.1) && e.centre.iter().all(|v| *v < 0.005), "{e:?}");
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn confidence_floor_selects_points() {
    let (case, _) = case();
    let (mut pairs, matches) = case.input(AT_ONCE);
    let mut rng = Random::new(3);
    // Confidence as of Depth Anything 3: hardly above 1.
    for map in pairs.iter_mut().flat_map(|p| [&mut p.x11, &mut p.x21, &mut p.x22, &mut p.x12]) {
        map.confidence.iter_mut().for_each(|c| *c = 1.02 + 0.2 * rng.uniform() as f32);
    }
    let align_with = |floor: Option<f64>| {
        let maps = Pointmaps { confidence_floor: floor, ..network_output(&case.views, &pairs) };
        align(maps, matches.clone(), 0, &Silent).unwrap().geometry
    };
    let (free, own, other) = (align_with(None), align_with(Some(1.15)), align_with(Some(3.0)));
    let counts = [&free, &own, &other].map(|g| g.points.len());
    println!(
        "points without a floor {}, with its own {}, with that of another network {}",
        counts[0], counts[1], counts[2]
    );
    assert!(counts[0] > 100_000 && counts[2] == 0, "{counts:?}");
    assert!(counts[1] > 30_000 && counts[1] < counts[0] * 4 / 5, "{counts:?}");
    // Training takes depth from half the confidence of a point.
    let usable_share = |g: &Geometry| {
        let all = g.depths.iter().flat_map(|d| d.confidence.data.iter().zip(&d.depth.data));
        let known: Vec<bool> = all.filter(|(_, z)| **z > 0.0).map(|(c, _)| *c >= 0.5).collect();
        known.iter().filter(|k| **k).count() as f64 / known.len() as f64
    };
    assert!(
        usable_share(&free) > 0.9 && usable_share(&other) == 0.0,
        "{} {}",
        usable_share(&free),
        usable_share(&other)
    );
}
