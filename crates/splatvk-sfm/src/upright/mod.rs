//! Direction up of a scene (docs/internals/method.md#upright).
mod clues;
mod planes;

use super::segments::{self, END_SIGMA};
use crate::math::sphere_directions;
use crate::scene::{Camera, PointCloud, RgbImage, Up, UpEvidence};
use clues::{Agreement, EdgePlane, Evidence, Refined};
use glam::DVec3;

/// Least score of a known direction: two fifths of the maximum of edges, surface and roll (2.5).
/// The tuning sets have 1.4 and more, except `room_a` with 0.85, 3° off, and four photos of a tree
/// trunk with 1.2, 7° off.
const LEAST_AGREEMENT: f64 = 1.0;
/// Least ratio of the best score to that of every other direction: 1.15 in `room_a`, 1.05 for the
/// trunk; no other tuning set comes near.
const CLEAR: f64 = 1.3;
/// Largest standard deviation of a known direction, degrees: a tilt of the floor by 5° is visible.
const MOST_SIGMA: f64 = 5.0;
/// Least agreement of a kind of evidence that is reported.
const NAMED: f64 = 0.25;

/// Direction up of a scene from its undistorted photos, cameras and points: upright edges in the
/// photos, level surfaces among the points, small roll of the cameras, and `gravity` in camera axes
/// from accelerometers. `None` with too little evidence, or if several directions agree.
pub fn up(
    images: &[&RgbImage],
    cameras: &[Camera],
    points: &PointCloud,
    gravity: &[Option<DVec3>],
) -> Option<Up> {
    decide(&candidates(&gather(images, cameras, points, gravity)))
}

/// The best candidate, if its score is sufficient and clearly the best.
fn decide(found: &[(Refined, Agreement)]) -> Option<Up> {
    let (best, agreement) = found.first()?;
    let next = found.get(1).map_or(0.0, |f| f.1.score());
    let sigma_degrees = best.sigma.to_degrees();
    let known = agreement.score() >= LEAST_AGREEMENT.max(CLEAR * next) && sigma_degrees <= MOST_SIGMA;
    let kinds = [
        (UpEvidence::Accelerometer, agreement.gravity),
        (UpEvidence::VerticalEdges, agreement.edges),
        (UpEvidence::LevelSurface, agreement.surface),
        (UpEvidence::CameraRoll, agreement.roll),
    ];
    let evidence = kinds.into_iter().filter(|k| k.1 >= NAMED).map(|k| k.0).collect();
    known.then_some(Up { direction: best.direction, sigma_degrees, evidence })
}

fn gather(
    images: &[&RgbImage],
    cameras: &[Camera],
    points: &PointCloud,
    gravity: &[Option<DVec3>],
) -> Evidence {
    let mut evidence = Evidence::default();
    for (image, camera) in images.iter().zip(cameras) {
        let segments::Found { segments: found, width, height } = segments::detect(image);
        let camera = camera.resized(width as u32, height as u32);
        let total: f64 = found.iter().map(|s| s.length()).sum();
        evidence.edges.extend(found.iter().map(|s| EdgePlane {
            normal: camera.pose.rotation.transpose()
                * camera.ray(s.from).cross(camera.ray(s.to)).normalize_or_zero(),
            sigma: END_SIGMA * std::f64::consts::SQRT_2 / s.length(),
            weight: s.length() / total / images.len() as f64,
        }));
    }
    evidence.cameras = cameras.iter().map(|c| [c.pose.rotation.row(0), -c.pose.rotation.row(1)]).collect();
    let world_up = |(c, g): (&Camera, &Option<DVec3>)| g.map(|g| -(c.pose.rotation.transpose() * g));
    evidence.gravity = cameras.iter().zip(gravity).filter_map(world_up).collect();
    evidence.surfaces = planes::surfaces(points, cameras);
    evidence
}

/// Number of directions that are searched: 2.2° apart.
const DIRECTIONS: usize = 8000;
/// `blur` of the search and the refinement, radians: 2.5° exceeds the pitch of the directions.
const BLURS: [f64; 3] = [0.044, 0.02, 0.0];
/// Least angle between candidates, radians (6°).
const APART: f64 = 0.1;
/// Number of refined candidates: the three directions of a room and some between them.
const CANDIDATES: usize = 12;
/// Least score for refinement: a twentieth of that of a known direction.
const WORTH: f64 = 0.05;
/// Steps per blur: on the tuning sets two reach the same to a twentieth of a degree, among a tree's
/// branches to a quarter.
const STEPS: usize = 4;

