//! Sky: it has no texture and no parallax, so matching and filling put it on roofs and hills.
//! It gets a surface of its own, a sphere far behind all that is matched
//! (docs/internals/method.md#sky).
use super::surface::{Surface, neighbours, ray};
use super::views::{halved, in_image};
use super::{Level, ReferenceView};
use crate::scene::{Camera, CameraOrbit, RgbImage};
use glam::{DVec2, DVec3, Vec3};

/// Longer side to which photos are reduced, pixels: noise and single twigs vanish.
const LONGER_SIDE: usize = 640;
/// Largest range of a channel over 3 × 3 pixels of sky.
const LARGEST_RANGE: f32 = 0.06;
/// Largest mean of that range over an area: grain of walls is above, clouds are below.
const MEAN_RANGE: f32 = 0.025;
/// Least share of an area in its photo.
const LEAST_SHARE: f32 = 0.02;
/// Largest density of sparse points in an area, relative to the rest of its photo: nothing stands
/// in front of the sky, and few points on clouds survive.
const MOST_POINTS: f64 = 0.1;
/// Width of the seam around an area, pixels, that belongs to it where its colour does: there, sky
/// and what stands before it mix.
const SEAM: usize = 2;
/// Largest colour distance (L2) of a pixel of the seam from the sky beside it.
const SEAM_COLOUR: f32 = 0.15;
/// Confidence of the depth of sky: as if one other view agreed.
const CONFIDENCE: f32 = 0.6;
/// Radius of the sphere over the farthest depth that filling accepts in any view.
const RADIUS: f64 = 1.5;

/// Sky in all views.
pub struct Sky {
    /// Per pixel of all views.
    pub pixels: Vec<bool>,
    centre: DVec3,
    radius: f64,
}

impl Sky {
    /// Finds bright, smooth, blue or white areas that begin at the top of a photo, point upwards
    /// and have no `sparse` points. Excludes `void` pixels.
    pub fn find(level: &Level, sparse: &[DVec3], void: &[bool]) -> Sky {
        let up = CameraOrbit::mean_up(&level.cameras).normalize_or_zero();
        let mut pixels = vec![false; level.pixels()];
        for (view, camera) in level.cameras.iter().enumerate() {
            let first = level.references[view].first as usize;
            let own = void[first..first + level.guide[view].data.len()].iter();
            let found = of_photo(&level.guide[view], camera, up, sparse);
            for ((out, sky), void) in pixels[first..].iter_mut().zip(found).zip(own) {
                *out = sky && !void;
            }
        }
        let centres = level.cameras.iter().map(|c| c.pose.centre());
        let centre = centres.sum::<DVec3>() / level.cameras.len().max(1) as f64;
        // Filling accepts half of the least inverse depth that is searched.
        let farthest = level.references.iter().map(|r| 2.0 / f64::from(r.range[0])).fold(0.0, f64::max);
        Sky { pixels, centre, radius: RADIUS * farthest }
    }

    /// Share of sky per view.
    pub fn shares(&self, level: &Level) -> Vec<f32> {
        let share = |r: &ReferenceView| {
            let own = &self.pixels[r.first as usize..(r.first + r.width * r.height) as usize];
            own.iter().filter(|sky| **sky).count() as f32 / own.len().max(1) as f32
        };
        level.references.iter().map(share).collect()
    }

    /// The surface with the sky's pixels on the sphere.
    pub fn added_to(&self, level: &Level, mut surface: Surface) -> Surface {
        for (view, camera) in level.cameras.iter().enumerate() {
            let r = &level.references[view];
            let to_centre = camera.pose.transform(self.centre).as_vec3();
            for k in 0..(r.width * r.height) as usize {
                let index = r.first as usize + k;
                if self.pixels[index] {
                    let ray = ray(level, view, k % r.width as usize, k / r.width as usize);
                    surface.planes[index] = tangent(ray, to_centre, self.radius as f32);
                    surface.confidence[index] = CONFIDENCE;
                }
            }
        }
        surface
    }
}

/// The plane that touches a sphere where a ray leaves it; `centre` in the camera's frame.
fn tangent(ray: Vec3, centre: Vec3, radius: f32) -> Vec3 {
    let direction = ray.normalize();
    let along = direction.dot(centre);
    let beside = (centre.length_squared() - along * along).max(0.0);
    let point = direction * (along + (radius * radius - beside).max(0.0).sqrt());
    let normal = (point - centre) / radius;
    normal / normal.dot(point)
}

