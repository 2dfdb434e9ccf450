//! The camera as the passes see it: a twin form in f64 and the 24 floats that the shaders read.
use crate::scene::Camera;
use glam::{DMat3, DVec3};

/// Number of floats of [`View::to_gpu`] (`glsl/shared/camera.glsl`).
pub const VIEW_FLOATS: usize = 24;

/// A pinhole view plus what rasterisation needs to know beside the camera.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// R, world → camera.
    pub rotation: DMat3,
    /// τ, world units.
    pub translation: DVec3,
    /// Focal lengths, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels, centre of the first pixel at 0.5.
    pub centre: [f64; 2],
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Splats with camera z ≤ near are dropped. World units; 0.01 × the scene's median depth is a good value
    /// (docs/method.md#projection), because scenes are not metric and may have close points.
    pub near: f64,
    /// RGB behind everything.
    pub background: [f64; 3],
}

impl View {
    /// A view of a camera on black.
    pub fn new(camera: &Camera, near: f64) -> View {
        View {
            rotation: camera.pose.rotation,
            translation: camera.pose.translation,
            focal: [camera.fx, camera.fy],
            centre: [camera.cx, camera.cy],
            size: [camera.width, camera.height],
            near,
            background: [0.0; 3],
        }
    }

    /// The same view on another background colour.
    pub fn with_background(mut self, background: [f64; 3]) -> View {
        self.background = background;
        self
    }

    /// Largest |t_x/t_z|, |t_y/t_z| that the Jacobian of the projection is evaluated at, towards negative and
    /// positive coordinates: the image border plus 30 % of the half width. The general form of gsplat; for a
    /// centred principal point it equals the 1.3·tan(fov/2) of Kerbl et al. 2023.
    pub fn jacobian_limits(&self) -> ([f64; 2], [f64; 2]) {
        let limit =
            |axis: usize, to_border: f64| (to_border + 0.15 * f64::from(self.size[axis])) / self.focal[axis];
        let negative = [limit(0, self.centre[0]), limit(1, self.centre[1])];
        let positive = [
            limit(0, f64::from(self.size[0]) - self.centre[0]),
            limit(1, f64::from(self.size[1]) - self.centre[1]),
        ];
        (negative, positive)
    }

    /// Camera centre in world coordinates, C = −Rᵀτ.
    pub fn position(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// The layout of `glsl/shared/camera.glsl`: three rows (R | τ), then (fx, fy, cx, cy), (W, H, near, 0) and
    /// (background, 0).
    pub fn to_gpu(&self) -> [f32; VIEW_FLOATS] {
        let mut out = [0.0; VIEW_FLOATS];
        for row in 0..3 {
            let r = self.rotation.row(row);
            out[row * 4..row * 4 + 4].copy_from_slice(&[
                r.x as f32,
                r.y as f32,
                r.z as f32,
                self.translation[row] as f32,
            ]);
        }
        for axis in 0..2 {
            out[12 + axis] = self.focal[axis] as f32;
            out[14 + axis] = self.centre[axis] as f32;
            out[16 + axis] = self.size[axis] as f32;
        }
        out[18] = self.near as f32;
        for channel in 0..3 {
            out[20 + channel] = self.background[channel] as f32;
        }
        out
    }
}
