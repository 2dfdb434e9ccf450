//! The sphere on which stereo places the sky.
use super::{Camera, DepthMap};
use glam::{DVec2, DVec3};

/// Everything but sky is nearer than this share of the sky's distance, with a margin; stereo keeps
/// two thirds.
const NEARER: f64 = 0.75;

/// A sphere around the cameras, far behind all surfaces.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sky {
    centre: DVec3,
    /// Scene units.
    pub radius: f64,
}

impl Sky {
    /// The sphere of the farthest depth, if nothing is between it and three quarters of its
    /// distance: surfaces reach into the distance without such a gap.
    pub fn of(cameras: &[Camera], depths: &[DepthMap]) -> Option<Sky> {
        let centre = cameras.iter().map(|c| c.pose.centre()).sum::<DVec3>() / cameras.len().max(1) as f64;
        let distances: Vec<f64> = cameras
            .iter()
            .zip(depths)
            .flat_map(|(camera, map)| {
                let known = (0..map.depth.data.len()).step_by(7).filter(|i| map.depth.data[*i] > 0.0);
                known.map(move |i| {
                    let (x, y) = (i % map.depth.width, i / map.depth.width);
                    let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    camera.unproject(pixel, f64::from(map.depth.data[i])).distance(centre)
                })
            })
            .collect();
        let radius = distances.iter().copied().reduce(f64::max)?;
        let on_sphere = distances.iter().filter(|d| **d > 0.99 * radius).count();
        let between = distances.iter().filter(|d| (NEARER * radius..0.99 * radius).contains(*d)).count();
        (between == 0 && 200 * on_sphere > distances.len()).then_some(Sky { centre, radius })
    }

    /// Whether a point is a part of the sky.
    pub fn contains(&self, point: DVec3) -> bool {
        point.distance(self.centre) >= NEARER * self.radius
    }
}
