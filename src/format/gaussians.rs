//! Files of Gaussians: one reader and one writer for every format, chosen by the end of the file's name or by the format's.
pub mod gltf;
pub mod ply;
pub mod ply_packed;
mod ply_table;
pub mod splat;
pub mod spz;
pub(crate) mod usable;

use super::side_file;
use crate::files::Partial;
use crate::scene::{LanguageField, Splats};
use crate::{Error, Result};
use std::path::Path;

/// A format of Gaussians.
pub struct SplatFormat {
    /// As `splatvk export --format` takes it.
    pub name: &'static str,
    /// What it is.
    pub about: &'static str,
    /// End of the files' names.
    pub ending: &'static str,
    /// Brightest base colour that it holds; `None` = any.
    pub brightest: Option<f32>,
    /// Its axes are right, up, back by definition; the others hold whatever axes a scene has.
    pub y_up: bool,
    read: fn(&Path) -> Result<Splats>,
    /// Returns the order of the rows; empty = the scene's own.
    write: fn(&Path, &Splats) -> Result<Vec<u32>>,
}

/// All formats; an ending comes before those that it ends with.
pub static FORMATS: [SplatFormat; 6] = [
    SplatFormat {
        name: "compressed-ply",
        about: "compressed .ply, as SuperSplat writes it",
        ending: ".compressed.ply",
        brightest: None,
        y_up: false,
        read: ply::read_splats,
        write: ply_packed::write_splats,
    },
    SplatFormat {
        name: "ply",
        about: "INRIA .ply",
        ending: ".ply",
        brightest: None,
        y_up: false,
        read: ply::read_splats,
        write: |path, s| ply::write_splats(path, s, ply::PlyOptions::default()).map(|()| Vec::new()),
    },
    SplatFormat {
        name: "splat",
        about: ".splat",
        ending: ".splat",
        brightest: Some(splat::BRIGHTEST),
        y_up: false,
        read: splat::read_splats,
        write: splat::write_splats,
    },
    SplatFormat {
        name: "spz",
        about: ".spz version 4",
        ending: ".spz",
        brightest: Some(spz::BRIGHTEST),
        y_up: true,
        read: spz::read_splats,
        write: |path, s| spz::write_splats(path, s).map(|()| Vec::new()),
    },
    SplatFormat {
        name: "glb",
        about: "glTF with KHR_gaussian_splatting, binary",
        ending: ".glb",
        brightest: None,
        y_up: true,
        read: gltf::read_splats,
        write: |path, s| gltf::write_glb(path, s).map(|()| Vec::new()),
    },
    SplatFormat {
        name: "gltf",
        about: "the same as text",
        ending: ".gltf",
        brightest: None,
        y_up: true,
        read: gltf::read_splats,
        write: |path, s| gltf::write_gltf(path, s).map(|()| Vec::new()),
    },
];

impl SplatFormat {
    /// The one of a name.
    pub fn named(name: &str) -> Option<&'static SplatFormat> {
        FORMATS.iter().find(|f| f.name == name)
    }
}

fn find(path: &Path) -> Option<&'static SplatFormat> {
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    FORMATS.iter().find(|k| name.ends_with(k.ending))
}

/// Whether the name is one of a file of Gaussians.
pub fn is_named(path: &Path) -> bool {
    find(path).is_some()
}

fn format(path: &Path) -> Result<&'static SplatFormat> {
    find(path).ok_or_else(|| {
        let (path, endings) = (path.display(), endings());
        Error::input(format!("{path}: no known format of splats; the name must end in one of {endings}"))
    })
}

/// The endings of all formats, for messages.
pub fn endings() -> String {
    FORMATS.iter().map(|k| k.ending).collect::<Vec<_>>().join(", ")
}

/// Reads a file of Gaussians, and the language beside it, if any. Gaussians that cannot be computed with (numbers that are not
/// finite or beyond 1e18, no rotation) are left out.
pub fn read(path: &Path) -> Result<(Splats, Option<LanguageField>)> {
    read_counted(path).map(|(splats, language, _)| (splats, language))
}

/// [`read`], and what was left out, one line.
pub fn read_counted(path: &Path) -> Result<(Splats, Option<LanguageField>, Option<String>)> {
    let splats = (format(path)?.read)(path)?;
    let language = side_file::read(path, splats.len())?;
    usable::keep(splats, language, path)
}

/// Writes a file of Gaussians, and beside it ([`side_file`]) their language, if they have any.
pub fn write(path: &Path, splats: &Splats, language: Option<&LanguageField>) -> Result<()> {
    write_as(path, splats, language, format(path)?)
}

/// [`write()`] in a format, whatever the file is called.
pub fn write_as(
    path: &Path,
    splats: &Splats,
    language: Option<&LanguageField>,
    format: &SplatFormat,
) -> Result<()> {
    let with_codes = language.filter(|l| l.levels.iter().any(|l| !l.codebook.is_empty()));
    let side = side_file::path(path);
    let partial = |place: &Path| Partial::beside(place, false).map_err(Error::unwritable(place));
    let splat_file = partial(path)?;
    let order = (format.write)(splat_file.path(), splats)?;
    let language_file = match with_codes {
        Some(field) => {
            let file = partial(&side)?;
            side_file::write(file.path(), field, splats.len(), &order)?;
            Some(file)
        }
        None => None,
    };
    // Both are written. Wherever a kill comes between these moves, no file has the language of another one beside it.
    if side.is_file() {
        std::fs::remove_file(&side).map_err(Error::unwritable(&side))?;
    }
    let place = |file: Partial, place: &Path| {
        file.finish(|from| std::fs::rename(from, place).map_err(Error::unwritable(place)))
    };
    place(splat_file, path)?;
    language_file.map_or(Ok(()), |file| place(file, &side))
}
