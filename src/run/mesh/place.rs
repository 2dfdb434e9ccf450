//! Where a mesh stands outside of its scene: upright, in metres, on the ground.
use crate::scene::{Mesh, Similarity, UpAxis, World};
use glam::{DMat3, DVec3, Vec3};

/// A placement, and what is known of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Scene → file.
    pub by: Similarity,
    /// Whether y points up: the scene's direction up is known.
    pub upright: bool,
    /// Whether a unit is a metre: the scene's scale is known.
    pub metric: bool,
}

/// Share of the vertices beyond each side of the box that the mesh is centred by.
const OUTLIERS: f64 = 0.005;

impl Placement {
    /// The scene's own axes: right, down, forward, or with `y_up` right, up, back.
    pub fn own(y_up: bool) -> Placement {
        let rotation = if y_up { turned() } else { DMat3::IDENTITY };
        let by = Similarity { scale: 1.0, rotation, translation: DVec3::ZERO };
        Placement { by, upright: false, metric: false }
    }

    /// Right, up, back, as far as the world is known; the origin lies below the middle of the mesh
    /// on the height of its lowest places.
    pub fn standing(mesh: &Mesh, world: &World) -> Placement {
        let rotation = world.up.as_ref().map_or_else(turned, |up| up.levelled(UpAxis::PlusY));
        let scale = world.scale.as_ref().map_or(1.0, |s| s.metres_per_unit);
        let by = Similarity { scale, rotation, translation: DVec3::ZERO };
        let points: Vec<DVec3> =
            mesh.positions.iter().map(|p| by.transform(Vec3::from_array(*p).as_dvec3())).collect();
        let range = |k: usize| {
            let mut values: Vec<f64> = points.iter().map(|p| p[k]).collect();
            values.sort_by(f64::total_cmp);
            let at = (OUTLIERS * values.len() as f64) as usize;
            match values.get(at).zip(values.get((values.len().max(1) - 1).saturating_sub(at))) {
                Some((low, high)) => (*low, *high),
                None => (0.0, 0.0),
            }
        };
        let [x, y, z] = [0, 1, 2].map(range);
        let ground = DVec3::new((x.0 + x.1) / 2.0, y.0, (z.0 + z.1) / 2.0);
        Placement {
            by: Similarity { translation: -ground, ..by },
            upright: world.up.is_some(),
            metric: world.scale.is_some(),
        }
    }
}

/// Rotation from right, down, forward to right, up, back.
fn turned() -> DMat3 {
    DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0))
}

/// A mesh without colliders in the axes of a placement.
pub fn placed(mesh: &Mesh, by: &Similarity) -> Mesh {
    let point = |p: &[f32; 3]| by.transform(Vec3::from_array(*p).as_dvec3()).as_vec3().to_array();
    let normal = |n: &[f32; 3]| (by.rotation * Vec3::from_array(*n).as_dvec3()).as_vec3().to_array();
    Mesh {
        positions: mesh.positions.iter().map(point).collect(),
        normals: mesh.normals.iter().map(normal).collect(),
        ..mesh.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Scale, Up};

    #[test]
    fn mesh_stands_on_the_ground_in_metres() {
        let up = DVec3::new(0.3, -0.8, 0.1).normalize();
        let side = up.any_orthonormal_vector();
        let ahead = up.cross(side);
        // A plate of 2 × 1 units that is 0.5 units thick, anywhere.
        let corner = |i: i32| {
            let at = |bit: i32, length: f64| f64::from(i >> bit & 1) * length;
            DVec3::new(5.0, -2.0, 9.0) + side * at(0, 2.0) + ahead * at(1, 1.0) + up * at(2, 0.5)
        };
        let positions = (0..8).map(|i| corner(i).as_vec3().to_array()).collect();
        let normals = vec![up.as_vec3().to_array(); 8];
        let mesh = Mesh { positions, normals, ..Mesh::default() };
        let world = World {
            up: Some(Up { direction: up, sigma_degrees: 1.0, evidence: Vec::new() }),
            scale: Some(Scale { metres_per_unit: 0.1, log_sigma: 0.0, stated: Vec::new() }),
        };
        let placement = Placement::standing(&mesh, &world);
        assert!(placement.upright && placement.metric);
        let stood = placed(&mesh, &placement.by);
        let (low, high) = stood.extent().unwrap();
        assert!(low[1].abs() < 1e-5 && (high[1] - 0.05).abs() < 1e-5, "{low:?} {high:?}");
        assert!((low[0] + high[0]).abs() < 1e-5 && (low[2] + high[2]).abs() < 1e-5);
        assert!((stood.normals[0][1] - 1.0).abs() < 1e-5);
        let plain = Placement::standing(&mesh, &World::default());
        assert!(!plain.upright && !plain.metric && plain.by.scale == 1.0);
        assert_eq!(placed(&mesh, &Placement::own(false).by), mesh);
    }
}
