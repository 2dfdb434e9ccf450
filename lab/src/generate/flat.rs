//! Planar scenes: coloured sheets on the ground seen straight down, as from a drone, or a poster
//! seen from the front. Photos straight down leave the focal length undetermined: a longer focal
//! length from a greater height gives the same picture.
use super::shapes::{SceneObject, Shape, paint};
use glam::{DMat3, DVec3};
use serde::Serialize;
use splatvk::math::Random;
use splatvk::scene::Pose;

/// Arrangement of the cameras over the plane z = 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Flat {
    /// Cameras look straight down and move sideways.
    Ground,
    /// Cameras stand around the normal and look at the middle.
    Poster,
}

impl Flat {
    /// All variants with their names and help texts.
    pub const ALL: [(Flat, &str, &str); 2] = [
        (Flat::Ground, "ground", "Seen straight down, as from a drone that moves sideways"),
        (Flat::Poster, "poster", "Seen from before it, from directions --baseline apart"),
    ];
}

/// Metres from the cameras to the plane.
const DISTANCE: f64 = 0.95;
/// Largest tilt of a photo straight down, degrees: residual error of a gimbal.
const TILT: f64 = 1.0;
/// Largest turn about the vertical, degrees, as by wind.
const YAW: f64 = 5.0;
/// Largest relative change of height.
const HEIGHT: f64 = 0.03;
/// Half the thickness of a sheet, metres; a tenth of a pixel at [`DISTANCE`] is 0.15 mm.
const THIN: f64 = 5e-5;

/// The ground with `sheets` sheets on it at random positions and angles.
pub(super) fn objects(sheets: usize, texture: f64, random: &mut Random) -> Vec<SceneObject> {
    let ground = paint([0.36, 0.42, 0.3], 0.8 * texture, 0.08, random);
    let mut out = vec![SceneObject {
        label: 1,
        phrase: "flat ground".into(),
        shape: Shape::Plane(DVec3::Z, 0.0),
        paint: ground,
    }];
    for (label, k) in (4..).zip(0..sheets) {
        let mut within = |reach: f64| reach * (2.0 * random.uniform() - 1.0);
        let at = DVec3::new(within(0.7), within(0.45), THIN * (1 + k) as f64);
        let half = DVec3::new(0.11 + within(0.05), 0.08 + within(0.04), THIN);
        let turn = within(std::f64::consts::FRAC_PI_2);
        let colour = [0.5, 0.45, 0.4].map(|c| c + within(0.3));
        out.push(SceneObject {
            label,
            phrase: format!("sheet {}", k + 1),
            shape: Shape::Block(at, half, turn),
            paint: paint(colour, 0.7 * texture, 0.03, random),
        });
    }
    out
}

/// Pose of a camera over the plane, `angle` degrees from the middle of the set.
pub(super) fn pose(arrangement: Flat, angle: f64, random: &mut Random) -> Pose {
    let mut within = |reach: f64| reach * (2.0 * random.uniform() - 1.0);
    // View along −z; the picture's y axis is the plane's −y axis.
    let down = DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z);
    let (rotation, centre) = match arrangement {
        Flat::Ground => {
            let tilt = DMat3::from_rotation_x(within(TILT).to_radians())
                * DMat3::from_rotation_y(within(TILT).to_radians())
                * DMat3::from_rotation_z(within(YAW).to_radians());
            let height = DISTANCE * (1.0 + within(HEIGHT));
            (tilt * down, DVec3::new(DISTANCE * angle.to_radians().tan(), within(0.1), height))
        }
        Flat::Poster => {
            let (a, e) = (angle.to_radians(), within(10.0).to_radians());
            let centre = DISTANCE * DVec3::new(a.sin() * e.cos(), e.sin(), a.cos() * e.cos());
            let z = -centre.normalize();
            let x = z.cross(DVec3::Y).normalize();
            (DMat3::from_cols(x, z.cross(x), z).transpose(), centre)
        }
    };
    Pose { rotation, translation: -(rotation * centre) }
}

#[cfg(test)]
mod tests {
    use super::super::{SceneSpec, build_scene, render};
    use super::*;

    #[test]
    fn flat_scene_lies_on_one_plane() {
        for (arrangement, straight) in [(Flat::Ground, true), (Flat::Poster, false)] {
            let spec = SceneSpec {
                seed: 1000,
                size: (160, 120),
                flat: Some(arrangement),
                held_out: 1,
                ..SceneSpec::default()
            };
            let scene = build_scene(&spec).unwrap();
            for camera in &scene.train {
                let seen = render(&scene, camera, 0.0, 0);
                for p in (0..160 * 120).step_by(97) {
                    let pixel = glam::DVec2::new((p % 160) as f64 + 0.5, (p / 160) as f64 + 0.5);
                    let point = camera.unproject(pixel, f64::from(seen.depth.data[p]));
                    assert!(point.z.abs() < 0.002, "{arrangement:?} {point}");
                }
                let lean = camera.pose.rotation.row(2).angle_between(DVec3::NEG_Z).to_degrees();
                assert!(!straight || lean < 2.0, "{lean}");
            }
            let first = scene.train[0].pose.rotation.row(2);
            let turned = first.angle_between(scene.train[3].pose.rotation.row(2)).to_degrees();
            assert!(straight || turned > 30.0, "{turned}");
        }
    }
}
