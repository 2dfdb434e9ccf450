//! Shapes of regions from depth: level, upright, rough, sky (docs/internals/method.md#stuff).
use crate::scene::{Camera, DepthMap, Image, RgbImage, Sky};
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;
use splatvk_infer::stuff::Surface;
use std::ops::Range;

/// Step of the differences that give normals, as a share of the longer side.
const STEP: f64 = 1.0 / 200.0;
/// Cosine to the direction up from which a pixel is level.
const LEVEL: f32 = 0.95;
/// Least share of the pixels with depth that level pixels have where the scene has a level surface.
const LEAST_LEVEL: f64 = 0.02;
/// Quantile of the heights of level pixels that is the lowest level surface.
const LOWEST: f64 = 0.03;
/// Least height above the lowest level surface, relative to the cameras, of another storey.
const STOREY: f64 = 0.2;
/// Least share of level pixels in another storey.
const LEAST_STOREY: f64 = 0.05;
/// Excess of green over the mean of red and blue in plants.
const GREEN: f32 = 0.02;

/// Stride of the points that surfaces are compared with, pixels.
const STRIDE: usize = 7;
/// Radius around a region in which points may lie behind it, relative to its own.
const AROUND: f32 = 4.0;
/// Distance behind a plane from which a point counts, relative to the region's radius.
const BEHIND: f32 = 0.4;
/// Width of the frame around a region in its photo in which surfaces may lie behind it, relative to
/// the sides of the region's bounding box.
const FRAME: f32 = 1.0;

/// Points and normals of the pixels of one view.
struct View<'a> {
    image: &'a RgbImage,
    /// Scene units; NaN without depth and for sky.
    point: Vec<Vec3>,
    /// Unit normal towards the camera; zero without one.
    normal: Vec<Vec3>,
    sky: Vec<bool>,
}

/// The surfaces of a scene's photos.
pub struct Surfaces<'a> {
    views: Vec<View<'a>>,
    up: Vec3,
    /// Height of the lowest level surface, and that of the cameras above it.
    ground: Option<(f64, f64)>,
    storeys: bool,
    /// Median height of the cameras.
    eye: f64,
    /// Points of all views.
    points: Vec<Vec3>,
}

