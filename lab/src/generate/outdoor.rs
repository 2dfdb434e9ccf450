//! Outdoor scenes: a house behind the objects, paved ground from the photographer's feet to the
//! horizon, and a cloudy sky at infinite distance.
use super::shapes::{Paint, SceneObject, Shape, paint};
use glam::DVec3;
use splatvk::math::Random;

/// Scale of an outdoor scene over a table scene: crates of one to two metres, seen from ten.
pub(super) const SCALE: f64 = 10.0;
/// Elevation of the camera above the horizontal, degrees: eyes at two metres.
pub(super) const ELEVATION: f64 = 5.0;

/// Sky at infinite distance behind all objects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sky {
    /// Index in the masks.
    pub label: u32,
    /// Pattern of the clouds over the unit direction.
    clouds: Paint,
}

impl Sky {
    /// Phrase of its label.
    pub const PHRASE: &str = "cloudy sky";

    pub(super) fn new(random: &mut Random) -> Sky {
        // Clouds of 15° and less, too faint for most corner detectors.
        Sky {
            label: 3,
            clouds: Paint { colour: [1.0; 3], contrast: 0.08, grain: 0.26, seed: random.bits(), tile: None },
        }
    }

    /// sRGB colour towards a direction: pale at the horizon, blue above.
    pub fn at(&self, direction: DVec3) -> [f64; 3] {
        let d = direction.normalize();
        let up = d.z.clamp(0.0, 1.0).sqrt();
        let cloud = self.clouds.smooth(d);
        let mix = |low: f64, high: f64, k: usize| ((low + (high - low) * up) * cloud[k]).clamp(0.0, 1.0);
        [mix(0.9, 0.45, 0), mix(0.92, 0.62, 1), mix(0.95, 0.88, 2)]
    }
}

/// Makes ground and house with patterns of contrast `texture`, labels 1 and 2; the sky has label 3.
pub(super) fn background(texture: f64, random: &mut Random) -> Vec<SceneObject> {
    let surface = |label, phrase: String, shape, colour, grain, random: &mut Random| SceneObject {
        label,
        phrase,
        shape,
        paint: paint(colour, 0.8 * texture, grain * SCALE, random),
    };
    let ground = Shape::Plane(DVec3::Z, 0.0);
    let mut objects = vec![surface(1, "paved ground".into(), ground, [0.45, 0.43, 0.4], 0.05, random)];
    // One long building as wide as most photos; the sky ends at its front.
    let tall = 0.35 + 0.25 * random.uniform();
    let front = Shape::Block(
        DVec3::new(0.5 * (random.uniform() - 0.5), 1.3, 0.5 * tall) * SCALE,
        DVec3::new(0.7, 0.2, 0.5 * tall) * SCALE,
        0.3 * (random.uniform() - 0.5),
    );
    objects.push(surface(2, "stone house".into(), front, [0.62, 0.55, 0.45], 0.08, random));
    objects
}
