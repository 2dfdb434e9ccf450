//! Cameras, depth and points.
use super::depth::DepthSources;
use super::table::{self, GraphBuilder, NO_CHECK, PosedPhotos, Source, SourceKind};
use crate::Result;
use crate::format::cameras;
use crate::infer::PackFileKind;
use crate::infer::installed::{Installed, Task};
use crate::photo::Photo;
use crate::run::stages::{CameraOrigin, Cameras, DenseDepth};

/// `--init`
pub struct GeometrySources;

impl SourceKind for GeometrySources {
    const OPTION: &'static str = "init";
    const ABOUT: &'static str = "Cameras and points";
    const TASK: Task = Task::Geometry;
    const SOURCES: &'static [Source<Self>] = &[
        Source {
            name: "sfm",
            argument: None,
            about: "",
            needs: &[PackFileKind::Keypoints],
            check: NO_CHECK,
            make: |_, (build, photos)| build.posed(photos, CameraOrigin::Sfm),
        },
        Source {
            name: "cameras",
            argument: Some("FILE"),
            about: "transforms.json, COLMAP folder, cameras.json",
            needs: &[PackFileKind::Keypoints],
            check: NO_CHECK,
            make: |file, (build, photos)| build.posed(photos, CameraOrigin::Known(cameras::read_file(file)?)),
        },
    ];
    type Input<'i> = (&'i mut GraphBuilder, Vec<Photo>);
    type Output = PosedPhotos;

    fn network(model: Installed, (build, photos): Self::Input<'_>) -> Result<PosedPhotos> {
        build.posed(photos, CameraOrigin::Network(model))
    }
}

impl GraphBuilder {
    /// Adds photos with cameras of any source, and depth by stereo unless a network gives it.
    pub fn posed(&mut self, photos: Vec<Photo>, source: CameraOrigin) -> Result<PosedPhotos> {
        // A network with depth needs no priors.
        let none = table::default::<DepthSources>();
        let choice = if matches!(source, CameraOrigin::Network(_)) { none } else { self.depth_prior.clone() };
        let placed = self.graph.add(Cameras::new(photos, source, self.seed)?, ());
        let registry = self.registry.clone();
        let priors = table::make::<DepthSources>(&choice, &registry, (self, placed))?;
        let geometry = self.graph.add(DenseDepth { preset: self.preset, seed: self.seed }, (placed, priors));
        Ok(PosedPhotos { placed, geometry })
    }
}
