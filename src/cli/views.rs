//! Names of the files that belong to a camera.
use crate::photo::stem;
use crate::scene::Camera;
use crate::{Error, Result};

/// One stem per camera; two cameras of one name would overwrite each other's files.
pub fn stems(list: &[Camera]) -> Result<Vec<String>> {
    let stems: Vec<String> = list.iter().map(|c| stem(&c.name).to_string()).collect();
    for (i, stem) in stems.iter().enumerate() {
        if stems[..i].contains(stem) {
            return Err(Error::input(format!(
                "two cameras have the name \"{stem}\"; rename one in the camera file"
            )));
        }
    }
    Ok(stems)
}
