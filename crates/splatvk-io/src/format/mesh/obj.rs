//! Wavefront OBJ.
use super::{MeshFile, collider_name, one_line, srgb};
use crate::scene::Mesh;
use crate::{Error, Result};
use std::fmt::Write;
use std::path::Path;

pub(super) fn write(path: &Path, mesh: &Mesh, file: &MeshFile) -> Result<()> {
    let mut out = format!("# splatvk {} mesh of {}\n", env!("CARGO_PKG_VERSION"), one_line(file.name));
    // Vertices count from 1 through the whole file. Writing to a String cannot fail.
    let mut first = 1;
    for part in &mesh.parts {
        let own = mesh.part(part);
        let _ = writeln!(out, "o {}", one_line(&part.name));
        for ([x, y, z], colour) in own.positions.iter().zip(&own.colours) {
            let [r, g, b] = srgb(*colour).map(|v| f32::from(v) / 255.0);
            let _ = writeln!(out, "v {x} {y} {z} {r:.4} {g:.4} {b:.4}");
        }
        for [x, y, z] in &own.normals {
            let _ = writeln!(out, "vn {x:.4} {y:.4} {z:.4}");
        }
        let normal = first - collider_vertices_before(mesh, part.triangles.start);
        for triangle in &own.triangles {
            let [a, b, c] = triangle.map(|v| (first + v as usize, normal + v as usize));
            let _ = writeln!(out, "f {}//{} {}//{} {}//{}", a.0, a.1, b.0, b.1, c.0, c.1);
        }
        first += own.positions.len();
        for (i, hull) in part.colliders.iter().enumerate() {
            let _ = writeln!(out, "o {}", one_line(&collider_name(&part.name, i, part.colliders.len())));
            for [x, y, z] in &hull.positions {
                let _ = writeln!(out, "v {x} {y} {z}");
            }
            for triangle in &hull.triangles {
                let [a, b, c] = triangle.map(|v| first + v as usize);
                let _ = writeln!(out, "f {a} {b} {c}");
            }
            first += hull.positions.len();
        }
    }
    std::fs::write(path, out).map_err(Error::unwritable(path))
}

/// Number of vertices without a normal before a part: those of shapes of earlier parts.
fn collider_vertices_before(mesh: &Mesh, start: usize) -> usize {
    let earlier = mesh.parts.iter().filter(|part| part.triangles.start < start);
    earlier.flat_map(|part| &part.colliders).map(|hull| hull.positions.len()).sum()
}
