//! Ray casting: photo, depth and mask of a synthetic scene.
use super::phone::PhotoEffects;
use super::scene::SyntheticScene;
use super::shapes::{Hit, SceneObject};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use splatvk::math::Random;
use splatvk::scene::{Camera, Image, Lens, RgbImage};

/// Towards the light.
const LIGHT: DVec3 = DVec3::new(-0.4, -0.5, 0.77);
/// Brightness of a surface that the light does not reach.
const AMBIENT: f64 = 0.5;
/// Direction to the window that shines on surfaces: behind the scene, so that a table shows it to
/// the cameras.
const WINDOW: DVec3 = DVec3::new(0.25, 0.8, 0.55);
/// Exponent of highlights (Blinn 1977): half as bright 19 degrees off, as on satin paint or a
/// book's cover.
const HIGHLIGHT: i32 = 12;
/// Rays per pixel side: edges of the photo are as soft as a lens makes them.
const SAMPLES: usize = 2;

/// One view of a scene; depth and mask are those of the pixel centres.
#[derive(Clone, Debug)]
pub struct RayCast {
    /// The photo.
    pub image: RgbImage,
    /// Camera z, metres; 0 where nothing is, or sky.
    pub depth: Image<f32>,
    /// Label per pixel.
    pub objects: Image<u32>,
}

fn first(scene: &SyntheticScene, from: DVec3, ray: DVec3) -> Option<(&SceneObject, Hit)> {
    let hits = scene.objects.iter().filter_map(|t| t.shape.hit(from, ray).map(|h| (t, h)));
    hits.min_by(|a, b| a.1.t.total_cmp(&b.1.t))
}

/// Mean colour over the rays of a pixel, sRGB values; black where nothing is and no sky either.
fn colour(scene: &SyntheticScene, camera: &Camera, lens: Option<&Lens>, (x, y): (f64, f64)) -> [f64; 3] {
    let to_world = camera.pose.inverse();
    let mut sum = [0.0; 3];
    for k in 0..SAMPLES * SAMPLES {
        let at = |i: usize| (i as f64 + 0.5) / SAMPLES as f64;
        let pixel = DVec2::new(x + at(k % SAMPLES), y + at(k / SAMPLES));
        let ray = lens.map_or_else(|| camera.ray(pixel), |l| l.ray(camera, pixel));
        let direction = to_world.rotation * ray;
        let shown = match (first(scene, to_world.translation, direction), &scene.sky) {
            (Some((object, hit)), _) => {
                let light = AMBIENT + (1.0 - AMBIENT) * hit.normal.dot(LIGHT).max(0.0);
                let between = (WINDOW.normalize() - direction.normalize()).normalize_or_zero();
                let highlight = scene.gloss * hit.normal.dot(between).max(0.0).powi(HIGHLIGHT);
                object.paint.at(hit.place).map(|c| light * c + highlight)
            }
            (None, Some(sky)) => sky.at(direction),
            (None, None) => [0.0; 3],
        };
        (0..3).for_each(|c| sum[c] += shown[c]);
    }
    sum.map(|v| v / (SAMPLES * SAMPLES) as f64)
}

/// The picture alone, with a lens if there is one: each ray goes where the lens sends it, so
/// nothing is resampled.
fn picture(scene: &SyntheticScene, camera: &Camera, lens: Option<&Lens>, noise: f64, seed: u64) -> RgbImage {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let pixel = |p: usize| {
        let shown = colour(scene, camera, lens, ((p % width) as f64, (p / width) as f64));
        let mut random = Random::new(seed ^ (p as u64).wrapping_mul(0x2545_f491_4f6c_dd1d));
        let shown = shown.map(|v| v + noise * random.normal());
        shown.map(|v| v.clamp(0.0, 1.0) as f32)
    };
    RgbImage { width, height, data: (0..width * height).into_par_iter().map(pixel).collect() }
}

/// Renders a view; `noise` is the standard deviation of the photo's noise.
pub fn render(scene: &SyntheticScene, camera: &Camera, noise: f64, seed: u64) -> RayCast {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let to_world = camera.pose.inverse();
    let beyond = scene.sky.as_ref().map_or(0, |sky| sky.label);
    // The ray has camera z 1: its parameter is the depth.
    let cast = |p: usize| {
        let pixel = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
        let hit = first(scene, to_world.translation, to_world.rotation * camera.ray(pixel));
        hit.map_or((0.0, beyond), |(t, h)| (h.t as f32, t.label))
    };
    let pixels: Vec<(f32, u32)> = (0..width * height).into_par_iter().map(cast).collect();
    RayCast {
        image: picture(scene, camera, None, noise, seed),
        depth: Image { width, height, data: pixels.iter().map(|p| p.0).collect() },
        objects: Image { width, height, data: pixels.iter().map(|p| p.1).collect() },
    }
}

