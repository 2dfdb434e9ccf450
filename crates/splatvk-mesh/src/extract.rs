//! Surface of a TSDF, by surface nets on chunks that overlap by a voxel.
use crate::surface::Surface;
use crate::tsdf::{Block, SIDE, Tsdf};
use fast_surface_nets::ndshape::{ConstShape, ConstShape3u32};
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::{IVec3, Vec3};
use rayon::prelude::*;
use std::collections::HashMap;

/// Voxels along each side of a chunk, without the overlap of one on either side.
const CHUNK: i32 = 32;
const PADDED: u32 = CHUNK as u32 + 2;
type Shape = ConstShape3u32<PADDED, PADDED, PADDED>;

/// A vertex of a chunk and the cell of voxels that it lies in.
struct Vertex {
    cell: IVec3,
    position: Vec3,
    colour: Vec3,
    label: u32,
}

struct Piece {
    vertices: Vec<Vertex>,
    triangles: Vec<[u32; 3]>,
}

impl Tsdf {
    /// The surface where all voxels around it are observed; open elsewhere.
    pub fn surface(&self) -> Surface {
        let per_chunk = CHUNK / SIDE as i32;
        let mut chunks: Vec<IVec3> =
            self.places.iter().map(|p| p.div_euclid(IVec3::splat(per_chunk))).collect();
        chunks.sort_unstable_by_key(|c| [c.z, c.y, c.x]);
        chunks.dedup();
        let pieces: Vec<Piece> = chunks.par_iter().map(|chunk| self.piece(*chunk * CHUNK)).collect();
        welded(pieces)
    }

    /// Block of a voxel and the voxel's index there.
    fn at(&self, voxel: IVec3) -> Option<(&Block, usize)> {
        let side = IVec3::splat(SIDE as i32);
        let block = self.index.get(&voxel.div_euclid(side))?;
        let inside = voxel.rem_euclid(side);
        let at = (inside.z * side.y + inside.y) * side.x + inside.x;
        Some((&self.blocks[*block], at as usize))
    }

    fn piece(&self, first: IVec3) -> Piece {
        let origin = first - IVec3::ONE;
        let voxel = |i: u32| origin + IVec3::from_array(Shape::delinearize(i).map(|v| v as i32));
        let observed = |i: u32| self.at(voxel(i)).filter(|(block, at)| block.weight[*at] > 0.0);
        // Any positive value: cells with an unobserved voxel are left out below.
        let distances: Vec<Option<f32>> =
            (0..Shape::SIZE).map(|i| observed(i).map(|(block, at)| block.distance[at])).collect();
        let filled: Vec<f32> = distances.iter().map(|d| d.unwrap_or(1.0)).collect();
        let mut net = SurfaceNetsBuffer::default();
        surface_nets(&filled, &Shape {}, [0; 3], [PADDED - 1; 3], &mut net);
        let corners = [0, 1].map(|z| [0, 1].map(|y| [0, 1].map(|x| Shape::linearize([x, y, z]))));
        let corners = corners.as_flattened().as_flattened();
        let known: Vec<bool> = net
            .surface_strides
            .iter()
            .map(|stride| corners.iter().all(|c| distances[(stride + c) as usize].is_some()))
            .collect();
        let triangles: Vec<[u32; 3]> = net
            .indices
            .as_chunks::<3>()
            .0
            .iter()
            .copied()
            .filter(|t| t.iter().all(|v| known[*v as usize]))
            .collect();
        let vertices = net.positions.iter().zip(&net.surface_points).map(|(position, cell)| {
            let cell = origin + IVec3::from_array(cell.map(|v| v as i32));
            let position = (origin.as_vec3() + Vec3::from_array(*position)) * self.position(IVec3::ONE);
            let (colour, label) = self.appearance(cell);
            Vertex { cell, position, colour, label }
        });
        Piece { vertices: vertices.collect(), triangles }
    }

    /// Colour and label of a cell: from its voxels, those near the surface most.
    fn appearance(&self, cell: IVec3) -> (Vec3, u32) {
        let corners = (0..8).map(|k| cell + IVec3::new(k & 1, k >> 1 & 1, k >> 2));
        let (mut sum, mut total) = (Vec3::ZERO, 0.0);
        let mut votes: Vec<(u32, f32)> = Vec::new();
        for (block, at) in corners.filter_map(|voxel| self.at(voxel)) {
            let weight = block.colour_weight[at] / (block.distance[at].abs() + 1e-3 * self.voxel() as f32);
            sum += block.colour[at] * weight;
            total += weight;
            let (label, lead) = block.label[at];
            match votes.iter_mut().find(|(known, _)| *known == label) {
                Some((_, sum)) => *sum += lead,
                None => votes.push((label, lead)),
            }
        }
        votes.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        let colour = if total > 0.0 { sum / total } else { Vec3::ZERO };
        (colour, votes.first().map_or(0, |(label, _)| *label))
    }
}

/// Joins chunks: a cell has one vertex.
fn welded(pieces: Vec<Piece>) -> Surface {
    let mut surface = Surface::default();
    let mut index: HashMap<IVec3, u32> = HashMap::new();
    for Piece { vertices, triangles } in pieces {
        for triangle in triangles {
            let own = triangle.map(|v| {
                let vertex = &vertices[v as usize];
                *index.entry(vertex.cell).or_insert_with(|| {
                    surface.positions.push(vertex.position);
                    surface.colours.push(vertex.colour);
                    surface.labels.push(vertex.label);
                    surface.positions.len() as u32 - 1
                })
            });
            surface.triangles.push(own);
        }
    }
    surface
}
