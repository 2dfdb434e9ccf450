//! Solids that a ray can hit, their colours and names.
use glam::{DVec2, DVec3};
use splatvk::math::Random;

/// A solid, metres, +z up.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Shape {
    /// Centre and radius.
    Ball(DVec3, f64),
    /// Centre, half sizes, turn about +z in radians.
    Block(DVec3, DVec3, f64),
    /// Middle of the base, radius, height; the axis is +z.
    Can(DVec3, f64, f64),
    /// The plane n·x = offset, n a unit vector.
    Plane(DVec3, f64),
}

/// Intersection of a ray with a solid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Ray parameter.
    pub t: f64,
    /// Unit normal, outwards.
    pub normal: DVec3,
    /// Position in the solid's own coordinates, metres, at which its paint is evaluated.
    pub place: DVec3,
}

/// Smallest ray parameter of a hit; smaller ones are the start of the ray itself.
const NEAR: f64 = 1e-6;

impl Shape {
    /// First hit of a ray that starts outside.
    pub fn hit(&self, from: DVec3, ray: DVec3) -> Option<Hit> {
        match *self {
            Shape::Ball(centre, radius) => {
                let o = from - centre;
                let (a, b, c) = (ray.length_squared(), o.dot(ray), o.length_squared() - radius * radius);
                let t = (-b - (b * b - a * c).sqrt()) / a;
                let place = o + ray * t;
                (t > NEAR).then(|| Hit { t, normal: place / radius, place })
            }
            Shape::Block(centre, half, turn) => {
                let (o, d) = (rotated(from - centre, -turn), rotated(ray, -turn));
                let (a, b) = ((-half - o) / d, (half - o) / d);
                let (enter, leave) = (a.min(b), a.max(b));
                let t = enter.max_element();
                if t <= NEAR || t > leave.min_element() {
                    return None;
                }
                let axis = if enter.x >= t {
                    DVec3::X
                } else if enter.y >= t {
                    DVec3::Y
                } else {
                    DVec3::Z
                };
                Some(Hit { t, normal: rotated(-axis * d.signum(), turn), place: o + d * t })
            }
            Shape::Can(base, radius, height) => can(from - base, ray, radius, height),
            Shape::Plane(n, offset) => {
                let t = (offset - n.dot(from)) / n.dot(ray);
                (t > NEAR && t.is_finite()).then(|| Hit {
                    t,
                    normal: -n * n.dot(ray).signum(),
                    place: from + ray * t,
                })
            }
        }
    }
}

/// Rotates a vector about +z by an angle in radians.
fn rotated(v: DVec3, angle: f64) -> DVec3 {
    let (s, c) = angle.sin_cos();
    DVec3::new(c * v.x - s * v.y, s * v.x + c * v.y, v.z)
}

/// First hit of the ray o + t d with a cylinder on the origin, axis +z.
fn can(o: DVec3, d: DVec3, radius: f64, height: f64) -> Option<Hit> {
    let (o2, d2) = (DVec2::new(o.x, o.y), DVec2::new(d.x, d.y));
    let (a, b, c) = (d2.length_squared(), o2.dot(d2), o2.length_squared() - radius * radius);
    let side = (-b - (b * b - a * c).sqrt()) / a;
    let point = |t: f64| o + d * t;
    if side > NEAR && (0.0..=height).contains(&point(side).z) {
        let p = point(side);
        return Some(Hit { t: side, normal: DVec3::new(p.x, p.y, 0.0) / radius, place: p });
    }
    let (level, normal) = if d.z < 0.0 { (height, DVec3::Z) } else { (0.0, -DVec3::Z) };
    let t = (level - o.z) / d.z;
    let p = point(t);
    (t > NEAR && DVec2::new(p.x, p.y).length() <= radius).then_some(Hit { t, normal, place: p })
}

/// Colour and pattern of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Paint {
    /// Mean sRGB colour in [0, 1].
    pub colour: [f64; 3],
    /// Contrast of the pattern, 0 = plain.
    pub contrast: f64,
    /// Side of the pattern's largest blocks, metres.
    pub grain: f64,
    /// Seed of the pattern.
    pub seed: u64,
    /// Period of the pattern, metres; `None`: it does not repeat.
    pub tile: Option<f64>,
}

/// An object with its phrase.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneObject {
    /// Index in the masks.
    pub label: u32,
    /// Text that names it.
    pub phrase: String,
    /// Solid.
    pub shape: Shape,
    /// Surface.
    pub paint: Paint,
}

/// A surface with a new pattern.
pub(super) fn paint(colour: [f64; 3], contrast: f64, grain: f64, random: &mut Random) -> Paint {
    Paint { colour, contrast, grain, seed: random.bits(), tile: None }
}

