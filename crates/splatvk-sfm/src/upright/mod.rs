//! Which way is up in a scene (docs/internals/method.md#upright).
mod clues;
mod planes;

use super::segments::{self, END_SIGMA};
use crate::scene::{Camera, PointCloud, RgbImage, Up, UpEvidence};
use clues::{Agreement, Clues, EdgePlane, Refined};
use glam::DVec3;

/// Least agreement of a direction that counts as known: two fifths of what edges, surface and roll
/// make together (2.5). The tuning sets have 1.4 and more, but for `room_a` with 0.85, 3° off, and
/// four photos of a tree trunk with 1.2, 7° off.
const LEAST_AGREEMENT: f64 = 1.0;
/// So many times the agreement of every other direction: 1.15 in `room_a`, 1.05 for the trunk;
/// nothing else comes near on the other tuning sets.
const CLEAR: f64 = 1.3;
/// Largest standard deviation of a direction that counts as known, degrees: a floor that leans by
/// 5° is seen to lean.
const MOST_SIGMA: f64 = 5.0;
/// Agreement from which a kind of evidence is named.
const NAMED: f64 = 0.25;

/// The direction up of a scene, from its photos (without lens), cameras and points: edges of the
/// photos that are upright in the scene, level surfaces among the points, that cameras are held
/// without much roll, and gravity in camera axes where a phone noted it. `None` where these are too
/// few, or agree on several directions.
pub fn up(
    images: &[&RgbImage],
    cameras: &[Camera],
    points: &PointCloud,
    gravity: &[Option<DVec3>],
) -> Option<Up> {
    decide(&candidates(&clues(images, cameras, points, gravity)))
}

/// The best of the candidates, if it is good enough and clearly the best.
fn decide(found: &[(Refined, Agreement)]) -> Option<Up> {
    let (best, agreement) = found.first()?;
    let next = found.get(1).map_or(0.0, |f| f.1.total());
    let sigma_degrees = best.sigma.to_degrees();
    let known = agreement.total() >= LEAST_AGREEMENT.max(CLEAR * next) && sigma_degrees <= MOST_SIGMA;
    let kinds = [
        (UpEvidence::Accelerometer, agreement.gravity),
        (UpEvidence::VerticalEdges, agreement.edges),
        (UpEvidence::LevelSurface, agreement.surface),
        (UpEvidence::CameraRoll, agreement.roll),
    ];
    let evidence = kinds.into_iter().filter(|k| k.1 >= NAMED).map(|k| k.0).collect();
    known.then_some(Up { direction: best.direction, sigma_degrees, evidence })
}

fn clues(images: &[&RgbImage], cameras: &[Camera], points: &PointCloud, gravity: &[Option<DVec3>]) -> Clues {
    let mut clues = Clues::default();
    for (image, camera) in images.iter().zip(cameras) {
        let segments::Found { segments: found, width, height } = segments::of(image);
        let camera = camera.resized(width as u32, height as u32);
        let total: f64 = found.iter().map(|s| s.length()).sum();
        clues.edges.extend(found.iter().map(|s| EdgePlane {
            normal: camera.pose.rotation.transpose()
                * camera.ray(s.from).cross(camera.ray(s.to)).normalize_or_zero(),
            sigma: END_SIGMA * std::f64::consts::SQRT_2 / s.length(),
            weight: s.length() / total / images.len() as f64,
        }));
    }
    clues.cameras = cameras.iter().map(|c| [c.pose.rotation.row(0), -c.pose.rotation.row(1)]).collect();
    let up = |(c, g): (&Camera, &Option<DVec3>)| g.map(|g| -(c.pose.rotation.transpose() * g));
    clues.gravity = cameras.iter().zip(gravity).filter_map(up).collect();
    clues.surfaces = planes::surfaces(points, cameras);
    clues
}

/// Directions over the sphere, 2.2° apart.
fn sphere() -> impl Iterator<Item = DVec3> {
    const N: usize = 8000;
    (0..N).map(|k| {
        let z = 1.0 - (2 * k + 1) as f64 / N as f64;
        let (sin, cos) = (k as f64 * 2.399_963_229_728_653).sin_cos();
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * cos, r * sin, z)
    })
}

/// Coarseness of the search and of the steps that follow it, radians: 2.5°, beyond the distance of
/// the directions tried.
const BLURS: [f64; 3] = [0.044, 0.02, 0.0];
/// Candidates are this far apart, radians (6°).
const APART: f64 = 0.1;
/// Candidates that are refined: the three directions of a room, and what lies between them.
const CANDIDATES: usize = 12;
/// Agreement of what is worth refining: a twentieth of what counts as known.
const WORTH: f64 = 0.05;
/// Steps per coarseness: on the tuning sets two reach the same to a twentieth of a degree, among a
/// tree's branches to a quarter.
const STEPS: usize = 4;

