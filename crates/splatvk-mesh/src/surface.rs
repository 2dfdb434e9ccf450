//! The extracted surface before it is a mesh: small components, labels.
use glam::Vec3;
use std::collections::HashMap;

/// Area of an island from which it belongs to its label, relative to the largest island of the
/// label: behind the silhouette of a thing, a few triangles in the air have its label.
const CRUMB: f64 = 0.02;

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

    /// Label of every triangle: that of most of its vertices, after islands of less than `least`
    /// square units, and crumbs of a label, got the label around them. Crumbs in the air get none.
    pub fn triangle_labels(&self, least: f64) -> Vec<u32> {
        let majority = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| self.labels[v as usize]);
            if b == c { b } else { a }
        };
        let mut labels: Vec<u32> = self.triangles.iter().map(majority).collect();
        if labels.iter().any(|label| *label != 0) {
            self.join_islands(&mut labels, least);
        }
        labels
    }

    /// Gives islands the label that most of their border touches.
    fn join_islands(&self, labels: &mut [u32], least: f64) {
        let edges = edge_pairs(&self.triangles);
        let mut sets = Sets::new(labels.len());
        for [a, b] in &edges {
            if labels[*a as usize] == labels[*b as usize] {
                sets.join(*a, *b);
            }
        }
        let island: Vec<u32> = (0..labels.len() as u32).map(|t| sets.root(t)).collect();
        let mut areas = vec![0.0; labels.len()];
        for (t, triangle) in self.triangles.iter().enumerate() {
            areas[island[t] as usize] += self.area(*triangle);
        }
        let mut largest: HashMap<u32, f64> = HashMap::new();
        for (t, area) in areas.iter().enumerate() {
            let most = largest.entry(labels[t]).or_default();
            *most = most.max(*area);
        }
        let is_crumb = |t: u32| areas[t as usize] < CRUMB * largest[&labels[t as usize]];
        let is_small = |t: u32| areas[t as usize] < least || is_crumb(t);
        let mut touched: HashMap<(u32, u32), usize> = HashMap::new();
        for [a, b] in edges {
            for [own, other] in [[a, b], [b, a]].map(|pair| pair.map(|t| island[t as usize])) {
                if own != other && is_small(own) && !is_small(other) {
                    *touched.entry((own, labels[other as usize])).or_default() += 1;
                }
            }
        }
        let mut best: HashMap<u32, (usize, u32)> = HashMap::new();
        for ((own, label), count) in touched {
            // Of equal borders the lower label, for the same result in every run.
            let rank = |(count, label): (usize, u32)| (count, std::cmp::Reverse(label));
            let entry = best.entry(own).or_insert((count, label));
            if rank((count, label)) > rank(*entry) {
                *entry = (count, label);
            }
        }
        let joined = island.iter().zip(&*labels).map(|(own, label)| match best.get(own) {
            Some((_, around)) => *around,
            None if is_crumb(*own) => 0,
            None => *label,
        });
        let joined: Vec<u32> = joined.collect();
        labels.copy_from_slice(&joined);
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

fn sides([a, b, c]: [u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]].map(|[a, b]| [a.min(b), a.max(b)])
}

/// Pairs of triangles with a common edge.
fn edge_pairs(triangles: &[[u32; 3]]) -> Vec<[u32; 2]> {
    let own = |(t, triangle): (usize, &[u32; 3])| sides(*triangle).map(|side| (side, t as u32));
    let mut all: Vec<([u32; 2], u32)> = triangles.iter().enumerate().flat_map(own).collect();
    all.sort_unstable();
    all.windows(2).filter(|pair| pair[0].0 == pair[1].0).map(|pair| [pair[0].1, pair[1].1]).collect()
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
struct Sets(Vec<u32>);

impl Sets {
    fn new(count: usize) -> Sets {
        Sets((0..count as u32).collect())
    }

    fn root(&mut self, mut at: u32) -> u32 {
        while self.0[at as usize] != at {
            let above = self.0[self.0[at as usize] as usize];
            self.0[at as usize] = above;
            at = above;
        }
        at
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A flat grid of `n` × `n` squares of side 1 with labels by column.
    fn grid(n: u32, label: impl Fn(u32, u32) -> u32) -> Surface {
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

    #[test]
    fn islands_join_the_label_around_them() {
        let s = grid(20, |x, y| if (x, y) == (4, 4) { 9 } else { 1 + u32::from(x > 10) });
        let labels = s.triangle_labels(12.0);
        let area = |label: u32| {
            labels
                .iter()
                .zip(&s.triangles)
                .filter(|(l, _)| **l == label)
                .map(|(_, t)| s.area(*t))
                .sum::<f64>()
        };
        assert_eq!(area(9), 0.0);
        assert!((area(1) - 210.0).abs() <= 20.0 && (area(2) - 190.0).abs() <= 20.0);
        // A crumb of a large label joins, however small the least area is; alone it has no label.
        let mut s = grid(20, |x, y| if (6..8).contains(&x) && y < 2 { 2 } else { 1 + u32::from(x > 10) });
        let first = s.positions.len() as u32;
        s.positions.extend([Vec3::X, Vec3::Y, Vec3::ZERO].map(|p| p + 100.0));
        s.colours.extend([Vec3::ONE; 3]);
        s.labels.extend([2; 3]);
        s.triangles.push([first, first + 1, first + 2]);
        let labels = s.triangle_labels(0.0);
        assert_eq!(labels.iter().filter(|label| **label == 0).count(), 1);
        assert_eq!(labels.last(), Some(&0));
        let at = |x: usize, y: usize| labels[2 * (20 * y + x)];
        assert_eq!([at(6, 0), at(3, 3), at(15, 3)], [1, 1, 2]);
        assert!(grid(4, |_, _| 0).triangle_labels(12.0).iter().all(|l| *l == 0));
    }
}
