//! Supervision of views that nobody took: the photos, warped by their depth to cameras around them
//! (docs/internals/method.md#virtual-views).
//!
//! A few photos leave splats free along the rays: from the side, surfaces open and splats that one
//! photo alone supports stand in the way. Warped photos show how the surfaces look from there.
use super::photos::{OwnedPhotos, Photos};
use crate::math::Random;
use crate::scene::{Camera, CameraOrbit, Coverage, DepthMap, Image, Outside, RgbImage};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Largest ratio of the depths of neighbouring pixels on one surface, at half resolution.
const SAME_SURFACE: f32 = 1.03;
/// A photo that sees this much further than a point refutes it.
const SEES_THROUGH: f64 = 1.03;
/// Ranges of the displacements about the point that the photos look at: degrees to either side,
/// degrees down and up, factor of the distance.
const AZIMUTH: [f64; 2] = [4.0, 22.0];
const ELEVATION: [f64; 2] = [-12.0, 16.0];
const DISTANCE: [f64; 2] = [0.8, 1.25];

/// Warps photos to `count` cameras around them, at half their size. Pixels that no photo shows
/// without contradiction are not used. Empty without depth, and with an empty background.
pub(super) fn virtual_views(photos: &Photos, count: usize, min_confidence: f32, seed: u64) -> OwnedPhotos {
    if count == 0 || photos.depths.is_none() || photos.show_emptiness() {
        return OwnedPhotos::default();
    }
    let half = OwnedPhotos::at_half_res(photos);
    warped_views(&half.photos(), count, ELEVATION, min_confidence, seed)
}

fn warped_views(
    photos: &Photos,
    count: usize,
    elevation: [f64; 2],
    min_confidence: f32,
    seed: u64,
) -> OwnedPhotos {
    let mut views = OwnedPhotos::default();
    let Photos { images, cameras, depths: Some(depths), coverage } = *photos else { return views };
    let with_depth = images.iter().zip(cameras).zip(depths).enumerate();
    let surfaces: Vec<Surface> = with_depth
        .filter(|(_, ((image, _), map))| map.depth.data.len() == image.data.len())
        .map(|(i, ((image, camera), map))| {
            let coverage = coverage.get(i).and_then(Option::as_ref);
            Surface::new(image, camera, map, coverage, min_confidence)
        })
        .collect();
    let targets: Vec<DVec3> = surfaces.iter().filter_map(Surface::target).collect();
    if targets.is_empty() {
        return views;
    }
    let target = targets.iter().sum::<DVec3>() / targets.len() as f64;
    let cameras = around(cameras, target, elevation, count, seed);
    let mut all_depths = Vec::new();
    for camera in cameras {
        let Warped { image, depth, used } = warp(&surfaces, &camera);
        views.images.push(image);
        all_depths.push(DepthMap { depth, confidence: used.clone() });
        views.coverage.push(Some(Coverage { share: used, outside: Outside::Unknown }));
        views.cameras.push(camera);
    }
    views.depths = Some(all_depths);
    views
}

/// Number of views in which surfaces that no photo shows must not stand in front.
const BESIDE: usize = 24;

/// Cameras around photos, with the depth of the surfaces that the photos show there, 0 where they
/// show none; at half the photos' size.
pub(super) fn views_beside(photos: &Photos, min_confidence: f32, seed: u64) -> Vec<(Camera, DepthMap)> {
    let half = OwnedPhotos::at_half_res(photos);
    // From below the ground, its continuation stands in front of everything.
    let elevation = [0.0, ELEVATION[1]];
    let views = warped_views(&half.photos(), BESIDE, elevation, min_confidence, seed ^ 0x7be5);
    views.cameras.into_iter().zip(views.depths.into_iter().flatten()).collect()
}

/// Cameras displaced from the photos in turn, to the left and to the right.
fn around(photos: &[Camera], target: DVec3, elevation: [f64; 2], count: usize, seed: u64) -> Vec<Camera> {
    let up = CameraOrbit::mean_up(photos).normalize_or(-DVec3::Y);
    let orbit = CameraOrbit::new(photos, target, up);
    let mut random = Random::new(seed ^ 0x51de);
    (0..count)
        .map(|k| {
            let side = if (k / photos.len()).is_multiple_of(2) { 1.0 } else { -1.0 };
            let azimuth = side * random.between(AZIMUTH[0], AZIMUTH[1]);
            let elevation = random.between(elevation[0], elevation[1]);
            let distance = random.between(DISTANCE[0], DISTANCE[1]);
            orbit.displaced(&photos[k % photos.len()], azimuth, elevation, distance)
        })
        .collect()
}