/// Whether each pixel of a photo is sky.
fn of_photo(photo: &RgbImage, camera: &Camera, up: DVec3, sparse: &[DVec3]) -> Vec<bool> {
    let mut reduced = photo.clone();
    let mut scale = 1;
    while reduced.width.max(reduced.height) > LONGER_SIDE {
        (reduced, scale) = (halved(&reduced), 2 * scale);
    }
    let (width, height) = (reduced.width, reduced.height);
    let ranges: Vec<f32> = (0..width * height).map(|k| range_around(&reduced, k)).collect();
    let candidate: Vec<bool> =
        (0..width * height).map(|k| ranges[k] < LARGEST_RANGE && is_sky_colour(reduced.data[k])).collect();
    let points: Vec<usize> = sparse
        .iter()
        .filter(|p| in_image(camera, **p))
        .map(|p| {
            let pixel = camera.project(*p).0 / scale as f64;
            (pixel.y as usize).min(height - 1) * width + (pixel.x as usize).min(width - 1)
        })
        .collect();
    let is_sky = |area: &[usize], member: &[bool]| {
        let share = area.len() as f32 / ranges.len() as f32;
        let mean_range = area.iter().map(|k| ranges[*k]).sum::<f32>() / area.len() as f32;
        let elevation = |k: &usize| {
            let pixel = DVec2::new((k % width) as f64 + 0.5, (k / width) as f64 + 0.5) * scale as f64;
            (camera.pose.rotation.transpose() * camera.ray(pixel)).dot(up)
        };
        let above = area.iter().filter(|k| elevation(k) > 0.0).count();
        let inside = points.iter().filter(|k| member[**k]).count() as f64;
        let others = points.len() as f64 - inside;
        share >= LEAST_SHARE
            && mean_range <= MEAN_RANGE
            && 2 * above > area.len()
            && inside * f64::from(1.0 - share) <= MOST_POINTS * others * f64::from(share)
    };
    let mut found = vec![false; width * height];
    let mut done = vec![false; width * height];
    for start in 0..width {
        if !candidate[start] || done[start] {
            continue;
        }
        let area = connected(start, &candidate, width, height, &mut done);
        let mut member = vec![false; width * height];
        area.iter().for_each(|k| member[*k] = true);
        if is_sky(&area, &member) {
            area.iter().for_each(|k| found[*k] = true);
        }
    }
    for _ in 0..SEAM {
        widen(&mut found, &reduced);
    }
    let at = |k: usize| {
        let (x, y) = (k % photo.width / scale, k / photo.width / scale);
        found[y.min(height - 1) * width + x.min(width - 1)]
    };
    (0..photo.data.len()).map(at).collect()
}

