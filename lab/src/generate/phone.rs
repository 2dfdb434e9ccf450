//! Effects of a phone camera: lens, light, sensor noise. The distributions are stated in
//! docs/internals/data.md.
use crate::{Error, Result};
use glam::DVec2;
use rayon::prelude::*;
use serde::Serialize;
use splatvk::math::Random;
use splatvk::scene::{Camera, Lens, RgbImage};

/// Focal length over width: from an ultra-wide crop (71° across) to a 28 mm equivalent cropped to
/// 4:3 (45°).
const FOCAL: (f64, f64) = (0.7, 1.2);
/// Largest |k1|: three times that of the phone of the set `breakfast-phone`, so that both signs are
/// well covered.
const K1: f64 = 0.15;
/// Largest |k2 / k1|: as the lens of `breakfast-phone`, whose terms are 0.06 and −0.02.
const K2_SHARE: f64 = 1.0 / 3.0;
/// Smallest derivative of the distorted radius by the undistorted one in the picture. A smaller one
/// squeezes the corners below a quarter, unlike the lens of any phone.
const MIN_SLOPE: f64 = 0.25;
/// Largest offset of the principal point along x and along y, share of the width.
const CENTRE: f64 = 0.01;
/// Largest change of exposure of a photo, stops.
const EXPOSURE: f64 = 0.35;
/// Largest relative change of one channel by white balance.
const WHITE_BALANCE: f64 = 0.06;
/// Largest share of light lost in the corners.
const VIGNETTING: f64 = 0.35;
/// Electrons per pixel and channel at full white: a small phone sensor near ISO 200.
const FULL_WELL: f64 = 3000.0;
/// Read noise, electrons.
const READ_NOISE: f64 = 4.0;

/// Camera effects that the photos of a scene have; their parameters are drawn from its seed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Effects {
    /// Focal length drawn instead of 1.025 widths.
    pub focal: bool,
    /// Radial distortion.
    pub lens: bool,
    /// Principal point off the middle.
    pub centre: bool,
    /// Exposure and white balance per photo, vignetting.
    pub light: bool,
    /// Shot and read noise.
    pub sensor_noise: bool,
    /// JPEG quality of the photos, instead of 95.
    pub jpeg: Option<u8>,
    /// Every other photo by a second camera, with intrinsics and vignetting of its own.
    pub two_cameras: bool,
}

impl Effects {
    /// All effects of a phone camera.
    pub const PHONE: Effects = Effects {
        focal: true,
        lens: true,
        centre: true,
        light: true,
        sensor_noise: true,
        jpeg: Some(82),
        two_cameras: false,
    };

    /// Whether any effect is on.
    pub fn any(&self) -> bool {
        *self != Effects::default()
    }
}

/// Whether the slope of the distortion stays above [`MIN_SLOPE`] out to every corner, so that each
/// pixel has one ray.
fn is_invertible(lens: &Lens, camera: &Camera) -> bool {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)];
    let reach = corners.map(|(x, y)| camera.ray(DVec2::new(x, y)).truncate().length());
    let reach = reach.into_iter().fold(0.0, f64::max);
    // Walk outwards until the distorted radius covers the farthest corner.
    let mut x = DVec2::ZERO;
    while lens.distort(x).x < reach {
        if lens.jacobian(x).x_axis.x < MIN_SLOPE {
            return false;
        }
        x.x += 0.01 * reach;
    }
    true
}

/// True photometric parameters of one photo.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrueLight {
    /// Exposure in stops: linear values are multiplied by 2 to this power.
    pub exposure_ev: f64,
    /// Gain of R, G and B on top of the exposure.
    pub white_balance: [f64; 3],
    /// v2, v4 of the fall-off `1 + v2 ρ² + v4 ρ⁴`; ρ is the distance from the principal point over
    /// half the diagonal.
    pub vignetting: [f64; 2],
}

