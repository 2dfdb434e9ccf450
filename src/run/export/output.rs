//! Reserved output of an export, and its format.
use crate::files::{Kind, check_place};
use crate::format::gaussians::{FORMATS, Reserved, SplatFormat};
use crate::run::outputs::{WrittenFile, WrittenFiles, check_file};
use crate::{Error, Result};
use std::path::Path;

/// Reserved output of a format.
pub(super) enum Output {
    /// The files of a COLMAP model.
    Folder(WrittenFiles),
    /// One file: cameras, a page, or a PLY, the only format with language inside and any SH degree.
    File(WrittenFile),
    /// Splats, with the language beside them.
    Splats(Reserved, &'static SplatFormat),
}

impl Output {
    /// Reserves the output, or refuses a place that may not be written, before the scene is read.
    pub(super) fn reserve(scene: &Path, out: &Path, format: &str, force: bool) -> Result<Output> {
        let is_folder = is_folder(format);
        check_ending(out, format)?;
        // Refuses a link wherever it leads.
        check_place(out, if is_folder { Kind::Folder } else { Kind::File }, true)?;
        if let (Ok(place), Ok(scene)) = (out.canonicalize(), scene.canonicalize())
            && scene.is_dir()
            && place.starts_with(&scene)
        {
            return Err(Error::input(format!(
                "{}: a part of the scene that is exported; choose another place",
                out.display()
            )));
        }
        let inputs = [scene];
        if is_folder {
            return WrittenFiles::open(out, force, &inputs).map(Output::Folder);
        }
        match SplatFormat::named(format).filter(|format| format.name != "ply") {
            Some(format) => {
                check_file(out, force, &inputs)?;
                Ok(Output::Splats(Reserved::open(out, force)?, format))
            }
            None => WrittenFile::open(out, force, &inputs).map(Output::File),
        }
    }
}

/// Formats with a file ending: (name, ending).
fn endings() -> impl Iterator<Item = (&'static str, &'static str)> {
    FORMATS.iter().map(|f| (f.name, f.ending)).chain([("transforms", ".json"), ("html", ".html")])
}

/// Formats beside those of Gaussians, with a description.
const OTHERS: [(&str, &str); 4] = [
    ("html", "the interactive view as one page, to look at and to send"),
    ("colmap", "COLMAP text model"),
    ("colmap-bin", "COLMAP binary model"),
    ("transforms", "nerfstudio transforms.json"),
];

/// All formats with a description.
pub fn formats() -> impl Iterator<Item = (&'static str, &'static str)> {
    FORMATS.iter().map(|f| (f.name, f.about)).chain(OTHERS)
}

/// Whether a format is a folder of files.
pub fn is_folder(format: &str) -> bool {
    format.starts_with("colmap")
}

/// The requested format, or that of the ending of the file's name.
///
/// # Errors
/// An unknown format, and a name that states none.
pub fn format<'a>(asked: Option<&'a str>, out: &Path) -> Result<&'a str> {
    if let Some(format) = asked {
        return match formats().any(|(name, _)| name == format) {
            true => Ok(format),
            false => Err(Error::input(format!(
                "--format: there is no format {format}; there are {}",
                formats().map(|(name, _)| name).collect::<Vec<_>>().join(", ")
            ))),
        };
    }
    let lower = out.to_string_lossy().to_lowercase();
    match endings().find(|(_, ending)| lower.ends_with(ending)) {
        Some((name, _)) => Ok(name),
        None if [".usd", ".usda", ".usdc", ".usdz"].iter().any(|usd| lower.ends_with(usd)) => {
            Err(Error::input(format!(
                "{}: USD is written by the Python package splatvk[usd]: scene.save(\"kitchen.usdc\")",
                out.display()
            )))
        }
        None => Err(Error::input(format!(
            "{}: its ending states no format; give --format, or one of the endings {}",
            out.display(),
            endings().map(|(_, ending)| ending).collect::<Vec<_>>().join(", ")
        ))),
    }
}

/// Refuses an ending of another format, and returns a warning for an ending of none.
pub(super) fn check_ending(path: &Path, format: &str) -> Result<Option<String>> {
    let Some((_, own)) = endings().find(|(name, _)| *name == format) else { return Ok(None) };
    let (out, file) = (path.display(), path.to_string_lossy());
    let lower = file.to_lowercase();
    match endings().find(|(_, ending)| lower.ends_with(ending)) {
        Some((name, _)) if name == format => Ok(None),
        // Programs recognise a compressed .ply by its content.
        Some(("ply", _)) if format == "compressed-ply" => Ok(None),
        Some((name, ending)) => {
            let stem = file.get(..file.len() - ending.len()).unwrap_or_default();
            Err(Error::input(format!(
                "{out}: names that end in {ending} are of --format {name}, not {format}; name it {stem}{own}, or give \
                 --format {name}"
            )))
        }
        None => Ok(Some(format!("{out}: programs know --format {format} by names that end in {own}"))),
    }
}