/// Pseudo-random number in [−1, 1] of the unit cell that contains `p`.
fn cell(p: DVec3, seed: u64) -> f64 {
    let q = p.floor();
    let mut h = seed ^ 0x9e37_79b9_7f4a_7c15;
    for v in [q.x, q.y, q.z] {
        h = (h ^ (v as i64 as u64)).wrapping_mul(0xff51_afd7_ed55_8ccd);
        h ^= h >> 32;
    }
    // After the last product the upper bits of neighbours are nearly equal; one more mixes them.
    h = h.wrapping_mul(0xc4ce_b9fe_1a85_ec53);
    h ^= h >> 32;
    (h >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// Smooth interpolation of the numbers of the eight nearest cells.
fn interpolated_cells(p: DVec3, seed: u64) -> f64 {
    let low = p.floor();
    let t = p - low;
    let t = t * t * (3.0 - 2.0 * t);
    let corner = |k: u32| {
        let side = DVec3::new(f64::from(k & 1), f64::from(k >> 1 & 1), f64::from(k >> 2));
        let share = side * t + (1.0 - side) * (1.0 - t);
        share.x * share.y * share.z * cell(low + side, seed)
    };
    (0..8).map(corner).sum()
}

impl Paint {
    /// sRGB colour at a position: blocks of three sizes, so that corners can be matched at any
    /// distance.
    pub fn at(&self, place: DVec3) -> [f64; 3] {
        // Faces of solids lie on cell borders; the offset keeps rounding from drawing noise there.
        let p = place + DVec3::new(0.000_31, 0.000_17, 0.000_23);
        let p = self.tile.map_or(p, |side| p.map(|v| v.rem_euclid(side)));
        self.with_pattern(p, cell)
    }

    /// sRGB colour at a position, with soft edges as clouds have.
    pub fn smooth(&self, place: DVec3) -> [f64; 3] {
        self.with_pattern(place, interpolated_cells)
    }

    /// Mean colour modulated by the sum of a pattern at three sizes.
    fn with_pattern(&self, place: DVec3, pattern: impl Fn(DVec3, u64) -> f64) -> [f64; 3] {
        let sum: f64 = [(1.0, 0.5), (0.37, 0.3), (0.13, 0.2)]
            .into_iter()
            .enumerate()
            .map(|(k, (size, weight))| {
                weight * pattern(place / (self.grain * size), self.seed.wrapping_add(k as u64))
            })
            .sum();
        self.colour.map(|c| (c * (1.0 + self.contrast * sum)).clamp(0.0, 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cell_is_independent_of_neighbours() {
        // The mean difference of two independent numbers in [−1, 1] is 2/3.
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let corner = |i: i32| DVec3::new(f64::from(i % 9), f64::from(i / 9 % 9), f64::from(i / 81));
            let differences = (0..729).map(|i| (cell(corner(i), 1005) - cell(corner(i) + axis, 1005)).abs());
            let mean = differences.sum::<f64>() / 729.0;
            assert!((mean - 2.0 / 3.0).abs() < 0.06, "{axis} {mean}");
        }
    }

    /// Whether a point lies inside or on the solid, by its definition.
    fn contains(shape: &Shape, p: DVec3) -> bool {
        match *shape {
            Shape::Ball(c, r) => (p - c).length() <= r,
            Shape::Block(c, h, turn) => {
                let q = rotated(p - c, -turn).abs();
                q.x <= h.x && q.y <= h.y && q.z <= h.z
            }
            Shape::Can(b, r, h) => {
                let q = p - b;
                DVec2::new(q.x, q.y).length() <= r && (0.0..=h).contains(&q.z)
            }
            Shape::Plane(n, o) => n.dot(p) <= o,
        }
    }

    #[test]
    fn hit_matches_ray_marching() {
        let shapes = [
            Shape::Ball(DVec3::new(0.1, 0.2, 0.3), 0.25),
            Shape::Block(DVec3::new(-0.1, 0.1, 0.2), DVec3::new(0.3, 0.1, 0.2), 0.7),
            Shape::Can(DVec3::new(0.05, -0.1, 0.0), 0.2, 0.4),
            Shape::Plane(DVec3::new(0.0, 0.6, 0.8), 0.1),
        ];
        let mut random = Random::new(1000);
        let mut hits = 0;
        for shape in &shapes {
            for _ in 0..300 {
                let mut draw = || random.uniform() - 0.5;
                let from = DVec3::new(draw(), draw(), draw()).normalize() * 2.0;
                let ray = (DVec3::new(draw(), draw(), draw()) * 0.8 - from).normalize();
                if contains(shape, from) {
                    continue;
                }
                let step = 1e-3;
                let marched = (0..5000).map(|k| k as f64 * step).find(|t| contains(shape, from + ray * *t));
                let hit = shape.hit(from, ray).filter(|h| h.t < 4.9);
                match (marched, hit) {
                    (Some(t), Some(h)) => {
                        assert!(h.t <= t + 1e-9 && h.t > t - step - 1e-9, "{shape:?}: {t} {h:?}");
                        assert!((h.normal.length() - 1.0).abs() < 1e-9 && h.normal.dot(ray) < 1e-9);
                        hits += 1;
                    }
                    (None, None) => {}
                    // Marching skips corners thinner than a step.
                    (None, Some(h)) => {
                        assert!(!contains(shape, from + ray * (h.t + 2.0 * step)), "{shape:?} {h:?}")
                    }
                    (Some(t), None) => panic!("{shape:?}: marching hits at {t}"),
                }
            }
        }
        assert!(hits > 300, "{hits}");
    }
}
