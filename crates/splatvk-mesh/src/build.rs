//! Surface → mesh: simplified, in parts.
use crate::distance::{Nearest, samples};
use crate::surface::Surface;
use glam::Vec3;
use meshopt::{SimplifyOptions, VertexDataAdapter};
use splatvk_types::scene::{Mesh, MeshPart};
use std::collections::HashMap;

/// How far a surface is simplified.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Simplify {
    /// Not at all.
    None,
    /// To about this many triangles at most.
    Triangles(usize),
    /// As far as 99.9 % of the surface moves by at most this length, world units.
    Error(f64),
}

/// A mesh, and how far simplification moved its surface.
#[derive(Clone, Debug, Default)]
pub struct Built {
    /// The mesh.
    pub mesh: Mesh,
    /// Distance within which 99.9 % of the surfaces before and after the simplification are, either
    /// way, world units; measured at the vertices and at points on the triangles.
    pub error: f64,
}

/// Weight of a difference in colour of 1 against one in place of the size of the mesh, as of
/// `meshopt_simplifyWithAttributes`.
const COLOUR_WEIGHT: f32 = 0.05;
/// Most simplifications for an error.
const ROUNDS: usize = 6;
/// Area below which a label is taken for noise, in squares of `unit`.
const ISLAND: f64 = 150.0;

/// Makes the mesh of a surface. Every label is a part with the name that `name` has for it; parts
/// follow the order of their labels. `unit` is the side of a voxel.
pub fn build(surface: &Surface, unit: f64, how: Simplify, name: impl Fn(u32) -> String) -> Built {
    let normals = surface.normals();
    let labels = surface.triangle_labels(ISLAND * unit * unit);
    let mut split = Split::default();
    for (triangle, label) in surface.triangles.iter().zip(&labels) {
        split.add(surface, &normals, *triangle, *label);
    }
    let (kept, error) = split.reduced(how);
    let mut mesh = Mesh {
        positions: split.positions,
        normals: split.normals.iter().map(Vec3::to_array).collect(),
        colours: split.colours.iter().map(|c| c.clamp(Vec3::ZERO, Vec3::ONE).to_array()).collect(),
        ..Mesh::default()
    };
    let label = |t: &[u32; 3]| split.labels[t[0] as usize];
    let mut triangles = kept;
    // Stable: within a part in the order of the surface.
    triangles.sort_by_key(label);
    let mut from = 0;
    for part in triangles.chunk_by(|a, b| label(a) == label(b)) {
        let to = from + part.len();
        mesh.parts.push(MeshPart { name: name(label(&part[0])), triangles: from..to, colliders: Vec::new() });
        from = to;
    }
    mesh.triangles = triangles;
    drop_unused(&mut mesh);
    Built { mesh, error }
}

/// Vertices of their own for every label, so that parts share none.
#[derive(Default)]
struct Split {
    positions: Vec<[f32; 3]>,
    normals: Vec<Vec3>,
    colours: Vec<Vec3>,
    labels: Vec<u32>,
    triangles: Vec<[u32; 3]>,
    index: HashMap<(u32, u32), u32>,
}

impl Split {
    fn add(&mut self, surface: &Surface, normals: &[Vec3], triangle: [u32; 3], label: u32) {
        let own = triangle.map(|v| {
            *self.index.entry((v, label)).or_insert_with(|| {
                self.positions.push(surface.positions[v as usize].to_array());
                self.normals.push(normals[v as usize]);
                self.colours.push(surface.colours[v as usize]);
                self.labels.push(label);
                self.positions.len() as u32 - 1
            })
        });
        self.triangles.push(own);
    }

    /// Triangles after the simplification, and its measured error.
    fn reduced(&self, how: Simplify) -> (Vec<[u32; 3]>, f64) {
        let all = self.triangles.len();
        let nearest = Nearest::new(&self.positions, &self.triangles);
        let (Some(nearest), false) = (nearest, how == Simplify::None || how == Simplify::Triangles(all))
        else {
            return (self.triangles.clone(), 0.0);
        };
        let bound = match how {
            Simplify::Triangles(count) => {
                let kept = self.simplified(count.min(all), f32::MAX);
                let moved = self.moved(&nearest, &kept);
                return (kept, moved);
            }
            Simplify::Error(bound) => bound,
            Simplify::None => 0.0,
        };
        // The estimate of meshoptimizer is a mean over planes: places are up to four times as far.
        let mut asked = bound;
        for _ in 0..ROUNDS {
            let kept = self.simplified(0, asked as f32);
            let moved = self.moved(&nearest, &kept);
            if moved <= bound {
                return (kept, moved);
            }
            asked *= (0.9 * bound / moved).min(0.7);
        }
        (self.triangles.clone(), 0.0)
    }

