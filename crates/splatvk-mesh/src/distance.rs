//! Distances between points and meshes.
use glam::DVec3;
use parry3d::math::Vector;
use parry3d::query::{PointQuery, Ray, RayCast};
use parry3d::shape::TriMesh;
use rayon::prelude::*;
use splatvk_types::scene::Mesh;

/// A mesh that finds the nearest point of its surface.
pub struct Nearest(TriMesh);

impl Nearest {
    /// Prepares triangles; `None` without any.
    pub fn new(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Option<Nearest> {
        let points = positions.iter().map(|p| Vector::from_array(*p)).collect();
        TriMesh::new(points, triangles.to_vec()).ok().map(Nearest)
    }

    /// Distance of every point to the surface, world units.
    pub fn distances(&self, points: &[[f32; 3]]) -> Vec<f32> {
        let distance = |p: &[f32; 3]| self.0.distance_to_local_point(Vector::from_array(*p), false);
        points.par_iter().map(distance).collect()
    }

    /// Whether the way from `eye` to a point meets no surface but near its end: within `share` of
    /// the way.
    pub fn is_free(&self, eye: DVec3, point: DVec3, share: f64) -> bool {
        let ray = Ray::new(vector(eye), vector(point - eye));
        self.0.cast_local_ray(&ray, 1.0 - share as f32, false).is_none()
    }
}

fn vector(v: DVec3) -> Vector {
    Vector::from_array(v.as_vec3().to_array())
}

/// About `count` points spread evenly over the surface of a mesh, always the same ones.
pub fn samples(mesh: &Mesh, count: usize) -> Vec<[f32; 3]> {
    let corners = |t: usize| mesh.corners(t).map(glam::Vec3::from_array);
    let area = |t: usize| {
        let [a, b, c] = corners(t);
        f64::from((b - a).cross(c - a).length()) / 2.0
    };
    let total: f64 = (0..mesh.triangles.len()).map(area).sum();
    let (mut out, mut due) = (Vec::new(), 0.5);
    for t in 0..mesh.triangles.len() {
        due += area(t) / total * count as f64;
        let [a, b, c] = corners(t);
        while due >= 1.0 {
            due -= 1.0;
            let (u, v) = plastic(out.len());
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            out.push((a + (b - a) * u + (c - a) * v).to_array());
        }
    }
    out
}

/// Points of the additive sequence with the least discrepancy in two dimensions.
fn plastic(i: usize) -> (f32, f32) {
    const STEP: f64 = 0.754_877_666_246_692_8;
    let at = |step: f64| ((0.5 + step * i as f64) % 1.0) as f32;
    (at(STEP), at(STEP * STEP))
}
