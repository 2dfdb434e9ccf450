//! Names of the files that belong to a camera.
use super::progress;
use crate::format::cameras;
use crate::photo::stems_apart;
use crate::scene::Camera;
use crate::{Error, Result};
use std::path::Path;

/// Reads the cameras of a file as views to render, and prints its warnings.
pub fn read(path: &Path) -> Result<Vec<Camera>> {
    let (cameras, warnings) = cameras::read_file(path)?.pinholes();
    warnings.iter().for_each(|w| progress::print_warning(w));
    Ok(cameras)
}

/// One stem per camera, with parent folders where file names repeat. Two equal names are refused:
/// their files would overwrite each other.
pub fn stems(list: &[Camera]) -> Result<Vec<String>> {
    let stems = stems_apart(&list.iter().map(|c| c.name.as_str()).collect::<Vec<_>>());
    for (i, stem) in stems.iter().enumerate() {
        if stems[..i].contains(stem) {
            return Err(Error::input(format!(
                "two cameras have the name \"{stem}\"; rename one in the camera file"
            )));
        }
    }
    Ok(stems)
}