/// The surfaces of a photo as a grid of points, one per pixel with known depth.
struct Surface<'a> {
    image: &'a RgbImage,
    camera: &'a Camera,
    /// [H, W] camera z; 0 = unknown.
    depth: Image<f32>,
}

impl Surface<'_> {
    fn new<'a>(
        image: &'a RgbImage,
        camera: &'a Camera,
        map: &DepthMap,
        coverage: Option<&Coverage>,
        min_confidence: f32,
    ) -> Surface<'a> {
        let known = |i: usize| map.confidence.data[i] >= min_confidence && coverage.is_none_or(|c| c.uses(i));
        let values = map.depth.data.iter().enumerate();
        let data = values.map(|(i, z)| if known(i) && z.is_finite() { *z } else { 0.0 }).collect();
        Surface { image, camera, depth: Image { data, ..map.depth } }
    }

    /// The point at the median depth of the central third.
    fn target(&self) -> Option<DVec3> {
        let middle = DVec2::new(f64::from(self.camera.width), f64::from(self.camera.height)) / 2.0;
        Some(self.camera.unproject(middle, self.depth.central_median()?))
    }

    fn point(&self, index: usize) -> DVec3 {
        let (x, y) = (index % self.depth.width, index / self.depth.width);
        let centre = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        self.camera.unproject(centre, f64::from(self.depth.data[index]))
    }

    /// Whether the photo sees further than a point on the ray through it.
    fn sees_through(&self, point: DVec3) -> bool {
        let (DVec2 { x, y }, z) = self.camera.project(point);
        let (width, height) = (self.depth.width as f64, self.depth.height as f64);
        if z <= 0.0 || x < 0.0 || y < 0.0 || x >= width || y >= height {
            return false;
        }
        f64::from(self.depth.at(x as usize, y as usize)) > SEES_THROUGH * z
    }

    /// The surfaces from another camera: per pixel the nearest one, with the cosine between the
    /// rays of the two cameras; depth 0 where there is none.
    fn rasterised(&self, camera: &Camera) -> Vec<Sample> {
        let (width, height) = (self.depth.width, self.depth.height);
        let (out_width, out_height) = (camera.width as usize, camera.height as usize);
        let mut out = vec![Sample::default(); out_width * out_height];
        let (own, other) = (self.camera.pose.centre(), camera.pose.centre());
        let vertices: Vec<Option<Vertex>> = (0..width * height)
            .map(|i| {
                let point = (self.depth.data[i] > 0.0).then(|| self.point(i))?;
                let (pixel, z) = camera.project(point);
                let cosine = (point - own).normalize_or_zero().dot((point - other).normalize_or_zero());
                let colour = self.image.data[i];
                (z > 0.0).then_some(Vertex { pixel, z: z as f32, colour, cosine: cosine as f32 })
            })
            .collect();
        for y in 0..height - 1 {
            for x in 0..width - 1 {
                let i = y * width + x;
                for corners in [[i, i + 1, i + width], [i + 1, i + width + 1, i + width]] {
                    let depths = corners.map(|k| self.depth.data[k]);
                    let (least, most) =
                        depths.iter().fold((f32::MAX, 0.0f32), |(a, b), z| (a.min(*z), b.max(*z)));
                    if least <= 0.0 || most > SAME_SURFACE * least {
                        continue;
                    }
                    if let [Some(a), Some(b), Some(c)] = corners.map(|k| vertices[k]) {
                        draw([a, b, c], (out_width, out_height), &mut out);
                    }
                }
            }
        }
        out
    }
}

#[derive(Clone, Copy)]
struct Vertex {
    pixel: DVec2,
    z: f32,
    colour: [f32; 3],
    cosine: f32,
}

/// A surface at a pixel.
#[derive(Clone, Copy, Default)]
struct Sample {
    /// Camera z; 0 = none.
    z: f32,
    colour: [f32; 3],
    /// Cosine between the rays of the photo and of the view; 0 for the back of a surface.
    cosine: f32,
}