impl<'a> Surfaces<'a> {
    /// Points, normals and level surfaces of photos with their cameras and depth maps; `up` is a
    /// unit vector.
    pub fn new(images: &[&'a RgbImage], cameras: &[Camera], depths: &[DepthMap], up: DVec3) -> Surfaces<'a> {
        let sky = Sky::of(cameras, depths);
        let views: Vec<View> = (images, cameras, depths)
            .into_par_iter()
            .map(|(image, camera, depth)| View::new(image, camera, depth, sky.as_ref()))
            .collect();
        let direction = up.as_vec3();
        let mut heights: Vec<f32> = views.iter().flat_map(|v| v.level_heights(direction)).collect();
        let known: usize = views.iter().map(|v| v.point.iter().filter(|p| p.is_finite()).count()).sum();
        heights.sort_unstable_by(f32::total_cmp);
        let mut above: Vec<f64> = cameras.iter().map(|c| c.pose.centre().dot(up)).collect();
        above.sort_unstable_by(f64::total_cmp);
        let eye = above.get(above.len() / 2).copied().unwrap_or(0.0);
        let enough = heights.len() as f64 > LEAST_LEVEL * known as f64;
        let ground = enough.then(|| {
            let lowest = f64::from(heights[(LOWEST * heights.len() as f64) as usize]);
            (lowest, eye - lowest)
        });
        let ground = ground.filter(|(_, cameras)| *cameras > 0.0);
        let storeys = ground.is_some_and(|(lowest, cameras)| {
            let from = (lowest + STOREY * cameras) as f32;
            let higher = heights.iter().filter(|h| **h > from).count();
            higher as f64 > LEAST_STOREY * heights.len() as f64
        });
        let sampled = views.iter().flat_map(|v| v.point.iter().step_by(STRIDE * STRIDE + 1).copied());
        let points = sampled.filter(|p| p.is_finite()).collect();
        Surfaces { views, up: direction, ground, storeys, eye, points }
    }

    /// The surface of each region `0..count` of a label map of one view.
    pub fn of_regions(&self, view: usize, labels: &Image<i32>, count: usize) -> Vec<Surface> {
        let (own, up) = (&self.views[view], self.up.as_dvec3());
        let mut sums: Vec<Sums> = (0..count).map(|region| Sums::of(region as i32)).collect();
        for (i, label) in labels.data.iter().enumerate() {
            if let Some(sum) = usize::try_from(*label).ok().and_then(|l| sums.get_mut(l)) {
                sum.add(own, i, [i % labels.width, i / labels.width], up);
            }
        }
        sums.iter().map(|s| self.surface(view, labels, s)).collect()
    }

    fn surface(&self, view: usize, labels: &Image<i32>, s: &Sums) -> Surface {
        let per = |n: u32| n as f32 / s.pixels.max(1) as f32;
        let mean = s.normal / s.normals.max(1) as f32;
        let centre = (s.centre / f64::from(s.points.max(1))).as_vec3();
        let squares = s.squares / f64::from(s.points.max(1)) - centre.as_dvec3().length_squared();
        let radius = squares.max(0.0).sqrt() as f32;
        let plane = Plane { centre, normal: self.squared(mean), radius };
        let up = f64::from(centre.dot(self.up));
        let height = |(lowest, cameras): (f64, f64)| ((up - lowest) / cameras) as f32;
        Surface {
            share: s.pixels as f32 / labels.data.len().max(1) as f32,
            sky: per(s.sky),
            known: per(s.points + s.sky),
            level: mean.normalize_or_zero().dot(self.up),
            flat: mean.length(),
            height: self.ground.filter(|_| s.points > 0).map(height),
            behind: self.behind(&plane).max(self.behind_in_view(view, labels, s, &plane)),
            green: per(s.green),
            storeys: self.storeys,
        }
    }
}

impl Surfaces<'_> {
    /// The normal as a level or an upright plane has it.
    fn squared(&self, normal: Vec3) -> Vec3 {
        let along = normal.dot(self.up);
        let across = normal - along * self.up;
        if along.abs() > across.length() { along.signum() * self.up } else { across.normalize_or_zero() }
    }

    /// Share of the scene's points around a plane that lie behind it.
    fn behind(&self, plane: &Plane) -> f32 {
        let all = self.points.iter().copied();
        plane.share_behind(all.filter(|p| (*p - plane.centre).length() < AROUND * plane.radius))
    }

    /// Share of the points that the photo shows around the region and that lie behind its plane,
    /// because the wall behind a box may lie farther away than [`AROUND`]; or of those above it,
    /// where it ends below the cameras: a wall does not, the front of a cupboard does.
    fn behind_in_view(&self, view: usize, labels: &Image<i32>, s: &Sums, plane: &Plane) -> f32 {
        let ([left, top], [right, bottom]) = (s.first, s.end);
        let margin = |from: usize, to: usize| (FRAME * to.saturating_sub(from) as f32).ceil() as usize;
        let (x, y) = (margin(left, right), margin(top, bottom));
        let highest = top.saturating_sub(y);
        let share = |columns: Range<usize>, rows: Range<usize>| {
            let pixels = rows.flat_map(|y| columns.clone().map(move |x| y * labels.width + x));
            let around = pixels.filter(|i| labels.data[*i] != s.region).map(|i| self.views[view].point[i]);
            plane.share_behind(around.filter(|p| p.is_finite()))
        };
        let columns = left.saturating_sub(x)..(right + x).min(labels.width);
        let around = share(columns, highest..(bottom + y).min(labels.height));
        let ends_below = s.top() < self.eye;
        if ends_below { around.max(share(left..right, highest..top)) } else { around }
    }
}

/// The plane of a region.
struct Plane {
    centre: Vec3,
    normal: Vec3,
    /// Root mean square distance of the region's points from its centre.
    radius: f32,
}

impl Plane {
    fn share_behind(&self, points: impl Iterator<Item = Vec3>) -> f32 {
        let (mut all, mut behind) = (0u32, 0u32);
        for point in points {
            all += 1;
            behind += u32::from((point - self.centre).dot(self.normal) < -BEHIND * self.radius);
        }
        behind as f32 / all.max(1) as f32
    }
}

impl<'a> View<'a> {
    fn new(image: &'a RgbImage, camera: &Camera, depth: &DepthMap, sky: Option<&Sky>) -> View<'a> {
        let (width, height) = (depth.depth.width, depth.depth.height);
        let point = |i: usize| {
            let z = f64::from(depth.depth.data[i]);
            let pixel = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            (z > 0.0).then(|| camera.unproject(pixel, z))
        };
        let points: Vec<Option<DVec3>> = (0..width * height).map(point).collect();
        let is_sky: Vec<bool> =
            points.iter().map(|p| p.is_some_and(|p| sky.is_some_and(|s| s.contains(p)))).collect();
        let known = points.iter().zip(&is_sky).map(|(p, sky)| match p {
            Some(p) if !sky => p.as_vec3(),
            _ => Vec3::NAN,
        });
        let step = ((width.max(height) as f64 * STEP).round() as usize).max(1);
        let centre = camera.pose.centre();
        let normal = |i: usize| {
            let (x, y) = (i % width, i / width);
            let inside = x >= step && y >= step && x + step < width && y + step < height;
            let at = |i: usize| points[i].filter(|_| !is_sky[i]);
            let across = (at(inside.then(|| i + step)?)?, at(i - step)?);
            let down = (at(i + step * width)?, at(i - step * width)?);
            let normal = (across.0 - across.1).cross(down.0 - down.1).normalize_or_zero();
            Some(if normal.dot(centre - points[i]?) < 0.0 { -normal } else { normal }.as_vec3())
        };
        let normals = (0..width * height).into_par_iter().map(|i| normal(i).unwrap_or(Vec3::ZERO));
        View { image, point: known.collect(), normal: normals.collect(), sky: is_sky }
    }

    /// Heights of the level pixels.
    fn level_heights(&self, up: Vec3) -> impl Iterator<Item = f32> {
        let level = self.point.iter().zip(&self.normal).filter(move |(_, n)| n.dot(up) > LEVEL);
        level.map(move |(p, _)| p.dot(up))
    }
}

/// Sums over the pixels of a region.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    region: i32,
    pixels: u32,
    /// Column and row of the first pixel of its bounding box, and behind the last one.
    first: [usize; 2],
    end: [usize; 2],
    sky: u32,
    green: u32,
    points: u32,
    centre: DVec3,
    squares: f64,
    /// Sum of the heights, and of their squares.
    heights: [f64; 2],
    normals: u32,
    normal: Vec3,
}

impl Sums {
    fn of(region: i32) -> Sums {
        Sums { region, first: [usize::MAX; 2], ..Sums::default() }
    }