/// A view as its phone takes it; depth and mask are those of the undistorted pinhole.
pub fn photo(scene: &SyntheticScene, effects: &PhotoEffects, noise: f64, seed: u64) -> RayCast {
    let mut seen = render(scene, &effects.camera, noise, seed);
    if let Some(lens) = &effects.lens {
        seen.image = picture(scene, &effects.camera, Some(lens), noise, seed);
    }
    effects.expose(&mut seen.image);
    seen
}

#[cfg(test)]
mod tests {
    use super::super::scene::{SceneSpec, build_scene};
    use super::*;

    fn spec(seed: u64) -> SceneSpec {
        SceneSpec { seed, size: (160, 120), thin: 1, similar: 1, held_out: 2, ..SceneSpec::default() }
    }

    fn small(seed: u64) -> (SyntheticScene, Vec<RayCast>) {
        let scene = build_scene(&spec(seed)).unwrap();
        let seen = scene.train.iter().map(|c| render(&scene, c, 0.0, 0)).collect();
        (scene, seen)
    }

    #[test]
    fn highlights_move_over_a_surface_with_the_camera() {
        let (matt, _) = small(1000);
        let glossy = SyntheticScene { gloss: 0.4, ..build_scene(&spec(1000)).unwrap() };
        // The place on the table that gloss brightens most, and by how much.
        let peak = |camera: &Camera| {
            let (without, with) = (render(&matt, camera, 0.0, 0), render(&glossy, camera, 0.0, 0));
            let added = |p: usize| f64::from(with.image.data[p][2] - without.image.data[p][2]);
            let table = (0..160 * 120).filter(|p| with.objects.data[*p] == 1);
            let p = table.max_by(|a, b| added(*a).total_cmp(&added(*b))).unwrap();
            let pixel = DVec2::new((p % 160) as f64 + 0.5, (p / 160) as f64 + 0.5);
            (camera.unproject(pixel, f64::from(with.depth.data[p])), added(p))
        };
        let (first, last) = (peak(&matt.train[0]), peak(&matt.train[3]));
        assert!([first.1, last.1].iter().all(|a| (0.2..=0.41).contains(a)), "{first:?} {last:?}");
        assert!(first.0.distance(last.0) > 0.1, "{first:?} {last:?}");
    }

    #[test]
    fn objects_that_have_no_room_move_apart() {
        for seed in 21..41 {
            let spec = SceneSpec { objects: 12, similar: 6, occlusion: 0.9, ..spec(seed) };
            assert_eq!(build_scene(&spec).unwrap().objects.len(), 3 + 12 + 1);
        }
        assert!(
            build_scene(&SceneSpec { thin: 500, ..spec(1) }).is_err(),
            "more poles than the table has room for"
        );
    }

    #[test]
    fn views_agree_on_depth_and_label_where_they_see_the_same_place() {
        for seed in 1000..1003 {
            let (scene, seen) = small(seed);
            let (mut same, mut agree, mut label) = (0, 0, 0);
            for p in 0..160 * 120 {
                let pixel = DVec2::new((p % 160) as f64 + 0.5, (p / 160) as f64 + 0.5);
                let x = scene.train[0].unproject(pixel, f64::from(seen[0].depth.data[p]));
                let (q, z) = scene.train[1].project(x);
                if z <= 0.0 || q.x < 0.0 || q.y < 0.0 || q.x >= 160.0 || q.y >= 120.0 {
                    continue;
                }
                // an exact ray at the exact position tells whether the other camera sees that place
                let to_world = scene.train[1].pose.inverse();
                let ray = to_world.rotation * scene.train[1].ray(q);
                let (object, hit) = first(&scene, to_world.translation, ray).unwrap();
                if hit.t < z - 1e-4 {
                    continue;
                }
                same += 1;
                agree += usize::from((hit.t - z).abs() < 1e-6);
                label += usize::from(object.label == seen[0].objects.data[p]);
            }
            // depth is stored as f32, and two objects meet where an object stands on the table
            assert!(same > 9000 && agree as f64 > 0.995 * same as f64, "{same} {agree}");
            assert!(label as f64 > 0.995 * same as f64, "{same} {label}");
        }
    }