/// Local maxima of the score over directions, best first.
fn candidates(evidence: &Evidence) -> Vec<(Refined, Agreement)> {
    let mut coarse: Vec<(DVec3, f64)> = sphere_directions(DIRECTIONS)
        .map(|v| (v, evidence.agreement(v, BLURS[0]).score()))
        .filter(|c| c.1 > WORTH)
        .collect();
    coarse.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut found: Vec<(Refined, Agreement)> = Vec::new();
    let mut tried: Vec<DVec3> = Vec::new();
    for (v, _) in coarse {
        if tried.len() == CANDIDATES {
            break;
        }
        if tried.iter().any(|s| s.angle_between(v) < APART) {
            continue;
        }
        tried.push(v);
        let mut refined = Refined { direction: v, sigma: 1.0 };
        for blur in BLURS {
            for _ in 0..STEPS {
                refined = evidence.refined(refined.direction, blur);
            }
        }
        if found.iter().all(|f| f.0.direction.angle_between(refined.direction) > APART) {
            found.push((refined, evidence.agreement(refined.direction, 0.0)));
        }
    }
    found.sort_by(|a, b| b.1.score().total_cmp(&a.1.score()));
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing;
    use glam::DVec2;

    /// Points from every twelfth pixel of the true depth.
    fn points(truth: &testing::Truth) -> PointCloud {
        let mut cloud = PointCloud::default();
        for (photo, camera) in truth.photos.iter().zip(&truth.cameras) {
            for (k, z) in testing::depth(&truth.folder, &photo.stem).iter().enumerate().step_by(12) {
                let pixel =
                    DVec2::new((k % photo.image.width) as f64 + 0.5, (k / photo.image.width) as f64 + 0.5);
                cloud.positions.push(camera.unproject(pixel, f64::from(*z)).as_vec3().to_array());
            }
        }
        cloud
    }

    #[test]
    fn up_found_from_edges_or_table() {
        let truth = testing::train(&testing::folder());
        let images: Vec<_> = truth.photos.iter().map(|p| &p.image).collect();
        let estimate = |points: &PointCloud, images: &[&RgbImage]| {
            let up = up(images, &truth.cameras, points, &[]).unwrap();
            let error = up.direction.angle_between(DVec3::Z).to_degrees();
            println!("{error:.2} degrees off: {up:?}");
            (error, up)
        };
        let (both, up_of_both) = estimate(&points(&truth), &images);
        // Measured: 0.09° with both, 0.11° by the edges alone, 0.39° by the table alone.
        assert!(both < 0.4 && up_of_both.evidence.len() == 3);
        let (edges, up_of_edges) = estimate(&PointCloud::default(), &images);
        assert!(edges < 0.5 && !up_of_edges.evidence.contains(&UpEvidence::LevelSurface));
        assert!(up_of_edges.sigma_degrees >= up_of_both.sigma_degrees);
        let blank = RgbImage { data: vec![[0.5; 3]; 640 * 480], ..images[0].clone() };
        let (table, up_of_table) = estimate(&points(&truth), &[&blank; 4]);
        assert!(table < 1.0 && !up_of_table.evidence.contains(&UpEvidence::VerticalEdges));
    }

    #[test]
    fn up_unknown_without_clear_evidence() {
        let truth = testing::train(&testing::folder());
        let blank = RgbImage { width: 640, height: 480, data: vec![[0.5; 3]; 640 * 480] };
        // The roll of the cameras is not enough.
        assert_eq!(up(&[&blank; 4], &truth.cameras, &PointCloud::default(), &[]), None);
        assert_eq!(up(&[], &[], &PointCloud::default(), &[]), None);
        // Accelerometers are.
        let down = |c: &Camera| Some(c.pose.rotation * DVec3::NEG_Z);
        let gravity: Vec<_> = truth.cameras.iter().map(down).collect();
        let measured = up(&[&blank; 4], &truth.cameras, &PointCloud::default(), &gravity).unwrap();
        assert!(measured.direction.angle_between(DVec3::Z) < 0.01, "{measured:?}");
        assert_eq!(measured.evidence[0], UpEvidence::Accelerometer);
        // Cameras on their side contradict the edges and the table.
        let images: Vec<_> = truth.photos.iter().map(|p| &p.image).collect();
        let quarter = glam::DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let mut evidence = gather(&images, &truth.cameras, &points(&truth), &[]);
        for (held, camera) in evidence.cameras.iter_mut().zip(&truth.cameras) {
            let rotation = quarter * camera.pose.rotation;
            *held = [rotation.row(0), -rotation.row(1)];
        }
        assert!(decide(&candidates(&evidence)).is_none());
    }

    #[test]
    fn decide_rejects_two_similar_scores() {
        let candidate = |direction: DVec3, edges: f64| {
            (Refined { direction, sigma: 0.01 }, Agreement { edges, roll: 1.0, ..Agreement::default() })
        };
        // Scores of 1.5 and 1.3, then of 1.5 and 0.7.
        assert_eq!(decide(&[candidate(DVec3::Z, 1.0), candidate(DVec3::X, 0.8)]), None);
        assert_eq!(
            decide(&[candidate(DVec3::Z, 1.0), candidate(DVec3::X, 0.2)]).unwrap().direction,
            DVec3::Z
        );
    }
}
