//! `splatvk mesh`: surfaces of a scene as triangles.
use super::args::{DeviceArgs, EditUse};
use super::outputs::WrittenFile;
use super::print::{print, print_json};
use super::progress;
use super::scene::{self, scene_name};
use super::{objects, views};
use crate::format::mesh::{self as files, MeshFile, MeshFormat};
use crate::format::scene_dir::Scene;
use crate::run::mesh::{self, MeshOptions, Placement, SceneMesh, Things};
use crate::run::metric::Distance;
use crate::run::objects::ObjectOptions;
use crate::scene::{LEVEL_NAMES, Mesh, World};
use crate::{Error, Result};
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use splatvk_mesh::{Collider, Simplify};
use std::path::{Path, PathBuf};

/// `splatvk mesh`
#[derive(Debug, Args)]
pub struct MeshArgs {
    /// Scene directory, or with --cameras a file of Gaussians
    pub scene: PathBuf,
    /// File to write
    pub file: PathBuf,
    /// Format of the file [default: by its ending: .glb, .ply or .obj]
    #[arg(long, value_enum, value_name = "FORMAT")]
    pub format: Option<FormatKind>,
    /// Most triangles
    #[arg(long, default_value_t = 100_000, value_parser = super::args::whole::<usize>(1..=100_000_000), value_name = "N")]
    pub triangles: usize,
    /// Simplify as far as 99.9 % of the surface moves by at most this length, instead of to a number
    /// of triangles: 2mm, 0.5cm, or a number in the units of the scene
    #[arg(long, conflicts_with = "triangles", value_name = "LENGTH", value_parser = positive)]
    pub error: Option<Distance>,
    /// Side of a voxel [default: two pixels of the photos at their surfaces]
    #[arg(long, value_name = "LENGTH", value_parser = positive)]
    pub voxel: Option<Distance>,
    /// Also surfaces that no photo shows; without it they are holes
    #[arg(long)]
    pub fill_guessed: bool,
    /// Shapes for physics beside every part: its convex hull, or convex pieces
    #[arg(long, value_enum, default_value_t = ColliderKind::None, value_name = "KIND")]
    pub collider: ColliderKind,
    /// A part with a name for every thing of the scene, as splatvk objects lists them
    #[arg(long)]
    pub by_object: bool,
    /// Text file with names to choose from, one per line [default: those of the text model]
    #[arg(long, value_name = "FILE", requires = "by_object")]
    pub vocabulary: Option<PathBuf>,
    /// Cameras to look from: transforms.json, a COLMAP model or cameras.json [default: those of the
    /// photos]
    #[arg(long, value_name = "FILE")]
    pub cameras: Option<PathBuf>,
    /// Keep the scene's own axes, units and origin, as export does
    #[arg(long)]
    pub raw: bool,
    /// Write over an ordinary file
    #[arg(long)]
    pub force: bool,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Device and output
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// Formats of meshes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FormatKind {
    /// Binary glTF, with named nodes and linear colours
    Glb,
    /// Binary PLY with colours
    Ply,
    /// Wavefront OBJ with colours and named groups
    Obj,
}

impl From<FormatKind> for MeshFormat {
    fn from(kind: FormatKind) -> MeshFormat {
        match kind {
            FormatKind::Glb => MeshFormat::Glb,
            FormatKind::Ply => MeshFormat::Ply,
            FormatKind::Obj => MeshFormat::Obj,
        }
    }
}

/// Shapes for physics.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ColliderKind {
    /// None
    None,
    /// The convex hull
    Hull,
    /// Convex pieces that follow the shape (V-HACD)
    Decomposition,
}

impl ColliderKind {
    fn kind(self) -> Option<Collider> {
        match self {
            ColliderKind::None => None,
            ColliderKind::Hull => Some(Collider::Hull),
            ColliderKind::Decomposition => Some(Collider::Decomposition),
        }
    }
}

/// Parses a positive distance.
fn positive(text: &str) -> Result<Distance, String> {
    text.parse().ok().filter(Distance::is_positive).ok_or_else(|| {
        format!("\"{text}\": give a positive length such as 2mm, 0.5cm, or 0.01 in the units of the scene")
    })
}

