//! A sphere behind the scene in the blurred colours of what is farthest in each direction. It fills
//! directions in which neither a photo nor a continued surface shows anything, and fades away from
//! those the photos look in.
use crate::fit::photos::Photos;
use crate::math::{quantile, sphere_directions};
use crate::scene::{SH_C0, Splats};
use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

/// Number of directions over the sphere: 2° apart.
const DIRECTIONS: usize = 10_000;
const SPACING: f64 = 0.035;
/// Samples along the longer side of a photo.
const SAMPLES: usize = 40;
/// Radius over the distance that all but 0.5 % of the points are within.
const RADIUS: f64 = 1.05;
/// Angles from the nearest sample, radians: opaque up to 12°, nothing from 35° on.
const FADES: [f64; 2] = [0.21, 0.61];
const OPACITY: f64 = 0.98;
const LEAST_OPACITY: f64 = 0.02;

/// A colour that a photo shows in a direction from the middle of the cameras.
struct Sample {
    direction: DVec3,
    colour: [f32; 3],
    /// Distance; the farther of two surfaces is nearer to the background.
    distance: f64,
}

/// Splats on a sphere around cameras and `points`; empty without depth.
pub(crate) fn backdrop(photos: &Photos, points: &[[f32; 3]]) -> Splats {
    let centres = photos.cameras.iter().map(|c| c.pose.centre());
    let centre = centres.sum::<DVec3>() / photos.cameras.len().max(1) as f64;
    let samples = samples(photos, centre);
    let stride = points.len().div_ceil(20_000).max(1);
    let distances = points.iter().step_by(stride).map(|p| DVec3::from(p.map(f64::from)).distance(centre));
    let Some(farthest) = quantile(&mut distances.collect::<Vec<f64>>(), 0.995) else {
        return Splats::default();
    };
    let radius = RADIUS * farthest;
    let directions: Vec<DVec3> = sphere_directions(DIRECTIONS).collect();
    let shown: Vec<Option<([f32; 3], f64)>> =
        directions.par_iter().map(|direction| colour_towards(*direction, &samples)).collect();
    let mut splats = Splats::default();
    for (direction, shown) in directions.iter().zip(shown) {
        let Some((colour, angle)) = shown else { continue };
        let faded = ((angle - FADES[0]) / (FADES[1] - FADES[0])).clamp(0.0, 1.0);
        let opacity = OPACITY * (1.0 - faded);
        if opacity < LEAST_OPACITY {
            continue;
        }
        let x = direction.any_orthonormal_vector();
        let q = DQuat::from_mat3(&DMat3::from_cols(x, direction.cross(x), *direction));
        let size = (radius * SPACING).ln() as f32;
        splats.means.push((centre + radius * *direction).as_vec3().into());
        // An eighth, as the thickness of continued surfaces.
        splats.log_scales.push([size, size, size - 8f32.ln()]);
        splats.quats.push([q.w as f32, q.x as f32, q.y as f32, q.z as f32]);
        splats.opacity_logits.push((opacity / (1.0 - opacity)).ln() as f32);
        splats.sh.extend(colour.map(|v| (v - 0.5) / SH_C0));
    }
    splats
}

fn samples(photos: &Photos, centre: DVec3) -> Vec<Sample> {
    let mut out = Vec::new();
    for (view, (image, camera)) in photos.images.iter().zip(photos.cameras).enumerate() {
        let Some(map) = photos.depths.and_then(|d| d.get(view)) else { continue };
        let coverage = photos.coverage.get(view).and_then(Option::as_ref);
        let step = image.width.max(image.height).div_ceil(SAMPLES).max(1);
        let small = image.resized_by_area(image.width.div_ceil(step), image.height.div_ceil(step));
        for k in 0..small.data.len() {
            let at = |i: usize, small: usize, full: usize| ((2 * i + 1) * full / (2 * small)).min(full - 1);
            let x = at(k % small.width, small.width, image.width);
            let y = at(k / small.width, small.height, image.height);
            let i = y * image.width + x;
            let z = f64::from(map.depth.data[i]);
            if z <= 0.0 || !z.is_finite() || coverage.is_some_and(|c| !c.uses(i)) {
                continue;
            }
            let offset = camera.unproject(DVec2::new(x as f64 + 0.5, y as f64 + 0.5), z) - centre;
            let (direction, distance) = (offset.normalize_or_zero(), offset.length());
            out.push(Sample { direction, colour: small.data[k], distance });
        }
    }
    out
}

