//! `splatvk mesh`: surfaces of a scene as triangles.
use super::args::{DeviceArgs, EditUse};
use super::print::{print, print_json};
use super::{objects, progress, scene, views};
use crate::Result;
use crate::format::mesh::MeshFormat;
use crate::run::mesh::{Collider, MeshPlan, TRIANGLES};
use crate::run::metric::Distance;
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
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
    #[arg(long, default_value_t = TRIANGLES, value_parser = super::args::whole::<usize>(1..=100_000_000), value_name = "N")]
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

impl MeshArgs {
    fn plan(&self) -> Result<MeshPlan> {
        Ok(MeshPlan {
            format: self.format.map(MeshFormat::from),
            triangles: self.triangles,
            error: self.error,
            voxel: self.voxel,
            fill_guessed: self.fill_guessed,
            collider: self.collider.kind(),
            by_object: self.by_object,
            vocabulary: self.vocabulary.as_deref().map(objects::vocabulary).transpose()?,
            cameras: self.cameras.as_deref().map(views::read).transpose()?,
            raw: self.raw,
        })
    }
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
    let inputs = [Some(&args.scene), args.cameras.as_ref(), args.vocabulary.as_ref()].into_iter().flatten();
    let inputs: Vec<&Path> = inputs.map(PathBuf::as_path).collect();
    let plan = args.plan()?;
    let out = plan.reserve(&args.file, args.force, &inputs)?;
    let scene = scene::load(&args.scene, args.edits)?;
    let figures = out.write(scene, &args.device.machine(), progress::reporter().as_ref())?;
    match args.device.json {
        true => print_json(&with_file(figures, &args.file)),
        false => print(&line(&figures, &args.file)),
    }
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
