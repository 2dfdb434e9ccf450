//! Truncated signed distance on sparse blocks.
use crate::frame::{Frame, Prepared, Surfel};
use glam::{IVec3, Vec3};
use rayon::prelude::*;
use splatvk_types::math::median;
use splatvk_types::{Error, Result};
use std::collections::{HashMap, HashSet};

/// Voxels along each side of a block.
pub(crate) const SIDE: usize = 8;
/// Voxels of a block.
pub(crate) const VOXELS: usize = SIDE * SIDE * SIDE;

/// Sizes of a [`Tsdf`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TsdfOptions {
    /// Side of a voxel, world units; `None` = from the pixels ([`Tsdf::new`]).
    pub voxel: Option<f64>,
    /// Distance from the surface up to which voxels are used, in voxels.
    pub truncation: f32,
    /// Most blocks of 8 × 8 × 8 voxels, about 16 kB each; a voxel size from the pixels grows until
    /// they suffice, a given one may need three times as many.
    pub most_blocks: usize,
}

impl Default for TsdfOptions {
    fn default() -> Self {
        TsdfOptions { voxel: None, truncation: 4.0, most_blocks: 100_000 }
    }
}

/// Side of a voxel in distances between neighbouring pixels.
const PIXELS_PER_VOXEL: f64 = 2.0;
/// Growth of the voxel size where there are too many blocks.
const GROWTH: f64 = 1.25;

/// Voxels of 8 × 8 × 8 places; those without weight are unobserved.
pub(crate) struct Block {
    /// Mean signed distance, world units; positive towards the cameras.
    pub distance: [f32; VOXELS],
    pub weight: [f32; VOXELS],
    /// Mean linear colour.
    pub colour: [Vec3; VOXELS],
    pub colour_weight: [f32; VOXELS],
    /// The label that most of the weight has seen, with its lead over the others.
    pub label: [(u32, f32); VOXELS],
}

impl Block {
    const EMPTY: Block = Block {
        distance: [0.0; VOXELS],
        weight: [0.0; VOXELS],
        colour: [Vec3::ZERO; VOXELS],
        colour_weight: [0.0; VOXELS],
        label: [(0, 0.0); VOXELS],
    };
}

/// Signed distance to the surfaces of depth maps, near those surfaces.
pub struct Tsdf {
    voxel: f32,
    truncation: f32,
    pub(crate) index: HashMap<IVec3, usize>,
    pub(crate) places: Vec<IVec3>,
    pub(crate) blocks: Vec<Block>,
}

impl Tsdf {
    /// Integrates frames, in their order. Without a size in the options, voxels have twice the
    /// median distance between neighbouring pixels on the surfaces.
    ///
    /// Weight: that of the pixel × cosine between normal and ray × pixels per voxel. The distance
    /// is that to the plane of the pixel, so that views at all angles agree.
    ///
    /// # Errors
    /// Bad input for a given voxel size that needs too many blocks.
    pub fn new(frames: &[Frame], options: TsdfOptions) -> Result<Tsdf> {
        let views: Vec<Prepared> = frames.iter().map(Prepared::new).collect();
        let (voxel, places) = match options.voxel {
            Some(voxel) => (voxel as f32, places(&views, voxel as f32, options.truncation)),
            None => fitting(&views, options),
        };
        if places.len() > 3 * options.most_blocks {
            return Err(Error::input(format!(
                "voxels of {voxel:.2e} need {} MB of memory, more than the {} that a mesh may take; give a larger size",
                places.len() * size_of::<Block>() / 1_000_000,
                3 * options.most_blocks * size_of::<Block>() / 1_000_000
            )));
        }
        let index = places.iter().enumerate().map(|(i, place)| (*place, i)).collect();
        let mut tsdf =
            Tsdf { voxel, truncation: options.truncation * voxel, index, places, blocks: Vec::new() };
        tsdf.blocks = tsdf.places.par_iter().map(|place| tsdf.integrated(*place, &views)).collect();
        Ok(tsdf)
    }

    /// Side of a voxel, world units.
    pub fn voxel(&self) -> f64 {
        f64::from(self.voxel)
    }

    /// World coordinates of a voxel.
    pub(crate) fn position(&self, voxel: IVec3) -> Vec3 {
        voxel.as_vec3() * self.voxel
    }