impl TrueLight {
    /// Gain of the linear value per channel at a pixel position.
    pub fn gain(&self, camera: &Camera, pixel: DVec2) -> [f64; 3] {
        let half = DVec2::new(f64::from(camera.width), f64::from(camera.height)).length() / 2.0;
        let s = (pixel - DVec2::new(camera.cx, camera.cy)).length_squared() / (half * half);
        let fall_off = 1.0 + s * (self.vignetting[0] + self.vignetting[1] * s);
        self.white_balance.map(|g| g * self.exposure_ev.exp2() * fall_off)
    }
}

/// Effects on one photo. Their order is lens, light, noise, 8 bits and JPEG.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotoEffects {
    /// The undistorted pinhole.
    pub camera: Camera,
    /// Distortion.
    pub lens: Option<Lens>,
    /// Exposure, white balance and vignetting.
    pub light: Option<TrueLight>,
    /// Seed of the sensor noise.
    pub noise: Option<u64>,
}

/// Intrinsics and vignetting that the photos of one camera share.
struct Intrinsics {
    /// Focal length, share of the width.
    focal: f64,
    /// Offset of the principal point from the middle, shares of the width.
    offset: DVec2,
    lens: Option<Lens>,
    /// v2, v4 of [`TrueLight::vignetting`].
    vignetting: [f64; 2],
}

/// Draws the intrinsics of a camera; `example` is one of the pinholes that it replaces.
fn draw_intrinsics(example: &Camera, effects: &Effects, seed: u64) -> Result<Intrinsics> {
    let (mut geometric, mut light) = (Random::new(seed ^ 0x1e45), Random::new(seed ^ 0x71e));
    let focal = between(&mut geometric, FOCAL.0, FOCAL.1);
    let offset =
        DVec2::new(between(&mut geometric, -CENTRE, CENTRE), between(&mut geometric, -CENTRE, CENTRE));
    let mut lens = None;
    if effects.lens {
        let camera = with_intrinsics(example, focal, offset, effects);
        let drawn = (0..1000).find_map(|_| {
            let k1 = between(&mut geometric, -K1, K1);
            let lens = Lens::radial(k1, k1 * between(&mut geometric, -K2_SHARE, K2_SHARE));
            is_invertible(&lens, &camera).then_some(lens)
        });
        lens = Some(drawn.ok_or_else(|| Error::work("generate: no lens covers the picture"))?);
    }
    // Share of light lost in the corners, and share of the fall-off that goes with ρ⁴, not ρ².
    let (lost, late) = (between(&mut light, 0.0, VIGNETTING), light.uniform());
    Ok(Intrinsics { focal, offset, lens, vignetting: [-lost * (1.0 - late), -lost * late] })
}

/// Draws uniformly from [a, b].
fn between(random: &mut Random, a: f64, b: f64) -> f64 {
    a + (b - a) * random.uniform()
}

/// Draws the effects on the photos of one scene. Switching an effect off leaves the parameters of
/// the others unchanged.
pub fn photo_effects(cameras: &[Camera], effects: &Effects, seed: u64) -> Result<Vec<PhotoEffects>> {
    let Some(first) = cameras.first() else { return Ok(Vec::new()) };
    let stream = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mut intrinsics = vec![draw_intrinsics(first, effects, stream)?];
    if effects.two_cameras {
        intrinsics.push(draw_intrinsics(first, effects, stream ^ 0x2cab_0000)?);
    }
    let mut light = Random::new(stream ^ 0x116f7);
    let photo_effects = cameras.iter().enumerate().map(|(i, camera)| {
        let own = &intrinsics[i % intrinsics.len()];
        let drawn = TrueLight {
            exposure_ev: between(&mut light, -EXPOSURE, EXPOSURE),
            white_balance: [(); 3].map(|()| 1.0 + between(&mut light, -WHITE_BALANCE, WHITE_BALANCE)),
            vignetting: own.vignetting,
        };
        PhotoEffects {
            camera: with_intrinsics(camera, own.focal, own.offset, effects),
            lens: own.lens,
            light: effects.light.then_some(drawn),
            noise: effects.sensor_noise.then_some(seed.wrapping_mul(0x100_0000_01b3) ^ (i as u64) << 48),
        }
    });
    Ok(photo_effects.collect())
}

