//! Files of Gaussians: one reader and one writer for every format, chosen by the ending of the
//! file's name or by the name of the format.
mod degree;
pub mod gltf;
mod other;
pub mod ply;
mod ply_comments;
mod ply_header;
pub mod ply_packed;
mod ply_points;
mod ply_table;
pub mod sog;
pub mod splat;
pub mod spz;
mod spz_extensions;
pub mod usable;

use super::side_file;
use crate::files::{Kind, Partial, check_place};
use crate::scene::{LanguageField, Splats};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// A format of Gaussians.
pub struct SplatFormat {
    /// Name for `splatvk export --format`.
    pub name: &'static str,
    /// Description in the help text.
    pub about: &'static str,
    /// Ending of the file names.
    pub ending: &'static str,
    /// Brightest base colour that it represents; `None` = any.
    pub brightest: Option<f32>,
    /// Whether its axes are right, up, back by definition; other formats use the axes of the scene.
    pub y_up: bool,
    /// Whether it stores that Gaussians are antialiased ([`Splats::antialiased`]).
    pub states_filter: bool,
    /// Reads a file; appends a note on each part that is not read.
    read: fn(&Path, &mut Vec<String>) -> Result<Splats>,
    /// Writes a file; returns the order of the rows; empty = the scene's own.
    write: fn(&Path, &Splats, WriteOptions) -> Result<Vec<u32>>,
}

/// Parameters that the formats leave open.
#[derive(Clone, Copy, Debug)]
pub struct WriteOptions {
    /// Version of `.spz`, one of [`spz::VERSIONS`].
    pub spz_version: u32,
}

impl Default for WriteOptions {
    fn default() -> Self {
        WriteOptions { spz_version: spz::DEFAULT_VERSION }
    }
}

/// All formats; an ending stands before its own suffixes (".compressed.ply" before ".ply").
pub static FORMATS: [SplatFormat; 7] = [
    SplatFormat {
        name: "compressed-ply",
        about: "compressed .ply, as SuperSplat writes it",
        ending: ".compressed.ply",
        brightest: None,
        y_up: false,
        states_filter: true,
        read: ply::read_noted,
        write: |path, s, _| ply_packed::write_splats(path, s),
    },
    SplatFormat {
        name: "ply",
        about: "INRIA .ply",
        ending: ".ply",
        brightest: None,
        y_up: false,
        states_filter: true,
        read: ply::read_noted,
        write: |path, s, _| ply::write_splats(path, s, ply::PlyOptions::default()).map(|()| Vec::new()),
    },
    SplatFormat {
        name: "splat",
        about: ".splat",
        ending: ".splat",
        brightest: Some(splat::BRIGHTEST),
        y_up: false,
        states_filter: false,
        read: splat::read_noted,
        write: |path, s, _| splat::write_splats(path, s),
    },
    SplatFormat {
        name: "spz",
        about: ".spz of Niantic, as --spz-version says",
        ending: ".spz",
        brightest: Some(spz::BRIGHTEST),
        y_up: true,
        states_filter: true,
        read: spz::read_noted,
        write: |path, s, options| spz::write_splats(path, s, options.spz_version).map(|()| Vec::new()),
    },
    SplatFormat {
        name: "sog",
        about: ".sog of PlayCanvas, the smallest",
        ending: ".sog",
        brightest: None,
        y_up: false,
        states_filter: true,
        read: sog::read_noted,
        write: |path, s, _| sog::write_splats(path, s),
    },
    SplatFormat {
        name: "glb",
        about: "glTF with KHR_gaussian_splatting, binary",
        ending: ".glb",
        brightest: None,
        y_up: true,
        states_filter: false,
        read: gltf::read_noted,
        write: |path, s, _| gltf::write_glb(path, s).map(|()| Vec::new()),
    },
    SplatFormat {
        name: "gltf",
        about: "the same as text",
        ending: ".gltf",
        brightest: None,
        y_up: true,
        states_filter: false,
        read: gltf::read_noted,
        write: |path, s, _| gltf::write_gltf(path, s).map(|()| Vec::new()),
    },
];

impl SplatFormat {
    /// Format with a name.
    pub fn named(name: &str) -> Option<&'static SplatFormat> {
        FORMATS.iter().find(|f| f.name == name)
    }
}

fn find(path: &Path) -> Option<&'static SplatFormat> {
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    FORMATS.iter().find(|k| name.ends_with(k.ending))
}

/// Whether the name is that of a file of Gaussians.
pub fn is_named(path: &Path) -> bool {
    find(path).is_some()
}

