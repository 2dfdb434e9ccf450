//! Files of Gaussians: one reader and one writer for every format, chosen by the end of the file's name or by the format's.
pub mod gltf;
pub mod ply;
pub mod ply_packed;
mod ply_table;
pub mod splat;
pub mod spz;
pub(crate) mod usable;

use super::side_file;
use crate::files::{Kind, Partial, check_place};
use crate::scene::{LanguageField, Splats};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

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

/// The format that the name of a file says.
pub(crate) fn format(path: &Path) -> Result<&'static SplatFormat> {
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

/// Writes a file of Gaussians, and beside it ([`side_file`]) their language, if they have any; ordinary files that are there are
/// replaced.
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
    Reserved::open(path, true)?.write(splats, language, format)
}

/// The places of a file of Gaussians and of the language beside it, to which nobody else writes as long as this lives.
#[derive(Debug)]
pub(crate) struct Reserved {
    path: PathBuf,
    side: PathBuf,
    force: bool,
    splat_file: Partial,
    language_file: Partial,
}

impl Reserved {
    /// Refuses places that may not be written over.
    pub fn open(path: &Path, force: bool) -> Result<Reserved> {
        let side = side_file::path(path);
        check_place(path, Kind::File, force)?;
        check_place(&side, Kind::File, force)?;
        let (splat_file, language_file) = (Partial::beside(path)?, Partial::beside(&side)?);
        Ok(Reserved { path: path.to_path_buf(), side, force, splat_file, language_file })
    }

    /// Writes both files, or the one where there is no language.
    pub fn write(
        self,
        splats: &Splats,
        language: Option<&LanguageField>,
        format: &SplatFormat,
    ) -> Result<()> {
        let with_codes = language.filter(|l| l.levels.iter().any(|l| !l.codebook.is_empty()));
        let order = (format.write)(self.splat_file.path(), splats)?;
        if let Some(field) = with_codes {
            side_file::write(self.language_file.path(), field, splats.len(), &order)?;
        }
        // Both are written. What came there meanwhile is not ours.
        check_place(&self.path, Kind::File, self.force)?;
        check_place(&self.side, Kind::File, self.force)?;
        // Wherever a kill comes between these moves, no file has the language of another one beside it.
        if self.side.is_file() {
            std::fs::remove_file(&self.side).map_err(Error::unwritable(&self.side))?;
        }
        let place = |file: Partial, place: &Path| {
            file.finish(|from| std::fs::rename(from, place).map_err(Error::unwritable(place)))
        };
        place(self.splat_file, &self.path)?;
        with_codes.map_or(Ok(()), |_| place(self.language_file, &self.side))
    }
}
