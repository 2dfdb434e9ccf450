//! Ray casting of a synthetic scene: photo, depth and mask.
use super::phone::PhotoEffects;
use super::scene::SyntheticScene;
use super::shapes::{Hit, SceneObject};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use splatvk::math::Random;
use splatvk::scene::{Camera, Image, Lens, RgbImage};

/// Direction to the light.
const LIGHT: DVec3 = DVec3::new(-0.4, -0.5, 0.77);
/// Brightness of a surface that the light does not reach.
const AMBIENT: f64 = 0.5;
/// Direction to the window whose highlights surfaces show: behind the scene, so that a table
/// reflects it to the cameras.
const WINDOW: DVec3 = DVec3::new(0.25, 0.8, 0.55);
/// Exponent of highlights (Blinn 1977): half as bright 19 degrees off, as on satin paint or a book
/// cover.
const HIGHLIGHT: i32 = 12;
/// Rays along the side of a pixel, so that edges are as soft as through a lens.
const SAMPLES: usize = 2;

/// One view of a scene; depth and mask are those of the pixel centres.
#[derive(Clone, Debug)]
pub struct RayCast {
    /// The photo.
    pub image: RgbImage,
    /// Camera z, metres; 0 for sky or empty space.
    pub depth: Image<f32>,
    /// Label per pixel.
    pub objects: Image<u32>,
}

/// Nearest object on a ray, with the hit.
pub(super) fn first_hit(scene: &SyntheticScene, from: DVec3, ray: DVec3) -> Option<(&SceneObject, Hit)> {
    let hits = scene.objects.iter().filter_map(|t| t.shape.hit(from, ray).map(|h| (t, h)));
    hits.min_by(|a, b| a.1.t.total_cmp(&b.1.t))
}

/// Mean colour over the rays of a pixel, sRGB values; black for rays without object or sky.
fn colour(scene: &SyntheticScene, camera: &Camera, lens: Option<&Lens>, (x, y): (f64, f64)) -> [f64; 3] {
    let to_world = camera.pose.inverse();
    let mut sum = [0.0; 3];
    for k in 0..SAMPLES * SAMPLES {
        let pixel = sample(x, y, k);
        let ray = lens.map_or_else(|| camera.ray(pixel), |l| l.ray(camera, pixel));
        let direction = to_world.rotation * ray;
        let shown = match (first_hit(scene, to_world.translation, direction), &scene.sky) {
            (Some((object, hit)), _) => {
                let light = AMBIENT + (1.0 - AMBIENT) * hit.normal.dot(LIGHT).max(0.0);
                let halfway = (WINDOW.normalize() - direction.normalize()).normalize_or_zero();
                let highlight = scene.gloss * hit.normal.dot(halfway).max(0.0).powi(HIGHLIGHT);
                object.paint.at(hit.place).map(|c| light * c + highlight)
            }
            (None, Some(sky)) => sky.at(direction),
            (None, None) => [0.0; 3],
        };
        (0..3).for_each(|c| sum[c] += shown[c]);
    }
    sum.map(|v| v / (SAMPLES * SAMPLES) as f64)
}

/// Renders the picture alone, through a lens if there is one: the rays are those of the distorted
/// pixels, so that nothing is resampled.
fn picture(scene: &SyntheticScene, camera: &Camera, lens: Option<&Lens>, noise: f64, seed: u64) -> RgbImage {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let noisy_colour = |p: usize| {
        let shown = colour(scene, camera, lens, ((p % width) as f64, (p / width) as f64));
        let mut random = Random::new(seed ^ (p as u64).wrapping_mul(0x2545_f491_4f6c_dd1d));
        let shown = shown.map(|v| v + noise * random.normal());
        shown.map(|v| v.clamp(0.0, 1.0) as f32)
    };
    RgbImage { width, height, data: (0..width * height).into_par_iter().map(noisy_colour).collect() }
}

/// Pixels of a photo that show any of an object, through a lens if there is one.
pub(super) fn shows(scene: &SyntheticScene, camera: &Camera, lens: Option<&Lens>, label: u32) -> Image<bool> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let to_world = camera.pose.inverse();
    let shown = |p: usize| {
        (0..SAMPLES * SAMPLES).any(|k| {
            let pixel = sample((p % width) as f64, (p / width) as f64, k);
            let ray = lens.map_or_else(|| camera.ray(pixel), |l| l.ray(camera, pixel));
            let hit = first_hit(scene, to_world.translation, to_world.rotation * ray);
            hit.is_some_and(|(object, _)| object.label == label)
        })
    };
    Image { width, height, data: (0..width * height).into_par_iter().map(shown).collect() }
}

/// Position of ray `k` of a pixel.
fn sample(x: f64, y: f64, k: usize) -> DVec2 {
    let offset = |i: usize| (i as f64 + 0.5) / SAMPLES as f64;
    DVec2::new(x + offset(k % SAMPLES), y + offset(k / SAMPLES))
}

/// Renders a view without effects of its camera; `noise` is the standard deviation of its noise,
/// share of full white.
pub fn render(scene: &SyntheticScene, camera: &Camera, noise: f64, seed: u64) -> RayCast {
    let (depth, objects) = geometry(scene, camera);
    RayCast { image: picture(scene, camera, None, noise, seed), depth, objects }
}

