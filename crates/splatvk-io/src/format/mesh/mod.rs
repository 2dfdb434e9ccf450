//! Files of meshes: glb, ply and obj.
mod glb;
mod obj;
mod ply;

use crate::scene::Mesh;
use crate::{Error, Result};
use serde_json::Value;
use std::path::Path;

/// Format of a mesh file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    /// Binary glTF 2.0: a named node per part below the node of the scene, linear `COLOR_0` on an
    /// unlit material.
    Glb,
    /// Binary PLY with the colours of vertices; parts are comments.
    Ply,
    /// Wavefront OBJ with the colours of vertices; a part is an `o NAME`.
    Obj,
}

/// Formats by the ending of the file's name.
const ENDINGS: [(&str, MeshFormat); 3] =
    [(".glb", MeshFormat::Glb), (".ply", MeshFormat::Ply), (".obj", MeshFormat::Obj)];

impl MeshFormat {
    /// Format by the ending of a file's name.
    ///
    /// # Errors
    /// Bad input for another ending.
    pub fn of(path: &Path) -> Result<MeshFormat> {
        let name = path.to_string_lossy().to_lowercase();
        let found = ENDINGS.iter().find(|(ending, _)| name.ends_with(ending));
        found.map(|(_, format)| *format).ok_or_else(|| {
            let place = path.display();
            Error::input(format!(
                "{place}: its ending states no format of meshes; choose .glb, .ply or .obj, or give --format"
            ))
        })
    }

    /// Whether y is up by definition.
    pub fn is_y_up(self) -> bool {
        self == MeshFormat::Glb
    }

    /// Whether the file has places for the shapes of physics.
    pub fn has_colliders(self) -> bool {
        self != MeshFormat::Ply
    }
}

/// Statements of a file beside the mesh.
#[derive(Clone, Debug)]
pub struct MeshFile<'a> {
    /// Name of the scene.
    pub name: &'a str,
    /// Whether the origin of a part is the middle of the bottom of its box; otherwise that of the
    /// scene. Only glb has origins.
    pub own_origins: bool,
    /// `extras` of the scene's node (glb); the text of other files is for people.
    pub extras: Value,
}

/// Writes a mesh, in its own axes; glTF has y up.
///
/// # Errors
/// Places that cannot be written, and more than 4 GiB of glb.
pub fn write(path: &Path, mesh: &Mesh, format: MeshFormat, file: &MeshFile) -> Result<()> {
    match format {
        MeshFormat::Glb => glb::write(path, mesh, file),
        MeshFormat::Ply => ply::write(path, mesh, file),
        MeshFormat::Obj => obj::write(path, mesh, file),
    }
}

/// A name on one line.
fn one_line(name: &str) -> String {
    name.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// Name of a shape of physics: that of its part with a suffix, and a number where there are several.
fn collider_name(part: &str, index: usize, count: usize) -> String {
    match count {
        1 => format!("{part}_collider"),
        _ => format!("{part}_collider_{index:02}"),
    }
}

/// An sRGB byte per channel of a linear colour.
fn srgb(colour: [f32; 3]) -> [u8; 3] {
    colour.map(|v| super::to_byte(crate::scene::to_srgb(v.clamp(0.0, 1.0))))
}

#[cfg(test)]
mod tests;
