//! Preview of a scene whose splats are still being trained: the points of stereo as splats.
use super::stages::PlacedPhotos;
use crate::Result;
use crate::files::Partial;
use crate::fit::init::splats_from_points;
use crate::fit::{InitOptions, RgbOptions};
use crate::format::Workspace;
use crate::format::scene_dir::{self, Contents};
use crate::pose::Geometry;
use crate::progress::Progress;
use crate::report::shell_quoted;
use crate::scene::{Seen, World};
use std::path::{Path, PathBuf};

/// Opacity of a splat: training starts from transparent ones, which look like fog.
const OPACITY: f32 = 0.95;
/// Size of a splat against training, which closes the gaps itself.
const GROWTH: f32 = 1.5;

/// Place of the preview of a run.
#[derive(Clone, Debug)]
pub struct Preview {
    /// Folder of the preview, inside the hidden folder of the scene: it goes with it.
    folder: PathBuf,
    /// Place of the finished scene, for the message.
    scene: PathBuf,
}

impl Preview {
    /// Preview of the scene that `workspace` writes to `scene`.
    pub(super) fn of(workspace: &Workspace, scene: &Path) -> Preview {
        Preview { folder: workspace.preview(), scene: scene.to_path_buf() }
    }

    /// Writes the preview, whole or not at all, and says how to look at it. A failure costs the run
    /// nothing but the preview.
    pub(super) fn show(
        &self,
        placed: &PlacedPhotos,
        geometry: &Geometry,
        options: &RgbOptions,
        progress: &dyn Progress,
    ) {
        match self.write(placed, geometry, options) {
            Ok(()) => progress
                .inform(&format!("look at a preview meanwhile: splatvk view {}", shell_quoted(&self.scene))),
            Err(error) => progress.inform(&format!("no preview: {error}")),
        }
    }

    fn write(&self, placed: &PlacedPhotos, geometry: &Geometry, options: &RgbOptions) -> Result<()> {
        let InitOptions { footprint, neighbours, .. } = options.init;
        let init = InitOptions {
            opacity: OPACITY,
            footprint: GROWTH * footprint,
            neighbours: GROWTH * neighbours,
            ..options.init
        };
        let splats = splats_from_points(&geometry.points, &init, options.seed)?;
        let written = self.folder.with_extension("part");
        crate::format::create_folder(&written)?;
        let contents = Contents {
            splats: &splats,
            seen: &Seen::default(),
            backdrop: &Default::default(),
            cameras: &geometry.cameras,
            world: &World::default(),
            photos: &placed.photos,
            points: None,
            language: None,
            text_embeddings: None,
        };
        scene_dir::write(&written, &contents)?;
        std::fs::rename(&written, &self.folder).map_err(crate::Error::io(&self.folder))
    }
}

/// Preview of the scene that a running process writes to `scene`.
pub fn of_running(scene: &Path) -> Option<PathBuf> {
    Partial::preview_of_running(scene)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;
    use crate::run::stages::{KnownGeometry, PlacedPhotos};
    use crate::scene::{PointCloud, RgbImage, seeded};

    #[test]
    fn preview_is_a_scene_until_its_workspace_ends() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("a scene");
        let image = RgbImage { width: 64, height: 64, data: vec![[0.5; 3]; 64 * 64] };
        let photo = crate::photo::from_pixels("a.png".as_ref(), &image, None, 64).unwrap();
        let (splats, camera) = seeded::small(40, 64, 64, 0, 3);
        let points = PointCloud {
            positions: splats.means.clone(),
            colours: vec![[0.2, 0.4, 0.6]; splats.len()],
            ..PointCloud::default()
        };
        let geometry = Geometry { cameras: vec![camera], points, ..Geometry::default() };
        let known = KnownGeometry::Complete(geometry.clone());
        let placed = PlacedPhotos { photos: vec![photo], left_out: Vec::new(), known };
        for commits in [false, true] {
            let workspace = Workspace::create(&out, false, &[]).unwrap();
            assert_eq!(of_running(&out), None, "nothing before it is written");
            let preview = Preview::of(&workspace, &out);
            preview.show(&placed, &geometry, &RgbOptions::preset(crate::fit::Preset::Draft), &Silent);
            let found = of_running(&out).unwrap();
            let scene = scene_dir::load(&found).unwrap();
            assert_eq!((scene.splats.len(), scene.cameras.len()), (splats.len(), 1));
            assert!(!out.exists() && scene.splats.opacity_logits[0] > 2.0);
            if commits {
                workspace.commit().unwrap();
            } else {
                drop(workspace);
            }
            assert_eq!((of_running(&out), found.exists(), out.exists()), (None, false, commits));
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else stays");
    }
}
