//! Triangle meshes with coloured vertices and named parts.
use std::ops::Range;

/// An indexed triangle mesh; the vertex arrays have the same length V.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// [V, 3] world units.
    pub positions: Vec<[f32; 3]>,
    /// [V, 3] unit normals; outwards where the triangles are seen counter-clockwise.
    pub normals: Vec<[f32; 3]>,
    /// [V, 3] linear RGB in [0, 1].
    pub colours: Vec<[f32; 3]>,
    /// [T, 3] vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Named parts. Together they have every triangle once, in order, and no vertex is in two of
    /// them.
    pub parts: Vec<MeshPart>,
}

/// A named part of a mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeshPart {
    /// Name, as in the files.
    pub name: String,
    /// Rows of [`Mesh::triangles`].
    pub triangles: Range<usize>,
    /// Convex shapes for physics; empty without.
    pub colliders: Vec<Hull>,
}

/// A closed convex shape.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Hull {
    /// [V, 3] world units.
    pub positions: Vec<[f32; 3]>,
    /// [T, 3] vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Whether there are no triangles.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// Corners of a triangle.
    pub fn corners(&self, triangle: usize) -> [[f32; 3]; 3] {
        self.triangles[triangle].map(|v| self.positions[v as usize])
    }

    /// A part with vertices of its own: its triangles count from 0. A vertex of another part is
    /// left out.
    pub fn part(&self, part: &MeshPart) -> Mesh {
        let mut index = vec![u32::MAX; self.positions.len()];
        let mut out = Mesh::default();
        for triangle in &self.triangles[part.triangles.clone()] {
            let own = triangle.map(|v| {
                let v = v as usize;
                if index[v] == u32::MAX {
                    index[v] = out.positions.len() as u32;
                    out.positions.push(self.positions[v]);
                    out.normals.push(self.normals[v]);
                    out.colours.push(self.colours[v]);
                }
                index[v]
            });
            out.triangles.push(own);
        }
        let triangles = 0..out.triangles.len();
        out.parts = vec![MeshPart { triangles, ..part.clone() }];
        out
    }

    /// Smallest and largest coordinates of the vertices; `None` without any.
    pub fn extent(&self) -> Option<([f32; 3], [f32; 3])> {
        let first = *self.positions.first()?;
        let grown = |(low, high): ([f32; 3], [f32; 3]), p: &[f32; 3]| {
            ([0, 1, 2].map(|k| p[k].min(low[k])), [0, 1, 2].map(|k| p[k].max(high[k])))
        };
        Some(self.positions.iter().fold((first, first), grown))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn part_has_only_its_own_vertices() {
        let corner = |i: usize| [i as f32, 0.0, 1.0];
        let part = |name: &str, triangles| MeshPart { name: name.into(), triangles, colliders: Vec::new() };
        let mesh = Mesh {
            positions: (0..6).map(corner).collect(),
            normals: vec![[0.0, 0.0, 1.0]; 6],
            colours: (0..6).map(corner).collect(),
            triangles: vec![[0, 1, 2], [5, 3, 4]],
            parts: vec![part("a", 0..1), part("b", 1..2)],
        };
        let second = mesh.part(&mesh.parts[1]);
        assert_eq!(second.positions, [corner(5), corner(3), corner(4)]);
        assert_eq!(second.triangles, [[0, 1, 2]]);
        assert_eq!((second.parts[0].name.as_str(), second.parts[0].triangles.clone()), ("b", 0..1));
        assert_eq!(mesh.extent(), Some(([0.0, 0.0, 1.0], [5.0, 0.0, 1.0])));
        assert_eq!(Mesh::default().extent(), None);
    }
}
