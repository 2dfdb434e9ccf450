//! Files of Gaussians: one reader and one writer for every kind, chosen by the end of the file's name.
use super::{gltf, ply, ply_packed, side_file, splat, spz, whole};
use crate::scene::{LanguageField, Splats};
use crate::{Error, Result};
use std::path::Path;

/// A kind of file.
struct Kind {
    /// End of the names.
    ending: &'static str,
    read: fn(&Path) -> Result<Splats>,
    /// Returns the order of the rows; empty = the scene's own.
    write: fn(&Path, &Splats) -> Result<Vec<u32>>,
}

/// All kinds; an ending comes before those that it ends with.
static KINDS: [Kind; 6] = [
    Kind { ending: ".compressed.ply", read: ply::read_splats, write: ply_packed::write_splats },
    Kind {
        ending: ".ply",
        read: ply::read_splats,
        write: |path, s| ply::write_splats(path, s, ply::PlyOptions::default()).map(|()| Vec::new()),
    },
    Kind { ending: ".splat", read: splat::read_splats, write: splat::write_splats },
    Kind {
        ending: ".spz",
        read: spz::read_splats,
        write: |path, s| spz::write_splats(path, s).map(|()| Vec::new()),
    },
    Kind {
        ending: ".glb",
        read: gltf::read_splats,
        write: |path, s| gltf::write_glb(path, s).map(|()| Vec::new()),
    },
    Kind {
        ending: ".gltf",
        read: gltf::read_splats,
        write: |path, s| gltf::write_gltf(path, s).map(|()| Vec::new()),
    },
];

fn find(path: &Path) -> Option<&'static Kind> {
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    KINDS.iter().find(|k| name.ends_with(k.ending))
}

/// Whether the name is one of a file of Gaussians.
pub fn is_named(path: &Path) -> bool {
    find(path).is_some()
}

fn kind(path: &Path) -> Result<&'static Kind> {
    find(path).ok_or_else(|| {
        let endings = KINDS.iter().map(|k| k.ending).collect::<Vec<_>>().join(", ");
        let path = path.display();
        Error::input(format!("{path}: no known kind of splat file; the name must end in one of {endings}"))
    })
}

/// Reads a file of Gaussians, and the language beside it, if any.
pub fn read(path: &Path) -> Result<(Splats, Option<LanguageField>)> {
    let splats = (kind(path)?.read)(path)?;
    let language = side_file::read(path, splats.len())?;
    Ok((splats, language))
}

/// Writes a file of Gaussians, and beside it ([`side_file`]) their language, if they have any.
pub fn write(path: &Path, splats: &Splats, language: Option<&LanguageField>) -> Result<()> {
    write_as(path, splats, language, kind(path)?.write)
}

/// [`write()`] with a writer that returns the order of its rows (empty = the scene's own), whatever the file is called.
pub fn write_as(
    path: &Path,
    splats: &Splats,
    language: Option<&LanguageField>,
    write: impl FnOnce(&Path, &Splats) -> Result<Vec<u32>>,
) -> Result<()> {
    let spoken = language.filter(|l| l.levels.iter().any(|l| !l.codebook.is_empty()));
    whole(path, |partial| {
        let order = write(partial, splats)?;
        let beside = side_file::path(path);
        match spoken {
            // Language first: a file with the wrong language beside it would be worse than one that is missing.
            Some(field) => whole(&beside, |p| side_file::write(p, field, splats.len(), &order)),
            // So would be that of an older file.
            None if beside.is_file() => std::fs::remove_file(&beside).map_err(Error::io(&beside)),
            None => Ok(()),
        }
    })
}
