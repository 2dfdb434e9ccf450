//! Pixel maps of resizing, cropping and padding.
use super::Camera;
use serde::{Deserialize, Serialize};

/// Axis-aligned affine map of pixel positions, `u' = s·u + o` per axis
/// (docs/internals/method.md#pixel-maps).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Affine {
    /// Scale along x and y.
    pub scale: [f64; 2],
    /// Offset along x and y, pixels of the target.
    pub offset: [f64; 2],
}

impl Affine {
    /// Identity map.
    pub const IDENTITY: Affine = Affine { scale: [1.0; 2], offset: [0.0; 2] };

    /// The map of a resize between two sizes `(width, height)`. The scales come from the rounded
    /// sizes, so they may differ between the axes; the edges of the two images coincide.
    pub fn resize(from: (u32, u32), to: (u32, u32)) -> Affine {
        Affine { scale: [to.0 as f64 / from.0 as f64, to.1 as f64 / from.1 as f64], offset: [0.0; 2] }
    }
    /// The map of a crop whose first pixel is `(x, y)` of the source.
    pub fn crop(x: f64, y: f64) -> Affine {
        Affine { scale: [1.0; 2], offset: [-x, -y] }
    }
    /// Source → target position, both continuous (the centre of the first pixel is 0.5).
    pub fn apply(&self, p: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|k| self.scale[k] * p[k] + self.offset[k])
    }
    /// Target → source.
    pub fn inverse(&self) -> Affine {
        Affine {
            scale: [0, 1].map(|k| 1.0 / self.scale[k]),
            offset: [0, 1].map(|k| -self.offset[k] / self.scale[k]),
        }
    }
    /// `self` first, then `next`.
    pub fn then(&self, next: &Affine) -> Affine {
        Affine {
            scale: [0, 1].map(|k| next.scale[k] * self.scale[k]),
            offset: [0, 1].map(|k| next.scale[k] * self.offset[k] + next.offset[k]),
        }
    }
    /// Camera of the target image with `size` = (width, height); the pose is unchanged.
    pub fn camera(&self, source: &Camera, size: (u32, u32)) -> Camera {
        let [cx, cy] = self.apply([source.cx, source.cy]);
        Camera {
            name: source.name.clone(),
            width: size.0,
            height: size.1,
            fx: source.fx * self.scale[0],
            fy: source.fy * self.scale[1],
            cx,
            cy,
            pose: source.pose,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;
    use glam::{DVec2, DVec3};

    #[test]
    fn affine_inverse_restores_corners() {
        // An odd size, resized to rounded sizes, cropped, padded (negative crop).
        let map = Affine::resize((4031, 3025), (683, 512))
            .then(&Affine::crop(5.0, 0.0))
            .then(&Affine::crop(0.0, -8.0));
        for corner in [[0.0, 0.0], [4031.0, 0.0], [0.5, 3024.5], [1234.25, 777.75]] {
            let back = map.inverse().apply(map.apply(corner));
            assert!((back[0] - corner[0]).abs() < 1e-9 && (back[1] - corner[1]).abs() < 1e-9, "{back:?}");
        }
        assert_eq!(map.apply([4031.0, 3025.0]), [678.0, 520.0], "the far edge lands on the far edge");
    }

    #[test]
    fn mapped_camera_projects_to_mapped_pixel() {
        let camera = Camera {
            name: "a".into(),
            width: 4000,
            height: 3000,
            fx: 3100.0,
            fy: 3090.0,
            cx: 2010.0,
            cy: 1490.0,
            pose: Pose::exp(DVec3::new(0.1, 0.2, 0.3), DVec3::new(0.0, 0.1, 0.0)),
        };
        let map = Affine::resize((4000, 3000), (684, 513)).then(&Affine::crop(4.0, 1.0));
        let world = camera.unproject(DVec2::new(1000.0, 700.0), 2.5);
        let (seen, _) = map.camera(&camera, (676, 512)).project(world);
        let expected = map.apply([1000.0, 700.0]);
        assert!((seen - DVec2::from_array(expected)).length() < 1e-9);
    }
}
