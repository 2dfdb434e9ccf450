//! Small synthetic scenes with exact ground truth: a table with objects before a wall, or a place
//! outdoors, and the settings that make them hard.
use super::flat::{self, Flat};
use super::outdoor::{self, Sky};
use super::phone::{self, Effects, PhotoEffects};
use super::shapes::{SceneObject, Shape, paint};
use super::spoil::{self, Spoil};
use crate::{Error, Result};
use glam::{DMat3, DVec2, DVec3};
use serde::Serialize;
use splatvk::math::Random;
use splatvk::scene::{Camera, CameraOrbit, Pose};

/// Contents and difficulties of a synthetic scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SceneSpec {
    /// Seed of all random choices.
    pub seed: u64,
    /// Photos, at least 2.
    pub views: usize,
    /// Held-out views.
    pub held_out: usize,
    /// Whether there are also held-out views beside the photos ([`CameraOrbit::beyond`]).
    pub beyond: bool,
    /// Width and height, pixels.
    pub size: (u32, u32),
    /// Objects on the table, 1 to 12.
    pub objects: usize,
    /// Angle between neighbouring photos, degrees: 20 is easy, 40 and more is wide.
    pub baseline: f64,
    /// Contrast of patterns, 1 = plenty to match, 0 = bare surfaces.
    pub texture: f64,
    /// Strength of highlights, share of full white; they move over the surfaces with the camera.
    pub gloss: f64,
    /// Thin poles.
    pub thin: usize,
    /// 0 = objects far apart, 1 = close together and behind each other.
    pub occlusion: f64,
    /// Look-alikes of other objects; their phrases differ by one word.
    pub similar: usize,
    /// Standard deviation of the pose error of the written starting cameras, degrees; the error of
    /// positions moves the picture as much.
    pub pose_noise: f64,
    /// Standard deviation of the photos' noise, share of full white.
    pub photo_noise: f64,
    /// Whether cameras stand at even steps; otherwise each is up to 2 degrees off along the circle
    /// and 4 above or below it.
    pub steady: bool,
    /// Focal length of the last photo over that of the first; between them it grows from photo to
    /// photo.
    pub zoom: f64,
    /// Everything on one plane instead of a table.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flat: Option<Flat>,
    /// Outdoors, ten times as large: the ground begins at the feet, the sky stands behind a house.
    pub outdoor: bool,
    /// Effects of a phone camera on the photos; held-out views have none.
    pub effects: Effects,
    /// Whether a person walks through the scene while the photos are taken.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub walker: bool,
    /// Fault of the photo set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spoil: Option<Spoil>,
}

impl Default for SceneSpec {
    fn default() -> Self {
        SceneSpec {
            seed: 0,
            views: 4,
            held_out: 6,
            beyond: false,
            size: (640, 480),
            objects: 8,
            baseline: 20.0,
            texture: 1.0,
            gloss: 0.0,
            thin: 0,
            occlusion: 0.3,
            similar: 0,
            pose_noise: 0.1,
            photo_noise: 0.005,
            steady: false,
            zoom: 1.0,
            flat: None,
            outdoor: false,
            effects: Effects::default(),
            walker: false,
            spoil: None,
        }
    }
}

/// A synthetic scene with its cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct SyntheticScene {
    /// Background first.
    pub objects: Vec<SceneObject>,
    /// Strength of highlights, share of full white.
    pub gloss: f64,
    /// Sky of outdoor scenes.
    pub sky: Option<Sky>,
    /// True cameras of the photos, without distortion.
    pub train: Vec<Camera>,
    /// Camera effects on each photo.
    pub photo_effects: Vec<PhotoEffects>,
    /// True cameras of the held-out views.
    pub test: Vec<Camera>,
    /// True cameras of the views beside the photos.
    pub out: Vec<Camera>,
    /// Cameras of the photos with pose errors, as a starting point.
    pub noisy: Vec<Camera>,
}

/// Colour words with their sRGB colours.
const COLOURS: [(&str, [f64; 3]); 6] = [
    ("red", [0.75, 0.12, 0.1]),
    ("blue", [0.12, 0.25, 0.7]),
    ("green", [0.15, 0.5, 0.2]),
    ("yellow", [0.85, 0.75, 0.15]),
    ("purple", [0.45, 0.2, 0.5]),
    ("white", [0.85, 0.85, 0.85]),
];
const NOUNS: [&str; 6] = ["ball", "box", "can", "book", "brick", "drum"];

