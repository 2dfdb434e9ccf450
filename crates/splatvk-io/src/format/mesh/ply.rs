//! Binary PLY.
use super::{MeshFile, one_line, srgb};
use crate::scene::Mesh;
use crate::{Error, Result};
use std::fmt::Write;
use std::path::Path;

pub(super) fn write(path: &Path, mesh: &Mesh, file: &MeshFile) -> Result<()> {
    let mut head = format!(
        "ply\nformat binary_little_endian 1.0\ncomment splatvk {} mesh of {}\n",
        env!("CARGO_PKG_VERSION"),
        one_line(file.name)
    );
    // Writing to a String cannot fail.
    for part in &mesh.parts {
        let (name, rows) = (one_line(&part.name), &part.triangles);
        let _ = writeln!(head, "comment faces {} to {}: {name}", rows.start, rows.end);
    }
    let _ = writeln!(head, "element vertex {}", mesh.positions.len());
    for (kind, names) in [("float", "x y z nx ny nz"), ("uchar", "red green blue")] {
        names.split(' ').for_each(|name| {
            let _ = writeln!(head, "property {kind} {name}");
        });
    }
    let _ = write!(
        head,
        "element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.triangles.len()
    );
    let mut out = head.into_bytes();
    for ((position, normal), colour) in mesh.positions.iter().zip(&mesh.normals).zip(&mesh.colours) {
        out.extend_from_slice(bytemuck::cast_slice(position));
        out.extend_from_slice(bytemuck::cast_slice(normal));
        out.extend(srgb(*colour));
    }
    for triangle in &mesh.triangles {
        out.push(3);
        out.extend_from_slice(bytemuck::cast_slice(triangle));
    }
    std::fs::write(path, out).map_err(Error::unwritable(path))
}