    #[test]
    fn every_thing_has_its_own_phrase_and_shows_somewhere() {
        for seed in 1000..1006 {
            let (scene, seen) = small(seed);
            let mut phrases: Vec<&str> = scene.objects.iter().map(|t| t.phrase.as_str()).collect();
            phrases.sort_unstable();
            let count = phrases.len();
            phrases.dedup();
            assert_eq!((phrases.len(), count), (12, 12), "{phrases:?}");
            for object in &scene.objects {
                let shown = seen.iter().any(|s| s.objects.data.contains(&object.label));
                assert!(shown, "{} is nowhere", object.phrase);
            }
        }
    }

    #[test]
    fn knobs_do_what_they_say() {
        let base = SceneSpec { seed: 1000, size: (160, 120), ..SceneSpec::default() };
        let of = |spec: &SceneSpec| {
            let scene = build_scene(spec).unwrap();
            let seen = render(&scene, &scene.train[0], spec.photo_noise, 1);
            (scene, seen)
        };
        // bare surfaces: neighbouring pixels of the table are alike
        let rough = |s: &RayCast| {
            let l = s.image.luma();
            let pairs =
                (0..l.data.len() - 1).filter(|&p| s.objects.data[p] == 1 && s.objects.data[p + 1] == 1);
            pairs.map(|p| (l.data[p] - l.data[p + 1]).abs() as f64).sum::<f64>()
        };
        let quiet = SceneSpec { photo_noise: 0.0, ..base.clone() };
        let bare = SceneSpec { texture: 0.0, ..quiet.clone() };
        assert!(rough(&of(&quiet).1) > 20.0 * rough(&of(&bare).1));
        // wide baselines
        let angle = |k: &SceneSpec| {
            let w = build_scene(k).unwrap();
            let axis = |c: &Camera| c.pose.rotation.transpose() * DVec3::Z;
            axis(&w.train[0]).angle_between(axis(&w.train[1])).to_degrees()
        };
        assert!(angle(&SceneSpec { baseline: 40.0, ..base.clone() }) > angle(&base) + 10.0);
        // poses err by what was asked
        let error = |k: &SceneSpec| {
            let w = build_scene(k).unwrap();
            let off = |(a, b): (&Camera, &Camera)| {
                let r = a.pose.rotation * b.pose.rotation.transpose();
                ((r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees()
            };
            w.train.iter().zip(&w.noisy).map(off).sum::<f64>() / w.train.len() as f64
        };
        // acos near 1 keeps half of the digits
        assert!(error(&SceneSpec { pose_noise: 0.0, ..base.clone() }) < 1e-5);
        // the mean length of three normal numbers is 1.6 σ; four cameras scatter by a quarter of
        // that
        let two = error(&SceneSpec { pose_noise: 2.0, ..base.clone() });
        assert!((1.5..5.5).contains(&two), "{two}");
        for bad in [
            SceneSpec { views: 1, ..base.clone() },
            SceneSpec { objects: 13, ..base.clone() },
            SceneSpec { similar: 5, ..base.clone() },
            SceneSpec { texture: 2.0, ..base.clone() },
        ] {
            assert_eq!(build_scene(&bad).unwrap_err().exit_code(), 2);
        }
    }

    #[test]
    fn out_of_doors_the_sky_has_no_depth_and_the_ground_begins_at_the_feet() {
        let spec =
            SceneSpec { seed: 1001, size: (160, 120), outdoor: true, held_out: 1, ..SceneSpec::default() };
        let scene = build_scene(&spec).unwrap();
        let sky = scene.sky.unwrap();
        for camera in scene.train.iter().chain(&scene.test) {
            let seen = render(&scene, camera, 0.0, 0);
            let share = |label: u32| {
                seen.objects.data.iter().filter(|o| **o == label).count() as f64 / (160.0 * 120.0)
            };
            assert!(share(sky.label) > 0.1 && share(1) > 0.2 && share(0) == 0.0, "{} {}", share(3), share(1));
            for (depth, object) in seen.depth.data.iter().zip(&seen.objects.data) {
                assert_eq!(*depth == 0.0, *object == sky.label);
            }
            let nearest = seen.depth.data.iter().filter(|z| **z > 0.0).fold(f32::INFINITY, |m, z| m.min(*z));
            assert!(nearest > 1.0 && nearest < 6.0, "{nearest} m");
            // Bluer above than at the horizon.
            assert!(seen.image.at(80, 0)[0] < 0.75, "{:?}", seen.image.at(80, 0));
        }
    }
}
