//! Convex shapes for physics engines.
use parry3d::math::Vector;
use parry3d::transformation::try_convex_hull;
use parry3d::transformation::vhacd::{VHACD, VHACDParameters};
use splatvk_types::scene::{Hull, Mesh};

/// Shapes of a part for physics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Collider {
    /// The convex hull.
    Hull,
    /// Convex pieces that follow the shape (V-HACD).
    Decomposition,
}

/// Most pieces of a decomposition.
const MOST_PIECES: u32 = 16;

impl Collider {
    /// The shapes of a mesh; empty where it has no volume.
    pub fn shapes(self, mesh: &Mesh) -> Vec<Hull> {
        let points: Vec<Vector> = mesh.positions.iter().map(|p| Vector::from_array(*p)).collect();
        let whole = try_convex_hull(&points).ok().map(hull).into_iter().collect();
        match self {
            Collider::Hull => whole,
            Collider::Decomposition if whole.is_empty() => whole,
            Collider::Decomposition => decomposed(&points, &mesh.triangles),
        }
    }
}

fn decomposed(points: &[Vector], triangles: &[[u32; 3]]) -> Vec<Hull> {
    let parameters = VHACDParameters { max_convex_hulls: MOST_PIECES, ..VHACDParameters::default() };
    let pieces = VHACD::decompose(&parameters, points, triangles, false);
    let mut hulls: Vec<Hull> = pieces.compute_convex_hulls(1).into_iter().map(hull).collect();
    hulls.retain(|hull| hull.triangles.len() >= 4);
    include(&mut hulls, points);
    hulls
}

/// Widens hulls until every point is in one: V-HACD leaves out places where its cuts meet. A point
/// goes to the hull that it is nearest to.
fn include(hulls: &mut [Hull], points: &[Vector]) {
    let mut missing: Vec<Vec<Vector>> = hulls.iter().map(points_of).collect();
    let own: Vec<usize> = missing.iter().map(Vec::len).collect();
    for point in points {
        let outside = |hull: &Hull| beyond(hull, *point);
        let nearest = hulls.iter().map(outside).enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((k, distance)) = nearest
            && distance > 0.0
        {
            missing[k].push(*point);
        }
    }
    for ((hull_of, points), own) in hulls.iter_mut().zip(missing).zip(own) {
        if points.len() > own
            && let Ok(wider) = try_convex_hull(&points)
        {
            *hull_of = hull(wider);
        }
    }
}

fn points_of(hull: &Hull) -> Vec<Vector> {
    hull.positions.iter().map(|p| Vector::from_array(*p)).collect()
}

/// Distance of a point beyond the farthest of the faces of a hull; ≤ 0 inside.
fn beyond(hull: &Hull, point: Vector) -> f32 {
    let face = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| Vector::from_array(hull.positions[v as usize]));
        (b - a).cross(c - a).normalize_or_zero().dot(point - a)
    };
    hull.triangles.iter().map(face).fold(f32::MIN, f32::max)
}

fn hull((points, triangles): (Vec<Vector>, Vec<[u32; 3]>)) -> Hull {
    Hull { positions: points.iter().map(|p| p.to_array()).collect(), triangles }
}
