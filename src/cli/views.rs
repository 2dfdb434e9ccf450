//! Names of the files that belong to a camera.
use super::progress;
use crate::format::cameras;
use crate::photo::stems_apart;
use crate::scene::Camera;
use crate::{Error, Result};
use std::path::Path;

/// The cameras of a file as views to render; what of the file is not used is said.
pub fn read(path: &Path) -> Result<Vec<Camera>> {
    let (cameras, warnings) = cameras::read_file(path)?.pinholes();
    warnings.iter().for_each(|w| progress::print_warning(w));
    Ok(cameras)
}

/// One stem per camera, with folders of its name where that of the file is not its own; two of one
/// name would overwrite each other's files.
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