    /// Height of the upper end of a surface whose points are spread evenly over its height.
    fn top(&self) -> f64 {
        let [mean, square] = self.heights.map(|sum| sum / f64::from(self.points.max(1)));
        mean + (3.0 * (square - mean * mean).max(0.0)).sqrt()
    }

    fn add(&mut self, view: &View, i: usize, at: [usize; 2], up: DVec3) {
        let [r, g, b] = view.image.data[i];
        self.pixels += 1;
        self.first = [0, 1].map(|axis| self.first[axis].min(at[axis]));
        self.end = [0, 1].map(|axis| self.end[axis].max(at[axis] + 1));
        self.sky += u32::from(view.sky[i]);
        self.green += u32::from(g - 0.5 * (r + b) > GREEN && g >= r);
        if view.point[i].is_finite() {
            let point = view.point[i].as_dvec3();
            self.points += 1;
            self.centre += point;
            self.squares += point.length_squared();
            let height = point.dot(up);
            self.heights = [self.heights[0] + height, self.heights[1] + height * height];
        }
        if view.normal[i] != Vec3::ZERO {
            self.normals += 1;
            self.normal += view.normal[i];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    /// The nearest of some surfaces per pixel, from their depths along a ray, and its index.
    fn seen<const N: usize>(depths: fn(DVec3) -> [f64; N]) -> (RgbImage, Camera, DepthMap, Image<i32>) {
        let (width, height) = (160, 120);
        let camera = Camera {
            name: "a".into(),
            fx: 120.0,
            fy: 120.0,
            cx: 80.0,
            cy: 60.0,
            width: width as u32,
            height: height as u32,
            pose: Pose::IDENTITY,
        };
        let mut labels = Image::filled(width, height, 0);
        let mut depth = Image::filled(width, height, 0.0);
        for i in 0..width * height {
            let all = depths(camera.ray(DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5)));
            let nearest = (0..N).min_by(|a, b| all[*a].total_cmp(&all[*b])).unwrap();
            (labels.data[i], depth.data[i]) = (nearest as i32, all[nearest] as f32);
        }
        let image = RgbImage { width, height, data: vec![[0.2, 0.5, 0.2]; width * height] };
        let confidence = Image::filled(width, height, 1.0);
        (image, camera, DepthMap { depth, confidence }, labels)
    }

    fn at(depth: f64, inside: bool) -> f64 {
        if inside { depth } else { f64::INFINITY }
    }

    /// A room seen from the middle: floor one below the camera, back wall four in front, and an
    /// upright board at two that hides its lower middle.
    fn room() -> (RgbImage, Camera, DepthMap, Image<i32>) {
        seen(|ray| [at(1.0 / ray.y, ray.y > 0.0), 4.0, at(2.0, ray.x.abs() < 0.15 && ray.y > -0.1)])
    }

    #[test]
    fn front_of_cupboard_ends_below_the_cameras() {
        // A row of fronts at two, half below the camera, with a counter between them and the wall;
        // neighbours of a front lie on its plane.
        let (image, camera, depth, labels) = seen(|ray| {
            let front = |own: bool| at(2.0, ray.y > 0.25 && own);
            let counter = at(0.5 / ray.y, ray.y > 0.0 && ray.y <= 0.25);
            [counter, 4.0, front(ray.x.abs() < 0.1), front(ray.x.abs() >= 0.1)]
        });
        let surfaces = Surfaces::new(&[&image], &[camera], &[depth], DVec3::NEG_Y);
        let [_, wall, front, _] = surfaces.of_regions(0, &labels, 4).try_into().unwrap();
        assert!(front.behind > 0.8 && wall.behind < 0.05, "{front:?} {wall:?}");
    }

    #[test]
    fn surfaces_of_room_are_level_and_upright() {
        let (image, camera, depth, labels) = room();
        let surfaces = Surfaces::new(&[&image], &[camera], &[depth], DVec3::NEG_Y);
        let [floor, wall, board, none] = surfaces.of_regions(0, &labels, 4).try_into().unwrap();
        assert!(floor.level > 0.95 && floor.flat > 0.9 && floor.height.unwrap().abs() < 0.05, "{floor:?}");
        assert!(wall.level.abs() < 0.1 && wall.flat > 0.9 && wall.behind < 0.05, "{wall:?}");
        assert!(board.level.abs() < 0.1 && board.behind > 0.35, "{board:?}");
        assert!(!floor.storeys && floor.known == 1.0 && floor.sky == 0.0 && floor.green == 1.0);
        let all = floor.share + wall.share + board.share;
        assert!(
            (all - 1.0).abs() < 1e-5
                && none == Surface { storeys: false, height: none.height, ..Surface::default() }
        );
    }
}