/// Depth and label per pixel of a view, without its picture.
pub fn geometry(scene: &SyntheticScene, camera: &Camera) -> (Image<f32>, Image<u32>) {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let to_world = camera.pose.inverse();
    let sky_label = scene.sky.as_ref().map_or(0, |sky| sky.label);
    // The camera z of every ray is 1, so that its parameter is the depth.
    let depth_and_label = |p: usize| {
        let pixel = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
        let hit = first_hit(scene, to_world.translation, to_world.rotation * camera.ray(pixel));
        hit.map_or((0.0, sky_label), |(t, h)| (h.t as f32, t.label))
    };
    let pixels: Vec<(f32, u32)> = (0..width * height).into_par_iter().map(depth_and_label).collect();
    let depth = Image { width, height, data: pixels.iter().map(|p| p.0).collect() };
    (depth, Image { width, height, data: pixels.iter().map(|p| p.1).collect() })
}

/// Renders a photo with the effects of its camera; depth and mask are those of the undistorted
/// pinhole.
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

    /// A small scene with the renderings of its photos.
    fn small(seed: u64) -> (SyntheticScene, Vec<RayCast>) {
        let scene = build_scene(&spec(seed)).unwrap();
        let seen = scene.train.iter().map(|c| render(&scene, c, 0.0, 0)).collect();
        (scene, seen)
    }

    #[test]
    fn highlights_move_with_camera() {
        let (matt, _) = small(1000);
        let glossy = SyntheticScene { gloss: 0.4, ..build_scene(&spec(1000)).unwrap() };
        // Position on the table that gloss brightens most, and the difference there.
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
    fn build_scene_spreads_crowded_objects() {
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
    fn views_agree_on_depth_and_label() {
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
                // An exact ray through the projection shows whether the point is occluded.
                let to_world = scene.train[1].pose.inverse();
                let ray = to_world.rotation * scene.train[1].ray(q);
                let (object, hit) = first_hit(&scene, to_world.translation, ray).unwrap();
                if hit.t < z - 1e-4 {
                    continue;
                }
                same += 1;
                agree += usize::from((hit.t - z).abs() < 1e-6);
                label += usize::from(object.label == seen[0].objects.data[p]);
            }
            // Depth is stored as f32, and labels are ambiguous where an object meets the table.
            assert!(same > 9000 && agree as f64 > 0.995 * same as f64, "{same} {agree}");
            assert!(label as f64 > 0.995 * same as f64, "{same} {label}");
        }
    }

    #[test]
    fn objects_are_distinct_and_visible() {
        for seed in 1000..1006 {
            let (scene, seen) = small(seed);
            let mut phrases: Vec<&str> = scene.objects.iter().map(|t| t.phrase.as_str()).collect();
            phrases.sort_unstable();
            let count = phrases.len();
            phrases.dedup();
            assert_eq!((phrases.len(), count), (12, 12), "{phrases:?}");
            for object in &scene.objects {
                let shown = seen.iter().any(|s| s.objects.data.contains(&object.label));
                assert!(shown, "{} is in no photo", object.phrase);
            }
        }
    }

    #[test]
    fn scene_spec_options_take_effect() {
        let base = SceneSpec { seed: 1000, size: (160, 120), ..SceneSpec::default() };
        let quiet = SceneSpec { photo_noise: 0.0, ..base.clone() };
        let bare = SceneSpec { texture: 0.0, ..quiet.clone() };
        assert!(table_roughness(&quiet) > 20.0 * table_roughness(&bare));
        assert!(first_baseline(&SceneSpec { baseline: 40.0, ..base.clone() }) > first_baseline(&base) + 10.0);
        // acos keeps half of the digits near 1.
        assert!(mean_pose_error(&SceneSpec { pose_noise: 0.0, ..base.clone() }) < 1e-5);
        // The mean length of three normal numbers is 1.6 σ; that of four cameras varies by a
        // quarter.
        let two = mean_pose_error(&SceneSpec { pose_noise: 2.0, ..base.clone() });
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

    /// Sum of the luma differences of neighbouring pixels on the table.
    fn table_roughness(spec: &SceneSpec) -> f64 {
        let scene = build_scene(spec).unwrap();
        let seen = render(&scene, &scene.train[0], spec.photo_noise, 1);
        let (luma, objects) = (seen.image.luma(), &seen.objects.data);
        let pairs = (0..luma.data.len() - 1).filter(|&p| objects[p] == 1 && objects[p + 1] == 1);
        pairs.map(|p| (luma.data[p] - luma.data[p + 1]).abs() as f64).sum::<f64>()
    }

    /// Angle between the axes of the first two cameras, degrees.
    fn first_baseline(spec: &SceneSpec) -> f64 {
        let scene = build_scene(spec).unwrap();
        let axis = |c: &Camera| c.pose.rotation.transpose() * DVec3::Z;
        axis(&scene.train[0]).angle_between(axis(&scene.train[1])).to_degrees()
    }

    /// Mean rotation error of the noisy cameras, degrees.
    fn mean_pose_error(spec: &SceneSpec) -> f64 {
        let scene = build_scene(spec).unwrap();
        let error = |(a, b): (&Camera, &Camera)| {
            let r = a.pose.rotation * b.pose.rotation.transpose();
            ((r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees()
        };
        scene.train.iter().zip(&scene.noisy).map(error).sum::<f64>() / scene.train.len() as f64
    }

    #[test]
    fn outdoor_scene_has_sky_and_near_ground() {
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
            // The sky is bluer above than at the horizon.
            assert!(seen.image.at(80, 0)[0] < 0.75, "{:?}", seen.image.at(80, 0));
        }
    }
}
