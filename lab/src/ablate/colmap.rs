//! COLMAP models of a data set: cameras and sparse points in place of dense stereo (the rows "DC."
//! and "SC." of the paper).
use crate::{Error, Result};
use glam::Vec3;
use serde::Serialize;
use splatvk::format::colmap;
use splatvk::photo::stem;
use splatvk::pipeline::{Context, Lane, Output, Stage};
use splatvk::pose::Geometry;
use splatvk::pose::align::pose_errors;
use splatvk::run::points;
use splatvk::scene::{Camera, Similarity};
use std::path::{Path, PathBuf};

/// Photos of a COLMAP model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Views {
    /// All photos of the scene.
    Dense,
    /// The photos of the rows.
    Sparse,
}

impl Views {
    /// Both, in the order of the table.
    pub(super) const ALL: [Views; 2] = [Views::Dense, Views::Sparse];

    /// Name in row labels.
    pub(super) fn name(self) -> &'static str {
        match self {
            Views::Dense => "dense",
            Views::Sparse => "sparse",
        }
    }

    /// Folder of the model in that of the scene.
    pub(super) fn folder(self) -> &'static str {
        match self {
            Views::Dense => "sparse",
            Views::Sparse => "sparse_views",
        }
    }

    /// Folder of the model with points, if the scene has one.
    pub(super) fn model(self, scene: &Path) -> Option<PathBuf> {
        let places = ["0", ""].map(|below| scene.join(self.folder()).join(below));
        let has_points =
            |place: &PathBuf| ["points3D.bin", "points3D.txt"].iter().any(|file| place.join(file).is_file());
        places.into_iter().find(has_points)
    }
}

/// Makes the points of a COLMAP model the start of the splats, without depth maps.
pub(super) struct StartFromPoints {
    /// Folder of the model.
    pub(super) model: PathBuf,
}

impl Stage for StartFromPoints {
    const NAME: &'static str = "points";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Geometry>,);
    type Output = Geometry;

    fn settings(&self) -> String {
        format!("{:?}", self.model)
    }

    fn run(self, (geometry,): (&Geometry,), context: &Context) -> Result<Geometry> {
        let mut cloud = colmap::read_points(&self.model)?;
        let to_scene = self.similarity(&geometry.cameras)?;
        for position in &mut cloud.positions {
            *position = to_scene.transform(Vec3::from(*position).as_dvec3()).as_vec3().to_array();
        }
        let points = points::with_footprints(cloud, &geometry.cameras, context.progress)?;
        Ok(Geometry { points, depths: Vec::new(), ..geometry.clone() })
    }
}

impl StartFromPoints {
    /// Similarity from the world of the model to that of the scene: both have the cameras of the
    /// photos.
    fn similarity(&self, scene: &[Camera]) -> Result<Similarity> {
        let model = colmap::read(&self.model)?;
        let camera_of = |own: &Camera| {
            let found = model.iter().find(|g| stem(&g.camera.name) == stem(&own.name));
            found
                .map(|g| g.camera.clone())
                .ok_or_else(|| Error::input(format!("{}: no camera of {}", self.model.display(), own.name)))
        };
        let model = scene.iter().map(camera_of).collect::<Result<Vec<_>>>()?;
        Ok(pose_errors(&model, scene, 1.0).similarity)
    }
}