/// Returns the camera with the drawn focal length and principal point, where these effects are on.
fn with_intrinsics(camera: &Camera, focal: f64, offset: DVec2, effects: &Effects) -> Camera {
    let (mut camera, width) = (camera.clone(), f64::from(camera.width));
    if effects.focal {
        camera.fx = focal * width;
        camera.fy = focal * width;
    }
    if effects.centre {
        camera.cx += offset.x * width;
        camera.cy += offset.y * width;
    }
    camera
}

impl PhotoEffects {
    /// Applies light and noise to a rendered picture (sRGB values).
    pub fn expose(&self, image: &mut RgbImage) {
        if self.light.is_none() && self.noise.is_none() {
            return;
        }
        let width = image.width;
        image.data.par_iter_mut().enumerate().for_each(|(p, colour)| {
            let at = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
            let gain = self.light.map_or([1.0; 3], |l| l.gain(&self.camera, at));
            let mut random =
                self.noise.map(|seed| Random::new(seed ^ (p as u64).wrapping_mul(0x2545_f491_4f6c_dd1d)));
            for (value, gain) in colour.iter_mut().zip(gain) {
                let mut linear = to_linear(f64::from(*value)) * gain;
                if let Some(random) = &mut random {
                    let electrons = linear * FULL_WELL;
                    let sigma = (electrons + READ_NOISE * READ_NOISE).sqrt();
                    linear = (electrons + sigma * random.normal()) / FULL_WELL;
                }
                *value = to_srgb(linear.clamp(0.0, 1.0)) as f32;
            }
        });
    }
}