/// Format by the name of a file that is read: unpacked, a `.sog` is a `meta.json` with images.
fn readable(path: &Path) -> Result<&'static SplatFormat> {
    match SplatFormat::named("sog") {
        Some(sog) if path.file_name().is_some_and(|name| name == sog::META) => Ok(sog),
        _ => format(path),
    }
}

/// Format by the ending of a file's name.
pub fn format(path: &Path) -> Result<&'static SplatFormat> {
    find(path).ok_or_else(|| {
        let (place, endings) = (path.display(), endings());
        let advice = other::named(path).unwrap_or("give a file in one of these formats");
        Error::input(format!("{place}: splats are read from names that end in {endings}; {advice}"))
    })
}

/// Endings of all formats, for messages.
pub fn endings() -> String {
    FORMATS.iter().map(|k| k.ending).collect::<Vec<_>>().join(", ")
}

/// Reads a file of Gaussians, and the language beside it, if any. Unusable Gaussians (numbers that
/// are not finite or beyond 1e18, no rotation) are left out.
pub fn read(path: &Path) -> Result<(Splats, Option<LanguageField>)> {
    read_noted(path).map(|(splats, language, _)| (splats, language))
}

/// Like [`read`]; also returns notes on parts that were left out or not applied, a line each.
pub fn read_noted(path: &Path) -> Result<(Splats, Option<LanguageField>, Vec<String>)> {
    let format = readable(path)?;
    if let Some(e) = other::misnamed(path, format.name, format.ending) {
        return Err(e);
    }
    let mut notes = Vec::new();
    let splats = (format.read)(path, &mut notes)?;
    let language = side_file::read(path, splats.len())?;
    let (splats, language) = usable::keep(splats, language, path, &mut notes)?;
    notes.extend(usable::precision(&splats.means));
    Ok((splats, language, usable::finished(notes, path)))
}

/// Writes a file of Gaussians, and beside it ([`side_file`]) their language, if any; replaces
/// existing regular files.
pub fn write(path: &Path, splats: &Splats, language: Option<&LanguageField>) -> Result<()> {
    write_as(path, splats, language, format(path)?, WriteOptions::default())
}

/// Like [`write()`], in a given format, whatever the name of the file.
pub fn write_as(
    path: &Path,
    splats: &Splats,
    language: Option<&LanguageField>,
    format: &SplatFormat,
    options: WriteOptions,
) -> Result<()> {
    Reserved::open(path, true)?.write(splats, language, format, options)
}

/// Reserved places of a file of Gaussians and of the language beside it: nobody else writes to them
/// while this value lives.
#[derive(Debug)]
pub struct Reserved {
    path: PathBuf,
    side: PathBuf,
    force: bool,
    splat_file: Partial,
    language_file: Partial,
}

impl Reserved {
    /// Reserves the places; refuses files that may not be overwritten.
    pub fn open(path: &Path, force: bool) -> Result<Reserved> {
        let side = side_file::path(path);
        check_place(path, Kind::File, force)?;
        check_place(&side, Kind::File, force)?;
        let (splat_file, language_file) = (Partial::beside(path)?, Partial::beside(&side)?);
        Ok(Reserved { path: path.to_path_buf(), side, force, splat_file, language_file })
    }

    /// Writes both files, or only the first where there is no language.
    pub fn write(
        self,
        splats: &Splats,
        language: Option<&LanguageField>,
        format: &SplatFormat,
        options: WriteOptions,
    ) -> Result<()> {
        let with_codes = language.filter(|l| l.levels.iter().any(|l| !l.codebook.is_empty()));
        // An error of the format names the requested place, not the temporary file beside it.
        let order = (format.write)(self.splat_file.path(), splats, options).map_err(|e| match e {
            Error::Input(what) => Error::input(format!("{}: {what}", self.path.display())),
            other => other,
        })?;
        if let Some(field) = with_codes {
            side_file::write(self.language_file.path(), field, splats.len(), &order)?;
        }
        // Both are complete. Files that came to the places meanwhile are not overwritten without
        // `force`.
        check_place(&self.path, Kind::File, self.force)?;
        check_place(&self.side, Kind::File, self.force)?;
        // If the process is killed between the moves, a file may lack its language but never has
        // that of another one.
        if self.side.is_file() {
            std::fs::remove_file(&self.side).map_err(Error::unwritable(&self.side))?;
        }
        move_to(self.splat_file, &self.path)?;
        with_codes.map_or(Ok(()), |_| move_to(self.language_file, &self.side))
    }
}

/// Moves a finished file to its place.
fn move_to(file: Partial, place: &Path) -> Result<()> {
    file.finish(|from| std::fs::rename(from, place).map_err(Error::unwritable(place)))
}
