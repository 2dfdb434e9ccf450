//! A person who walks through the scene while the photos are taken: a figure of solids, in all
//! photos but one, each time elsewhere. The ground truth has no person.
use super::render::first_hit;
use super::scene::{SceneSpec, SyntheticScene};
use super::shapes::{SceneObject, Shape, paint};
use crate::{Error, Result};
use glam::{DVec2, DVec3};
use splatvk::math::Random;
use splatvk::scene::Camera;

/// Height of the figure in units of the scene: 1.8 m out of doors, a doll of 18 cm on a table.
const HEIGHT: f64 = 0.18;
/// Largest distance from the middle of the scene, in its units.
const REACH: f64 = 0.42;
/// Least distance between the places in two photos, and the radius that it needs, in heights.
const APART: f64 = 1.0;
const RADIUS: f64 = 0.2;
/// Places that are tried for a photo.
const TRIES: usize = 5000;
/// Least share of the body's axis that nothing hides.
const VISIBLE: f64 = 0.8;
/// Points of the axis that are tested.
const POINTS: usize = 20;

/// The figure in every photo; `None` where it has left.
#[derive(Clone, Debug, PartialEq)]
pub struct Walker(pub Vec<Option<Vec<SceneObject>>>);

impl Walker {
    /// Name of the figure.
    pub const PHRASE: &str = "person";

    /// Chooses a place per photo where the camera sees the figure.
    ///
    /// # Errors
    /// A photo without such a place.
    pub fn new(spec: &SceneSpec, scene: &SyntheticScene) -> Result<Walker> {
        let mut random = Random::new(spec.seed ^ 0x3a1_4e5);
        let absent = random.below(scene.train.len());
        let (height, clothes) = (HEIGHT * spec.unit(), Clothes::new(&mut random));
        let mut places: Vec<DVec2> = Vec::new();
        let mut photos = Vec::with_capacity(scene.train.len());
        for (i, camera) in scene.train.iter().enumerate() {
            if i == absent {
                photos.push(None);
                continue;
            }
            let draw = |random: &mut Random| {
                let p = DVec2::new(random.uniform() - 0.5, random.uniform() - 0.5);
                p * 2.0 * REACH * spec.unit()
            };
            let fits = |p: &DVec2| {
                places.iter().all(|q| p.distance(*q) > APART * height)
                    && is_free(scene, *p, RADIUS * height)
                    && is_visible(scene, camera, *p, height)
            };
            let place = (0..TRIES).map(|_| draw(&mut random)).find(fits).ok_or_else(|| {
                Error::input(
                    "generate: no place where a photo shows the whole walker; lower --objects or --occlusion",
                )
            })?;
            places.push(place);
            let turn = 1.2 * (random.uniform() - 0.5);
            photos.push(Some(clothes.figure(place, height, towards(camera, place) + turn)));
        }
        Ok(Walker(photos))
    }

    /// The scene as photo `i` shows it; `None` without the figure.
    pub fn scene(&self, scene: &SyntheticScene, i: usize) -> Option<SyntheticScene> {
        let figure = self.0.get(i)?.as_ref()?;
        let mut with = scene.clone();
        with.objects.extend(figure.iter().cloned());
        Some(with)
    }
}

/// Label of the figure, which no other object has.
pub(super) const LABEL: u32 = u32::MAX;

/// Whether nothing stands within a radius of a place on the ground.
fn is_free(scene: &SyntheticScene, place: DVec2, radius: f64) -> bool {
    scene.objects.iter().all(|object| match object.shape {
        Shape::Ball(c, r) => place.distance(c.truncate()) > r + radius,
        Shape::Can(c, r, _) => place.distance(c.truncate()) > r + radius,
        // The table and the ground are below.
        Shape::Block(c, half, _) => {
            c.z + half.z <= 1e-9 || place.distance(c.truncate()) > half.truncate().length() + radius
        }
        Shape::Plane(..) => true,
    })
}

/// Whether a camera sees most of the figure's axis and has all of it in the frame.
fn is_visible(scene: &SyntheticScene, camera: &Camera, place: DVec2, height: f64) -> bool {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let from = camera.pose.centre();
    let mut seen = 0;
    for k in 0..POINTS {
        let point = place.extend(height * (k as f64 + 0.5) / POINTS as f64);
        let (pixel, z) = camera.project(point);
        let margin = 0.03 * w;
        let inside = |v: f64, size: f64| (margin..size - margin).contains(&v);
        if z <= 0.0 || !inside(pixel.x, w) || !inside(pixel.y, h) {
            return false;
        }
        seen += usize::from(first_hit(scene, from, point - from).is_none_or(|(_, hit)| hit.t > 1.0));
    }
    seen as f64 >= VISIBLE * POINTS as f64
}

/// Angle about +z from a place to a camera; the figure's front is −y at 0.
fn towards(camera: &Camera, place: DVec2) -> f64 {
    let d = camera.pose.centre().truncate() - place;
    d.x.atan2(-d.y)
}

/// Colours and patterns, the same in all photos.
struct Clothes {
    shirt: [f64; 3],
    trousers: [f64; 3],
    skin: [f64; 3],
    hair: [f64; 3],
    seed: u64,
}