/// Draws a triangle with a depth test.
fn draw([a, b, c]: [Vertex; 3], (width, height): (usize, usize), out: &mut [Sample]) {
    let area = (b.pixel - a.pixel).perp_dot(c.pixel - a.pixel);
    if area.abs() < 1e-9 {
        return;
    }
    let low = a.pixel.min(b.pixel).min(c.pixel).max(DVec2::ZERO);
    let high = a.pixel.max(b.pixel).max(c.pixel).min(DVec2::new(width as f64, height as f64));
    // The pixels whose centres lie in the box.
    let first = (low - 0.5).ceil().max(DVec2::ZERO);
    let (columns, rows) = (
        first.x as usize..(high.x + 0.5).max(0.0) as usize,
        first.y as usize..(high.y + 0.5).max(0.0) as usize,
    );
    for y in rows.start..rows.end.min(height) {
        for x in columns.start..columns.end.min(width) {
            let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let wa = (c.pixel - b.pixel).perp_dot(p - b.pixel) / area;
            let wb = (a.pixel - c.pixel).perp_dot(p - c.pixel) / area;
            let wc = 1.0 - wa - wb;
            if wa < 0.0 || wb < 0.0 || wc < 0.0 {
                continue;
            }
            let [wa, wb, wc] = [wa, wb, wc].map(|w| w as f32);
            // Triangles are about a pixel large: affine weights suffice.
            let z = wa * a.z + wb * b.z + wc * c.z;
            let pixel = &mut out[y * width + x];
            if pixel.z > 0.0 && pixel.z <= z {
                continue;
            }
            let colour = [0, 1, 2].map(|k| wa * a.colour[k] + wb * b.colour[k] + wc * c.colour[k]);
            // The grid of a photo turns over where its surface is seen from behind.
            let cosine = if area > 0.0 { wa * a.cosine + wb * b.cosine + wc * c.cosine } else { 0.0 };
            *pixel = Sample { z, colour, cosine };
        }
    }
}

/// A view made of warped photos.
struct Warped {
    image: RgbImage,
    depth: Image<f32>,
    /// 1 where a photo shows the surface without contradiction, 0 elsewhere.
    used: Image<f32>,
}