/// Adds the pixels next to sky of nearly its colour.
fn widen(found: &mut [bool], image: &RgbImage) {
    let alike = |k: usize, n: usize| {
        let (a, b) = (image.data[k], image.data[n]);
        (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>() < SEAM_COLOUR * SEAM_COLOUR
    };
    let joins =
        |k: &usize| !found[*k] && neighbours(*k, image.width, image.height).any(|n| found[n] && alike(*k, n));
    let seam: Vec<usize> = (0..found.len()).filter(joins).collect();
    seam.into_iter().for_each(|k| found[k] = true);
}

/// Blue, or nearly white.
fn is_sky_colour([r, g, b]: [f32; 3]) -> bool {
    let (most, least) = (r.max(g).max(b), r.min(g).min(b));
    let blue = b >= r + 0.03 && b >= g - 0.005 && most >= 0.45;
    let white = least >= 0.8 && most - least <= 0.12;
    blue || white
}

/// Largest range of a channel over 3 × 3 pixels.
fn range_around(image: &RgbImage, k: usize) -> f32 {
    let (x, y) = (k % image.width, k / image.width);
    let (mut low, mut high) = ([f32::MAX; 3], [f32::MIN; 3]);
    for py in y.saturating_sub(1)..(y + 2).min(image.height) {
        for px in x.saturating_sub(1)..(x + 2).min(image.width) {
            let colour = image.at(px, py);
            (0..3).for_each(|c| (low[c], high[c]) = (low[c].min(colour[c]), high[c].max(colour[c])));
        }
    }
    (0..3).map(|c| high[c] - low[c]).fold(0.0, f32::max)
}

/// The candidates that are connected to `start`.
fn connected(start: usize, candidate: &[bool], width: usize, height: usize, done: &mut [bool]) -> Vec<usize> {
    let mut area = vec![start];
    done[start] = true;
    let mut next = 0;
    while next < area.len() {
        for n in neighbours(area[next], width, height) {
            if candidate[n] && !done[n] {
                done[n] = true;
                area.push(n);
            }
        }
        next += 1;
    }
    area
}

#[cfg(test)]
mod tests {
    use super::super::tests::{HEIGHT, WIDTH, camera_at, pixel_centre};
    use super::super::{StereoOptions, pyramid};
    use super::*;
    use crate::math::Random;

    /// First row below the sky.
    const ROOFS: usize = 40;

    /// Two cameras side by side.
    fn cameras() -> [Camera; 2] {
        [0.0, 0.5].map(camera_at)
    }

    /// Number of sky pixels of the first view in the upper part and below. The upper part has one
    /// colour up to a grain; below is texture.
    fn found(upper: [f32; 3], grain: f32, cameras: &[Camera; 2], points_above: bool) -> (usize, usize) {
        let mut random = Random::new(3);
        let mut noise = move || random.uniform() as f32 - 0.5;
        let photo = |_: &Camera| {
            let pixel = |k: usize| {
                let n = noise();
                if k / WIDTH < ROOFS { upper.map(|c| c + grain * n) } else { [0.3 + 0.5 * n; 3] }
            };
            RgbImage { width: WIDTH, height: HEIGHT, data: (0..WIDTH * HEIGHT).map(pixel).collect() }
        };
        let images: Vec<RgbImage> = cameras.iter().map(photo).collect();
        let shown = |k: &usize| points_above || k / WIDTH >= ROOFS;
        let point = |k: usize| cameras[0].unproject(DVec2::new((k % WIDTH) as f64, (k / WIDTH) as f64), 4.0);
        let sparse: Vec<DVec3> = (0..WIDTH * HEIGHT).step_by(37).filter(shown).map(point).collect();
        let options = StereoOptions { rounds: vec![1], ..StereoOptions::default() };
        let level = pyramid(&images, cameras, &sparse, &options).unwrap().pop().unwrap();
        let sky = Sky::find(&level, &sparse, &vec![false; level.pixels()]);
        let count = |rows: std::ops::Range<usize>| {
            sky.pixels[rows.start * WIDTH..rows.end * WIDTH].iter().filter(|s| **s).count()
        };
        (count(0..ROOFS), count(ROOFS..HEIGHT))
    }

    #[test]
    fn only_smooth_bright_empty_tops_are_sky() {
        let (blue, views) = ([0.5, 0.7, 0.95], cameras());
        let (above, below) = found(blue, 0.02, &views, false);
        assert!(above > 38 * WIDTH && below == 0, "{above} {below}");
        assert!(found([0.95; 3], 0.02, &views, false).0 > 38 * WIDTH, "overcast");
        for (upper, grain, points_above) in
            [([0.5; 3], 0.02, false), ([0.9, 0.6, 0.3], 0.02, false), (blue, 0.1, false), (blue, 0.02, true)]
        {
            assert_eq!(found(upper, grain, &views, points_above).0, 0, "{upper:?} {grain} {points_above}");
        }
    }

    #[test]
    fn sky_lies_on_sphere_behind_points() {
        let cameras = cameras();
        let images = cameras.each_ref().map(|_| RgbImage {
            width: WIDTH,
            height: HEIGHT,
            data: (0..WIDTH * HEIGHT)
                .map(|k| if k / WIDTH < ROOFS { [0.5, 0.7, 0.95] } else { [(k % 7) as f32 / 10.0; 3] })
                .collect(),
        });
        let sparse: Vec<DVec3> = (0..200).map(|k| DVec3::new(0.01 * f64::from(k) - 1.0, 0.5, 4.0)).collect();
        let options = StereoOptions { rounds: vec![1], ..StereoOptions::default() };
        let level = pyramid(&images, &cameras, &sparse, &options).unwrap().pop().unwrap();
        let sky = Sky::find(&level, &sparse, &vec![false; level.pixels()]);
        let nothing =
            Surface { planes: vec![Vec3::ZERO; level.pixels()], confidence: vec![0.0; level.pixels()] };
        let surface = sky.added_to(&level, nothing);
        let centre = DVec3::new(0.25, 0.0, 0.0);
        for (view, camera) in level.cameras.iter().enumerate() {
            for k in (0..ROOFS * WIDTH / 2).step_by(101) {
                let index = level.references[view].first as usize + k;
                let inverse = surface.planes[index].dot(ray(&level, view, k % WIDTH, k / WIDTH));
                let point = camera.unproject(pixel_centre(k), 1.0 / f64::from(inverse));
                assert!((point.distance(centre) / sky.radius - 1.0).abs() < 1e-3, "{view} {k}");
                assert!(surface.confidence[index] > 0.5);
            }
        }
        assert!(sky.radius > 4.0 * 4.0);
    }
}