pub fn mesh(args: &MeshArgs) -> Result<()> {
    let format = args.format.map_or_else(|| MeshFormat::of(&args.file), |kind| Ok(kind.into()))?;
    if args.collider != ColliderKind::None && !format.has_colliders() {
        return Err(Error::input("--collider: a .ply holds one mesh; write a .glb or .obj"));
    }
    let inputs: Vec<&Path> = [Some(&args.scene), args.cameras.as_ref(), args.vocabulary.as_ref()]
        .into_iter()
        .flatten()
        .map(PathBuf::as_path)
        .collect();
    let out = WrittenFile::open(&args.file, args.force, &inputs)?;
    let mut scene = scene::load(&args.scene, args.edits)?;
    let things = if args.by_object { Some(things(&mut scene, args)?) } else { None };
    let given = args.cameras.as_deref().map(views::read).transpose()?;
    let cameras = given.as_deref().unwrap_or(&scene.cameras);
    let name = scene_name(&args.scene);
    let options = options(args, &scene)?;
    let progress = progress::reporter();
    let device = args.device.device.as_deref();
    let made = mesh::mesh(&scene, cameras, things.as_ref(), &name, options, device, progress.as_ref())?;
    let placement = match args.raw {
        true => Placement::own(format.is_y_up()),
        false => Placement::standing(&made.mesh, &scene.world),
    };
    let mut placed = mesh::placed(&made.mesh, &placement.by);
    if let Some(collider) = args.collider.kind() {
        mesh::add_colliders(&mut placed, collider);
    }
    progress.check()?;
    let figures = figures(&made, &placed, &placement, &scene.world, args);
    let file = MeshFile { name: &name, own_origins: things.is_some(), extras: figures.clone() };
    out.keep(|path| files::write(path, &placed, format, &file))?;
    match args.device.json {
        true => print_json(&with_file(figures, &args.file)),
        false => print(&line(&figures, &args.file)),
    }
}

/// The things of a scene as a whole, for `--by-object`.
fn things(scene: &mut Scene, args: &MeshArgs) -> Result<Things> {
    let vocabulary = args.vocabulary.as_deref().map(objects::vocabulary).transpose()?;
    let options = ObjectOptions { vocabulary, ..ObjectOptions::default() };
    let (_, list) = objects::listed(scene, &args.device, &options)?;
    let whole = LEVEL_NAMES.len() - 1;
    let mut things = Things { object: vec![0; scene.splats.len()], names: Vec::new() };
    for object in list.into_iter().filter(|o| o.thing.level == whole) {
        things.names.push(object.name);
        let number = things.names.len() as u32;
        object.thing.instance.splats.iter().for_each(|i| things.object[*i] = number);
    }
    Ok(things)
}

fn options(args: &MeshArgs, scene: &Scene) -> Result<MeshOptions> {
    let units = |length: Option<Distance>| length.map(|l| l.in_units(scene)).transpose();
    Ok(MeshOptions {
        voxel: units(args.voxel)?,
        simplify: units(args.error)?.map_or(Simplify::Triangles(args.triangles), Simplify::Error),
        fill_guessed: args.fill_guessed,
    })
}

/// Figures of a mesh, lengths in the units of the file.
fn figures(made: &SceneMesh, placed: &Mesh, placement: &Placement, world: &World, args: &MeshArgs) -> Value {
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
        "up": if args.raw { "as in the scene" } else if placement.upright { "y" } else { "unknown" },
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
        "guessed": args.fill_guessed,
    })
}

fn with_file(mut figures: Value, file: &Path) -> Value {
    figures["file"] = json!(file);
    figures
}

/// One line on what was written.
fn line(figures: &Value, file: &Path) -> String {
    let number = |key: &str| figures[key].as_f64().unwrap_or_default();
    let metric = figures["unit"] == "metre";
    let length = |key: &str| match metric {
        true => format!("{:.1} mm", 1000.0 * number(key)),
        false => format!("{:.2e} units", number(key)),
    };
    let up = match (figures["up"].as_str(), figures["up_sigma_degrees"].as_f64()) {
        (Some("y"), Some(sigma)) => format!("y is up ± {sigma:.1}°"),
        (Some("unknown"), _) => "up is not known".to_owned(),
        _ => "axes of the scene".to_owned(),
    };
    let parts = match figures["parts"].as_u64() {
        Some(1) | None => String::new(),
        Some(n) => format!(" in {n} parts"),
    };
    let (unit, square) = if metric { ("metres", "m²") } else { ("scene units", "square units") };
    format!(
        "{}: {} triangles{parts}, {unit}, {up}; {:.3} {square}, {} edges at holes and borders; voxels of {}, simplification \
         moved 99.9 % of the surface by {} at most\n",
        file.display(),
        figures["triangles"],
        number("area"),
        figures["border_edges"],
        length("voxel"),
        length("moved")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_have_a_size() {
        assert_eq!(positive("2mm"), Ok(Distance::Metres(0.002)));
        for text in ["", "-1", "0", "2 inches"] {
            assert!(positive(text).is_err(), "{text}");
        }
    }
}