impl SceneSpec {
    /// Approximate distance from the cameras to the middle of the scene, metres.
    pub(super) fn unit(&self) -> f64 {
        if self.outdoor { outdoor::SCALE } else { 1.0 }
    }

    fn check(&self) -> Result<()> {
        let reason = match self {
            k if k.views < 2 => "--views: at least 2",
            k if !(1..=12).contains(&k.objects) => "--objects: 1 to 12",
            k if k.similar > k.objects / 2 => "--similar: at most half of --objects",
            k if k.size.0.min(k.size.1) < 64 || k.size.0.max(k.size.1) > 4096 => {
                "--size: 64 to 4096 pixels a side"
            }
            k if !(1.0..=80.0).contains(&k.baseline) => "--baseline: 1 to 80 degrees",
            k if !(0.25..=4.0).contains(&k.zoom) => "--zoom: 0.25 to 4",
            k if k.walker && (k.flat.is_some() || k.spoil.is_some()) => {
                "--walker: without --flat and --spoil"
            }
            k if k.flat.is_some() && (k.outdoor || k.beyond || k.similar + k.thin > 0) => {
                "--flat holds sheets alone: without --outdoor, --beyond, --similar and --thin"
            }
            k if [k.occlusion, k.texture, k.gloss].iter().any(|v| !(0.0..=1.0).contains(v)) => {
                "--occlusion, --texture and --gloss: 0 to 1"
            }
            k if k.pose_noise < 0.0 || !(0.0..=0.5).contains(&k.photo_noise) => {
                "--pose-noise: 0 or more; --photo-noise: 0 to 0.5"
            }
            _ => return Ok(()),
        };
        Err(Error::input(format!("generate: {reason}")))
    }
}

/// Builds the scene of a specification; an error where an option is out of range or the objects do
/// not fit on the table.
pub fn build_scene(spec: &SceneSpec) -> Result<SyntheticScene> {
    spec.check()?;
    let mut random = Random::new(spec.seed ^ 0x5ce7e);
    let (mut objects, sky) = match (spec.flat, spec.outdoor) {
        (Some(_), _) => (flat::objects(spec.objects, spec.texture, &mut random), None),
        (None, true) => (outdoor::background(spec.texture, &mut random), Some(Sky::new(&mut random))),
        (None, false) => (background(spec, &mut random), None),
    };
    if spec.flat.is_none() {
        place_objects(spec, &mut random, &mut objects)?;
    }
    let middle = (spec.views - 1) as f64 / 2.0;
    let loose = if spec.steady { 0.0 } else { 1.0 };
    let train = (0..spec.views).map(|i| {
        let (azimuth, name) = ((i as f64 - middle) * spec.baseline, format!("train_{i:02}"));
        if let Some(way) = spec.flat {
            return pinhole(spec, &name, flat::pose(way, azimuth, &mut random));
        }
        let azimuth = azimuth + loose * 4.0 * (random.uniform() - 0.5);
        camera(spec, &name, azimuth, 32.0 + loose * 8.0 * (random.uniform() - 0.5))
    });
    let train: Vec<Camera> = train.collect();
    let mut photo_effects = phone::photo_effects(&train, &spec.effects, spec.seed)?;
    for (i, effects) in photo_effects.iter_mut().enumerate() {
        let zoom = spec.zoom.powf(i as f64 / (spec.views - 1) as f64);
        (effects.camera.fx, effects.camera.fy) = (effects.camera.fx * zoom, effects.camera.fy * zoom);
        if spec.spoil == Some(Spoil::Cropped) && i % 2 == 1 {
            spoil::crop(&mut effects.camera, spec.seed.wrapping_add(i as u64));
        }
    }
    let train: Vec<Camera> = photo_effects.iter().map(|s| s.camera.clone()).collect();
    let test = (0..spec.held_out).map(|i| {
        let azimuth = (random.uniform() - 0.5) * (2.0 * middle * spec.baseline + 6.0);
        let name = format!("test_{:02}", spec.views + i);
        let made = match spec.flat {
            Some(way) => pinhole(spec, &name, flat::pose(way, azimuth, &mut random)),
            None => camera(spec, &name, azimuth, 25.0 + 18.0 * random.uniform()),
        };
        // Focal length of the first photo; the principal point is the middle of the picture.
        let (fx, fy) = train.first().map_or((made.fx, made.fy), |c| (c.fx, c.fy));
        Camera { fx, fy, ..made }
    });
    let test: Vec<Camera> = test.collect();
    let out = if spec.beyond { beside(spec, &train) } else { Vec::new() };
    let (sigma, unit) = (spec.pose_noise.to_radians(), spec.unit());
    let noisy = train.iter().map(|c| {
        let mut draw = || DVec3::new(random.normal(), random.normal(), random.normal()) * sigma;
        // The scene is about one unit away, so rotations and translations move the picture equally.
        let error = Pose::exp(unit * draw(), draw());
        Camera { pose: error.compose(&c.pose), ..c.clone() }
    });
    let noisy = noisy.collect();
    Ok(SyntheticScene { objects, gloss: spec.gloss, sky, train, photo_effects, test, out, noisy })
}