impl Clothes {
    fn new(random: &mut Random) -> Clothes {
        let pick = |random: &mut Random, from: &[[f64; 3]]| from[random.below(from.len())];
        Clothes {
            shirt: pick(random, &[[0.7, 0.15, 0.15], [0.15, 0.35, 0.65], [0.85, 0.8, 0.7], [0.2, 0.5, 0.3]]),
            trousers: pick(random, &[[0.15, 0.2, 0.38], [0.2, 0.2, 0.22], [0.5, 0.42, 0.3]]),
            skin: pick(random, &[[0.85, 0.66, 0.54], [0.62, 0.43, 0.32], [0.4, 0.27, 0.2]]),
            hair: pick(random, &[[0.1, 0.08, 0.07], [0.35, 0.22, 0.12], [0.6, 0.48, 0.28]]),
            seed: random.bits(),
        }
    }

    /// Head with hair and face, neck, arms with hands, torso, belt, legs and shoes.
    fn figure(&self, place: DVec2, height: f64, turn: f64) -> Vec<SceneObject> {
        let mut random = Random::new(self.seed);
        let (s, c) = turn.sin_cos();
        // Right, towards the back, up; shares of the height.
        let at = |x: f64, y: f64, z: f64| {
            DVec3::new(place.x, place.y, 0.0) + height * DVec3::new(c * x - s * y, s * x + c * y, z)
        };
        let block = |centre, half: [f64; 3]| Shape::Block(centre, height * DVec3::from(half), turn);
        let can = |base, radius: f64, tall: f64| Shape::Can(base, height * radius, height * tall);
        let ball = |centre, radius: f64| Shape::Ball(centre, height * radius);
        let mut parts: Vec<(Shape, [f64; 3], f64)> = vec![
            (ball(at(0.0, 0.0, 0.925), 0.062), self.skin, 0.05),
            (ball(at(0.0, 0.014, 0.942), 0.063), self.hair, 0.4),
            (can(at(0.0, 0.0, 0.82), 0.028, 0.06), self.skin, 0.05),
            (block(at(0.0, 0.0, 0.68), [0.115, 0.06, 0.15]), self.shirt, 0.6),
            (block(at(0.0, 0.0, 0.515), [0.1, 0.058, 0.02]), [0.12, 0.08, 0.06], 0.1),
            (ball(at(0.0, -0.062, 0.918), 0.012), self.skin.map(|v| 0.9 * v), 0.0),
            (block(at(0.0, -0.057, 0.893), [0.02, 0.004, 0.005]), [0.6, 0.25, 0.22], 0.0),
        ];
        for side in [-1.0, 1.0] {
            parts.extend([
                (ball(at(side * 0.022, -0.054, 0.937), 0.009), [0.05, 0.05, 0.06], 0.0),
                (ball(at(side * 0.12, 0.0, 0.79), 0.042), self.shirt, 0.6),
                (can(at(side * 0.145, 0.0, 0.58), 0.032, 0.21), self.shirt, 0.6),
                (can(at(side * 0.145, 0.0, 0.44), 0.025, 0.14), self.skin, 0.05),
                (ball(at(side * 0.145, -0.005, 0.425), 0.032), self.skin, 0.05),
                (can(at(side * 0.055, 0.0, 0.04), 0.05, 0.46), self.trousers, 0.4),
                (block(at(side * 0.055, -0.025, 0.02), [0.04, 0.075, 0.02]), [0.1, 0.1, 0.1], 0.2),
            ]);
        }
        let grain = 0.03 * height / HEIGHT;
        let solid = |(shape, colour, contrast): (Shape, [f64; 3], f64)| SceneObject {
            label: LABEL,
            phrase: Walker::PHRASE.into(),
            shape,
            paint: paint(colour, contrast, grain, &mut random),
        };
        parts.into_iter().map(solid).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{SceneSpec, build_scene, render};
    use super::*;

    #[test]
    fn walker_is_in_all_photos_but_one() {
        for seed in 1000..1004 {
            for outdoor in [false, true] {
                let spec =
                    SceneSpec { seed, outdoor, walker: true, size: (160, 120), ..SceneSpec::default() };
                let scene = build_scene(&spec).unwrap();
                let walker = Walker::new(&spec, &scene).unwrap();
                assert_eq!(walker, Walker::new(&spec, &scene).unwrap());
                assert_eq!(walker.0.iter().flatten().count(), 3);
                let mut places = Vec::new();
                for (i, figure) in walker.0.iter().enumerate().filter_map(|(i, f)| Some((i, f.as_ref()?))) {
                    let Shape::Ball(head, _) = figure[0].shape else { panic!("the head is a ball") };
                    places.push(head);
                    let with = walker.scene(&scene, i).unwrap();
                    let labels = render::geometry(&with, &scene.train[i]).1;
                    let share = labels.data.iter().filter(|l| **l == LABEL).count() as f64 / 19_200.0;
                    assert!((0.005..0.2).contains(&share), "seed {seed}, photo {i}: {share}");
                }
                assert!(places[0].distance(places[1]) > 0.1 * spec.unit(), "{places:?}");
            }
        }
    }
}
