//! The content of a camera file.
use crate::scene::{Camera, GivenCamera};

/// What a camera file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraFile {
    /// Its cameras with their lenses; no two have one name.
    pub cameras: Vec<GivenCamera>,
    /// What of the file is not used, for the user.
    pub warnings: Vec<String>,
}

impl From<Vec<GivenCamera>> for CameraFile {
    fn from(cameras: Vec<GivenCamera>) -> CameraFile {
        CameraFile { cameras, warnings: Vec::new() }
    }
}

impl CameraFile {
    /// Cameras for views that are rendered: the pinholes that remain when the lenses are taken out,
    /// and a warning where there are lenses.
    pub fn pinholes(self) -> (Vec<Camera>, Vec<String>) {
        let mut warnings = self.warnings;
        let lensed = self.cameras.iter().filter(|c| !c.lens.is_none()).count();
        if lensed > 0 {
            warnings.push(format!(
                "{lensed} of {} cameras have a lens: what is rendered shows their pinholes, without distortion",
                self.cameras.len()
            ));
        }
        (self.cameras.into_iter().map(|c| c.camera).collect(), warnings)
    }
}
