//! Content of a camera file.
use crate::scene::{Camera, GivenCamera};

/// Cameras of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraFile {
    /// Cameras with their distortion; names are unique.
    pub cameras: Vec<GivenCamera>,
    /// Warnings for the user on parts of the file that are not used.
    pub warnings: Vec<String>,
}

impl From<Vec<GivenCamera>> for CameraFile {
    fn from(cameras: Vec<GivenCamera>) -> CameraFile {
        CameraFile { cameras, warnings: Vec::new() }
    }
}

impl CameraFile {
    /// Cameras for rendered views: the undistorted pinholes, and a warning where there is
    /// distortion.
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