fn warp(surfaces: &[Surface], camera: &Camera) -> Warped {
    let layers: Vec<Vec<Sample>> = surfaces.par_iter().map(|s| s.rasterised(camera)).collect();
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut image = RgbImage { width, height, data: vec![[0.0; 3]; width * height] };
    let mut depth = Image::filled(width, height, 0.0f32);
    let mut used = Image::filled(width, height, 0.0f32);
    for i in 0..width * height {
        let samples = || layers.iter().map(|l| l[i]).filter(|s| s.z > 0.0);
        let Some(nearest) = samples().map(|s| s.z).min_by(f32::total_cmp) else { continue };
        // The photo that looks most along this ray, of those that show the front surface.
        let front = samples().filter(|s| s.z <= SAME_SURFACE * nearest);
        let Some(best) = front.max_by(|a, b| a.cosine.total_cmp(&b.cosine)) else { continue };
        let centre = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let point = camera.unproject(centre, f64::from(best.z));
        if best.cosine <= 0.0 || surfaces.iter().any(|s| s.sees_through(point)) {
            continue;
        }
        (image.data[i], depth.data[i], used.data[i]) = (best.colour, best.z, 1.0);
    }
    let known: Vec<bool> = used.data.iter().map(|u| *u > 0.0).collect();
    image.fill_from_used(|i| known[i]);
    Warped { image, depth, used }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    const WIDTH: usize = 80;
    const HEIGHT: usize = 60;
    /// Depth of the wall, and of a square before its middle.
    const WALL: f64 = 3.0;
    const SQUARE: f64 = 2.0;

    fn camera(x: f64) -> Camera {
        let pose = Pose { translation: DVec3::new(-x, 0.0, 0.0), ..Pose::IDENTITY };
        let (width, height) = (WIDTH as u32, HEIGHT as u32);
        Camera { name: "a".into(), width, height, fx: 80.0, fy: 80.0, cx: 40.0, cy: 30.0, pose }
    }

    /// Smooth colours of the wall, and a colour of the square that the wall does not have.
    fn colour(point: DVec3) -> [f32; 3] {
        if point.z < WALL - 0.1 {
            return [1.0, 0.0, 0.0];
        }
        [0.0, (0.5 + 0.2 * point.x.sin()) as f32, (0.5 + 0.2 * point.y.cos()) as f32]
    }

    /// The surface on the ray of a pixel.
    fn seen(camera: &Camera, index: usize) -> DVec3 {
        let pixel = DVec2::new((index % WIDTH) as f64 + 0.5, (index / WIDTH) as f64 + 0.5);
        let near = camera.unproject(pixel, SQUARE);
        if near.x.abs() < 0.4 && near.y.abs() < 0.4 { near } else { camera.unproject(pixel, WALL) }
    }

    fn photo(camera: &Camera) -> (RgbImage, DepthMap) {
        let points: Vec<DVec3> = (0..WIDTH * HEIGHT).map(|i| seen(camera, i)).collect();
        let data = points.iter().map(|p| colour(*p)).collect();
        let depth = points.iter().map(|p| p.z as f32).collect();
        let depth = Image { width: WIDTH, height: HEIGHT, data: depth };
        let confidence = Image::filled(WIDTH, HEIGHT, 1.0);
        (RgbImage { width: WIDTH, height: HEIGHT, data }, DepthMap { depth, confidence })
    }

    #[test]
    fn warped_photo_shows_surfaces_and_no_hidden_one() {
        let source = camera(0.0);
        let (image, map) = photo(&source);
        let surfaces = [Surface::new(&image, &source, &map, None, 0.5)];
        let view = camera(0.3);
        let warped = warp(&surfaces, &view);
        let (mut used, mut hidden) = (0, 0);
        for i in 0..WIDTH * HEIGHT {
            let point = seen(&view, i);
            // The photo sees the point unless the square is before it.
            let (pixel, _) = source.project(point);
            let inside = pixel.x > 1.0 && pixel.x < WIDTH as f64 - 1.0;
            let front = inside.then(|| seen(&source, pixel.y as usize * WIDTH + pixel.x as usize));
            if warped.used.data[i] == 0.0 {
                hidden += usize::from(front.is_none_or(|f| f.z < point.z - 0.1));
                continue;
            }
            used += 1;
            let near = |(a, b): (f32, f32)| (a - b).abs() < 0.02;
            let expected = colour(point);
            assert!(
                warped.image.data[i].into_iter().zip(expected).all(near),
                "{i}: {:?}",
                warped.image.data[i]
            );
            assert!((f64::from(warped.depth.data[i]) - point.z).abs() < 0.01, "{i}");
        }
        // 10 of 80 columns leave the picture; the square hides 4 columns of its 32 rows, and its
        // edges and the wall's are a pixel wide.
        assert!(used > 3800 && hidden > 400, "{used} {hidden}");
    }

    #[test]
    fn contradicted_surface_is_left_out() {
        let source = camera(0.0);
        let (image, mut map) = photo(&source);
        let other = camera(0.1);
        let (_, clean) = photo(&other);
        // A false surface before the wall in one photo, through which the other sees.
        (0..8).for_each(|k| (0..8).for_each(|x| map.depth.data[(4 + k) * WIDTH + 8 + x] = 1.0));
        let surfaces =
            [Surface::new(&image, &source, &map, None, 0.5), Surface::new(&image, &other, &clean, None, 0.5)];
        let warped = warp(&surfaces, &source);
        assert_eq!(warped.used.at(12, 8), 0.0);
        assert_eq!(warped.used.at(30, 8), 1.0);
    }

    #[test]
    fn virtual_views_surround_the_photos() {
        let cameras = [camera(-0.2), camera(0.2)];
        let (images, depths): (Vec<_>, Vec<_>) = cameras.iter().map(photo).unzip();
        let photos = Photos { images: &images, cameras: &cameras, depths: Some(&depths), coverage: &[] };
        let views = virtual_views(&photos, 6, 0.5, 3);
        assert_eq!((views.images.len(), views.cameras.len(), views.coverage.len()), (6, 6, 6));
        for (camera, coverage) in views.cameras.iter().zip(&views.coverage) {
            let used = &coverage.as_ref().unwrap().share;
            assert_eq!([used.width, used.height], [WIDTH / 2, HEIGHT / 2]);
            let share = used.data.iter().sum::<f32>() / used.data.len() as f32;
            assert!(share > 0.3, "{share}");
            let away = camera.pose.centre().distance(DVec3::ZERO);
            assert!(away > 0.1 && away < 2.0, "{away}");
        }
        let without = Photos { depths: None, ..photos };
        assert!(virtual_views(&without, 6, 0.5, 3).images.is_empty());
    }
}
