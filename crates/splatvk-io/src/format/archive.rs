//! Zip archives.
use crate::{Error, Result};
use std::fmt::Display;
use std::io::{Cursor, Write};
use std::path::Path;

/// Writes an archive of named members through memory: with a full disk, a `ZipWriter` continues to
/// write when it is dropped, prints the resulting errors itself, and may panic at an invalid
/// position.
pub(super) fn write(
    path: &Path,
    kind: &str,
    method: zip::CompressionMethod,
    members: impl Iterator<Item = Result<(String, Vec<u8>)>>,
) -> Result<()> {
    let failed =
        |e: &dyn Display| Error::work(format!("{}: cannot write the {kind} file: {e}", path.display()));
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    for member in members {
        let (name, bytes) = member?;
        zip.start_file(name, options).map_err(|e| failed(&e))?;
        zip.write_all(&bytes).map_err(|e| failed(&e))?;
    }
    let bytes = zip.finish().map_err(|e| failed(&e))?.into_inner();
    std::fs::write(path, bytes).map_err(Error::unwritable(path))
}