/// Views beside the photos, with the frame of held-out views.
fn beside(spec: &SceneSpec, train: &[Camera]) -> Vec<Camera> {
    let views = CameraOrbit::new(train, target(spec), DVec3::Z).beyond().into_iter().enumerate();
    let first = spec.views + spec.held_out;
    let (fx, fy) = train.first().map_or((1.0, 1.0), |c| (c.fx, c.fy));
    views
        .map(|(i, view)| {
            let name = format!("out_{:02}_{}", first + i, view.name);
            Camera { fx, fy, ..pinhole(spec, &name, view.pose) }
        })
        .collect()
}

/// The point that the cameras look at.
fn target(spec: &SceneSpec) -> DVec3 {
    let height = if spec.outdoor { 0.12 } else { 0.04 };
    DVec3::new(0.0, 0.0, height) * spec.unit()
}

/// Table, wall and carpet of an indoor scene, labels 1 to 3.
fn background(spec: &SceneSpec, random: &mut Random) -> Vec<SceneObject> {
    let mut object = |label, phrase: &str, shape, colour, grain| SceneObject {
        label,
        phrase: phrase.into(),
        shape,
        paint: paint(colour, 0.8 * spec.texture, grain, random),
    };
    let top = Shape::Block(DVec3::new(0.0, 0.0, -0.02), DVec3::new(0.62, 0.55, 0.02), 0.0);
    vec![
        object(1, "wooden table", top, [0.5, 0.35, 0.2], 0.05),
        object(2, "plaster wall", Shape::Plane(DVec3::Y, 1.0), [0.6, 0.58, 0.52], 0.12),
        object(3, "grey carpet", Shape::Plane(DVec3::Z, -0.6), [0.42, 0.42, 0.44], 0.12),
    ]
}

/// Largest distance of an object from the middle of the table, in units of the scene.
const TABLE: f64 = 0.5;

/// Adds named objects without overlap; look-alikes and poles come last.
fn place_objects(spec: &SceneSpec, random: &mut Random, objects: &mut Vec<SceneObject>) -> Result<()> {
    let mut names: Vec<(usize, usize)> =
        (0..COLOURS.len()).flat_map(|c| (0..NOUNS.len()).map(move |n| (c, n))).collect();
    random.shuffle(&mut names);
    let kinds = spec.objects - spec.similar;
    let unit = spec.unit();
    // Radius for --occlusion; where no room is left, it grows in steps up to the table.
    let closest = 0.42 - 0.16 * spec.occlusion;
    let reaches =
        || (0..).map(|i| closest + 0.04 * f64::from(i)).take_while(|r| *r <= TABLE).map(|r| r * unit);
    let mut taken: Vec<(DVec2, f64)> = Vec::new();
    for (label, k) in (4..).zip(0..spec.objects + spec.thin) {
        let like = k.checked_sub(kinds).filter(|_| k < spec.objects);
        let (phrase, colour, noun) = if k >= spec.objects {
            (format!("thin pole{}", number(k - spec.objects)), [0.1, 0.1, 0.12], "pole")
        } else {
            let (c, n) = names[like.unwrap_or(k)];
            let n = NOUNS[n];
            let word = if like.is_some() { "dark " } else { "" };
            let dim = if like.is_some() { 0.55 } else { 1.0 };
            (format!("{word}{} {n}", COLOURS[c].0), COLOURS[c].1.map(|v| v * dim), n)
        };
        let (footprint, make) = solid(noun, unit, random);
        let gap = (0.05 * (1.0 - spec.occlusion) + 0.01) * unit;
        let position = reaches().flat_map(|reach| std::iter::repeat_n(reach, 2000)).find_map(|reach| {
            let p = DVec2::new(random.uniform() - 0.5, random.uniform() - 0.5)
                * 2.0
                * DVec2::new(reach, 0.85 * reach);
            taken.iter().all(|(q, r)| p.distance(*q) > footprint + r + gap).then_some(p)
        });
        let Some(position) = position else {
            return Err(Error::input(
                "generate: no room for so many objects; lower --objects or --occlusion",
            ));
        };
        taken.push((position, footprint));
        let contrast = if noun == "pole" { 0.2 } else { 0.7 } * spec.texture;
        objects.push(SceneObject {
            label,
            phrase,
            shape: make(position),
            paint: paint(colour, contrast, 0.03 * unit, random),
        });
    }
    Ok(())
}

