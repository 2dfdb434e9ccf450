//! Directions over the sphere.
use glam::DVec3;

/// `count` unit vectors evenly over the sphere: a Fibonacci lattice.
pub fn sphere_directions(count: usize) -> impl Iterator<Item = DVec3> {
    (0..count).map(move |k| {
        let z = 1.0 - (2 * k + 1) as f64 / count as f64;
        // The golden angle, radians.
        let (sin, cos) = (k as f64 * 2.399_963_229_728_653).sin_cos();
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * cos, r * sin, z)
    })
}