/// sRGB value in [0, 1] → linear light (IEC 61966-2-1).
pub fn to_linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Linear light → sRGB value.
pub fn to_srgb(v: f64) -> f64 {
    if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::super::render::photo;
    use super::super::scene::{SceneSpec, SyntheticScene, build_scene};
    use super::super::shapes::{Paint, SceneObject, Shape};
    use super::*;
    use glam::DVec3;

    fn spec(seed: u64, effects: Effects) -> SceneSpec {
        SceneSpec { seed, size: (320, 240), photo_noise: 0.0, effects, ..SceneSpec::default() }
    }

    /// Small white discs on a black background, with the centre and rim of each. They lie flat, so
    /// that each has one brightness; higher rows of the picture would show them from the side.
    fn markers(camera: &Camera, lens: &Lens) -> (SyntheticScene, Vec<(DVec3, Vec<DVec3>)>) {
        let to_world = camera.pose.inverse();
        let (mut objects, mut places) = (Vec::new(), Vec::new());
        for (i, j) in (2..6).flat_map(|j| (0..8).map(move |i| (i, j))) {
            let pixel = DVec2::new(20.0 + 40.0 * f64::from(i), 20.0 + 40.0 * f64::from(j));
            let at = to_world.transform(lens.ray(camera, pixel));
            let radius = 10.0 / camera.fx;
            let paint = Paint { colour: [1.0; 3], contrast: 0.0, grain: 1.0, seed: 0, tile: None };
            objects.push(SceneObject {
                label: 1,
                phrase: "disc".into(),
                shape: Shape::Can(at, radius, 1e-6),
                paint,
            });
            let rim = (0..256).map(|k| DVec2::from_angle(std::f64::consts::TAU * f64::from(k) / 256.0));
            places.push((at, rim.map(|d| at + (radius * d).extend(0.0)).collect()));
        }
        (
            SyntheticScene {
                gloss: 0.0,
                objects,
                sky: None,
                train: vec![],
                photo_effects: vec![],
                test: vec![],
                out: vec![],
                noisy: vec![],
            },
            places,
        )
    }

    /// Centroid of a polygon.
    fn centroid(corners: &[DVec2]) -> DVec2 {
        let (mut sum, mut area) = (DVec2::ZERO, 0.0);
        for (k, a) in corners.iter().enumerate() {
            let b = corners[(k + 1) % corners.len()];
            let cross = a.perp_dot(b);
            sum += (*a + b) * cross / 3.0;
            area += cross;
        }
        sum / area
    }

    #[test]
    fn photo_shows_markers_at_projection() {
        let mut largest_shift: f64 = 0.0;
        for seed in 1000..1008 {
            let effects = Effects { focal: true, lens: true, centre: true, ..Effects::default() };
            let photo_effects = build_scene(&spec(seed, effects)).unwrap().photo_effects[1].clone();
            let (lens, camera) = (photo_effects.lens.unwrap(), &photo_effects.camera);
            let (discs, places) = markers(camera, &lens);
            let image = photo(&discs, &photo_effects, 0.0, 0).image;
            for (centre, rim) in places {
                let rim: Vec<DVec2> = rim.into_iter().map(|p| lens.project(camera, p)).collect();
                let stated = centroid(&rim);
                let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
                for y in stated.y as usize - 15..(stated.y as usize + 15).min(240) {
                    for x in stated.x as usize - 15..(stated.x as usize + 15).min(320) {
                        let v = f64::from(image.at(x, y)[1]);
                        sum += v * DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                        weight += v;
                    }
                }
                let error = (sum / weight - stated).length();
                assert!(weight > 20.0 && error < 0.1, "seed {seed}, {stated}: {error} px");
                largest_shift = largest_shift.max((camera.project(centre).0 - stated).length());
            }
        }
        // The test is sensitive to the lens: the pinhole's projections lie many pixels away.
        assert!(largest_shift > 5.0, "{largest_shift}");
    }

    #[test]
    fn drawn_lenses_are_invertible() {
        let cameras = build_scene(&spec(1000, Effects::default())).unwrap().train;
        let (mut barrel, mut pincushion) = (0, 0);
        for seed in 1000..1200 {
            let photo_effects = &photo_effects(&cameras, &Effects::PHONE, seed).unwrap()[0];
            let (lens, camera) = (photo_effects.lens.unwrap(), &photo_effects.camera);
            assert!(lens.k1.abs() <= K1 && lens.k2.abs() <= lens.k1.abs() * K2_SHARE);
            assert!((FOCAL.0..FOCAL.1).contains(&(camera.fx / 320.0)));
            assert!((camera.cx - 160.0).abs() <= 3.2 && (camera.cy - 120.0).abs() <= 3.2);
            for pixel in
                [DVec2::ZERO, DVec2::new(320.0, 0.0), DVec2::new(0.0, 240.0), DVec2::new(320.0, 240.0)]
            {
                let d = camera.ray(pixel).truncate();
                assert!((lens.distort(lens.undistort(d)) - d).length() < 1e-12, "seed {seed}");
            }
            if lens.k1 < 0.0 {
                barrel += 1
            } else {
                pincushion += 1
            };
        }
        assert!(barrel > 70 && pincushion > 70, "{barrel} {pincushion}");
    }

    #[test]
    fn photo_means_follow_stated_gains() {
        let dark = spec(1000, Effects::default());
        let plain = build_scene(&dark).unwrap();
        let before: Vec<RgbImage> =
            plain.photo_effects.iter().map(|s| photo(&plain, s, 0.0, 0).image).collect();
        let effects = Effects { light: true, sensor_noise: true, ..Effects::default() };
        let lit = build_scene(&SceneSpec { effects, ..dark }).unwrap();
        let mut first = Vec::new();
        for (photo_effects, before) in lit.photo_effects.iter().zip(&before) {
            let image = photo(&lit, photo_effects, 0.0, 0).image;
            let light = photo_effects.light.unwrap();
            // A block in the middle, and one in a corner with strong fall-off.
            for (x0, y0) in [(140, 100), (0, 0)] {
                let (mut sum, mut stated) = ([0.0; 3], [0.0; 3]);
                for p in (y0..y0 + 40).flat_map(|y| (x0..x0 + 40).map(move |x| y * 320 + x)) {
                    let at = DVec2::new((p % 320) as f64 + 0.5, (p / 320) as f64 + 0.5);
                    let gain = light.gain(&photo_effects.camera, at);
                    for c in 0..3 {
                        sum[c] += to_linear(f64::from(image.data[p][c]));
                        stated[c] += (to_linear(f64::from(before.data[p][c])) * gain[c]).min(1.0);
                    }
                }
                // The mean of 1600 pixels with at most 10 % noise each has 0.25 % noise.
                assert!((0..3).all(|c| (sum[c] / stated[c] - 1.0).abs() < 0.01), "{sum:?} {stated:?}");
            }
            first.push(light.exposure_ev);
        }
        // The exposure of the first photo is drawn like all others, and all differ.
        assert!(first.iter().all(|e| e.abs() > 1e-3 && e.abs() <= EXPOSURE), "{first:?}");
        assert!(first.windows(2).all(|w| (w[0] - w[1]).abs() > 1e-3));
    }

    #[test]
    fn sensor_noise_has_stated_sigma() {
        let camera = build_scene(&spec(1000, Effects::default())).unwrap().train[0].clone();
        let photo_effects = PhotoEffects { camera, lens: None, light: None, noise: Some(5) };
        let grey = to_srgb(0.18) as f32;
        let mut image = RgbImage { width: 320, height: 240, data: vec![[grey; 3]; 320 * 240] };
        photo_effects.expose(&mut image);
        let linear: Vec<f64> = image.data.iter().flatten().map(|v| to_linear(f64::from(*v))).collect();
        let mean = linear.iter().sum::<f64>() / linear.len() as f64;
        let sigma = (linear.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / linear.len() as f64).sqrt();
        let stated = (0.18 * FULL_WELL + READ_NOISE * READ_NOISE).sqrt() / FULL_WELL;
        assert!((mean / 0.18 - 1.0).abs() < 1e-3 && (sigma / stated - 1.0).abs() < 0.02, "{mean} {sigma}");
    }

    #[test]
    fn effects_are_drawn_independently() {
        let plain = build_scene(&spec(1000, Effects::default())).unwrap();
        let phone = build_scene(&spec(1000, Effects::PHONE)).unwrap();
        assert!(
            plain.photo_effects.iter().all(|s| s.lens.is_none() && s.light.is_none() && s.noise.is_none())
        );
        assert_eq!(plain.objects, phone.objects);
        for (a, b) in plain.train.iter().zip(&phone.train) {
            assert_eq!(a.pose, b.pose);
        }
        let lens =
            build_scene(&spec(1000, Effects { lens: true, focal: true, ..Effects::default() })).unwrap();
        assert_eq!(lens.photo_effects[0].camera.fx, phone.photo_effects[0].camera.fx);
        let light = build_scene(&spec(1000, Effects { light: true, ..Effects::default() })).unwrap();
        assert_eq!(light.photo_effects[2].light, phone.photo_effects[2].light);
        let two = build_scene(&spec(1000, Effects { two_cameras: true, ..Effects::PHONE })).unwrap();
        let (first, second) = (&two.photo_effects[0], &two.photo_effects[1]);
        assert_eq!(first.camera, phone.photo_effects[0].camera);
        assert!(second.lens != first.lens && second.camera.fx != first.camera.fx);
        assert_eq!(
            (two.photo_effects[3].lens, two.photo_effects[3].camera.fx),
            (second.lens, second.camera.fx)
        );
    }
}
