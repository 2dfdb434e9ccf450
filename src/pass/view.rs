//! Camera of the passes: in f64 for the references, and as the structure that the shaders read.
use crate::gpu::shaders::structs::CameraView;
use crate::scene::Camera;
use glam::{DMat3, DVec3};

/// Pinhole camera with the near plane and background of a render.
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
    /// Splats with camera z ≤ near are culled. World units; 0.01 × the median depth of the scene is
    /// a good value (docs/internals/method.md#projection), because scenes are not metric and may
    /// have close points.
    pub near: f64,
    /// RGB of the background.
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

    /// Limits of |t_x/t_z|, |t_y/t_z| in the Jacobian of the projection, towards negative and
    /// positive coordinates: the image border plus 30 % of the half width. The general form of
    /// gsplat; for a centred principal point it equals the 1.3·tan(fov/2) of Kerbl et al. 2023.
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

    /// Structure that the shaders read.
    pub fn to_gpu(&self) -> CameraView {
        let narrow = |v: [f64; 2]| v.map(|x| x as f32);
        let row = |row: usize| {
            let r = self.rotation.row(row);
            [r.x as f32, r.y as f32, r.z as f32, self.translation[row] as f32]
        };
        CameraView {
            world_to_camera: [0, 1, 2].map(row),
            focal: narrow(self.focal),
            centre: narrow(self.centre),
            size: self.size.map(|s| s as f32),
            near: self.near as f32,
            background: self.background.map(|c| c as f32),
            ..CameraView::default()
        }
    }
}
