//! Screen-space geometry of a splat in f32, as `glsl/shared/splat.glsl`, for the native passes.
use crate::gpu::shaders::shared::layout::TILE;
use crate::gpu::shaders::shared::splat::{DILATION, SMALLEST_AREA};
use crate::gpu::shaders::structs::CameraView;
use glam::{Mat3, Quat, Vec2, Vec3, Vec4};

/// Camera with its rows apart.
pub(super) struct Camera {
    /// Rows of R.
    rows: [Vec3; 3],
    pub translation: Vec3,
    pub position: Vec3,
    pub focal: Vec2,
    pub centre: Vec2,
    size: Vec2,
    /// Index of the last pixel of the last tile.
    pub far: Vec2,
    near: f32,
}

impl Camera {
    pub fn new(view: &CameraView) -> Camera {
        let rows = view.world_to_camera.map(|row| Vec3::new(row[0], row[1], row[2]));
        let translation = Vec3::from(view.world_to_camera.map(|row| row[3]));
        let mut camera = Camera {
            rows,
            translation,
            position: Vec3::ZERO,
            focal: view.focal.into(),
            centre: view.centre.into(),
            size: view.size.into(),
            far: (Vec2::from(view.size) / TILE as f32).ceil() * TILE as f32 - 1.0,
            near: view.near,
        };
        camera.position = -camera.to_world(translation);
        camera
    }

    pub fn to_camera(&self, v: Vec3) -> Vec3 {
        Vec3::from(self.rows.map(|row| row.dot(v)))
    }

    pub fn to_world(&self, v: Vec3) -> Vec3 {
        self.rows[0] * v.x + self.rows[1] * v.y + self.rows[2] * v.z
    }
}

/// Geometry of a splat on the screen; names as in the shader.
pub(super) struct Geometry {
    pub visible: bool,
    pub t: Vec3,
    pub quat: Quat,
    pub quat_length: f32,
    pub rotation: Mat3,
    pub scale: Vec3,
    pub clamped: Vec2,
    pub inside: [bool; 2],
    pub j: [Vec3; 2],
    pub tj: [Vec3; 2],
    pub b: [Vec3; 2],
    pub conic: Vec3,
    pub conic_det: f32,
    pub area: Vec3,
}

impl Geometry {
    pub fn of(camera: &Camera, mean: Vec3, log_scale: Vec3, raw_quat: Vec4) -> Geometry {
        let mut t = camera.to_camera(mean) + camera.translation;
        let visible = t.z > camera.near;
        if !visible {
            t.z = 1.0;
        }
        let quat_length = raw_quat.length();
        let unit = raw_quat / quat_length;
        let quat = Quat::from_xyzw(unit.y, unit.z, unit.w, unit.x);
        let rotation = Mat3::from_quat(quat);
        let scale = Vec3::new(log_scale.x.exp(), log_scale.y.exp(), log_scale.z.exp());
        let margin = 0.15 * camera.size;
        let low = -(camera.centre + margin) / camera.focal;
        let high = (camera.size - camera.centre + margin) / camera.focal;
        let inverse = 1.0 / t.z;
        let slope = t.truncate() * inverse;
        let limited = slope.clamp(low, high);
        let j = [
            Vec3::new(camera.focal.x * inverse, 0.0, -camera.focal.x * limited.x * inverse),
            Vec3::new(0.0, camera.focal.y * inverse, -camera.focal.y * limited.y * inverse),
        ];
        let tj = j.map(|j| camera.to_world(j));
        let b = tj.map(|t| rotation.transpose_mul_vec3(t) * scale);
        let area = b[0].cross(b[1]);
        let (xx, yy, xy) = (b[0].length_squared(), b[1].length_squared(), b[0].dot(b[1]));
        let dilation = DILATION as f32;
        let inverse_det = 1.0 / (area.length_squared() + dilation * (xx + yy) + dilation * dilation);
        Geometry {
            visible,
            t,
            quat,
            quat_length,
            rotation,
            scale,
            clamped: limited * t.z,
            inside: [slope.x == limited.x, slope.y == limited.y],
            j,
            tj,
            b,
            conic: Vec3::new(yy + dilation, -xy, xx + dilation) * inverse_det,
            conic_det: inverse_det,
            area,
        }
    }

    /// Square of the area, at least the smallest that counts.
    pub fn squared_area(&self) -> f32 {
        self.area.length_squared().max(SMALLEST_AREA as f32)
    }
}