/// Blurred colour in a direction, and the angle to the nearest sample, radians; `None` without
/// samples. The blur grows with that angle.
fn colour_towards(direction: DVec3, samples: &[Sample]) -> Option<([f32; 3], f64)> {
    let nearest = samples.iter().map(|s| s.direction.dot(direction)).reduce(f64::max)?;
    let angle = nearest.clamp(-1.0, 1.0).acos();
    if angle > FADES[1] {
        return None;
    }
    let sigma = SPACING + 0.5 * angle;
    let (mut sum, mut total) = ([0.0f64; 3], 0.0);
    for s in samples {
        // For small angles, half of the square of the angle is 1 - cosine.
        let squares = (nearest - s.direction.dot(direction)) / (sigma * sigma);
        if squares < 8.0 {
            let weight = (-squares).exp() * s.distance.powi(4);
            (0..3).for_each(|c| sum[c] += weight * f64::from(s.colour[c]));
            total += weight;
        }
    }
    (total > 0.0).then(|| (sum.map(|v| (v / total) as f32), angle))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, DepthMap, Image, Pose, RgbImage};

    const WIDTH: usize = 80;
    const HEIGHT: usize = 60;

    /// 53° across, at the origin, looking along z.
    fn camera() -> Camera {
        let (width, height) = (WIDTH as u32, HEIGHT as u32);
        Camera {
            name: "a".into(),
            width,
            height,
            fx: 80.0,
            fy: 80.0,
            cx: 40.0,
            cy: 30.0,
            pose: Pose::IDENTITY,
        }
    }

    #[test]
    fn far_colours_continue_behind_near_ones_and_fade() {
        // A blue wall, a red thing of 8 × 8 pixels before its middle.
        let near = |i: usize| (36..44).contains(&(i % WIDTH)) && (26..34).contains(&(i / WIDTH));
        let of =
            |near_value: f32, far_value: f32| move |i: usize| if near(i) { near_value } else { far_value };
        let data = (0..WIDTH * HEIGHT).map(|i| [of(0.9, 0.1)(i), 0.2, of(0.1, 0.8)(i)]).collect();
        let depth: Vec<f32> = (0..WIDTH * HEIGHT).map(of(1.0, 5.0)).collect();
        let points: Vec<[f32; 3]> = (0..1000).map(|k| [0.003 * k as f32 - 1.5, 0.0, 5.0]).collect();
        let photos = Photos {
            images: &[RgbImage { width: WIDTH, height: HEIGHT, data }],
            cameras: &[camera()],
            depths: Some(&[DepthMap {
                depth: Image { width: WIDTH, height: HEIGHT, data: depth },
                confidence: Image::filled(WIDTH, HEIGHT, 1.0),
            }]),
            coverage: &[],
        };
        let splats = backdrop(&photos, &points);
        let mut least = [1.0f32; 2];
        for i in 0..splats.len() {
            let mean = DVec3::from(splats.means[i].map(f64::from));
            assert!(mean.length() > 5.0, "behind all points");
            let colour = [0, 1, 2].map(|c| 0.5 + SH_C0 * splats.sh[3 * i + c]);
            let angle = mean.normalize().angle_between(DVec3::Z);
            if angle < 0.1 {
                assert!(colour[2] > 0.7 && colour[0] < 0.2, "the wall behind the thing: {colour:?}");
            }
            // The nearest border is 20.6° from the middle, the farthest 32°.
            assert!(angle < 32f64.to_radians() + FADES[1], "{angle}");
            let opacity = 1.0 / (1.0 + (-splats.opacity_logits[i]).exp());
            let at = usize::from(angle > 20f64.to_radians());
            least[at] = least[at].min(opacity);
        }
        assert!(splats.len() > 800 && least[0] > 0.97 && least[1] < 0.1, "{} {least:?}", splats.len());
        assert!(backdrop(&Photos { depths: None, ..photos }, &points).is_empty());
    }
}
