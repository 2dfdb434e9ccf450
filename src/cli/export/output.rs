//! Reserved output of `splatvk export`, and its format.
use super::ExportArgs;
use crate::cli::outputs::{WrittenFile, WrittenFiles, check_file};
use crate::files::{Kind, check_place};
use crate::format::gaussians::{FORMATS, Reserved, SplatFormat};
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
    pub(super) fn reserve(args: &ExportArgs, format: &str) -> Result<Output> {
        let is_folder = is_folder(format);
        if args.spz_version.is_some() && format != "spz" {
            return Err(Error::input("--spz-version: only --format spz has versions; leave it out"));
        }
        let out = args.place();
        check_ending(out, format)?;
        // Refuses a link wherever it leads.
        check_place(out, if is_folder { Kind::Folder } else { Kind::File }, true)?;
        if let (Ok(place), Ok(scene)) = (out.canonicalize(), args.scene.canonicalize())
            && scene.is_dir()
            && place.starts_with(&scene)
        {
            return Err(Error::input(format!(
                "{}: a part of the scene that is exported; choose another place",
                out.display()
            )));
        }
        let inputs = [args.scene.as_path()];
        if is_folder {
            return WrittenFiles::open(out, args.force, &inputs).map(Output::Folder);
        }
        match SplatFormat::named(format).filter(|format| format.name != "ply") {
            Some(format) => {
                check_file(out, args.force, &inputs)?;
                Ok(Output::Splats(Reserved::open(out, args.force)?, format))
            }
            None => WrittenFile::open(out, args.force, &inputs).map(Output::File),
        }
    }
}

/// Formats with a file ending: (name, ending).
fn endings() -> impl Iterator<Item = (&'static str, &'static str)> {
    FORMATS.iter().map(|f| (f.name, f.ending)).chain([("transforms", ".json"), ("html", ".html")])
}

/// Whether a format is a folder of files.
pub fn is_folder(format: &str) -> bool {
    format.starts_with("colmap")
}

/// The requested format, or that of the ending of the file's name.
pub fn format(args: &ExportArgs) -> Result<&str> {
    if let Some(format) = &args.format {
        return Ok(format);
    }
    let out = args.place();
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
