//! The extracted surface before it is a mesh.
use glam::Vec3;
use std::collections::HashMap;

/// Triangles whose vertices have a linear colour and a label.
#[derive(Clone, Debug, Default)]
pub struct Surface {
    /// [V] world units.
    pub positions: Vec<Vec3>,
    /// [V] linear RGB.
    pub colours: Vec<Vec3>,
    /// [V] 0 = none.
    pub labels: Vec<u32>,
    /// [T, 3] vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Surface {
    /// Area of a triangle, square world units.
    pub fn area(&self, triangle: [u32; 3]) -> f64 {
        f64::from(self.cross(triangle).length()) / 2.0
    }

    fn cross(&self, triangle: [u32; 3]) -> Vec3 {
        let [a, b, c] = triangle.map(|v| self.positions[v as usize]);
        (b - a).cross(c - a)
    }

    /// Unit normals of the vertices: means of those of the triangles, weighted by area.
    pub fn normals(&self) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO; self.positions.len()];
        for triangle in &self.triangles {
            let cross = self.cross(*triangle);
            triangle.iter().for_each(|v| sums[*v as usize] += cross);
        }
        sums.into_iter().map(|n| n.normalize_or(Vec3::Y)).collect()
    }

    /// Drops connected components with less than `share` of the area of the largest one.
    pub fn drop_small(&mut self, share: f64) {
        let component = components(self.positions.len(), &self.triangles);
        let mut areas: HashMap<u32, f64> = HashMap::new();
        for triangle in &self.triangles {
            *areas.entry(component[triangle[0] as usize]).or_default() += self.area(*triangle);
        }
        let least = share * areas.values().fold(0.0f64, |a, b| a.max(*b));
        self.triangles.retain(|t| areas[&component[t[0] as usize]] >= least);
        self.drop_unused();
    }

    fn drop_unused(&mut self) {
        let mut index = vec![u32::MAX; self.positions.len()];
        let mut kept = Surface::default();
        for triangle in &mut self.triangles {
            for v in triangle {
                let old = *v as usize;
                if index[old] == u32::MAX {
                    index[old] = kept.positions.len() as u32;
                    kept.positions.push(self.positions[old]);
                    kept.colours.push(self.colours[old]);
                    kept.labels.push(self.labels[old]);
                }
                *v = index[old];
            }
        }
        kept.triangles = std::mem::take(&mut self.triangles);
        *self = kept;
    }

    /// Number of edges with one triangle only: the borders of holes.
    pub fn border_edges(&self) -> usize {
        border_edges(&self.triangles)
    }
}

/// Number of edges with one triangle only.
pub fn border_edges(triangles: &[[u32; 3]]) -> usize {
    let mut sides: Vec<[u32; 2]> = triangles.iter().flat_map(|t| sides(*t)).collect();
    sides.sort_unstable();
    sides.chunk_by(|a, b| a == b).filter(|same| same.len() == 1).count()
}

/// Edges of a triangle, lower vertex first.
pub(crate) fn sides([a, b, c]: [u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]].map(|[a, b]| [a.min(b), a.max(b)])
}

/// Component of every vertex.
fn components(vertices: usize, triangles: &[[u32; 3]]) -> Vec<u32> {
    let mut sets = Sets::new(vertices);
    for [a, b, c] in triangles {
        sets.join(*a, *b);
        sets.join(*b, *c);
    }
    (0..vertices as u32).map(|v| sets.root(v)).collect()
}

/// Disjoint sets.
pub(crate) struct Sets(Vec<u32>);

impl Sets {
    pub fn new(count: usize) -> Sets {
        Sets((0..count as u32).collect())
    }

    pub fn root(&mut self, mut at: u32) -> u32 {
        while self.0[at as usize] != at {
            let above = self.0[self.0[at as usize] as usize];
            self.0[at as usize] = above;
            at = above;
        }
        at
    }

    pub fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A flat grid of `n` × `n` squares of side 1 with labels by column.
    pub(crate) fn grid(n: u32, label: impl Fn(u32, u32) -> u32) -> Surface {
        let mut s = Surface::default();
        for (y, x) in (0..=n).flat_map(|y| (0..=n).map(move |x| (y, x))) {
            s.positions.push(Vec3::new(x as f32, y as f32, 0.0));
            s.colours.push(Vec3::ONE);
            s.labels.push(label(x, y));
        }
        for (y, x) in (0..n).flat_map(|y| (0..n).map(move |x| (y, x))) {
            let a = y * (n + 1) + x;
            s.triangles.extend([[a, a + 1, a + n + 1], [a + 1, a + n + 2, a + n + 1]]);
        }
        s
    }

    #[test]
    fn small_components_are_dropped() {
        let mut s = grid(8, |_, _| 0);
        let first = s.positions.len() as u32;
        let far = |x: f32, y: f32| Vec3::new(100.0 + x, y, 0.0);
        s.positions.extend([far(0.0, 0.0), far(1.0, 0.0), far(0.0, 1.0)]);
        s.colours.extend([Vec3::ONE; 3]);
        s.labels.extend([0; 3]);
        s.triangles.push([first, first + 1, first + 2]);
        s.drop_small(0.5 / 64.0);
        assert_eq!((s.triangles.len(), s.positions.len()), (129, 84));
        s.drop_small(0.6 / 64.0);
        assert_eq!((s.triangles.len(), s.positions.len()), (128, 81));
        assert_eq!(s.border_edges(), 32);
        assert_eq!(s.normals()[40], Vec3::Z);
    }
}
