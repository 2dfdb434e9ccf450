//! A mesh as a file: things, place in the world, figures.
use super::{
    Collider, MeshOptions, Placement, SceneMesh, Simplify, Things, add_colliders, on_device, placed,
};
use crate::format::mesh::{self, MeshFile, MeshFormat};
use crate::format::scene_dir::Scene;
use crate::progress::Progress;
use crate::query::things::OBJECTS;
use crate::run::metric::Distance;
use crate::run::objects::{self, ObjectOptions};
use crate::run::outputs::WrittenFile;
use crate::run::{Machine, stored};
use crate::scene::{Camera, Mesh, World};
use crate::{Error, Result};
use serde_json::{Value, json};
use std::path::Path;

/// Default of [`MeshPlan::triangles`].
pub const TRIANGLES: usize = 100_000;

/// Settings of a mesh file.
#[derive(Clone, Debug)]
pub struct MeshPlan {
    /// Format; `None` = by the ending of the file.
    pub format: Option<MeshFormat>,
    /// Most triangles.
    pub triangles: usize,
    /// Instead of a number of triangles: length by which 99.9 % of the surface may move.
    pub error: Option<Distance>,
    /// Side of a voxel; `None` = two pixels of the photos at their surfaces.
    pub voxel: Option<Distance>,
    /// Also take surfaces that no photo shows.
    pub fill_guessed: bool,
    /// Shapes for physics beside every part.
    pub collider: Option<Collider>,
    /// A part with a name for every thing of the scene.
    pub by_object: bool,
    /// Names of the things to choose from; `None` = those of the text model.
    pub vocabulary: Option<Vec<String>>,
    /// Cameras to look from; `None` = those of the scene.
    pub cameras: Option<Vec<Camera>>,
    /// Keep the axes, the unit and the origin of the scene.
    pub raw: bool,
}

impl Default for MeshPlan {
    fn default() -> Self {
        MeshPlan {
            format: None,
            triangles: TRIANGLES,
            error: None,
            voxel: None,
            fill_guessed: false,
            collider: None,
            by_object: false,
            vocabulary: None,
            cameras: None,
            raw: false,
        }
    }
}

/// A checked mesh whose file is reserved.
pub struct MeshOutput<'a> {
    plan: &'a MeshPlan,
    format: MeshFormat,
    out: WrittenFile,
}

impl MeshPlan {
    /// Reserves a file before the scene is read; with `force` an ordinary file may be replaced, but
    /// none of `inputs`.
    ///
    /// # Errors
    /// Options that contradict each other, and places that may not be written.
    pub fn reserve(&self, file: &Path, force: bool, inputs: &[&Path]) -> Result<MeshOutput<'_>> {
        let format = self.format.map_or_else(|| MeshFormat::of(file), Ok)?;
        if self.collider.is_some() && !format.has_colliders() {
            return Err(Error::input("--collider: a .ply holds one mesh; write a .glb or .obj"));
        }
        if self.vocabulary.is_some() && !self.by_object {
            return Err(Error::input("--vocabulary: only a mesh by objects has names; add --by-object"));
        }
        if self.triangles == 0 {
            return Err(Error::input("--triangles 0: give at least 1"));
        }
        for (option, length) in [("--error", self.error), ("--voxel", self.voxel)] {
            if length.is_some_and(|length| !length.is_positive()) {
                return Err(Error::input(format!("{option}: give a length above 0")));
            }
        }
        Ok(MeshOutput { plan: self, format, out: WrittenFile::open(file, force, inputs)? })
    }

    fn options(&self, scene: &Scene) -> Result<MeshOptions> {
        let units = |length: Option<Distance>| length.map(|l| l.in_units(scene)).transpose();
        Ok(MeshOptions {
            voxel: units(self.voxel)?,
            simplify: units(self.error)?.map_or(Simplify::Triangles(self.triangles), Simplify::Error),
            fill_guessed: self.fill_guessed,
        })
    }
}

impl MeshOutput<'_> {
    /// Makes and writes the mesh of a scene, and returns its figures.
    ///
    /// # Errors
    /// Those of [`super::mesh`], and lengths in metres where the scale is not known.
    pub fn write(self, mut scene: Scene, machine: &Machine, progress: &dyn Progress) -> Result<Value> {
        let MeshOutput { plan, format, out } = self;
        let options = plan.options(&scene)?;
        let cameras = plan.cameras.as_deref().map_or_else(|| scene.cameras.clone(), <[_]>::to_vec);
        super::check(&scene, &cameras)?;
        let things = if plan.by_object { Some(things(&mut scene, plan, machine, progress)?) } else { None };
        let (name, device) = (stored::name(&scene.path), machine.gpu()?);
        let made = on_device(&device, &scene, &cameras, things.as_ref(), &name, options, progress)?;
        let placement = match plan.raw {
            true => Placement::own(format.is_y_up()),
            false => Placement::standing(&made.mesh, &scene.world),
        };
        let mut placed = placed(&made.mesh, &placement.by);
        if let Some(collider) = plan.collider {
            add_colliders(&mut placed, collider);
        }
        progress.check()?;
        let figures = figures(&made, &placed, &placement, &scene.world, plan);
        let file = MeshFile { name: &name, own_origins: things.is_some(), extras: figures.clone() };
        out.keep(|path| mesh::write(path, &placed, format, &file))?;
        Ok(figures)
    }
}

/// The objects of a scene, whose language moves onto the device.
fn things(scene: &mut Scene, plan: &MeshPlan, machine: &Machine, progress: &dyn Progress) -> Result<Things> {
    let options = ObjectOptions { vocabulary: plan.vocabulary.clone(), ..ObjectOptions::default() };
    let (_, list) = objects::of_scene(scene, machine, &options, progress)?;
    let mut things = Things { object: vec![0; scene.splats.len()], names: Vec::new() };
    for object in list.into_iter().filter(|o| o.thing.level == OBJECTS) {
        things.names.push(object.name);
        let number = things.names.len() as u32;
        object.thing.instance.splats.iter().for_each(|i| things.object[*i] = number);
    }
    Ok(things)
}

/// Figures of a mesh, lengths in the units of the file.
fn figures(made: &SceneMesh, placed: &Mesh, placement: &Placement, world: &World, plan: &MeshPlan) -> Value {
    let scale = placement.by.scale;
    let up = world.up.as_ref().filter(|_| placement.upright);
    let (low, high) = placed.extent().unwrap_or_default();
    let size = [0, 1, 2].map(|k| high[k] - low[k]);
    json!({
        "from_scene": {
            "scale": scale,
            "rotation": placement.by.rotation.transpose().to_cols_array(),
            "translation": placement.by.translation.to_array(),
        },
        "unit": if placement.metric { "metre" } else { "scene unit" },
        "up": if plan.raw { "as in the scene" } else if placement.upright { "y" } else { "unknown" },
        "up_sigma_degrees": up.map(|up| up.sigma_degrees),
        "triangles": placed.triangles.len(),
        "vertices": placed.positions.len(),
        "parts": placed.parts.len(),
        "size": size,
        "area": made.area * scale * scale,
        "border_edges": made.border_edges,
        "voxel": made.voxel * scale,
        "moved": made.moved * scale,
        "views": made.views,
        "guessed": plan.fill_guessed,
    })
}