/// Directions that agree better than those around them, best first.
fn candidates(clues: &Clues) -> Vec<(Refined, Agreement)> {
    let mut coarse: Vec<(DVec3, f64)> =
        sphere().map(|v| (v, clues.agreement(v, BLURS[0]).total())).filter(|c| c.1 > WORTH).collect();
    coarse.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut found: Vec<(Refined, Agreement)> = Vec::new();
    let mut seen: Vec<DVec3> = Vec::new();
    for (v, _) in coarse {
        if seen.len() == CANDIDATES {
            break;
        }
        if seen.iter().any(|s| s.angle_between(v) < APART) {
            continue;
        }
        seen.push(v);
        let mut at = Refined { direction: v, sigma: 1.0 };
        for blur in BLURS {
            for _ in 0..STEPS {
                at = clues.refined(at.direction, blur);
            }
        }
        if found.iter().all(|f| f.0.direction.angle_between(at.direction) > APART) {
            found.push((at, clues.agreement(at.direction, 0.0)));
        }
    }
    found.sort_by(|a, b| b.1.total().total_cmp(&a.1.total()));
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing;
    use glam::DVec2;

    /// Every twelfth pixel of the true depth.
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
    fn up_is_found_from_edges_and_the_table() {
        let truth = testing::train(&testing::folder());
        let images: Vec<_> = truth.photos.iter().map(|p| &p.image).collect();
        let off = |points: &PointCloud, images: &[&RgbImage]| {
            let up = up(images, &truth.cameras, points, &[]).unwrap();
            let off = up.direction.angle_between(DVec3::Z).to_degrees();
            println!("{off:.2} degrees off: {up:?}");
            (off, up)
        };
        let (both, up_of_both) = off(&points(&truth), &images);
        // Measured: 0.09° with both, 0.11° by the edges alone, 0.39° by the table alone.
        assert!(both < 0.4 && up_of_both.evidence.len() == 3);
        let (edges, up_of_edges) = off(&PointCloud::default(), &images);
        assert!(edges < 0.5 && !up_of_edges.evidence.contains(&UpEvidence::LevelSurface));
        assert!(up_of_edges.sigma_degrees >= up_of_both.sigma_degrees);
        let blank = RgbImage { data: vec![[0.5; 3]; 640 * 480], ..images[0].clone() };
        let (table, up_of_table) = off(&points(&truth), &[&blank; 4]);
        assert!(table < 1.0 && !up_of_table.evidence.contains(&UpEvidence::VerticalEdges));
    }

    #[test]
    fn what_nothing_tells_is_not_known() {
        let truth = testing::train(&testing::folder());
        let blank = RgbImage { width: 640, height: 480, data: vec![[0.5; 3]; 640 * 480] };
        // How the cameras were held is not enough.
        assert_eq!(up(&[&blank; 4], &truth.cameras, &PointCloud::default(), &[]), None);
        assert_eq!(up(&[], &[], &PointCloud::default(), &[]), None);
        // The phones' own measurement is.
        let down = |c: &Camera| Some(c.pose.rotation * DVec3::NEG_Z);
        let gravity: Vec<_> = truth.cameras.iter().map(down).collect();
        let measured = up(&[&blank; 4], &truth.cameras, &PointCloud::default(), &gravity).unwrap();
        assert!(measured.direction.angle_between(DVec3::Z) < 0.01, "{measured:?}");
        assert_eq!(measured.evidence[0], UpEvidence::Accelerometer);
        // Cameras on their side contradict the edges and the table.
        let images: Vec<_> = truth.photos.iter().map(|p| &p.image).collect();
        let quarter = glam::DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let mut clues = clues(&images, &truth.cameras, &points(&truth), &[]);
        for (held, camera) in clues.cameras.iter_mut().zip(&truth.cameras) {
            let rotation = quarter * camera.pose.rotation;
            *held = [rotation.row(0), -rotation.row(1)];
        }
        assert!(decide(&candidates(&clues)).is_none());
    }

    #[test]
    fn of_two_directions_that_agree_nearly_as_well_neither_is_up() {
        let one = |direction: DVec3, edges: f64| {
            (Refined { direction, sigma: 0.01 }, Agreement { edges, roll: 1.0, ..Agreement::default() })
        };
        // Totals of 1.5 and 1.3, then of 1.5 and 0.7.
        assert_eq!(decide(&[one(DVec3::Z, 1.0), one(DVec3::X, 0.8)]), None);
        assert_eq!(decide(&[one(DVec3::Z, 1.0), one(DVec3::X, 0.2)]).unwrap().direction, DVec3::Z);
    }
}
