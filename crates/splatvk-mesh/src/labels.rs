//! Labels of triangles from those of vertices: without islands, crumbs and shreds.
use crate::surface::{Sets, Surface, sides};
use std::collections::{HashMap, VecDeque};

/// Area of an island from which it belongs to its label, relative to the largest island of the
/// label: behind the silhouette of a thing, a few triangles in the air have its label.
const CRUMB: f64 = 0.02;
/// Half the width of the widest strip of a label that joins the label beside it, in triangles,
/// about two per voxel. At the silhouette of a thing, the depth in such a strip is that of none.
const SHRED: u32 = 6;
/// Share of the area of a label that its strips must leave; a label with less is thin everywhere,
/// as a spoon is, and keeps them.
const SOLID: f64 = 0.5;

impl Surface {
    /// Label of every triangle: that of most of its vertices, after islands of less than `least`
    /// square units, crumbs and shreds of a label got the label around them. Crumbs in the air get
    /// none.
    pub fn triangle_labels(&self, least: f64) -> Vec<u32> {
        let majority = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| self.labels[v as usize]);
            if b == c { b } else { a }
        };
        let mut labels: Vec<u32> = self.triangles.iter().map(majority).collect();
        if labels.iter().all(|label| *label == 0) {
            return labels;
        }
        let mesh = Adjacent::of(self);
        let none = vec![false; labels.len()];
        mesh.join(&mut labels, &none, least);
        let shreds = mesh.shreds(&labels);
        mesh.join(&mut labels, &shreds, 0.0);
        labels
    }
}

/// Triangles with their areas and neighbours.
struct Adjacent {
    areas: Vec<f64>,
    /// Pairs of triangles with a common edge.
    pairs: Vec<[u32; 2]>,
    /// Whether a triangle has an edge of its own.
    at_border: Vec<bool>,
}

impl Adjacent {
    fn of(surface: &Surface) -> Adjacent {
        let triangles = &surface.triangles;
        let own = |(t, triangle): (usize, &[u32; 3])| sides(*triangle).map(|side| (side, t as u32));
        let mut all: Vec<([u32; 2], u32)> = triangles.iter().enumerate().flat_map(own).collect();
        all.sort_unstable();
        let mut at_border = vec![false; triangles.len()];
        for same in all.chunk_by(|a, b| a.0 == b.0).filter(|same| same.len() == 1) {
            at_border[same[0].1 as usize] = true;
        }
        let common = all.windows(2).filter(|pair| pair[0].0 == pair[1].0);
        Adjacent {
            areas: triangles.iter().map(|t| surface.area(*t)).collect(),
            pairs: common.map(|pair| [pair[0].1, pair[1].1]).collect(),
            at_border,
        }
    }

    /// Whether a triangle is in a strip of its label: a morphological opening by [`SHRED`] steps
    /// removes it.
    fn shreds(&self, labels: &[u32]) -> Vec<bool> {
        let mut same = vec![Vec::new(); labels.len()];
        let mut edge = self.at_border.clone();
        for [a, b] in &self.pairs {
            let (i, j) = (*a as usize, *b as usize);
            if labels[i] == labels[j] {
                same[i].push(*b);
                same[j].push(*a);
            } else {
                (edge[i], edge[j]) = (true, true);
            }
        }
        let at_edge = (0..labels.len() as u32).filter(|t| edge[*t as usize]);
        let inside = steps(&same, at_edge);
        let wide = (0..labels.len() as u32).filter(|t| inside[*t as usize] >= SHRED);
        let outside = steps(&same, wide);
        let is_shred = |t: usize| outside[t] > SHRED;
        let mut kept: HashMap<u32, [f64; 2]> = HashMap::new();
        for (t, area) in self.areas.iter().enumerate() {
            let [kept, all] = kept.entry(labels[t]).or_default();
            *all += area;
            *kept += if is_shred(t) { 0.0 } else { *area };
        }
        let is_solid = |label: u32| kept[&label][0] >= SOLID * kept[&label][1];
        (0..labels.len()).map(|t| is_shred(t) && is_solid(labels[t])).collect()
    }

    /// `loose` triangles, islands of less than `least` square units, and crumbs get the label that
    /// most of their border touches.
    fn join(&self, labels: &mut [u32], loose: &[bool], least: f64) {
        let mut sets = Sets::new(labels.len());
        for [a, b] in &self.pairs {
            let (i, j) = (*a as usize, *b as usize);
            if labels[i] == labels[j] && loose[i] == loose[j] {
                sets.join(*a, *b);
            }
        }
        let island: Vec<u32> = (0..labels.len() as u32).map(|t| sets.root(t)).collect();
        let mut areas = vec![0.0; labels.len()];
        for (t, area) in self.areas.iter().enumerate() {
            areas[island[t] as usize] += area;
        }
        let mut largest: HashMap<u32, f64> = HashMap::new();
        for (t, area) in areas.iter().enumerate() {
            let most = largest.entry(labels[t]).or_default();
            *most = most.max(*area);
        }
        let is_crumb = |t: u32| areas[t as usize] < CRUMB * largest[&labels[t as usize]];
        let is_small = |t: u32| loose[t as usize] || areas[t as usize] < least || is_crumb(t);
        let mut touched: HashMap<(u32, u32), usize> = HashMap::new();
        for [a, b] in &self.pairs {
            for [own, other] in [[a, b], [b, a]].map(|pair| pair.map(|t| island[*t as usize])) {
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
            None if is_crumb(*own) && !loose[*own as usize] => 0,
            None => *label,
        });
        let joined: Vec<u32> = joined.collect();
        labels.copy_from_slice(&joined);
    }
}

/// Number of steps between neighbours from the nearest of `first`; `u32::MAX` where none leads.
fn steps(neighbours: &[Vec<u32>], first: impl Iterator<Item = u32>) -> Vec<u32> {
    let mut steps = vec![u32::MAX; neighbours.len()];
    let mut next: VecDeque<u32> = first.collect();
    next.iter().for_each(|t| steps[*t as usize] = 0);
    while let Some(t) = next.pop_front() {
        for other in &neighbours[t as usize] {
            if steps[*other as usize] == u32::MAX {
                steps[*other as usize] = steps[t as usize] + 1;
                next.push_back(*other);
            }
        }
    }
    steps
}

#[cfg(test)]
mod tests {
    use crate::surface::tests::grid;
    use glam::Vec3;

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

    #[test]
    fn shreds_join_the_label_along_them() {
        // A plate with a strip at the border of the mesh, along the lemon on it.
        let s = grid(40, |x, y| 1 + u32::from(y > 20 && x > 2));
        let labels = s.triangle_labels(0.0);
        let at = |x: usize, y: usize| labels[2 * (40 * y + x)];
        assert_eq!([at(5, 5), at(1, 5), at(1, 35), at(20, 35)], [1, 1, 2, 2]);
        // A label that is thin everywhere stays.
        let s = grid(40, |x, _| 1 + u32::from((18..=20).contains(&x)));
        let labels = s.triangle_labels(0.0);
        assert_eq!([labels[2 * (40 * 20 + 19)], labels[2 * (40 * 20 + 5)]], [2, 1]);
    }
}
