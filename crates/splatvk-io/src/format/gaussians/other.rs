//! Files whose format differs from their name, or is not supported: detection and advice.
use super::sog;
use crate::{Error, files};
use std::io::Read as _;
use std::path::Path;

/// Endings of other programs' files, with advice.
const OTHERS: [(&str, &str); 13] = [
    (".ksplat", "a .ksplat is of GaussianSplats3D: export the .ply that it was made from"),
    (".lcc", "an .lcc is of XGRIDS: splat-transform turns it into a .ply"),
    (".rad", "a .rad is of Spark: give the .ply or .spz that it was made from"),
    (".usdz", "export the Gaussians of a .usdz as .ply"),
    (".usda", "export the Gaussians of a .usda as .ply"),
    (".usdc", "export the Gaussians of a .usdc as .ply"),
    (".usd", "export the Gaussians of a .usd as .ply"),
    (".html", "a page cannot be read: give the file that it shows"),
    (
        ".json",
        "a lod-meta.json of PlayCanvas becomes a .ply with splat-transform; a nerfstudio folder, with ns-export",
    ),
    (
        ".ckpt",
        "a checkpoint becomes a .ply with the program that trained it (nerfstudio: ns-export gaussian-splat)",
    ),
    (".pt", "a checkpoint becomes a .ply with the program that trained it (gsplat: export_splats)"),
    (".pth", "a checkpoint becomes a .ply with the program that trained it"),
    (".zip", "unpack it and give the file inside"),
];

/// Advice for a file name.
pub(super) fn named(path: &Path) -> Option<&'static str> {
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    OTHERS.iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, advice)| *advice)
}

/// Format of a file by its first bytes.
fn content(path: &Path) -> Option<&'static str> {
    let mut start = Vec::new();
    files::open(path).ok()?.0.take(16).read_to_end(&mut start).ok()?;
    let start = start.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&start);
    let name = match start {
        [b'p', b'l', b'y', b'\n' | b'\r' | b' ', ..] => "ply",
        [0x1f, 0x8b, ..] | [b'N', b'G', b'S', b'P', ..] => "spz",
        [b'g', b'l', b'T', b'F', ..] => "glb",
        [b'P', b'K', 3, 4, ..] if is_sog(path) => "sog",
        _ => return None,
    };
    Some(name)
}

/// Whether an archive contains the description of a `.sog`.
fn is_sog(path: &Path) -> bool {
    let names = || {
        let archive = zip::ZipArchive::new(files::open(path).ok()?.0).ok()?;
        archive.index_for_name(sog::META)
    };
    matches!(files::guarded(names), Ok(Some(_)))
}

/// Error for a file whose content is of another format than `format` with `ending`.
pub(super) fn misnamed(path: &Path, format: &str, ending: &str) -> Option<Error> {
    let name = content(path)?;
    // A .glb may be named .gltf, and a compressed .ply like a plain one: they share a reader.
    if ending.ends_with(&format!(".{name}")) || (name, format) == ("glb", "gltf") {
        return None;
    }
    let path = path.display();
    Some(Error::input(format!(
        "{path}: is a .{name} file, not what its name says; rename it to end in .{name}"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::gaussians::{FORMATS, WriteOptions, read_noted, write_as};
    use crate::scene::seeded;

    #[test]
    fn other_formats_are_refused_with_advice() {
        for (name, words) in [
            ("a.ksplat", "GaussianSplats3D"),
            ("lod-meta.json", "splat-transform"),
            ("a.usdz", "as .ply"),
            ("a.xyz", "one of these formats"),
        ] {
            let e = read_noted(Path::new(name)).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().contains(words), "{e}");
        }
    }

    #[test]
    fn content_of_another_format_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let splats = seeded::small(9, 32, 24, 0, 1001).0;
        for format in FORMATS.iter().filter(|f| !["splat", "gltf"].contains(&f.name)) {
            for name in ["a.ply", "a.spz", "a.glb", "a.splat", "a.sog"] {
                let path = folder.path().join(name);
                write_as(&path, &splats, None, format, WriteOptions::default()).unwrap();
                match read_noted(&path) {
                    Ok(_) => assert!(format.ending.ends_with(&name[1..]), "{} as {name}", format.name),
                    Err(e) => assert!(
                        e.to_string().contains("not what its name says"),
                        "{} as {name}: {e}",
                        format.name
                    ),
                }
                std::fs::remove_file(&path).unwrap();
            }
        }
    }
}
