//! Posed depth maps, and what of them is a surface.
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use splatvk_types::scene::{Camera, Image, RgbImage, to_linear};

/// A view with depth.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its camera; all maps have its size.
    pub camera: Camera,
    /// [H, W] camera z, world units; 0 = unknown.
    pub depth: Image<f32>,
    /// [H, W] in 0..1: share of the pixel that is an observed surface. Pixels below ½ are not
    /// used.
    pub weight: Image<f32>,
    /// [H, W] RGB, sRGB values in [0, 1].
    pub colour: RgbImage,
    /// Weight of its colours relative to those of other frames.
    pub colour_weight: f32,
    /// [H, W] label of each pixel, 0 = none.
    pub labels: Option<Image<u32>>,
}

/// Pixels to each side over which a plane is fitted.
const REACH: usize = 2;
/// Largest root mean square distance from the plane, as a share of depth, of one surface: rendered
/// depth runs over edges in ramps of a few pixels.
const BENT: f32 = 0.008;
/// Least cosine between normal and ray: what is seen flatter is noise, or the ramp at an edge.
const FLATTEST: f32 = 0.2;

/// A pixel that shows a surface.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Surfel {
    /// Camera z of the fitted plane; 0 = not used.
    pub depth: f32,
    /// Unit normal towards the camera, camera axes.
    pub normal: Vec3,
    /// Cosine between the normal and the ray, times the weight of the pixel.
    pub weight: f32,
}

/// A frame that is prepared for integration.
pub(crate) struct Prepared<'a> {
    pub frame: &'a Frame,
    pub surfels: Vec<Surfel>,
    rotation: glam::Mat3,
    translation: Vec3,
    focal: [f32; 2],
    centre: [f32; 2],
}

impl<'a> Prepared<'a> {
    pub fn new(frame: &'a Frame) -> Prepared<'a> {
        let c = &frame.camera;
        let prepared = Prepared {
            frame,
            surfels: Vec::new(),
            rotation: c.pose.rotation.as_mat3(),
            translation: c.pose.translation.as_vec3(),
            focal: [c.fx as f32, c.fy as f32],
            centre: [c.cx as f32, c.cy as f32],
        };
        let surfels = surfels(frame, &prepared);
        Prepared { surfels, ..prepared }
    }

    /// Camera coordinates of a world point.
    pub fn local(&self, point: Vec3) -> Vec3 {
        self.rotation * point + self.translation
    }

    /// World coordinates of a point in camera coordinates.
    pub fn world(&self, point: Vec3) -> DVec3 {
        self.frame.camera.pose.inverse().transform(point.as_dvec3())
    }

    /// Index of the pixel that shows a point in camera coordinates.
    pub fn pixel(&self, local: Vec3) -> Option<usize> {
        if local.z <= 0.0 {
            return None;
        }
        let x = self.focal[0] * local.x / local.z + self.centre[0];
        let y = self.focal[1] * local.y / local.z + self.centre[1];
        let (w, h) = (self.frame.depth.width, self.frame.depth.height);
        let inside = x >= 0.0 && y >= 0.0 && x < w as f32 && y < h as f32;
        inside.then(|| y as usize * w + x as usize)
    }

    /// Ray with z = 1 through the centre of a pixel, camera coordinates.
    pub fn ray(&self, pixel: usize) -> Vec3 {
        let (x, y) = (pixel % self.frame.depth.width, pixel / self.frame.depth.width);
        self.ray_at(x, y)
    }

    fn ray_at(&self, x: usize, y: usize) -> Vec3 {
        let at = |v: usize, k: usize| (v as f32 + 0.5 - self.centre[k]) / self.focal[k];
        Vec3::new(at(x, 0), at(y, 1), 1.0)
    }

    /// Distance between neighbouring pixels at a depth.
    pub fn footprint(&self, depth: f32) -> f32 {
        depth / self.focal[0].min(self.focal[1])
    }

    /// Linear colour of a pixel.
    pub fn colour(&self, pixel: usize) -> Vec3 {
        Vec3::from_array(self.frame.colour.data[pixel].map(|v| to_linear(v.clamp(0.0, 1.0))))
    }

    /// Label of a pixel, 0 = none.
    pub fn label(&self, pixel: usize) -> u32 {
        self.frame.labels.as_ref().map_or(0, |labels| labels.data[pixel])
    }
}

fn surfels(frame: &Frame, view: &Prepared) -> Vec<Surfel> {
    let (w, h) = (frame.depth.width, frame.depth.height);
    let row = |y: usize| (0..w).map(move |x| surfel(frame, view, x, y).unwrap_or_default());
    (0..h).into_par_iter().flat_map_iter(row).collect()
}

/// Fits a plane to the depth around a pixel; `None` without weight, and where depth there is not
/// that of one surface.
fn surfel(frame: &Frame, view: &Prepared, x: usize, y: usize) -> Option<Surfel> {
    let weight = frame.weight.at(x, y);
    if weight < 0.5 {
        return None;
    }
    let [inverse, across, along] = plane(&frame.depth, x, y)?;
    let (dx, dy) = (x as f32 + 0.5 - view.centre[0], y as f32 + 0.5 - view.centre[1]);
    // Points p of the plane have n·p = 1.
    let n = Vec3::new(view.focal[0] * across, view.focal[1] * along, inverse - across * dx - along * dy);
    let normal = -n.try_normalize()?;
    let cosine = -normal.dot(view.ray_at(x, y).normalize());
    (cosine > FLATTEST).then(|| Surfel { depth: 1.0 / inverse, normal, weight: cosine * weight })
}

/// Inverse depth of the plane through the depth around a pixel, at the pixel and its changes per
/// pixel to the right and downwards. Inverse depth of a plane is linear in the pixel.
fn plane(depth: &Image<f32>, x: usize, y: usize) -> Option<[f32; 3]> {
    let room = x.min(y).min(depth.width - 1 - x).min(depth.height - 1 - y);
    let r = REACH.min(room);
    if r == 0 {
        return None;
    }
    let side = (2 * r + 1) as f32;
    let offset = |i: usize| i as f32 - r as f32;
    let (mut sum, mut across, mut along, mut squares) = (0.0, 0.0, 0.0, 0.0);
    let own = 1.0 / depth.at(x, y);
    for (j, i) in (0..=2 * r).flat_map(|j| (0..=2 * r).map(move |i| (j, i))) {
        let z = depth.at(x + i - r, y + j - r);
        if z <= 0.0 {
            return None;
        }
        let v = 1.0 / z - own;
        sum += v;
        across += offset(i) * v;
        along += offset(j) * v;
        squares += v * v;
    }
    let count = side * side;
    // Sum of the squares of either offset over the window.
    let spread = count * (side * side - 1.0) / 12.0;
    let (mean, across, along) = (sum / count, across / spread, along / spread);
    let left = squares - count * mean * mean - spread * (across * across + along * along);
    let inverse = own + mean;
    ((left / count).max(0.0).sqrt() < BENT * inverse).then_some([inverse, across, along])
}