    fn integrated(&self, place: IVec3, views: &[Prepared]) -> Block {
        let mut block = Block::EMPTY;
        let first = place * SIDE as i32;
        let middle = self.position(first) + Vec3::splat(0.5 * (SIDE as f32 - 1.0) * self.voxel);
        let radius = 0.87 * SIDE as f32 * self.voxel;
        for view in views.iter().filter(|view| view.local(middle).z > -radius) {
            for (i, offset) in offsets().enumerate() {
                self.observe(&mut block, i, view.local(self.position(first + offset)), view);
            }
        }
        block
    }

    /// Adds the observation of a voxel by a view.
    fn observe(&self, block: &mut Block, i: usize, local: Vec3, view: &Prepared) {
        let Some(pixel) = view.pixel(local) else { return };
        let surfel = view.surfels[pixel];
        if surfel.depth == 0.0 {
            return;
        }
        let distance = surfel.normal.dot(local - view.ray(pixel) * surfel.depth);
        if distance < -self.truncation {
            return;
        }
        let density = self.voxel / view.footprint(surfel.depth);
        let near = surfel.weight * density * density;
        // Less behind the surface, where another one may begin.
        let weight = near * (1.0 + distance / self.truncation).clamp(0.05, 1.0);
        mix(&mut block.distance[i], &mut block.weight[i], distance.min(self.truncation), weight);
        if distance.abs() < 2.0 * self.voxel {
            self.observe_colour(block, i, pixel, near, view);
        }
    }

    fn observe_colour(&self, block: &mut Block, i: usize, pixel: usize, near: f32, view: &Prepared) {
        // Squared, so that the best view has most of it.
        let weight = near * near * view.frame.colour_weight;
        let total = block.colour_weight[i] + weight;
        if total > 0.0 {
            block.colour[i] += (view.colour(pixel) - block.colour[i]) * (weight / total);
            block.colour_weight[i] = total;
        }
        if view.frame.labels.is_some() {
            vote(&mut block.label[i], view.label(pixel), near);
        }
    }
}

fn mix(mean: &mut f32, total: &mut f32, value: f32, weight: f32) {
    *total += weight;
    *mean += (value - *mean) * (weight / *total);
}

/// Majority vote of Boyer and Moore, weighted.
fn vote(lead: &mut (u32, f32), label: u32, weight: f32) {
    if lead.0 == label {
        lead.1 += weight;
    } else if lead.1 >= weight {
        lead.1 -= weight;
    } else {
        *lead = (label, weight - lead.1);
    }
}

/// Offsets of the voxels of a block, in the order of its arrays.
fn offsets() -> impl Iterator<Item = IVec3> {
    let side = SIDE as i32;
    (0..side).flat_map(move |z| (0..side).flat_map(move |y| (0..side).map(move |x| IVec3::new(x, y, z))))
}

/// Voxel size from the pixels, and its blocks.
fn fitting(views: &[Prepared], options: TsdfOptions) -> (f32, Vec<IVec3>) {
    let mut footprints: Vec<f64> = views
        .iter()
        .flat_map(|view| view.surfels.iter().step_by(17).map(move |s| view.footprint(s.depth)))
        .filter(|f| *f > 0.0)
        .map(f64::from)
        .collect();
    let mut voxel = PIXELS_PER_VOXEL * median(&mut footprints).unwrap_or(1.0);
    loop {
        let places = places(views, voxel as f32, options.truncation);
        if places.len() <= options.most_blocks {
            return (voxel as f32, places);
        }
        voxel *= GROWTH;
    }
}

/// Blocks within the truncation of a surface, sorted.
fn places(views: &[Prepared], voxel: f32, truncation: f32) -> Vec<IVec3> {
    let found = views.par_iter().map(|view| {
        let mut found = HashSet::new();
        let used = view.surfels.iter().enumerate().filter(|(_, s)| s.depth > 0.0);
        for (pixel, surfel) in used {
            add_band(&mut found, view, pixel, surfel, voxel, truncation);
        }
        found
    });
    let all = found.reduce(HashSet::new, |mut a, b| {
        a.extend(b);
        a
    });
    let mut places: Vec<IVec3> = all.into_iter().collect();
    places.sort_unstable_by_key(|p| [p.z, p.y, p.x]);
    places
}

/// Adds the blocks along the normal of a surfel.
fn add_band(
    found: &mut HashSet<IVec3>,
    view: &Prepared,
    pixel: usize,
    surfel: &Surfel,
    voxel: f32,
    truncation: f32,
) {
    let side = SIDE as f32 * voxel;
    let point = view.ray(pixel) * surfel.depth;
    for step in [-1.0, -0.5, 0.0, 0.5, 1.0] {
        let at = view.world(point + surfel.normal * (step * truncation * voxel));
        found.insert((at / f64::from(side)).floor().as_ivec3());
    }
}
