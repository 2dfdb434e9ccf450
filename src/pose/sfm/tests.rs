use super::*;
use crate::pose::align::pose_errors;
use crate::pose::testing;
use crate::progress::Silent;

/// Learned features when the model pack is installed.
fn learned(photos: &[Photo]) -> Vec<Features> {
    let Ok(registry) = crate::infer::Registry::open(None) else { return Vec::new() };
    let Ok(mut xfeat) = crate::infer::xfeat::XFeat::load(&registry) else { return Vec::new() };
    photos.iter().map(|p| Features::from(xfeat.detect(&p.image, 4096).unwrap())).collect()
}

fn check(name: &str, features: impl Fn(&[Photo]) -> Vec<Features>, rotation: f64, centre: f64, focal: f64) {
    let truth = testing::train(&testing::folder());
    let start = std::time::Instant::now();
    let features = features(&truth.photos);
    let found = start.elapsed();
    let model = reconstruct(&truth.photos, &features, &Silent).unwrap();
    let e = pose_errors(&model.cameras, &truth.cameras, truth.mean_depth);
    println!(
        "{name}: rotation {:.3?}° centre {:.3?} % focal {:.2} % ± {:.2} %, {} points, {:.1} + {:.1} s",
        e.rotation_degrees,
        e.centre.iter().map(|c| 100.0 * c).collect::<Vec<_>>(),
        100.0 * e.focal[0],
        100.0 * model.focal_log_sigma.unwrap(),
        model.points.len(),
        found.as_secs_f64(),
        (start.elapsed() - found).as_secs_f64(),
    );
    assert!(e.rotation_degrees.iter().all(|v| *v < rotation), "{:?}", e.rotation_degrees);
    assert!(e.centre.iter().all(|v| *v < centre), "{:?}", e.centre);
    assert!(e.focal.iter().all(|v| *v < focal), "{:?}", e.focal);
}

#[test]
fn corners_alone_place_the_breakfast_cameras() {
    check("corners", |_| Vec::new(), 0.2, 0.003, 0.01);
}

#[test]
fn learned_features_place_the_breakfast_cameras() {
    check("corners + XFeat", learned, 0.2, 0.003, 0.01);
}
