//! Large planes of the scene (tables, walls, floors) from the consistent points of all views, by
//! sequential RANSAC.
use super::Level;
use super::surface::{Surface, ray};
use crate::math::hash;
use crate::scene::Camera;
use glam::{DMat3, DVec3, Vec3};
use nalgebra::{Matrix3, SymmetricEigen};
use rayon::prelude::*;

/// `normal · X = offset` in world coordinates.
#[derive(Clone, Copy, Debug)]
pub struct WorldPlane {
    /// Unit normal.
    pub normal: DVec3,
    /// Distance from the origin, world units.
    pub offset: f64,
}

impl WorldPlane {
    /// The plane as `π·X = 1` in a camera's frame; `None` if it contains the camera centre.
    pub fn in_camera(&self, camera: &Camera) -> Option<Vec3> {
        let distance = self.offset - self.normal.dot(camera.pose.centre());
        (distance.abs() > 1e-9).then(|| (camera.pose.rotation * self.normal / distance).as_vec3())
    }
}

/// Largest distance of an inlier, relative to the depth tolerance of its view.
const TOLERANCE: f64 = 0.4;
/// Largest angle between the local normal of an inlier and the plane's, as a cosine (25°).
const NORMAL_TOLERANCE: f64 = 0.906;
/// Least share of all points on a large plane.
const SMALLEST_SHARE: f64 = 0.02;
/// Most planes looked for.
const MAX_PLANES: usize = 8;
/// Sampled points: the smallest plane has about 200 of them.
const SAMPLES: usize = 10_000;
/// Hypotheses per plane, each from one point and its normal: a plane with 2 % of the points is
/// missed with probability 0.98^300 < 0.3 %.
const TRIALS: u32 = 300;

struct Sample {
    position: DVec3,
    normal: DVec3,
    depth: f64,
    /// Depth tolerance, world units.
    tolerance: f64,
}

/// Planes by decreasing number of points. `surface` must be smoothed for accurate normals.
pub fn large_planes(level: &Level, surface: &Surface, seed: u32) -> Vec<WorldPlane> {
    let mut samples = gather(level, surface);
    let total = samples.len();
    let mut planes = Vec::new();
    let mut state = seed;
    while planes.len() < MAX_PLANES && samples.len() >= 100 {
        let mut draw = || {
            state = hash(state);
            let s = &samples[state as usize % samples.len()];
            WorldPlane { normal: s.normal, offset: s.normal.dot(s.position) }
        };
        let drawn: Vec<WorldPlane> = (0..TRIALS).map(|_| draw()).collect();
        let count = |plane: &WorldPlane| samples.iter().filter(|s| lies_on(plane, s)).count();
        let counts: Vec<usize> = drawn.par_iter().map(count).collect();
        // The first of the planes with the most points.
        let mut best = (0, WorldPlane { normal: DVec3::Z, offset: 0.0 });
        for (count, plane) in counts.into_iter().zip(drawn) {
            if count > best.0 {
                best = (count, plane);
            }
        }
        let mut plane = best.1;
        for _ in 0..4 {
            plane = refit(&plane, &samples);
        }
        let before = samples.len();
        samples.retain(|s| !lies_on(&plane, s));
        if ((before - samples.len()) as f64) < SMALLEST_SHARE * total as f64 {
            break;
        }
        planes.push(plane);
    }
    planes
}

fn lies_on(plane: &WorldPlane, s: &Sample) -> bool {
    (plane.normal.dot(s.position) - plane.offset).abs() < TOLERANCE * s.tolerance
        && plane.normal.dot(s.normal).abs() > NORMAL_TOLERANCE
}

fn gather(level: &Level, surface: &Surface) -> Vec<Sample> {
    let consistent = surface.confidence.iter().filter(|&&c| c > 0.0).count();
    let stride = (consistent / SAMPLES).max(1);
    let mut samples = Vec::new();
    let mut counter = 0;
    for (view, r) in level.references.iter().enumerate() {
        let to_world = level.cameras[view].pose.inverse();
        for k in 0..(r.width * r.height) as usize {
            let index = r.first as usize + k;
            if surface.confidence[index] <= 0.0 {
                continue;
            }
            counter += 1;
            if counter % stride != 0 {
                continue;
            }
            let ray = ray(level, view, k % r.width as usize, k / r.width as usize);
            let plane = surface.planes[index];
            let depth = 1.0 / plane.dot(ray);
            samples.push(Sample {
                position: to_world.transform((ray * depth).as_dvec3()),
                normal: (to_world.rotation * plane.as_dvec3()).normalize(),
                depth: depth as f64,
                tolerance: (level.tolerance[view] * depth) as f64,
            });
        }
    }
    samples
}

/// Total least squares over the inliers, weighted by 1/depth².
fn refit(plane: &WorldPlane, samples: &[Sample]) -> WorldPlane {
    let on: Vec<&Sample> = samples.iter().filter(|s| lies_on(plane, s)).collect();
    if on.len() < 10 {
        return *plane;
    }
    let weight: f64 = on.iter().map(|s| s.depth.powi(-2)).sum();
    let mean = on.iter().map(|s| s.position * s.depth.powi(-2)).sum::<DVec3>() / weight;
    let mut scatter = DMat3::ZERO;
    for s in on {
        let d = (s.position - mean) / s.depth;
        scatter += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let eigen = SymmetricEigen::new(Matrix3::from_column_slice(&scatter.to_cols_array()));
    let smallest = eigen.eigenvalues.imin();
    let v = eigen.eigenvectors.column(smallest);
    let normal = DVec3::new(v[0], v[1], v[2]);
    WorldPlane { normal, offset: normal.dot(mean) }
}