    /// Distance within which nearly all of the surface and of some of its triangles are.
    fn moved(&self, whole: &Nearest, kept: &[[u32; 3]]) -> f64 {
        let Some(nearest) = Nearest::new(&self.positions, kept) else { return 0.0 };
        let mesh = Mesh { positions: self.positions.clone(), triangles: kept.to_vec(), ..Mesh::default() };
        let there = nearest.distances(&self.positions);
        let back = whole.distances(&samples(&mesh, self.positions.len()));
        f64::from(nearly_all(there).max(nearly_all(back)))
    }

    /// Triangles after a simplification to a number of triangles or up to an error. Borders between
    /// labels stay closed: vertices at one place are simplified together.
    fn simplified(&self, count: usize, error: f32) -> Vec<[u32; 3]> {
        let Ok(places) = VertexDataAdapter::new(bytemuck::cast_slice(&self.positions), 12, 0) else {
            return self.triangles.clone();
        };
        let attributes: Vec<f32> = self.colours.iter().flat_map(Vec3::to_array).collect();
        let indices = meshopt::simplify_with_attributes_and_locks(
            self.triangles.as_flattened(),
            &places,
            &attributes,
            &[COLOUR_WEIGHT; 3],
            12,
            &vec![false; self.positions.len()],
            3 * count,
            error,
            SimplifyOptions::ErrorAbsolute,
            None,
        );
        without_flaps(indices.as_chunks::<3>().0)
    }
}

/// Drops triangles with the same corners but one: collapses fold thin things onto themselves. Of two
/// that face each other none is left.
fn without_flaps(triangles: &[[u32; 3]]) -> Vec<[u32; 3]> {
    let sorted = |t: &[u32; 3]| {
        let mut corners = *t;
        corners.sort_unstable();
        corners
    };
    // From the least corner: whether the next one is the lesser of the others.
    let turn = |t: &[u32; 3]| {
        let least = (0..3).min_by_key(|k| t[*k]).unwrap_or(0);
        if t[(least + 1) % 3] < t[(least + 2) % 3] { 1 } else { -1 }
    };
    let mut sides: HashMap<[u32; 3], i32> = HashMap::new();
    triangles.iter().for_each(|t| *sides.entry(sorted(t)).or_default() += turn(t));
    let mut kept = triangles.to_vec();
    kept.retain(|t| match sides.get_mut(&sorted(t)) {
        Some(side) if side.signum() == turn(t) => {
            *side = 0;
            true
        }
        _ => false,
    });
    kept
}

/// The distance that 99.9 % do not exceed: slivers of a noisy surface make the largest one.
fn nearly_all(mut distances: Vec<f32>) -> f32 {
    distances.sort_by(f32::total_cmp);
    let at = (0.999 * distances.len() as f64) as usize;
    distances.get(at.min(distances.len().max(1) - 1)).copied().unwrap_or_default()
}

fn drop_unused(mesh: &mut Mesh) {
    let whole = MeshPart { triangles: 0..mesh.triangles.len(), ..MeshPart::default() };
    let parts = std::mem::take(&mut mesh.parts);
    *mesh = mesh.part(&whole);
    mesh.parts = parts;
}

#[cfg(test)]
mod tests {
    use super::without_flaps;

    #[test]
    fn flaps_are_dropped() {
        let triangles =
            [[0, 1, 2], [3, 2, 1], [2, 3, 1], [1, 2, 3], [4, 5, 6], [6, 4, 5], [2, 1, 0], [7, 8, 9]];
        assert_eq!(without_flaps(&triangles), [[2, 3, 1], [4, 5, 6], [7, 8, 9]]);
        assert_eq!(without_flaps(&[[0, 1, 2], [1, 0, 2]]), [[0u32; 3]; 0]);
    }
}
