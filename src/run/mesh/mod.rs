//! Triangle mesh of a scene: rendered depth, fused (docs/use/mesh.md).
mod file;
mod frames;
mod place;
#[cfg(test)]
mod tests;
mod things;

use crate::format::scene_dir::Scene;
use crate::gpu::{self, Device};
use crate::progress::Progress;
use crate::scene::{Camera, Mesh};
use crate::{Error, Result};
use splatvk_mesh::{Frame, Tsdf, TsdfOptions, border_edges, build};

pub use file::{MeshOutput, MeshPlan, TRIANGLES};
pub use place::{Placement, placed};
pub use splatvk_mesh::{Collider, Simplify};
pub use things::Things;

/// Settings of a mesh.
#[derive(Clone, Copy, Debug)]
pub struct MeshOptions {
    /// Side of a voxel, scene units; `None` = twice the distance between neighbouring pixels.
    pub voxel: Option<f64>,
    /// Simplification; lengths in scene units.
    pub simplify: Simplify,
    /// Also take surfaces that no photo shows.
    pub fill_guessed: bool,
}

/// A mesh in scene axes, with its figures.
#[derive(Clone, Debug)]
pub struct SceneMesh {
    /// The mesh, scene axes and units.
    pub mesh: Mesh,
    /// Side of a voxel, scene units.
    pub voxel: f64,
    /// Length by which the simplification moved 99.9 % of the surface at most, scene units.
    pub moved: f64,
    /// Area of the surface, square scene units.
    pub area: f64,
    /// Edges with one triangle: the borders of holes and of the surface itself.
    pub border_edges: usize,
    /// Number of rendered views.
    pub views: usize,
}

/// Least area of a connected component, as a share of the largest one.
const SMALL: f64 = 0.001;
/// Name of what belongs to no thing.
const REST: &str = "rest";

/// Makes the mesh of a scene from views at `cameras` and between them. With `things` every thing is
/// a part with its name; otherwise the mesh is one part, `name`.
///
/// # Errors
/// Bad input for no cameras, for things of another scene, and where nothing opaque is in front of
/// the cameras.
pub fn mesh(
    scene: &Scene,
    cameras: &[Camera],
    things: Option<&Things>,
    name: &str,
    options: MeshOptions,
    device: Option<&str>,
    progress: &dyn Progress,
) -> Result<SceneMesh> {
    check(scene, cameras)?;
    on_device(&gpu::open(device)?, scene, cameras, things, name, options, progress)
}

/// [`mesh`] on an open device.
pub fn on_device(
    device: &Device,
    scene: &Scene,
    cameras: &[Camera],
    things: Option<&Things>,
    name: &str,
    options: MeshOptions,
    progress: &dyn Progress,
) -> Result<SceneMesh> {
    check(scene, cameras)?;
    let frames = frames::render(device, scene, cameras, things, options.fill_guessed, progress)?;
    progress.begin("mesh", 0);
    let fused = fused(&frames, things, name, options)?;
    progress.end();
    Ok(fused)
}

fn check(scene: &Scene, cameras: &[Camera]) -> Result<()> {
    match cameras.is_empty() {
        true => Err(Error::input(format!(
            "{}: has no cameras, and a mesh is made of what cameras see; give those of its photos with --cameras",
            scene.path.display()
        ))),
        false => Ok(()),
    }
}

fn fused(frames: &[Frame], things: Option<&Things>, name: &str, options: MeshOptions) -> Result<SceneMesh> {
    let tsdf = Tsdf::new(frames, TsdfOptions { voxel: options.voxel, ..TsdfOptions::default() })?;
    let mut surface = tsdf.surface();
    surface.drop_small(SMALL);
    if surface.triangles.is_empty() {
        return Err(Error::input(
            "no surface is found: nothing opaque that a photo shows is in front of the cameras; try --fill-guessed, or \
             other --cameras",
        ));
    }
    let part = |label: u32| match (label, things) {
        (0, Some(_)) => REST.to_owned(),
        (label, Some(things)) => things.name(label).to_owned(),
        (_, None) => name.to_owned(),
    };
    let built = build(&surface, tsdf.voxel(), options.simplify, part);
    let area = surface.triangles.iter().map(|t| surface.area(*t)).sum();
    Ok(SceneMesh {
        mesh: built.mesh,
        voxel: tsdf.voxel(),
        moved: built.error,
        area,
        border_edges: border_edges(&surface.triangles),
        views: frames.len(),
    })
}

/// Adds shapes of physics to every part of a mesh.
pub fn add_colliders(mesh: &mut Mesh, collider: Collider) {
    let shapes: Vec<_> = mesh.parts.iter().map(|part| collider.shapes(&mesh.part(part))).collect();
    mesh.parts.iter_mut().zip(shapes).for_each(|(part, shapes)| part.colliders = shapes);
}