/// Suffix of the phrase of pole `k`, counted from 0: none for the first one.
fn number(k: usize) -> String {
    if k == 0 { String::new() } else { format!(" {}", k + 1) }
}

/// A solid of random size: its radius on the table, and a function from its position to the solid.
fn solid(noun: &str, unit: f64, random: &mut Random) -> (f64, Box<dyn Fn(DVec2) -> Shape>) {
    let size = (0.85 + 0.3 * random.uniform()) * unit;
    let turn = random.uniform() * std::f64::consts::PI;
    let block = |x: f64, y: f64, z: f64| -> (f64, Box<dyn Fn(DVec2) -> Shape>) {
        let half = DVec3::new(x, y, z) * size;
        (half.truncate().length(), Box::new(move |p| Shape::Block(p.extend(half.z), half, turn)))
    };
    match noun {
        "ball" => {
            let r = 0.055 * size;
            (r, Box::new(move |p| Shape::Ball(p.extend(r), r)))
        }
        "box" => block(0.055, 0.045, 0.08),
        "book" => block(0.08, 0.06, 0.015),
        "brick" => block(0.07, 0.035, 0.03),
        "can" => (0.035 * size, Box::new(move |p| Shape::Can(p.extend(0.0), 0.035 * size, 0.12 * size))),
        "drum" => (0.065 * size, Box::new(move |p| Shape::Can(p.extend(0.0), 0.065 * size, 0.06 * size))),
        // A pole of 8 mm is 4 pixels wide at the default picture size.
        _ => (0.02 * unit, Box::new(move |p| Shape::Can(p.extend(0.0), 0.004 * unit, 0.24 * unit))),
    }
}

/// A camera on a sphere around the middle of the scene, which it looks at; angles in degrees.
/// `elevation` is that of a table scene; outdoors it is scaled to [`outdoor::ELEVATION`].
fn camera(spec: &SceneSpec, name: &str, azimuth: f64, elevation: f64) -> Camera {
    let elevation = if spec.outdoor { outdoor::ELEVATION * elevation / 32.0 } else { elevation };
    let (a, e, target) = (azimuth.to_radians(), elevation.to_radians(), target(spec));
    let centre = target + 0.95 * spec.unit() * DVec3::new(a.sin() * e.cos(), -a.cos() * e.cos(), e.sin());
    let z = (target - centre).normalize();
    let x = z.cross(DVec3::Z).normalize();
    let y = z.cross(x);
    let rotation = DMat3::from_cols(x, y, z).transpose();
    pinhole(spec, name, Pose { rotation, translation: -(rotation * centre) })
}

/// The default pinhole at a pose: focal length 1.025 widths.
fn pinhole(spec: &SceneSpec, name: &str, pose: Pose) -> Camera {
    let (width, height) = spec.size;
    let f = 1.025 * f64::from(width);
    Camera {
        name: name.into(),
        width,
        height,
        fx: f,
        fy: f,
        cx: f64::from(width) / 2.0,
        cy: f64::from(height) / 2.0,
        pose,
    }
}
