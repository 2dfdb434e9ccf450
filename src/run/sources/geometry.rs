//! Cameras, depth and points.
use super::table::{Build, Kind, NO_CHECK, PosedPhotos, Source};
use crate::Result;
use crate::format::cameras;
use crate::infer::Role;
use crate::infer::installed::{Duty, Installed};
use crate::photo::Photo;
use crate::run::stages::{CameraSource, Cameras, Depth};

/// `--init`
pub struct Geometry;

impl Kind for Geometry {
    const OPTION: &'static str = "init";
    const ABOUT: &'static str = "Cameras and points";
    const DUTY: Duty = Duty::Geometry;
    const SOURCES: &'static [Source<Self>] = &[
        Source {
            name: "sfm",
            argument: None,
            about: "",
            needs: &[Role::Keypoints],
            check: NO_CHECK,
            make: |_, (build, photos)| build.posed(photos, CameraSource::Sfm),
        },
        Source {
            name: "cameras",
            argument: Some("FILE"),
            about: "transforms.json, COLMAP folder, cameras.json",
            needs: &[Role::Keypoints],
            check: NO_CHECK,
            make: |file, (build, photos)| build.posed(photos, CameraSource::Known(cameras::read(file)?)),
        },
    ];
    type Input<'i> = (&'i mut Build, Vec<Photo>);
    type Output = PosedPhotos;

    fn network(model: Installed, (build, photos): Self::Input<'_>) -> Result<PosedPhotos> {
        build.posed(photos, CameraSource::Network(model))
    }
}

impl Build {
    /// Photos with cameras from anywhere, and depth by stereo where a network has not given it.
    pub fn posed(&mut self, photos: Vec<Photo>, source: CameraSource) -> Result<PosedPhotos> {
        let placed = self.graph.add(Cameras::new(photos, source, self.seed)?, ());
        let geometry = self.graph.add(Depth { preset: self.preset, seed: self.seed }, (placed,));
        Ok(PosedPhotos { placed, geometry })
    }
}
